//! How often the simulators of a team have failed. Pure.

use jiff::{SignedDuration, Timestamp};
use kube::ResourceExt;

use leaderboard_api::{Submission, conditions, reasons};

/// How long an ended submission counts.
const COUNTED: SignedDuration = SignedDuration::from_hours(24);

/// Other submissions of the same team and Leaderboard that ended because of their simulators, within a day.
pub fn simulator_failures<'a>(
    all: impl IntoIterator<Item = &'a Submission>,
    submission: &Submission,
    now: Timestamp,
) -> usize {
    let Some(team) = submission.team() else { return 0 };
    let is_counted = |other: &&Submission| {
        other.namespace() == submission.namespace()
            && other.spec.leaderboard_name == submission.spec.leaderboard_name
            && other.uid() != submission.uid()
            && other.team() == Some(team)
            && ended_by_its_simulator(other, now)
    };
    all.into_iter().filter(is_counted).count()
}

fn ended_by_its_simulator(submission: &Submission, now: Timestamp) -> bool {
    let Some(status) = &submission.status else { return false };
    let is_finished = conditions::is_true(&status.conditions, conditions::FINISHED);
    let is_recent = |at: Timestamp| now.duration_since(at) < COUNTED;
    let failure = status.failure.as_ref().filter(|_| is_finished);
    failure.is_some_and(|failure| failure.reason == reasons::SIMULATION_CRASHED)
        && status.times.finished.as_ref().is_some_and(|at| is_recent(at.0))
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
        assert_eq!(simulator_failures(&all, &all[0], now), 1);
        let mut nobodys = all[0].clone();
        nobodys.spec.team = None;
        assert_eq!(simulator_failures(&all, &nobodys, now), 0);
    }
}
