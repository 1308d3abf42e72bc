//! The Submissions of a Leaderboard in numbers, as the cache shows them. Pure.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};
use std::hash::{DefaultHasher, Hash, Hasher};

use leaderboard_api::leaderboard::Counts;
use leaderboard_api::standings::is_candidate;
use leaderboard_api::{MAX_USING_TEAMS, Reason, State, Submission, SubmissionStatus, TeamUse, conditions};

/// Checks are in no count.
#[derive(Debug, Default, PartialEq)]
pub struct Census {
    pub counts: Counts,
    /// Submissions that are live, or whose end is not yet published and recorded.
    pub in_use: usize,
    /// Changes when a result that ranks comes, goes or changes.
    pub results: u64,
    /// GPU seconds of each team that has used any.
    teams: BTreeMap<String, i64>,
    /// The teams of those whose images cannot be pulled at present, by the names of the submissions.
    unpulled: BTreeMap<String, Option<String>>,
}

impl Census {
    pub fn of<'a>(submissions: impl IntoIterator<Item = &'a Submission>) -> Self {
        let mut census = Self::default();
        for submission in submissions {
            census.add(submission);
        }
        census
    }

    pub fn add(&mut self, submission: &Submission) {
        let status = submission.status.as_ref();
        self.in_use += usize::from(status.is_none_or(needs_leaderboard));
        let used = status
            .and_then(|status| status.usage)
            .map_or(0, |usage| usage.gpu_seconds);
        if let Some(team) = submission.team().filter(|_| used > 0) {
            let sum = self.teams.entry(team.to_owned()).or_default();
            *sum = sum.saturating_add(used);
        }
        if status.is_some_and(lacks_image) {
            let name = submission.metadata.name.clone().unwrap_or_default();
            self.unpulled.insert(name, submission.team().map(str::to_owned));
        }
        if submission.spec.check {
            return;
        }
        self.results = self.results.wrapping_add(mark(submission));
        let counts = &mut self.counts;
        let count = match status.map_or(State::Pending, SubmissionStatus::state_of_conditions) {
            State::Pending => &mut counts.pending,
            State::Running | State::Resumed => &mut counts.running,
            State::Finished => &mut counts.finished,
            State::Failed => &mut counts.failed,
            State::Cancelled => &mut counts.cancelled,
        };
        *count += 1;
    }

    /// The teams that have used the most GPU seconds, the most first.
    pub fn gpu_use(&self) -> Vec<TeamUse> {
        let mut teams: Vec<_> = self.teams.iter().collect();
        teams.sort_by_key(|(_, gpu_seconds)| Reverse(**gpu_seconds));
        let most = teams.into_iter().take(MAX_USING_TEAMS);
        let shown = most.map(|(team, gpu_seconds)| TeamUse {
            team: team.clone(),
            gpu_seconds: *gpu_seconds,
        });
        shown.collect()
    }

    /// A note about images that several teams lack: the nodes are the likeliest cause.
    pub fn image_note(&self) -> Option<String> {
        let teams: BTreeSet<_> = self.unpulled.values().collect();
        let (first, _) = self.unpulled.first_key_value()?;
        (teams.len() > 1).then(|| {
            format!(
                "Images of {} teams cannot be pulled, such as that of {first}: look at the rights of the nodes in the registry, and at their \
                 way to it.",
                teams.len()
            )
        })
    }
}

/// Zero for a Submission that does not rank.
fn mark(submission: &Submission) -> u64 {
    if !is_candidate(submission) {
        return 0;
    }
    let mut hasher = DefaultHasher::new();
    let status = submission.status.as_ref();
    submission.metadata.uid.hash(&mut hasher);
    status
        .and_then(|status| status.score.as_ref())
        .map(|score| &score.value)
        .hash(&mut hasher);
    submission.team().hash(&mut hasher);
    hasher.finish()
}

fn lacks_image(status: &SubmissionStatus) -> bool {
    !status.has_ended() && status.shows(Reason::ImagePull)
}

fn needs_leaderboard(status: &SubmissionStatus) -> bool {
    let waits = |type_: &str| status.condition(type_).is_some() && !status.is_delivered(type_);
    !status.has_ended() || waits(conditions::PUBLISHED) || waits(conditions::RECORDED)
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::*;

    fn submission(name: &str, is_check: bool, status: &Value) -> Submission {
        let object = json!({
            "apiVersion": "leaderboard.carla.org/v1alpha1", "kind": "Submission", "metadata": {"name": name},
            "spec": {"leaderboardName": "lb", "image": "i", "track": "sensors", "check": is_check}, "status": status,
        });
        serde_json::from_value(object).unwrap()
    }

    fn condition(type_: &str, status: &str, reason: &str) -> Value {
        json!({"type": type_, "status": status, "reason": reason, "message": "", "lastTransitionTime": "2026-01-01T00:00:00Z"})
    }

    #[test]
    fn submissions_are_counted_by_their_conditions_and_not_by_the_stored_state() {
        let finished = |published: &str| {
            let conditions = [
                condition("Finished", "True", "Finished"),
                condition("Published", published, "R"),
            ];
            submission("a", false, &json!({"state": "Pending", "conditions": conditions}))
        };
        let running = json!({"state": "Finished", "conditions": [condition("Running", "True", "Running")]});
        let all = [
            submission("new", false, &Value::Null),
            submission("runs", false, &running),
            finished("False"),
            finished("True"),
            submission("checks", true, &running),
        ];
        let found = Census::of(&all);
        let counts = &found.counts;
        assert_eq!((counts.pending, counts.running, counts.finished), (1, 1, 2));
        assert_eq!(found.in_use, 4, "one end is not published yet, and a check runs");
        assert_eq!(Census::of([]), Census::default());
    }

    #[test]
    fn the_mark_of_the_results_moves_with_each_result_that_ranks_and_with_nothing_else() {
        let one = |name: &str, score: &str, ends: &str, published: &str| {
            let conditions = [
                condition("Finished", "True", ends),
                condition("Published", "False", published),
            ];
            let score = json!({"name": "Driving score", "value": score, "text": score, "final": true});
            let mut one = submission(name, false, &json!({"score": score, "conditions": conditions}));
            one.metadata.uid = Some(name.into());
            one
        };
        let mark = |all: &[Submission]| Census::of(all).results;
        let (a, b) = (
            one("a", "1", "Finished", "Waiting"),
            one("b", "2", "Finished", "Waiting"),
        );
        let both = mark(&[a.clone(), b.clone()]);
        assert_eq!(mark(&[b.clone(), a.clone()]), both, "in any order");
        for other in [
            one("a", "1.5", "Finished", "Waiting"),
            one("a", "1", "Finished", "CancelledInEvalAI"),
            one("c", "1", "Finished", "Waiting"),
        ] {
            assert_ne!(mark(&[other, b.clone()]), both);
        }
        let running = json!({"conditions": [condition("Running", "True", "Running")]});
        assert_eq!(mark(&[a.clone(), b.clone(), submission("r", false, &running)]), both);
        assert_eq!(
            mark(&[one("a", "1", "Finished", "Refused"), b]),
            both,
            "the result is the same"
        );
        assert_eq!(mark(&[one("a", "1", "Cancelled", "Waiting")]), 0);
    }

    #[test]
    fn the_teams_that_have_used_the_most_come_first_and_no_more_than_ten() {
        let used = |team: &str, gpu_seconds: i64| {
            let status = json!({"use": {"gpus": 4, "gpuSeconds": gpu_seconds}, "team": {"name": team}});
            submission("one", false, &status)
        };
        let sums = |all: &[Submission]| -> Vec<(String, i64)> {
            let found = Census::of(all).gpu_use().into_iter();
            found.map(|team| (team.team, team.gpu_seconds)).collect()
        };
        let all = [("b", 5), ("a", 3), ("b", 7), ("c", 0), ("d", 12)].map(|(team, seconds)| used(team, seconds));
        assert_eq!(sums(&all), [("b".into(), 12), ("d".into(), 12), ("a".into(), 3)]);
        let many: Vec<_> = (1..=30)
            .map(|seconds| used(&format!("team-{seconds}"), seconds))
            .collect();
        let sums = sums(&many);
        assert_eq!((sums.len(), &sums[0]), (MAX_USING_TEAMS, &("team-30".into(), 30)));
    }

    #[test]
    fn a_pull_that_fails_for_two_teams_is_noted_while_they_wait() {
        let one = |name: &str, team: &str, reason: &str, finished: &str| {
            let conditions = [condition("Finished", finished, "R")];
            let status = json!({"attempt": 1, "reason": reason, "conditions": conditions, "team": {"name": team}});
            submission(name, false, &status)
        };
        let lacks = |name: &str, team: &str| one(name, team, "ImagePull", "False");
        let shown = |all: &[Submission]| Census::of(all).image_note();
        let both = [lacks("s-2", "b"), lacks("s-1", "a"), lacks("s-3", "b")];
        let expected = "Images of 2 teams cannot be pulled, such as that of s-1: look at the rights of the nodes in the registry, and \
                        at their way to it.";
        assert_eq!(shown(&both).as_deref(), Some(expected));
        for other in [
            lacks("s-2", "a"),
            one("s-2", "b", "Preparing", "False"),
            one("s-2", "b", "ImagePull", "True"),
        ] {
            assert_eq!(shown(&[lacks("s-1", "a"), other]), None);
        }
    }
}
