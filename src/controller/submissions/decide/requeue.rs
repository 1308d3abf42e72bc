//! A host puts a submission back in line: its simulator's image was broken, or its nodes are to be upgraded. A run is stopped as before
//! an interruption, and another Job resumes it when its turn comes. Neither an attempt nor a retry is used up, and the failures of
//! the attempt before it are forgiven: unlike a retry or a resume, only a person with the right to edit Submissions can ask for it.
//!
//! Called by `live` and `end`.

use super::failure::infrastructure;
use super::plan_builder::PlanBuilder;
use leaderboard_api::text::{one_line, sentence};
use leaderboard_api::{Failure, Requeued, reasons};

/// Characters of a host's reason.
const LONGEST: usize = 256;

/// Whether a request has not been carried out yet.
pub(super) fn is_requested(draft: &PlanBuilder<'_>) -> bool {
    wanted(draft) > draft.status.requeued.as_ref().map_or(0, |requeued| requeued.number)
}

fn wanted(draft: &PlanBuilder<'_>) -> i64 {
    draft.spec().requeue.as_ref().map_or(0, |requeue| requeue.number)
}

/// Ends the present Job, unless its run has ended by itself.
pub(super) fn notice(draft: &mut PlanBuilder<'_>) {
    let pod = draft.view.pod.as_ref();
    if is_requested(draft) && pod.is_none_or(|pod| pod.run_ended.is_none()) {
        let found = failure(draft);
        draft.fail(found);
    }
}

/// Carries a request out where there is no Job to end.
pub(super) fn take_up(draft: &mut PlanBuilder<'_>) {
    if is_requested(draft) {
        let what = what(draft);
        note(draft, 0);
        draft.status.next_retry_time = None;
        draft.event(false, reasons::REQUEUED, what);
    }
}

/// Why the present Job ends.
pub(super) fn failure(draft: &PlanBuilder<'_>) -> Failure {
    infrastructure(reasons::REQUEUED, &what(draft))
}

/// Whether a failure is one.
pub(super) fn is_one(found: &Failure) -> bool {
    found.reason == reasons::REQUEUED
}

/// Remembers that the request is carried out, with `jobs` that end by it, and forgives what was before.
pub(super) fn note(draft: &mut PlanBuilder<'_>, jobs: i32) {
    let interruptions = draft.status.interruptions.as_ref().map_or(0, |past| past.number);
    let requeued = Requeued {
        number: wanted(draft),
        time: draft.time(),
        retries: draft.status.retry.saturating_sub(interruptions).saturating_add(jobs),
    };
    draft.status.requeued = Some(Box::new(requeued));
    draft.status.routes_before = None;
}

fn what(draft: &PlanBuilder<'_>) -> String {
    let reason = draft
        .spec()
        .requeue
        .as_ref()
        .and_then(|requeue| requeue.reason.as_deref());
    match reason
        .map(|reason| one_line(reason, LONGEST))
        .filter(|text| !text.is_empty())
    {
        Some(reason) => format!("A host has requeued the submission: {}", sentence(&reason)),
        None => "A host has requeued the submission.".to_owned(),
    }
}
