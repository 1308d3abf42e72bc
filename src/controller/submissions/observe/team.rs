//! How often the simulators of a team have failed. Pure.

use std::sync::Arc;

use jiff::{SignedDuration, Timestamp};

use crate::kubernetes::Store;
use leaderboard_api::{Submission, conditions, reasons};

/// How long an ended submission counts.
const COUNTED: SignedDuration = SignedDuration::from_hours(24);

/// Other submissions of the same team and Leaderboard that ended because of their simulators, within a day.
pub fn simulator_failures(all: &Store<Submission>, submission: &Submission, now: Timestamp) -> usize {
    let Some(key) = key(submission) else { return 0 };
    let is_counted = |other: &&Arc<Submission>| {
        let finished = other.status.as_ref().and_then(|status| status.times.finished.as_ref());
        let is_recent = finished.is_some_and(|at| now.duration_since(at.0) < COUNTED);
        is_recent && other.metadata.uid != submission.metadata.uid
    };
    all.indexed(&key).iter().filter(is_counted).count()
}

/// By what the cache finds those that ended because of their simulators.
pub fn index(submission: &Submission) -> Option<String> {
    let status = submission.status.as_ref()?;
    let failure = status.failure.as_ref()?;
    let is_finished = conditions::is_true(&status.conditions, conditions::FINISHED);
    let is_counted = is_finished && failure.reason == reasons::SIMULATION_CRASHED;
    is_counted.then(|| key(submission)).flatten()
}

/// Its namespace, Leaderboard and team, if it has one.
fn key(submission: &Submission) -> Option<String> {
    let namespace = submission.metadata.namespace.as_deref().unwrap_or_default();
    let leaderboard = &submission.spec.leaderboard_name;
    submission
        .team()
        .map(|team| format!("{namespace}/{leaderboard}/{team}"))
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::*;

    fn submission(name: &str, team: &str, leaderboard: &str, reason: &str, finished: &str) -> Submission {
        let condition = json!({"type": "Finished", "status": "True", "reason": reason, "message": "",
                               "lastTransitionTime": finished});
        let object: Value = json!({
            "apiVersion": "leaderboard.carla.org/v1alpha1", "kind": "Submission",
            "metadata": {"name": name, "namespace": "n", "uid": name},
            "spec": {"leaderboardName": leaderboard, "image": "r/i:1", "team": {"id": team}},
            "status": {
                "failure": {"class": "Infrastructure", "reason": reason, "message": "m", "charged": false},
                "times": {"finished": finished}, "conditions": [condition],
            },
        });
        serde_json::from_value(object).unwrap()
    }

    #[test]
    fn only_recent_ends_by_a_simulator_of_the_same_team_and_leaderboard_count() {
        let (crashed, now) = (reasons::SIMULATION_CRASHED, "2026-01-02T00:00:00Z".parse().unwrap());
        let recent = "2026-01-01T12:00:00Z";
        let mut under_way = submission("f", "t1", "lb", crashed, recent);
        under_way.status.as_mut().unwrap().conditions.clear();
        let all = [
            submission("own", "t1", "lb", crashed, recent),
            submission("a", "t1", "lb", crashed, recent),
            submission("b", "t2", "lb", crashed, recent),
            submission("c", "t1", "other", crashed, recent),
            submission("d", "t1", "lb", reasons::NODE_LOST, recent),
            submission("e", "t1", "lb", crashed, "2025-12-31T23:00:00Z"),
            under_way,
        ];
        let own = all[0].clone();
        let cache = Store::of(all, index);
        assert_eq!(simulator_failures(&cache, &own, now), 1);
        let mut nobodys = own;
        nobodys.spec.team = None;
        assert_eq!(simulator_failures(&cache, &nobodys, now), 0);
    }
}
