//! The steps in the cluster after an end: the Job's time to live, the object's own, the finalizer.

use jiff::Timestamp;

use super::plan::Action;
use super::status::{PlanBuilder, seconds};
use super::stop;
use super::waits::{Wait, after};
use crate::leaderboards::standings;
use crate::view::ObservedJob;
use leaderboard_api::conditions;
use leaderboard_api::{Ingested, JOB_SECONDS, Reason};

/// Why an attempt does not begin.
const NO_MESSAGE: &str = "no queue message announced it, and participants can edit the status there. Raise spec.attempt if it is to \
                          run; otherwise set the status back in EvalAI.";

const HAS_FINISHED: &str = "the submission has finished, which is final. Nothing to do if an old message was only sent again. Otherwise \
                            re-run it in EvalAI, which makes a new submission, or set its status back there.";

/// Shows once that EvalAI's row asks for another attempt which does not begin.
pub(super) fn show_refused_attempt(draft: &mut PlanBuilder<'_>) {
    let refused = Ingested::of(draft.submission()).and_then(|record| record.refused);
    let Some(refused) = refused.filter(|refused| refused.attempt == draft.spec().attempt.next()) else {
        return;
    };
    let (reason, why) = if draft.is_successful() {
        (Reason::AttemptAfterFinish, HAS_FINISHED)
    } else {
        (Reason::AttemptWithoutMessage, NO_MESSAGE)
    };
    let (attempt, since) = (refused.attempt, seconds(refused.at));
    let message =
        format!("Attempt {attempt} does not begin: EvalAI's status or queue asks for it since {since}, but {why}");
    let is_new = draft.blocked_since(reason).is_none();
    draft.stall_with(reason, &message);
    if is_new {
        draft.event(true, reason, message);
    }
}

/// Keeps the Job of an attempt that has ended for its time, and ends one that shows up late.
pub(super) fn leave_job(draft: &mut PlanBuilder<'_>) {
    let ObservedJob::Ours(job) = &draft.view.job else {
        return;
    };
    if job.end.is_some() {
        return;
    }
    if farewell(draft).is_some_and(|until| draft.waits_until(until)) {
        return;
    }
    if job.deleting {
        stop::remove_overdue_pod(draft);
    } else {
        draft.act(stop::delete(job, Wait::DELETION.longest));
    }
    draft.look_again(Wait::DELIVERY);
}

/// Until when a Pod whose run has ended may take to say its farewell; None if nothing is to be waited for.
fn farewell(draft: &PlanBuilder<'_>) -> Option<Timestamp> {
    let pod = draft.view.pod.as_ref().filter(|pod| pod.delete_by.is_none())?;
    pod.run_ended?;
    let end = draft.status.end()?;
    Some(Wait::FAREWELL.over_at(end.last_transition_time.0))
}

/// Removes a Job whose host wants it gone before Kubernetes removes it: that is late enough for every end to be read first.
pub(super) fn remove_job_in_time(draft: &mut PlanBuilder<'_>) {
    let ended = draft.view.job.ours().filter(|job| !job.deleting);
    let Some((job, end)) = ended.and_then(|job| job.end.as_ref().map(|end| (job, end))) else {
        return;
    };
    let seconds = draft
        .leaderboard()
        .map_or(JOB_SECONDS, |l| l.ttl_seconds_after_finished);
    if seconds >= JOB_SECONDS {
        return;
    }
    let finished = draft.status.times.finished.as_ref().map(|time| time.0);
    let until = after(end.at().or(finished).unwrap_or(draft.now()), seconds.into());
    if !draft.waits_until(until) {
        draft.act(stop::delete(job, Wait::DELETION.longest));
        draft.look_again(Wait::DELIVERY);
    }
}

pub(super) fn release(draft: &mut PlanBuilder<'_>, complete: bool) {
    let Some(deleted) = draft.submission().metadata.deletion_timestamp.clone() else {
        return;
    };
    if !draft.has_finalizer() {
        return;
    }
    if complete {
        return draft.act(Action::SetFinalizer(false));
    }
    let patience = draft.leaderboard().map_or(900, |l| l.deadlines.finalize_seconds);
    let until = after(deleted.0, patience);
    if !draft.waits_until(until) {
        draft.event(
            true,
            Reason::ReleasedUnpublished,
            "The submission was deleted, and its end was not published within deadlines.finalizeSeconds: the finalizer is removed.",
        );
        draft.act(Action::Forget);
        draft.act(Action::SetFinalizer(false));
    }
}

/// A deletion waits only for another system that has heard of the submission, or will, and not of its end.
pub(super) fn needs_finalizer(draft: &PlanBuilder<'_>) -> bool {
    let is_owed = draft.spec().evalai.is_some() || draft.has_row();
    let has_begun = draft.status.has_run();
    let is_requested = draft.does(|action| matches!(action, Action::UpdateEvalai(_) | Action::Record(_)));
    let is_settled = draft.does(|action| *action == Action::Forget);
    is_owed && (has_begun || is_requested) && !is_settled && !draft.has_finalizer() && !draft.is_deleting()
}

/// Deletes the Submission if its time is over, else comes back at that time.
pub(super) fn delete_in_time(draft: &mut PlanBuilder<'_>) {
    let Some(until) = deleted_at(draft) else { return };
    if draft.waits_until(until) {
        return draft.look_again(Wait::RETENTION);
    }
    let board = draft.view.leaderboard.as_deref();
    if !board.is_none_or(|board| standings::can_spare(board, draft.submission())) {
        return draft.look_again(Wait::STANDINGS);
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
fn deleted_at(draft: &PlanBuilder<'_>) -> Option<Timestamp> {
    let kept = draft.leaderboard()?.retention.finished_seconds?;
    let status = &draft.status;
    let end = status.end()?;
    let has_all = status.is_delivered(conditions::PUBLISHED) && status.is_delivered(conditions::RECORDED);
    let may_go = !draft.is_deleting() && has_all && !has_job(draft);
    may_go.then(|| after(end.last_transition_time.0, kept))
}

/// True if its Job has not ended: with the Submission its Pod would go.
fn has_job(draft: &PlanBuilder<'_>) -> bool {
    matches!(&draft.view.job, ObservedJob::Ours(job) if job.end.is_none())
}
