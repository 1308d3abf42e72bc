//! Infrastructure failures that an agent can provoke: it can crash its host's container, store more than its time allows, fill a disk, use up its
//! node, or be an image that no node takes. They are charged to nobody, so each further Job has to be earned.
//!
//! Called by `end`. An attempt alone decides, and no earlier one: the first such failure gets another Job, on another node where there is
//! one. After a further one a Job follows only if the Job before it has finished a unit of work.

use super::status::PlanBuilder;
use crate::controller::submissions::report_digest::clamp;
use leaderboard_api::{Failure, FailureClass, reasons};

/// An announced end of a node is `NodeInterrupted`, which no agent can provoke.
const REASONS: [&str; 8] = [
    reasons::SIMULATION_CRASHED,
    reasons::RESULTS_NOT_STORED,
    reasons::JOB_FAILED,
    reasons::CANNOT_START,
    reasons::NODE_CANNOT_START,
    reasons::NODE_LOST,
    reasons::DISK_FULL,
    reasons::IMAGE_PULL,
];

/// Added to the words of a failure that gets no further Job because of the rule.
const NO_ROUTE: &str =
    "The attempt had such an end before, and this Job has finished no route, so no further Job follows.";

/// Whether an agent can have provoked a failure.
pub(super) fn is_one(found: &Failure) -> bool {
    // A pull of the hosts' own images belongs to no worker.
    let is_of_hosts = found.reason == reasons::IMAGE_PULL && found.worker.is_none();
    found.class == FailureClass::Infrastructure && !is_of_hosts && REASONS.contains(&found.reason.as_str())
}

/// Whether the rule leaves another Job: `before` has the units that were stored when the failed Job was due, None for the attempt's first
/// such failure; `stored` those that are stored by now.
pub(super) fn may_go_on(found: &Failure, before: Option<i32>, stored: i32) -> bool {
    !is_one(found) || before.is_none_or(|before| stored > before)
}

/// The same for the present Job.
pub(super) fn leaves_a_job(draft: &PlanBuilder<'_>, found: &Failure) -> bool {
    may_go_on(found, draft.status.done_before, stored(draft))
}

/// Notes what the next Job begins with.
pub(super) fn note(draft: &mut PlanBuilder<'_>, found: &Failure) {
    if is_one(found) || draft.status.done_before.is_some() {
        draft.status.done_before = Some(stored(draft));
    }
}

/// A failure that ends its attempt, with the rule if that is why.
pub(super) fn explained(draft: &PlanBuilder<'_>, found: Failure) -> Failure {
    if leaves_a_job(draft, &found) {
        return found;
    }
    Failure {
        message: format!("{} {NO_ROUTE}", found.message),
        ..found
    }
}

/// Units of the attempt that are stored. What an earlier attempt has reached counts among them.
fn stored(draft: &PlanBuilder<'_>) -> i32 {
    let reached = draft.status.progress.as_ref().map_or(0, |progress| progress.done);
    draft.view.report.ours().map_or(reached, |report| clamp(report.done))
}
