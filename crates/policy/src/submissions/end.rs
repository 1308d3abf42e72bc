//! The end of an attempt: which outcome it has, or whether an infrastructure failure gives it another Job.
//!
//! Some infrastructure failures an agent can provoke. The first of an attempt gets another Job, on another node where there is one; after a
//! further one a Job follows only if the Job before it has finished a unit of work.

use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;

use super::status::PlanBuilder;
use super::waits::{Wait, after};
use super::{cause, failure, run, stop};
use crate::report_digest::{ReportDigest, clamp};
use crate::view::{JobEnd, ObservedReport, Stage};
use leaderboard_api::conditions::{self, Truth};
use leaderboard_api::text::sentence;
use leaderboard_api::{FailedNode, Failure, FailureClass, MAX_FAILED_NODES, Reason, ReasonName};

/// Shown while the report of an ended run has been asked for and no answer has come, not even a refusal.
const NO_ANSWER: &str = "its bucket has not answered yet.";

/// Failures of a node, which gets no third Job of the attempt.
const OF_NODES: [Reason; 2] = [Reason::NoGPU, Reason::NodeCannotStart];

/// The Job is terminal, or gone because we ended it (`None`).
pub(super) fn decide(draft: &mut PlanBuilder<'_>, job_end: Option<&JobEnd>) {
    let view = draft.view;
    // A mark that comes late would stop the next Pod.
    if let Some(left) = stop::requested_fence_left(draft) {
        return draft.requeue_in(left);
    }
    // Without a plan the place of a report is unknown.
    let is_read = run::is_of(draft, Stage::JobEnded) && view.report.stored != ObservedReport::NotRead;
    if draft.status.plan.is_some() && !is_read {
        if let Some(left) = run::answer_left(draft) {
            return draft.requeue_in(left);
        }
        if wait_for_bucket(draft, NO_ANSWER) {
            return;
        }
    }
    let report = match &view.report.stored {
        ObservedReport::Ours(report) if is_read => Some(report.as_ref()),
        ObservedReport::Unreadable(why) if wait_for_bucket(draft, why) => return,
        _ => None,
    };
    if let Some(report) = report.filter(|r| r.is_complete() && r.eligible) {
        return finished(draft, report);
    }
    // A cancel is then the higher attempt's, and what else has ended it is forgiven.
    if draft.is_followed() {
        run::count_use(draft, view.ended_at().unwrap_or(draft.now()));
        return draft.restart();
    }
    let report = report.filter(|r| run::is_of_present_job(draft, r));
    if draft.is_cancelled() {
        return cancelled(draft, "; what it had reached is kept");
    }
    let recorded = draft.status.failure.clone();
    let recorded = recorded.filter(|found| !report.is_some_and(|r| failure::is_refusal(&draft.status, found, r)));
    let found = recorded.map_or_else(|| cause(draft, report, job_end), |found| *found);
    if found.class == FailureClass::Infrastructure && may_retry(draft, &found) {
        return retry(draft, &found);
    }
    let found = explained(draft, found);
    failed(draft, found);
}

/// Finishes a run whose workers have ended well and whose complete results are stored and count: nothing that its
/// Pod still does can change them. Returns whether it did. Every other end waits for the Job.
pub(super) fn of_complete_run(draft: &mut PlanBuilder<'_>) -> bool {
    let view = draft.view;
    let Some(pod) = view.pod.as_ref().filter(|pod| pod.run_ended.is_some()) else {
        return false;
    };
    if !run::is_of(draft, Stage::RunEnded) {
        return false;
    }
    let report = view.report.ours().filter(|r| r.pod_uid == pod.uid);
    let Some(report) = report.filter(|r| r.is_complete() && r.eligible) else {
        return false;
    };
    finished(draft, report);
    true
}

/// True if the end still waits until the bucket can be read.
fn wait_for_bucket(draft: &mut PlanBuilder<'_>, why: &str) -> bool {
    let limit = if draft.is_cancelled() {
        draft.deadlines().cancel_seconds.max(Wait::CANCELLED_REPORT.longest)
    } else {
        Wait::REPORT.longest
    };
    let message = format!(
        "The results cannot be read: {} The submission goes on when they can.",
        sentence(why)
    );
    let message = draft.stall(Reason::NotStored, &message);
    let since = draft.blocked_since(Reason::NotStored).unwrap_or(draft.now());
    let until = after(since, limit);
    if !draft.waits_until(until) {
        return false;
    }
    draft.show(Reason::NotStored, message);
    draft.look_again(Wait::REPORT);
    true
}

/// Ends as Cancelled; nothing needs to be stopped any more. `when` goes on with the sentence.
pub(super) fn cancelled(draft: &mut PlanBuilder<'_>, when: &str) {
    let (reason, what) = if draft.spec().cancel {
        (Reason::Cancelled, "The submission was cancelled")
    } else if draft.is_deleting() {
        (Reason::Deleted, "The submission was cancelled")
    } else if draft.is_ended_in_evalai() {
        (Reason::EndedInEvalAI, "EvalAI ended the submission")
    } else {
        (Reason::Cancelled, "The submission was cancelled")
    };
    close_as(draft, reason, &format!("{what}{when}."));
}

/// Ends without a failure.
pub(super) fn close_as(draft: &mut PlanBuilder<'_>, reason: Reason, message: &str) {
    draft.status.failure = None;
    close(draft, reason, message);
}

fn cause(draft: &PlanBuilder<'_>, report: Option<&ReportDigest>, job_end: Option<&JobEnd>) -> Failure {
    // A refused checkpoint may still be fixed while the run goes on; only the last one counts.
    let verdict = report.filter(|r| r.is_verdict());
    if let Some(refused) = verdict.and_then(|r| r.refused.as_ref()) {
        return failure::invalid_results(refused, draft.words());
    }
    if let Some(unusable) = verdict.and_then(|r| r.unusable.as_ref()) {
        return failure::unusable_results(unusable);
    }
    if let Some(report) = verdict {
        return failure::not_eligible(report, &draft.status);
    }
    match job_end {
        Some(end) => of_job(draft, end),
        None => failure::job_deleted(),
    }
}

/// The failure of a Job that ended without final results.
fn of_job(draft: &PlanBuilder<'_>, end: &JobEnd) -> Failure {
    if let Some(found) = cause::disk_full(draft) {
        return found;
    }
    match end {
        JobEnd::Complete { .. } => failure::results_not_stored(),
        JobEnd::Failed { reason, message, .. } => {
            // Without a limit on the run the deadline is not ours.
            let limit = draft.deadlines().run_seconds.filter(|_| reason == "DeadlineExceeded");
            let late = limit.map(|limit| run::over_time(draft, limit));
            late.or_else(|| failure::worst(&draft.status)).unwrap_or_else(|| {
                let what = format!("The Job failed with {reason}: {}", sentence(message));
                failure::infrastructure(Reason::JobFailed, &what)
            })
        }
    }
}

/// Failures that a second try may fix.
fn may_retry(draft: &PlanBuilder<'_>, found: &Failure) -> bool {
    const FINAL: [Reason; 5] = [
        Reason::GraphicsDriverMissing,
        Reason::InputMissing,
        Reason::JobDeleted,
        Reason::JobExpired,
        Reason::ScheduleDeadline,
    ];
    let can_recover = !found.reason.is_one_of(&FINAL);
    let is_left = stop::is_interruption(found)
        || (leaves_a_job(draft, found) && stop::other_failures(&draft.status) < draft.retries().infrastructure);
    can_recover && is_left
}

fn retry(draft: &mut PlanBuilder<'_>, found: &Failure) {
    let (delay, next) = if stop::is_interruption(found) {
        stop::note_interruption(draft);
        let next = "A new Job resumes from the results in S3; this costs neither an attempt nor a retry.";
        (0, next.to_owned())
    } else {
        let failures = stop::other_failures(&draft.status);
        let delay = (Wait::RETRY.again << failures.clamp(0, 16)).min(Wait::RETRY.longest);
        (
            delay,
            format!("The submission is tried again in {delay} s; this costs no attempt."),
        )
    };
    let at = after(draft.now(), delay);
    run::count_use(draft, draft.view.ended_at().unwrap_or(draft.now()));
    note_provoked(draft, found);
    draft.status.retry += 1;
    draft.status.job_name = None;
    let is_of_node = found.reason.is_one_of(&OF_NODES);
    let node = draft.status.node_name.take();
    if let Some(node) = node.filter(|_| is_of_node || is_provoked(found)) {
        note_failed_node(&mut draft.status.failed_nodes, node, i32::from(is_of_node));
    }
    draft.status.failure = None;
    draft.status.recreated = 0;
    draft.status.next_retry_time = Some(Time(at));
    run::restart_clock(draft);
    draft.status.times.stopping = None;
    for worker in &mut draft.status.workers {
        worker.crashes = 0;
        worker.ended_from_outside = 0;
        worker.last = None;
    }
    let what = &found.message;
    let message = format!("{what} {next}");
    draft.moves();
    draft.condition(conditions::RUNNING, Truth::False, found.reason.clone(), what);
    draft.show(Reason::Replacing, message);
    draft.requeue_at(at);
}

/// Remembers a node on which a Job has failed; `jobs` is 1 if by its fault. If there are too many nodes, the oldest is forgotten.
pub(super) fn note_failed_node(nodes: &mut Vec<FailedNode>, node_name: String, jobs: i32) {
    if let Some(known) = nodes.iter_mut().find(|known| known.node_name == node_name) {
        known.jobs = known.jobs.saturating_add(jobs);
        return;
    }
    if nodes.len() >= MAX_FAILED_NODES {
        nodes.remove(0);
    }
    nodes.push(FailedNode { node_name, jobs });
}

fn finished(draft: &mut PlanBuilder<'_>, report: &ReportDigest) {
    // Without a Job no reconcile has taken the report in yet.
    run::take_report(draft, report);
    let score = draft.status.score.as_ref();
    let score = score.map_or_else(String::new, |score| format!(", {} {}", score.name, score.text));
    let message = format!("{} of {} {}{score}.", report.done, report.total, report.unit);
    close_as(draft, Reason::Finished, &message);
}

/// Ends as Failed; nothing needs to be stopped any more.
pub(super) fn failed(draft: &mut PlanBuilder<'_>, found: Failure) {
    let found = failure::at_the_end(found);
    let (reason, message) = (found.reason.clone(), found.message.clone());
    draft.status.failure = Some(Box::new(found));
    close(draft, reason, &message);
}

fn close(draft: &mut PlanBuilder<'_>, reason: impl Into<ReasonName>, message: &str) {
    let reason = reason.into();
    run::count_attempts(draft);
    let ended = draft.view.ended_at().unwrap_or(draft.now());
    let ended = ended.min(draft.now());
    if !draft.is_finished() {
        run::count_use(draft, ended);
    }
    draft.status.times.finished = Some(Time(ended));
    let started = draft.status.times.started.as_ref();
    draft.status.duration = started.map(|started| duration(ended.duration_since(started.0).as_secs()));
    draft.status.waiting = None;
    draft.status.next_retry_time = None;
    let stored = draft.view.report.ours().is_some_and(|r| r.is_final);
    let (truth, why) = if stored {
        (Truth::True, Reason::Stored)
    } else {
        (Truth::False, Reason::NotStored)
    };
    draft.condition(conditions::ARCHIVED, truth, why, "");
    draft.condition(conditions::RUNNING, Truth::False, reason.clone(), "");
    draft.moves();
    draft.ends(reason.clone(), message);
    if draft.spec().evalai.is_some() {
        draft.condition(conditions::PUBLISHED, Truth::False, Reason::Waiting, "");
    }
    if draft.view.record.is_some() {
        draft.condition(conditions::RECORDED, Truth::False, Reason::Waiting, "");
    }
    draft.show(reason, message);
}

/// A time span in its two largest units.
fn duration(seconds: i64) -> String {
    let minutes = seconds.max(0) / 60;
    match (minutes / 1440, minutes / 60 % 24, minutes % 60) {
        (0, 0, 0) => format!("{}s", seconds.max(0)),
        (0, 0, minutes) => format!("{minutes}m"),
        (0, hours, minutes) => format!("{hours}h{minutes}m"),
        (days, hours, _) => format!("{days}d{hours}h"),
    }
}

/// An announced end of a node is `NodeInterrupted`, which no agent can provoke.
const REASONS: [Reason; 9] = [
    Reason::SimulationCrashed,
    Reason::EvaluatorFailed,
    Reason::ResultsNotStored,
    Reason::JobFailed,
    Reason::CannotStart,
    Reason::NodeCannotStart,
    Reason::NodeLost,
    Reason::DiskFull,
    Reason::ImagePull,
];

/// True if an agent can have provoked a failure.
fn is_provoked(found: &Failure) -> bool {
    // A pull of the hosts' own images belongs to no worker.
    let is_of_hosts = found.reason == Reason::ImagePull && found.worker.is_none();
    found.class == FailureClass::Infrastructure && !is_of_hosts && found.reason.is_one_of(&REASONS)
}

/// True if the rule leaves another Job: `before` has the units that were stored when the failed Job was due, None for the attempt's first
/// such failure; `stored` those that are stored by now.
pub(super) fn may_go_on(found: &Failure, before: Option<i32>, stored: i32) -> bool {
    !is_provoked(found) || before.is_none_or(|before| stored > before)
}

/// True if the rule leaves another Job after the present one.
fn leaves_a_job(draft: &PlanBuilder<'_>, found: &Failure) -> bool {
    may_go_on(found, draft.status.done_before, stored_units(draft))
}

/// Notes what the next Job begins with.
fn note_provoked(draft: &mut PlanBuilder<'_>, found: &Failure) {
    if is_provoked(found) || draft.status.done_before.is_some() {
        draft.status.done_before = Some(stored_units(draft));
    }
}

/// A failure that ends its attempt, with the rule if that is why.
fn explained(draft: &PlanBuilder<'_>, found: Failure) -> Failure {
    if leaves_a_job(draft, &found) {
        return found;
    }
    Failure {
        message: format!(
            "{} The attempt had such an end before, and this Job has finished no {}, so no further Job follows.",
            found.message,
            draft.words().unit
        ),
        ..found
    }
}

/// Number of stored units of the attempt. Units that an earlier attempt has reached count among them.
fn stored_units(draft: &PlanBuilder<'_>) -> i32 {
    let reached = draft.status.progress.as_ref().map_or(0, |progress| progress.done);
    draft.view.report.ours().map_or(reached, |report| clamp(report.done))
}
