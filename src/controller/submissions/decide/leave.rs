//! When a Submission that has ended is deleted: `retention.finishedSeconds` after its end, once every system has that end.
//!
//! Called by `publish`. Pure. An end is deleted only as it is stored: the deletion names the version of the object that was decided
//! on, and a reconcile that still has something to store deletes nothing.

use jiff::Timestamp;

use super::plan::Action;
use super::status::PlanBuilder;
use super::waits::{Wait, after};
use crate::controller::submissions::view::ObservedJob;
use leaderboard_api::conditions;

/// Deletes the Submission if its time is over, else comes back at that time.
pub(super) fn decide(draft: &mut PlanBuilder<'_>) {
    let Some(until) = until(draft) else { return };
    if draft.now() < until {
        draft.look_again(Wait::RETENTION);
        return draft.requeue_at(until);
    }
    let object = draft.submission();
    if object.status.as_ref() == Some(&draft.status)
        && let (Some(uid), Some(resource_version)) =
            (object.metadata.uid.clone(), object.metadata.resource_version.clone())
    {
        draft.act(Action::DeleteSubmission { uid, resource_version });
    }
    draft.look_again(Wait::DELIVERY);
}

/// When it is to be deleted. None: not at all, or not as it stands.
fn until(draft: &PlanBuilder<'_>) -> Option<Timestamp> {
    let kept = draft.leaderboard()?.retention.finished_seconds;
    let status = &draft.status;
    let end = status.end()?;
    let has_all = status.is_delivered(conditions::PUBLISHED) && status.is_delivered(conditions::RECORDED);
    let may_go = kept > 0 && !draft.is_deleting() && has_all && !has_job(draft);
    may_go.then(|| after(end.last_transition_time.0, kept))
}

/// Whether its Job has not ended: with the Submission its Pod would go.
fn has_job(draft: &PlanBuilder<'_>) -> bool {
    matches!(&draft.view.job, ObservedJob::Ours(job) if job.end.is_none())
}
