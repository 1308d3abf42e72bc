//! The state of a submission, computed from its conditions. It is for people: no decision reads the stored one.

use leaderboard_api::conditions::{self, FINISHED, RUNNING};
use leaderboard_api::{State, SubmissionStatus, reasons};

/// The state that a status shows.
pub(super) fn of(status: &SubmissionStatus) -> State {
    let end = conditions::get(&status.conditions, FINISHED).filter(|c| c.status == "True");
    let running = conditions::get(&status.conditions, RUNNING);
    match end {
        Some(end) if end.reason == reasons::FINISHED => State::Finished,
        Some(_) if status.failure.is_some() => State::Failed,
        Some(_) => State::Cancelled,
        // Once its agents ran it is never Pending again while it has a Job.
        None if running.is_some_and(|c| c.status == "True" || c.reason == reasons::REPLACING) => {
            if is_resumed(status) {
                State::Resumed
            } else {
                State::Running
            }
        }
        None => State::Pending,
    }
}

/// Whether its run continues from stored results.
pub(super) fn is_resumed(status: &SubmissionStatus) -> bool {
    status.plan.as_ref().is_some_and(|plan| plan.resume) || status.attempt > Some(1)
}
