//! The state of a submission, computed from its conditions. `status.state` is for people and their selectors: programs compute it, so
//! that a state that was edited decides nothing.
//!
//! Called by everyone who reads a status. Pure.

use crate::conditions::{self, Condition, FINISHED, RUNNING};
use crate::{Attempt, Reason, ReasonName, State, SubmissionStatus};

/// Reasons of `Running` being False for a run whose agents come back.
const BETWEEN_PODS: [Reason; 2] = [Reason::Replacing, Reason::Suspended];

impl SubmissionStatus {
    /// A condition, if it was ever set.
    pub fn condition(&self, type_: &str) -> Option<&Condition> {
        conditions::get(&self.conditions, type_)
    }

    /// True if the condition of this type is set and True.
    pub fn is_true(&self, type_: &str) -> bool {
        conditions::is_true(&self.conditions, type_)
    }

    /// True if this condition shows that a system has the end, or that it gets none.
    pub fn is_delivered(&self, type_: &str) -> bool {
        let found = self.condition(type_);
        let settled = [Reason::NotRequired, Reason::Superseded, Reason::CancelledInEvalAI];
        found.is_some_and(|c| c.is_true() || c.reason.is_one_of(&settled))
    }

    /// The condition of the end that the present attempt has come to.
    pub fn end(&self) -> Option<&Condition> {
        self.condition(FINISHED).filter(|end| end.status == "True")
    }

    /// True if the present attempt has come to its end.
    pub fn has_ended(&self) -> bool {
        self.end().is_some()
    }

    /// True if a requested attempt follows the present one: its number is higher, and the present one is not Finished.
    pub fn is_followed_by(&self, attempt: Attempt) -> bool {
        self.attempt.is_some_and(|present| attempt > present) && self.state_of_conditions() != State::Finished
    }

    /// True for a reason that says no more than the state. The status then has none.
    pub fn repeats(&self, reason: &ReasonName) -> bool {
        self.state_of_conditions().as_str() == reason.as_str()
    }

    /// Why the submission is in its state: the reason of the status, or the state itself where it is a reason of the table.
    pub fn present_reason(&self) -> Option<ReasonName> {
        let of_state = || Reason::of(self.known_state()?.as_str()).map(ReasonName::from);
        self.reason.clone().or_else(of_state)
    }

    /// True if the submission is in its state for this reason.
    pub fn shows(&self, reason: Reason) -> bool {
        self.present_reason().is_some_and(|present| present == reason)
    }

    /// The state; none before the operator has processed the submission.
    pub fn known_state(&self) -> Option<State> {
        self.attempt.map(|_| self.state_of_conditions())
    }

    /// The state that the conditions show.
    pub fn state_of_conditions(&self) -> State {
        let running = self.condition(RUNNING);
        match self.end() {
            Some(end) if end.reason == Reason::Finished => State::Finished,
            Some(_) if self.failure.is_some() => State::Failed,
            Some(_) => State::Cancelled,
            // Once its agents ran it is never Pending again while it has a Job.
            None if running.is_some_and(|c| c.status == "True" || c.reason.is_one_of(&BETWEEN_PODS)) => {
                if self.is_resumed() {
                    State::Resumed
                } else {
                    State::Running
                }
            }
            None => State::Pending,
        }
    }

    /// True if the present attempt takes one of the slots that `concurrency.total` counts. It does from its first Job to its end:
    /// also while a Job starts, and between one that the infrastructure ended and the next.
    pub fn has_slot(&self) -> bool {
        !self.has_ended() && self.has_run()
    }

    /// True if a Job was made for the present attempt. A Job that an infrastructure failure ended counts.
    pub fn has_run(&self) -> bool {
        self.job_name.is_some() || self.retry > 0
    }

    /// True if the present attempt replaces one that ran. No other system got an end in between, so each end that EvalAI
    /// shows is new.
    pub fn is_restart(&self) -> bool {
        let live = self.condition(FINISHED).filter(|finished| finished.status != "True");
        live.is_some_and(|finished| finished.reason == Reason::Replacing)
    }

    /// True if the run continues from stored results.
    pub fn is_resumed(&self) -> bool {
        self.plan.as_ref().is_some_and(|plan| plan.resume) || self.attempt > Some(Attempt::FIRST)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn the_state_follows_the_conditions_whatever_the_stored_one_is() {
        let failure = json!({"class": "Participant", "reason": "AgentCrashed", "message": "It crashed."});
        for (expected, attempt, finished, running, failed) in [
            (State::Pending, 1, None, None, false),
            (
                State::Pending,
                1,
                Some(("False", "Preparing")),
                Some(("False", "Preparing")),
                false,
            ),
            (
                State::Running,
                1,
                Some(("False", "Preparing")),
                Some(("True", "Running")),
                false,
            ),
            (State::Running, 1, None, Some(("False", "Replacing")), false),
            (State::Running, 1, None, Some(("False", "Suspended")), false),
            (State::Resumed, 2, None, Some(("True", "Running")), false),
            // The end counts, although its agents still run.
            (
                State::Finished,
                1,
                Some(("True", "Finished")),
                Some(("True", "Running")),
                false,
            ),
            (
                State::Failed,
                1,
                Some(("True", "AgentCrashed")),
                Some(("False", "Ended")),
                true,
            ),
            (State::Cancelled, 2, Some(("True", "Cancelled")), None, false),
        ] {
            let condition = |type_: &str, (truth, reason): (&str, &str)| {
                json!({"type": type_, "status": truth, "reason": reason, "message": "",
                       "lastTransitionTime": "2026-01-01T00:00:00Z"})
            };
            let conditions = [(FINISHED, finished), (RUNNING, running)];
            let conditions = conditions
                .into_iter()
                .filter_map(|(type_, is)| Some(condition(type_, is?)));
            for stored in ["Pending", "Running", "Resumed", "Finished", "Failed", "Cancelled"] {
                let status = json!({
                    "state": stored, "attempt": attempt, "conditions": conditions.clone().collect::<Vec<_>>(),
                    "failure": failed.then_some(&failure),
                });
                let status: SubmissionStatus = serde_json::from_value(status).unwrap();
                assert_eq!(status.state_of_conditions(), expected, "{stored}: {status:?}");
            }
        }
    }
}
