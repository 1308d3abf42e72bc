//! What a decision needs of S3, and how long it waits for it. Pure.
//!
//! Reports are read next to the reconciles; an answer wakes the object. An end is decided only on a report that was
//! asked for after that end was seen: one that was asked for before may lack what was stored last.

use std::time::Duration;

use jiff::Timestamp;

use super::plan::Action;
use super::status::PlanBuilder;
use super::waits::{Wait, after};
use crate::controller::submissions::view::{ObservedFence, ObservedJob, ObservedReport, ReportDemand, Stage, View};
use crate::services::evalai::Patience;
use leaderboard_api::conditions::{self, Condition};
use leaderboard_api::{State, SubmissionStatus, reasons};

/// What is known of a result that is to be published.
pub(super) enum Reading {
    /// As much as there ever will be.
    Done,
    /// It is being read, or cannot be read and why.
    Waits(Option<String>),
}

/// Which report the present state of the run needs.
pub(super) fn demand(draft: &PlanBuilder<'_>) -> Option<ReportDemand> {
    let status = &draft.status;
    status.plan.as_ref()?;
    let stage = if draft.is_finished() {
        draft.needs_report.then(|| stage_after_end(draft))?
    } else {
        stage_of_live(draft)?
    };
    Some(ReportDemand {
        job: status.job_number(),
        pod: draft.view.pod.as_ref().map(|pod| pod.uid.as_str().into()),
        stage,
        period: draft.period(),
    })
}

/// An end that was decided on a complete run waits for its Job no more.
fn stage_after_end(draft: &PlanBuilder<'_>) -> Stage {
    let is_live = draft.view.job.ours().is_some_and(|job| job.end.is_none());
    let has_ended = draft.view.pod.as_ref().is_some_and(|pod| pod.run_ended.is_some());
    if is_live && has_ended && draft.is_successful() {
        Stage::RunEnded
    } else {
        Stage::JobEnded
    }
}

fn stage_of_live(draft: &PlanBuilder<'_>) -> Option<Stage> {
    draft.status.job_name.as_ref()?;
    match &draft.view.job {
        ObservedJob::Ours(job) if job.end.is_some() => Some(Stage::JobEnded),
        ObservedJob::Ours(_) if draft.view.pod.as_ref().is_some_and(|pod| pod.run_ended.is_some()) => {
            Some(Stage::RunEnded)
        }
        ObservedJob::Ours(_) => draft.status.times.scheduled.as_ref().map(|_| Stage::Live),
        ObservedJob::Created => None,
        // One that is created only now is not there either, and what is stored is not its own.
        ObservedJob::Absent { .. } if draft.does(|action| matches!(action, Action::CreateJob(_))) => None,
        // Whether the first Job of an attempt was there, its report shows.
        ObservedJob::Absent { .. } if draft.is_first_job() => Some(Stage::JobEnded),
        ObservedJob::Absent { .. } | ObservedJob::Foreign => {
            (draft.is_to_stop() || draft.was_job_seen()).then_some(Stage::JobEnded)
        }
    }
}

/// Whether the report that is known was asked for at this stage of the run, or later.
pub(super) fn is_of(draft: &PlanBuilder<'_>, stage: Stage) -> bool {
    draft.view.report.stage >= Some(stage)
}

/// How long is still waited for an answer before anything is shown.
pub(super) fn answer_left(draft: &PlanBuilder<'_>) -> Option<Duration> {
    Wait::REPORT.silence_left(draft.view.report.waited)
}

/// How long a lost Pod still waits for the fence.
pub(super) fn fence_left(draft: &PlanBuilder<'_>) -> Option<Duration> {
    let waited = match draft.view.fence {
        // Without a plan nobody knows where it would be.
        _ if draft.status.plan.is_none() => return None,
        ObservedFence::Held => return None,
        ObservedFence::NotRequested => Duration::ZERO,
        ObservedFence::Pending(waited) | ObservedFence::Failed(waited) => waited,
    };
    Wait::FENCE.left(waited)
}

/// The same for what follows the Pod: only a fence that was requested is waited for.
pub(super) fn requested_fence_left(draft: &PlanBuilder<'_>) -> Option<Duration> {
    fence_left(draft).filter(|_| draft.view.fence != ObservedFence::NotRequested)
}

/// Whether the report of an ended run is there. Asks for it.
pub(super) fn report_of_end(draft: &mut PlanBuilder<'_>) -> Reading {
    // What never had a Job has stored nothing.
    if draft.status.plan.is_none() || !draft.status.has_run() {
        return Reading::Done;
    }
    draft.needs_report = true;
    let view = draft.view;
    let is_read = is_of(draft, stage_after_end(draft)) && view.report.stored != ObservedReport::NotRead;
    match &view.report.stored {
        _ if !is_read && (draft.is_successful() || may_wait(draft)) => Reading::Waits(None),
        // What is Finished is nothing without its result.
        ObservedReport::Unreadable(why) if draft.is_successful() || may_wait(draft) => {
            Reading::Waits(Some(why.clone()))
        }
        _ => Reading::Done,
    }
}

/// Whether an end is still to be sent to EvalAI, with the texts that were read.
pub fn awaits_publication(status: &SubmissionStatus) -> bool {
    let published = status.condition(conditions::PUBLISHED);
    let is_open = |c: &Condition| c.reason != reasons::REFUSED && !status.is_delivered(conditions::PUBLISHED);
    status.has_ended() && published.is_some_and(is_open)
}

/// Until when an end waits for what cannot be read of its result. What is Finished is nothing without its results.
pub fn patience(view: &View, status: &SubmissionStatus) -> Patience {
    let unread = waits_until(view, status, Wait::UNREAD);
    let is_successful = status.state_of_conditions() == State::Finished;
    Patience {
        unfit: waits_until(view, status, Wait::UNFIT),
        unread,
        report: if is_successful { Timestamp::MAX } else { unread },
    }
}

/// Whether an end that is published once waits for its result: so long after it was decided, and not until the finalizer gives up.
fn may_wait(draft: &PlanBuilder<'_>) -> bool {
    draft.now() < waits_until(draft.view, &draft.status, Wait::UNREAD)
}

fn waits_until(view: &View, status: &SubmissionStatus, wait: Wait) -> Timestamp {
    let end = status.condition(conditions::FINISHED);
    let patience = wait.over_at(end.map_or(view.now, |c| c.last_transition_time.0));
    let Some(deleted) = &view.submission.metadata.deletion_timestamp else {
        return patience;
    };
    let leaderboard = view.leaderboard.as_ref();
    let seconds = leaderboard.map_or(0, |leaderboard| leaderboard.spec.deadlines.finalize_seconds);
    patience.min(after(deleted.0, seconds - Wait::BEFORE_RELEASE.longest))
}
