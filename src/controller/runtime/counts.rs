//! Joins the controller's parts to the process's metrics: loads and states every few seconds.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use crate::kubernetes::Store;
use crate::observability::Observability;
use crate::services::evalai::Hub;
use leaderboard_api::{Leaderboard, State, Submission};

/// How often what is not an event is counted: more often than anybody scrapes.
const EVERY: Duration = Duration::from_secs(5);
/// So many failures in a row are worth a host's look.
const REPEATED: i32 = 3;
/// All states, so that one without submissions says 0.
const STATES: [State; 6] = [
    State::Pending,
    State::Running,
    State::Resumed,
    State::Finished,
    State::Failed,
    State::Cancelled,
];

/// Keeps gauges true until the stop.
pub(super) async fn keep(
    hub: Hub,
    leaderboards: Store<Leaderboard>,
    submissions: Store<Submission>,
    telemetry: Observability,
) {
    let mut tick = tokio::time::interval(EVERY);
    loop {
        tokio::select! { _ = tick.tick() => {}, () = telemetry.stop.wait() => return }
        let (used, waiting) = hub.load();
        telemetry.metrics.set_evalai_load(used, waiting);
        for (state, count) in states(&submissions.state()) {
            telemetry.metrics.set_submissions(state, count);
        }
        telemetry
            .metrics
            .set_repeating_teams(repeating_teams(&leaderboards.state()));
    }
}

/// Teams that have had this often in a row what an agent can cause, by the statuses of the Leaderboards.
fn repeating_teams(leaderboards: &[Arc<Leaderboard>]) -> usize {
    let statuses = leaderboards
        .iter()
        .filter_map(|leaderboard| leaderboard.status.as_ref());
    let teams = statuses.flat_map(|status| &status.infrastructure_failures);
    teams.filter(|team| team.number >= REPEATED).count()
}

fn states(submissions: &[Arc<Submission>]) -> BTreeMap<&'static str, usize> {
    let mut counts: BTreeMap<_, _> = STATES.iter().map(|state| (state.as_str(), 0)).collect();
    for submission in submissions {
        let state = submission
            .status
            .as_ref()
            .and_then(|s| s.state)
            .unwrap_or(State::Pending);
        *counts.entry(state.as_str()).or_default() += 1;
    }
    counts
}

#[cfg(test)]
mod tests {
    use super::*;
    use leaderboard_api::{SubmissionSpec, SubmissionStatus};

    #[test]
    fn every_state_is_counted_also_with_nobody_in_it() {
        let spec: SubmissionSpec =
            serde_json::from_value(serde_json::json!({"leaderboardName": "one", "track": "map", "image": "agent:1"}))
                .unwrap();
        let submission = |state| {
            let status = SubmissionStatus {
                state,
                ..SubmissionStatus::default()
            };
            let mut object = Submission::new("one", spec.clone());
            object.status = Some(status);
            Arc::new(object)
        };
        let found = states(&[
            submission(None),
            submission(Some(State::Failed)),
            submission(Some(State::Failed)),
        ]);
        let expected = [
            ("Cancelled", 0),
            ("Failed", 2),
            ("Finished", 0),
            ("Pending", 1),
            ("Resumed", 0),
            ("Running", 0),
        ];
        assert_eq!(found, expected.into());
    }
}
