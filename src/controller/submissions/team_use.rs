//! How many GPU seconds the teams of a Leaderboard have used. Pure; the reconcile of a Leaderboard shows it.

use std::cmp::Reverse;
use std::collections::BTreeMap;
use std::sync::Arc;

use leaderboard_api::{MAX_USING_TEAMS, Submission, TeamUse};

/// The teams that have used the most, the most first.
pub fn teams(all: &[Arc<Submission>]) -> Vec<TeamUse> {
    let mut sums: BTreeMap<&str, i64> = BTreeMap::new();
    for one in all {
        if let (Some(team), used @ 1..) = (one.team(), gpu_seconds(one)) {
            let sum = sums.entry(team).or_default();
            *sum = sum.saturating_add(used);
        }
    }
    let mut found: Vec<TeamUse> = sums
        .into_iter()
        .map(|(team, gpu_seconds)| TeamUse {
            team: team.to_owned(),
            gpu_seconds,
        })
        .collect();
    found.sort_by_key(|team| Reverse(team.gpu_seconds));
    found.truncate(MAX_USING_TEAMS);
    found
}

/// What the Jobs of a submission have used.
pub fn gpu_seconds(submission: &Submission) -> i64 {
    let usage = submission.status.as_ref().and_then(|status| status.usage);
    usage.map_or(0, |usage| usage.gpu_seconds)
}

#[cfg(test)]
mod tests {
    use leaderboard_api::{SubmissionStatus, Use};
    use serde_json::json;

    use super::*;

    fn used(team: &str, gpu_seconds: i64) -> Arc<Submission> {
        let spec = json!({"leaderboardName": "one", "track": "map", "image": "agent:1", "team": {"id": team}});
        let mut object = Submission::new("one", serde_json::from_value(spec).unwrap());
        object.status = Some(SubmissionStatus {
            usage: Some(Use { gpus: 4, gpu_seconds }),
            ..SubmissionStatus::default()
        });
        Arc::new(object)
    }

    #[test]
    fn the_teams_that_have_used_the_most_come_first_and_no_more_than_ten() {
        let sums = |all: &[Arc<Submission>]| -> Vec<(String, i64)> {
            teams(all)
                .into_iter()
                .map(|team| (team.team, team.gpu_seconds))
                .collect()
        };
        let found = sums(&[used("b", 5), used("a", 3), used("b", 7), used("c", 0), used("d", 12)]);
        assert_eq!(found, [("b".into(), 12), ("d".into(), 12), ("a".into(), 3)]);
        let many: Vec<_> = (1..=30).map(|number| used(&format!("team-{number}"), number)).collect();
        assert_eq!(sums(&many).len(), MAX_USING_TEAMS);
        assert_eq!(sums(&many)[0], ("team-30".into(), 30));
    }
}
