//! How many GPU seconds the teams of each Leaderboard have used. Pure but for its lock.
//!
//! The cache of Submissions reports each change, so that no reconcile of a Leaderboard walks through all that have ended.

use std::cmp::Reverse;
use std::collections::{BTreeMap, HashMap};
use std::sync::{Arc, Mutex};

use crate::lock::lock;
use leaderboard_api::{Leaderboard, MAX_USING_TEAMS, Submission, TeamUse};

/// Namespace and name of a Leaderboard.
type Board = (String, String);

/// The GPU seconds of each team that has used any. Clones are the same.
#[derive(Clone, Default)]
pub struct Teams(Arc<Mutex<HashMap<Board, BTreeMap<String, i64>>>>);

impl Teams {
    /// The cache has changed.
    pub fn changed(&self, before: Option<&Submission>, now: Option<&Submission>) {
        let (before, now) = (before.and_then(used), now.and_then(used));
        if before == now {
            return;
        }
        let mut boards = lock(&self.0);
        let before = before.map(|(board, team, seconds)| (board, team, -seconds));
        for (board, team, seconds) in before.into_iter().chain(now) {
            let teams = boards.entry(board.clone()).or_default();
            let sum = teams.get(&team).map_or(seconds, |sum| sum.saturating_add(seconds));
            if sum > 0 {
                teams.insert(team, sum);
            } else {
                teams.remove(&team);
            }
            if teams.is_empty() {
                boards.remove(&board);
            }
        }
    }

    /// The teams of a Leaderboard that have used the most, the most first.
    pub fn gpu_use(&self, leaderboard: &Leaderboard) -> Vec<TeamUse> {
        let meta = &leaderboard.metadata;
        let board = (
            meta.namespace.clone().unwrap_or_default(),
            meta.name.clone().unwrap_or_default(),
        );
        let boards = lock(&self.0);
        let mut found: Vec<(&String, &i64)> = boards.get(&board).into_iter().flatten().collect();
        found.sort_by_key(|(_, gpu_seconds)| Reverse(**gpu_seconds));
        found.truncate(MAX_USING_TEAMS);
        let shown = found.into_iter().map(|(team, gpu_seconds)| TeamUse {
            team: team.clone(),
            gpu_seconds: *gpu_seconds,
        });
        shown.collect()
    }
}

/// What the Jobs of a submission have used, and for whom.
fn used(submission: &Submission) -> Option<(Board, String, i64)> {
    let usage = submission
        .status
        .as_ref()?
        .usage
        .filter(|usage| usage.gpu_seconds > 0)?;
    let namespace = submission.metadata.namespace.clone().unwrap_or_default();
    let board = (namespace, submission.spec.leaderboard_name.clone());
    Some((board, submission.team()?.to_owned(), usage.gpu_seconds))
}

#[cfg(test)]
mod tests {
    use leaderboard_api::Use;
    use serde_json::json;

    use super::*;

    fn used(name: &str, team: &str, gpu_seconds: i64) -> Submission {
        let object = json!({
            "apiVersion": "leaderboard.carla.org/v1alpha1", "kind": "Submission",
            "metadata": {"name": name, "namespace": "n", "uid": name},
            "spec": {"leaderboardName": "lb", "image": "r/i:1", "team": {"name": team}},
            "status": {"use": Use { gpus: 4, gpu_seconds }},
        });
        serde_json::from_value(object).unwrap()
    }

    /// As the cache shows these Submissions.
    fn shown(all: &[Submission]) -> Teams {
        let teams = Teams::default();
        for one in all {
            teams.changed(None, Some(one));
        }
        teams
    }

    fn sums(teams: &Teams) -> Vec<(String, i64)> {
        let mut board = crate::controller::fixtures::leaderboard("lb", "http://127.0.0.1:9");
        board.metadata.namespace = Some("n".into());
        let found = teams.gpu_use(&board).into_iter();
        found.map(|team| (team.team, team.gpu_seconds)).collect()
    }

    #[test]
    fn the_teams_that_have_used_the_most_come_first_and_no_more_than_ten() {
        let all = [("b", 5), ("a", 3), ("b", 7), ("c", 0), ("d", 12)];
        let all = all.map(|(team, seconds)| used(&format!("{team}-{seconds}"), team, seconds));
        assert_eq!(
            sums(&shown(&all)),
            [("b".into(), 12), ("d".into(), 12), ("a".into(), 3)]
        );
        let many: Vec<_> = (1..=30)
            .map(|seconds| used(&format!("s{seconds}"), &format!("team-{seconds}"), seconds))
            .collect();
        let sums = sums(&shown(&many));
        assert_eq!((sums.len(), &sums[0]), (MAX_USING_TEAMS, &("team-30".into(), 30)));
    }

    #[test]
    fn whatever_changes_the_sums_are_those_of_what_is_there() {
        let before = [used("one", "a", 10), used("two", "a", 20), used("three", "b", 5)];
        let teams = shown(&before);
        let more = used("one", "a", 15);
        teams.changed(Some(&before[0]), Some(&more));
        teams.changed(Some(&before[2]), None);
        assert_eq!(sums(&teams), [("a".into(), 35)]);
        let moved = used("two", "c", 20);
        teams.changed(Some(&before[1]), Some(&moved));
        assert_eq!(sums(&teams), [("c".into(), 20), ("a".into(), 15)]);
        teams.changed(Some(&moved), None);
        teams.changed(Some(&more), None);
        assert!(lock(&teams.0).is_empty(), "nothing is left of what is gone");
    }
}
