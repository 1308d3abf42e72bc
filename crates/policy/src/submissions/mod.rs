//! The next step of one submission: a pure function from a `View` to a `Plan`. It knows no client, no `async`, and no clock but
//! the view's.
//!
//! ```text
//! accept ─▶ gates ─▶ start ─▶ run ─▶ end ─▶ publish ─▶ leave
//!                               └─▶ stop ─▶┘
//! ```
//!
//! `cause` and `blame` decide whose fault a start or a crash was. `failure` makes it a sentence with its next step, and `logs` finds the log for
//! it. `waits` has how long anything is waited for, `limits` how long a start may take, and `workers` who runs. All write into one `status`;
//! `write` decides whether a changed one is worth a write, `events` has its events, and `plan` is the result.

mod accept;
mod blame;
mod cause;
mod end;
mod events;
mod failure;
mod gates;
mod leave;
mod limits;
mod logs;
mod plan;
mod publish;
mod run;
mod start;
mod status;
mod stop;
mod suspend;
#[cfg(test)]
mod tests;
mod waits;
mod workers;
mod write;

use std::sync::Arc;
use std::time::Duration;

use crate::report_digest::ReportDigest;
use crate::view::{JobView, ObservedJob, Stage, View};
use gates::{input, slot};
use leaderboard_api::{JOB_SECONDS, LeaderboardSpec, Reason};
pub use plan::{Action, EvalaiUpdate, Event, Plan, Question, SlotUse, StatusWrite, TableUpdate, job_name};
pub use run::{awaits_publication, patience, pinned};
use status::PlanBuilder;
use waits::{Wait, after};

/// Times a Job is made again after somebody deleted it.
const MAX_RECREATED: i32 = 3;

/// Decides one reconcile.
pub fn decide(view: &View) -> Plan {
    let mut draft = PlanBuilder::new(view);
    if draft.begin_attempt() {
        // The view is of another attempt.
        leave::leave_job(&mut draft);
        draft.requeue_in(Duration::ZERO);
    } else {
        life(&mut draft);
        if leave::needs_finalizer(&draft) {
            draft.actions.insert(0, Action::SetFinalizer(true));
        }
    }
    let report = run::demand(&draft);
    write::plan(draft, report)
}

/// The life of a submission. An end that is decided here is published at once.
fn life(draft: &mut PlanBuilder<'_>) {
    let view = draft.view;
    // Without a plan (a status that was lost) nothing can be made again before it is accepted.
    let had_job = draft.status.job_name.is_some() && (draft.status.plan.is_some() || draft.is_to_stop());
    let was_live = !draft.is_finished();
    match &view.job {
        _ if !was_live => {}
        // The view is of an earlier try; the next reconcile looks at the present one.
        ObservedJob::Ours(job) if job.name != draft.job_name() => draft.look_again(Wait::EARLIER_JOB),
        ObservedJob::Ours(job) => with_job(draft, job),
        ObservedJob::Created => draft.look_again(Wait::JOB),
        ObservedJob::Foreign if !draft.is_to_stop() => start::name_taken(draft),
        ObservedJob::Absent { .. } | ObservedJob::Foreign if had_job => without_its_job(draft),
        ObservedJob::Absent { .. } | ObservedJob::Foreign => in_line(draft),
    }
    if was_live {
        run::follow(draft);
    }
    if draft.is_finished() {
        publish::decide(draft);
    }
}

/// Between its acceptance and its Job, or between two Jobs.
fn in_line(draft: &mut PlanBuilder<'_>) {
    if draft.is_cancelled() {
        let is_between = draft.status.retry > 0 || draft.status.is_restart();
        return end::cancelled(
            draft,
            if is_between {
                " between two tries; what it had reached is kept"
            } else {
                " before it started"
            },
        );
    }
    if !accept::decide(draft) {
        return draft.look_again(Wait::SLOT);
    }
    if gates::waits_for_next_try(draft) {
        return;
    }
    if input::has_failed(draft) || slot::waits(draft) || input::waits(draft) {
        return draft.look_again(Wait::SLOT);
    }
    start::start_job(draft);
}

/// The Job is there: the submission starts, runs, is stopped, or has ended.
fn with_job(draft: &mut PlanBuilder<'_>, job: &JobView) {
    if gates::holds_back(draft, job) {
        return;
    }
    draft.status.job_name = Some(job.name.clone());
    draft.status.waiting = None;
    draft.status.next_retry_time = None;
    // Somebody has removed the status, and with it the plan.
    if draft.status.plan.is_none() && !draft.is_to_stop() && !accept::decide(draft) {
        return draft.look_again(Wait::JOB);
    }
    run::take_in(draft);
    match &job.end {
        Some(end) => end::decide(draft, Some(end)),
        None if end::of_complete_run(draft) => {}
        None if job.deleting => stop::being_deleted(draft),
        None if suspend::holds(draft, job) => {}
        None if stop::leaves_lost_pod(draft, job) => {}
        None => under_way(draft, job),
    }
}

/// The Pod starts or runs. The first cause of a stop counts.
fn under_way(draft: &mut PlanBuilder<'_>, job: &JobView) {
    if !draft.is_to_stop() {
        run::watch(draft);
    }
    if !draft.is_to_stop() {
        stop::notice(draft);
    }
    if !draft.is_to_stop() {
        start::watch(draft, job);
    }
    if draft.is_to_stop() {
        return stop::decide(draft, job);
    }
    run::update_evalai(draft);
    if draft.is_running() {
        run::record_progress(draft);
    }
    draft.look_again(Wait::RUN);
}

/// The Job was made, or was about to be, and is not there: we ended it, somebody deleted it, or we crashed in between.
fn without_its_job(draft: &mut PlanBuilder<'_>) {
    // The last stored report of the run decides if the Job is made again.
    let is_read = run::is_of(draft, Stage::JobEnded);
    if !draft.is_to_stop()
        && (draft.was_job_seen() || draft.is_first_job())
        && !is_read
        && let Some(left) = run::answer_left(draft)
    {
        return draft.requeue_in(left);
    }
    // A report from before this Job was seen is its predecessor's.
    let says = |report: &Arc<ReportDigest>| report.is_verdict() && run::is_of_present_job(draft, report);
    let is_verdict = is_read && draft.view.report.ours().is_some_and(says);
    if draft.is_to_stop() || (is_verdict && draft.was_job_seen()) {
        return end::decide(draft, None);
    }
    if draft.was_job_seen() && has_expired(draft) {
        draft.fail(failure::job_expired());
        return end::decide(draft, None);
    }
    if gates::is_held_up(draft) {
        return;
    }
    if let Some(left) = stop::requested_fence_left(draft) {
        return draft.requeue_in(left);
    }
    // Somebody has removed the status, and with it the file's size and digest.
    if input::waits(draft) {
        return draft.look_again(Wait::SLOT);
    }
    if draft.was_job_seen() {
        if draft.status.recreated >= MAX_RECREATED {
            draft.fail(failure::job_deleted());
            return end::decide(draft, None);
        }
        run::count_use(draft, draft.now());
        draft.status.recreated += 1;
        run::restart_clock(draft);
        draft.event(
            true,
            Reason::JobRecreated,
            "The Job was deleted by somebody else; it is created again.",
        );
    }
    start::start_job(draft);
}

/// True if Kubernetes may have removed the Job by its time to live, after an end that no reconcile has read.
fn has_expired(draft: &PlanBuilder<'_>) -> bool {
    let times = &draft.status.times;
    let known = [&times.scheduled, &times.started, &times.accepted];
    let since = known.into_iter().flatten().next().map_or(draft.now(), |time| time.0);
    let seconds = draft.leaderboard().map_or(JOB_SECONDS, LeaderboardSpec::job_seconds);
    draft.now() >= after(since, seconds.into())
}
