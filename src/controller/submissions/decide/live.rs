//! A submission that has not come to its end: in line, with its Job, without it.

use std::sync::Arc;

use super::plan::{Action, EvalaiUpdate, Question, TableUpdate};
use super::status::PlanBuilder;
use super::waits::{Wait, after};
use super::{
    accept, clock, crashes, disk, end, failure, gates, image, interruption, isolation, line, record, reported, run,
    start, stop,
};
use crate::controller::submissions::job_spec;
use crate::controller::submissions::report_digest::ReportDigest;
use crate::controller::submissions::view::{JobView, ObservedJob, PodView, Stage, Standing};
use leaderboard_api::conditions::{self, Truth};
use leaderboard_api::{JOB_SECONDS, LeaderboardSpec, reasons};

/// Times a Job is made again after somebody deleted it.
const MAX_RECREATED: i32 = 3;

/// Decides for a live submission.
pub(super) fn decide(draft: &mut PlanBuilder<'_>) {
    let view = draft.view;
    // Without a plan (a status that was lost) nothing can be made again before it is accepted.
    let has_job = draft.status.job_name.is_some() && (draft.status.plan.is_some() || draft.is_to_stop());
    match &view.job {
        // What was seen is of an earlier try; the next reconcile looks at the present one.
        ObservedJob::Ours(job) if job.name != draft.job_name() => draft.look_again(Wait::EARLIER_JOB),
        ObservedJob::Ours(job) => with_job(draft, job),
        ObservedJob::Created => draft.look_again(Wait::JOB),
        ObservedJob::Foreign if !draft.is_to_stop() => name_taken(draft),
        ObservedJob::Absent { .. } | ObservedJob::Foreign if has_job => without_its_job(draft),
        ObservedJob::Absent { .. } | ObservedJob::Foreign => in_line(draft),
    }
    follow(draft);
}

/// Looks for its end in EvalAI, also while it waits and nothing is sent to EvalAI, whatever it waits for.
fn follow(draft: &mut PlanBuilder<'_>) {
    // The time of its submission is taken with EvalAI's answer; without it nothing would be found.
    let is_known = draft.status.times.submitted.is_some();
    let may_run = is_known && draft.evalai_info().is_some_and(|info| info.standing != Standing::Ended);
    if draft.does(is_progress) || (may_run && !draft.is_finished() && !draft.is_to_stop()) {
        draft.act(Action::Ask(Question::EvalaisEnd));
    }
}

/// EvalAI learns that it is in line or runs.
fn is_progress(action: &Action) -> bool {
    matches!(
        action,
        Action::UpdateEvalai(EvalaiUpdate::Queued | EvalaiUpdate::Running)
    )
}

fn name_taken(draft: &mut PlanBuilder<'_>) {
    let message = format!(
        "The Job {} belongs to an older object of this name and is going away. If it stays, delete it.",
        draft.job_name()
    );
    let message = draft.stall(reasons::JOB_NAME_TAKEN, &message);
    draft.show(reasons::JOB_NAME_TAKEN, message);
    draft.look_again(Wait::JOB_NAME);
}

fn in_line(draft: &mut PlanBuilder<'_>) {
    if draft.is_cancelled() {
        let reason = end::cancel_reason(draft);
        let what = if reason == reasons::ENDED_IN_EVALAI {
            "EvalAI ended the submission"
        } else {
            "The submission was cancelled"
        };
        let when = if draft.status.retry > 0 || draft.status.is_restart() {
            "between two tries; what it had reached is kept"
        } else {
            "before it started"
        };
        return end::cancelled(draft, reason, &format!("{what} {when}."));
    }
    if !accept::decide(draft) {
        return draft.look_again(Wait::SLOT);
    }
    if waits_for_next_try(draft) {
        return;
    }
    match line::decide(draft) {
        line::Step::Start => return start_job(draft),
        line::Step::Join => {}
        line::Step::Wait => update_evalai(draft),
    }
    draft.look_again(Wait::SLOT);
}

fn waits_for_next_try(draft: &mut PlanBuilder<'_>) -> bool {
    let Some(at) = draft.status.next_retry_time.as_ref().map(|t| t.0) else {
        return false;
    };
    // A clock that was set back must not turn seconds into days.
    let latest = Wait::RETRY.over_at(draft.now());
    if at <= draft.now() || at > latest {
        return false;
    }
    if draft.status.reason.as_deref() != Some(reasons::REPLACING) {
        let message = "The submission is tried again after a failure that is not the participant's.";
        draft.show(reasons::REPLACING, message);
    }
    draft.requeue_at(at);
    true
}

fn start_job(draft: &mut PlanBuilder<'_>) {
    let view = draft.view;
    let name = draft.job_name();
    draft.status.waiting = None;
    draft.status.next_retry_time = None;
    draft.status.job_name = Some(name);
    note_gpus(draft);
    draft.act(Action::CreateJob(draft.status.job_number()));
    if let ObservedJob::Absent { refused: Some(words) } = &view.job {
        start::job_refused(draft, words);
    } else if draft.is_running() {
        draft.waits(reasons::PREPARING);
        let message = "The Job was deleted by somebody else. A new Job will resume from the results in S3.";
        start::replacing(draft, message);
    } else {
        draft.waits(reasons::PREPARING);
        draft.condition(conditions::RUNNING, Truth::False, reasons::PREPARING, "");
        draft.show(reasons::PREPARING, start::PREPARED);
    }
    update_evalai(draft);
    record(draft);
    draft.look_again(Wait::JOB);
}

/// How many GPUs the next Job has: the Leaderboard may be another one when it ends.
fn note_gpus(draft: &mut PlanBuilder<'_>) {
    let (Some(spec), Some(plan)) = (draft.leaderboard(), draft.status.plan.as_ref()) else {
        return;
    };
    let track = spec.tracks.iter().find(|track| track.name == plan.track);
    let gpus = job_spec::gpus(spec, track, plan);
    if gpus > 0 || draft.status.usage.is_some() {
        draft.status.usage.get_or_insert_default().gpus = gpus;
    }
}

/// The Job was made, or was about to be, and is not there: we ended it, somebody deleted it, or we crashed in between.
fn without_its_job(draft: &mut PlanBuilder<'_>) {
    // What the run has stored last decides whether it is made again.
    let is_read = run::is_of(draft, Stage::JobEnded);
    if !draft.is_to_stop()
        && (draft.was_job_seen() || draft.is_first_job())
        && !is_read
        && let Some(left) = run::answer_left(draft)
    {
        return draft.requeue_in(left);
    }
    // A report from before this Job was seen is its predecessor's.
    let says = |report: &Arc<ReportDigest>| report.is_verdict() && reported::is_of_present_job(draft, report);
    let is_verdict = is_read && draft.view.report.ours().is_some_and(says);
    if draft.is_to_stop() || (is_verdict && draft.was_job_seen()) {
        return end::decide(draft, None);
    }
    if draft.was_job_seen() && has_expired(draft) {
        draft.fail(failure::job_expired());
        return end::decide(draft, None);
    }
    if is_held_up(draft) {
        return;
    }
    if let Some(left) = run::requested_fence_left(draft) {
        return draft.requeue_in(left);
    }
    if draft.was_job_seen() {
        if draft.status.recreated >= MAX_RECREATED {
            draft.fail(failure::job_deleted());
            return end::decide(draft, None);
        }
        clock::count_use(draft, draft.now());
        draft.status.recreated += 1;
        clock::restart(draft);
        draft.event(
            true,
            reasons::JOB_RECREATED,
            "The Job was deleted by somebody else; it is created again.",
        );
    }
    start_job(draft);
}

/// Whether no Job may be made at the moment, because of its Leaderboard.
fn is_held_up(draft: &mut PlanBuilder<'_>) -> bool {
    if draft.leaderboard().is_none() {
        let message = accept::no_leaderboard(draft);
        let message = draft.stall(reasons::LEADERBOARD_NOT_FOUND, &message);
        draft.show(reasons::LEADERBOARD_NOT_FOUND, message);
        draft.look_again(Wait::SLOT);
        return true;
    }
    if let Some(missing) = isolation::missing(draft) {
        draft.stall_with(reasons::NOT_ISOLATED, &missing.message);
        draft.show(reasons::NOT_ISOLATED, missing.message);
        draft.look_again(Wait::SLOT);
        return true;
    }
    false
}

/// Whether Kubernetes may have removed the Job by its time to live, after an end that nobody has read.
fn has_expired(draft: &PlanBuilder<'_>) -> bool {
    let times = &draft.status.times;
    let known = [&times.scheduled, &times.started, &times.accepted];
    let since = known.into_iter().flatten().next().map_or(draft.now(), |time| time.0);
    let seconds = draft.leaderboard().map_or(JOB_SECONDS, LeaderboardSpec::job_seconds);
    draft.now() >= after(since, seconds.into())
}

fn with_job(draft: &mut PlanBuilder<'_>, job: &JobView) {
    if gates::holds(draft, job) {
        return;
    }
    draft.status.job_name = Some(job.name.clone());
    draft.status.waiting = None;
    draft.status.next_retry_time = None;
    // Somebody has removed the status, and with it the plan.
    if draft.status.plan.is_none() && !draft.is_to_stop() && !accept::decide(draft) {
        return draft.look_again(Wait::JOB);
    }
    let view = draft.view;
    if let Some(pod) = &view.pod {
        take_pod(draft, pod);
    }
    if let Some(report) = view.report.ours() {
        reported::take(draft, report);
    }
    if let Some(job_end) = &job.end {
        return end::decide(draft, Some(job_end));
    }
    if end::of_complete_run(draft) {
        return;
    }
    if job.deleting {
        return stop::being_deleted(draft);
    }
    if let Some(lost) = stop::lost_pod(draft) {
        return stop::leave_lost_pod(draft, job, lost);
    }
    if !draft.is_to_stop() {
        watch_run(draft);
    }
    if !draft.is_to_stop() {
        interruption::notice(draft);
    }
    if !draft.is_to_stop() {
        start::watch(draft, job);
    }
    if draft.is_to_stop() {
        return stop::decide(draft, job);
    }
    update_evalai(draft);
    if draft.is_running() {
        record(draft);
    }
    draft.look_again(Wait::RUN);
}

fn take_pod(draft: &mut PlanBuilder<'_>, pod: &PodView) {
    let known = draft.status.node_name.take();
    draft.status.node_name = pod.node.clone().or(known);
    clock::take_node(draft, pod);
    clock::take_agents(draft, pod);
    image::pin_digest(draft, pod);
    let now = draft.now();
    crashes::note(&mut draft.status, pod, now);
}

/// What ends a run under way: a full disk, agents with different images, crashes, time.
fn watch_run(draft: &mut PlanBuilder<'_>) {
    let found = disk::full(draft).or_else(|| image::changed(draft));
    if let Some(found) = found.or_else(|| crashes::too_many(draft)) {
        return draft.fail(found);
    }
    // One that outlives its Leaderboard is charged for no limit that nobody has set; the Pod has a net of its own.
    let Some(ran) = clock::run_seconds(draft).filter(|_| draft.leaderboard().is_some()) else {
        return;
    };
    let Some(limit) = draft.deadlines().run_seconds else {
        return;
    };
    if ran >= limit {
        draft.fail(failure::time_limit(limit));
    } else if clock::goes_on(draft) {
        draft.requeue_at(after(draft.now(), limit - ran));
    }
}

/// What EvalAI hears of a live submission; it is sent once, however often it is requested.
fn update_evalai(draft: &mut PlanBuilder<'_>) {
    if draft.spec().evalai.is_none() {
        return;
    }
    if !draft.is_running() {
        // Between two tries EvalAI keeps saying running.
        if draft.status.times.started.is_none() {
            draft.act(Action::UpdateEvalai(EvalaiUpdate::Queued));
        }
        return;
    }
    draft.act(Action::UpdateEvalai(EvalaiUpdate::Running));
    let Some(report) = draft.view.report.ours() else { return };
    let evalai = draft.view.evalai.as_ref();
    if report.done > 0 && Some(report.done) != evalai.and_then(|evalai| evalai.partial_done) {
        // EvalAI keeps a partial result, and would show it as final of a row that its participant calls finished.
        let is_shown = evalai.is_some_and(|evalai| evalai.shows_partial);
        draft.act(Action::UpdateEvalai(EvalaiUpdate::Partial { is_shown }));
    }
}

fn record(draft: &mut PlanBuilder<'_>) {
    if record::has_row(draft) {
        draft.act(Action::Record(TableUpdate::Progress));
    }
}
