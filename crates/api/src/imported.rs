//! Submissions whose object lost its status after their end. Pure.

use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;

use crate::conditions::{self, FINISHED, PUBLISHED, RECORDED, Truth};
use crate::{Failure, FailureClass, Progress, Score, SubmissionSpec, SubmissionStatus, TeamStatus, Times, reasons};

/// How a submission ended before its status was lost.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ImportedState {
    Finished,
    Failed,
    Cancelled,
}

/// What the other systems show of a submission that has ended.
#[derive(Clone, Debug, PartialEq)]
pub struct ImportedEnd {
    /// How it ended.
    pub state: ImportedState,
    /// Name of its track.
    pub track: String,
    /// Where its results are.
    pub results_url: Option<String>,
    /// Routes that were done.
    pub progress: Option<Progress>,
    /// Its final scores.
    pub score: Option<Score>,
    /// When it was submitted, started and finished.
    pub times: Times,
    /// Name of the table.
    pub table: String,
}

impl SubmissionStatus {
    /// The status of a submission whose end every system has, for a cause that `what` names.
    pub fn of_ended(spec: &SubmissionSpec, end: ImportedEnd, what: &str, generation: i64, now: &Time) -> Self {
        let (reason, failure) = match end.state {
            ImportedState::Finished => (reasons::FINISHED, None),
            ImportedState::Failed => (reasons::IMPORTED_FAILURE, Some(failure(what))),
            ImportedState::Cancelled => (reasons::CANCELLED, None),
        };
        let mut status = Self {
            observed_generation: Some(generation),
            attempt: Some(spec.attempt),
            reason: Some(reason.into()),
            message: Some(what.into()),
            team: spec.team.clone().map(TeamStatus::from),
            track: Some(end.track),
            progress: end.progress,
            score: end.score,
            results_url: end.results_url,
            failure: failure.map(Box::new),
            ..Self::default()
        };
        let ended = end.times.finished.clone().unwrap_or_else(|| now.clone());
        status.times = Times {
            finished: Some(ended.clone()),
            ..end.times
        };
        for (type_, truth, reason, message) in [
            (FINISHED, Truth::True, reason, what),
            (PUBLISHED, Truth::False, reasons::NOT_REQUIRED, ""),
            (RECORDED, Truth::True, reasons::RECORDED, ""),
        ] {
            let conditions = &mut status.conditions;
            conditions::set(conditions, type_, truth, reason, message, Some(generation), &ended);
        }
        status.state = Some(status.state_of_conditions());
        status.fit();
        status
    }
}

fn failure(what: &str) -> Failure {
    let next_step = reasons::after_failure(reasons::IMPORTED_FAILURE).map(reasons::plain);
    Failure {
        class: FailureClass::Infrastructure,
        reason: reasons::IMPORTED_FAILURE.to_owned(),
        message: format!("{what} {}", next_step.clone().unwrap_or_default())
            .trim_end()
            .to_owned(),
        next_step,
        participant_message: None,
        pair: None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Attempt, State};
    use jiff::Timestamp;
    use serde_json::json;

    fn spec() -> SubmissionSpec {
        let spec = json!({"leaderboardName": "lb", "evalai": {"challenge": 1, "phase": 2, "submission": 77},
                          "team": {"id": "7", "name": "Team Seven"}, "attempt": 2});
        serde_json::from_value(spec).unwrap()
    }

    fn end(state: ImportedState) -> ImportedEnd {
        ImportedEnd {
            state,
            track: "sensors".into(),
            results_url: None,
            progress: None,
            score: None,
            times: Times::default(),
            table: "leaderboard-20".into(),
        }
    }

    #[test]
    fn the_state_is_that_of_the_end() {
        let now = Time(Timestamp::UNIX_EPOCH);
        for (state, shown) in [
            (ImportedState::Finished, State::Finished),
            (ImportedState::Failed, State::Failed),
            (ImportedState::Cancelled, State::Cancelled),
        ] {
            let status = SubmissionStatus::of_ended(&spec(), end(state), "It had ended.", 1, &now);
            assert_eq!((status.state, status.attempt), (Some(shown), Some(Attempt(2))));
            assert_eq!(status.state_of_conditions(), shown);
            assert_eq!(status.failure.is_some(), shown == State::Failed);
            let is_theirs = |failure: Box<Failure>| failure.class == FailureClass::Participant;
            assert!(!status.failure.is_some_and(is_theirs));
        }
    }
}
