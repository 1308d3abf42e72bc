//! From the Job's creation to its running agents: what its Pod waits for, and when that has taken too long.
//!
//! Also of a Pod that replaces a lost one: the submission then keeps its state, with the reason `Replacing`. Pulls of images have a deadline
//! apart from all the rest (`limits`).

use jiff::Timestamp;

use super::cause::{self, Cause, Trouble};
use super::failure::infrastructure;
use super::plan::Action;
use super::status::PlanBuilder;
use super::waits::{Wait, after};
use super::workers::agents_of;
use super::{limits, run, suspend};
use crate::view::{JobView, ObservedJob, ObservedNode, PodView, ScaleUp};
use leaderboard_api::Reason;
use leaderboard_api::conditions::{self, Truth};
use leaderboard_api::text::sentence;
use leaderboard_pod_spec::job as job_spec;

/// The message for a Pod that starts as it should.
const PREPARED: &str = "The Pod is being prepared.";

/// The message between the agent's end and the evaluators' start.
const AGENT_IS_DONE: &str = "The agent has ended; the evaluators start.";

/// The kubelet's reason where a device plugin does not give the devices on which the scheduler counted.
const NOT_ADMITTED: &str = "UnexpectedAdmissionError";

const LOST: &str = "The Pod was lost. A new Pod will resume from the results in S3.";

/// The minutes of silence that are reported: a count of every one would be a write each.
const REPORTED_MINUTES: [i64; 6] = [2, 5, 10, 20, 30, 60];

pub(super) fn start_job(draft: &mut PlanBuilder<'_>) {
    let view = draft.view;
    let name = draft.job_name();
    draft.status.waiting = None;
    draft.status.next_retry_time = None;
    draft.status.job_name = Some(name);
    note_gpus(draft);
    draft.act(Action::CreateJob(draft.status.job_number()));
    if let ObservedJob::Absent { refused: Some(words) } = &view.job {
        job_refused(draft, words);
    } else if draft.is_running() {
        draft.waits(Reason::Preparing);
        let message = "The Job was deleted by somebody else. A new Job will resume from the results in S3.";
        draft.replacing(message);
    } else {
        draft.waits(Reason::Preparing);
        draft.condition(conditions::RUNNING, Truth::False, Reason::Preparing, "");
        draft.show(Reason::Preparing, PREPARED);
    }
    run::update_evalai(draft);
    run::record_progress(draft);
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

/// An older object of the same name still has the Job.
pub(super) fn name_taken(draft: &mut PlanBuilder<'_>) {
    let message = format!(
        "The Job {} belongs to an older object of this name and is going away. If it stays, delete it.",
        draft.job_name()
    );
    let message = draft.stall(Reason::JobNameTaken, &message);
    draft.show(Reason::JobNameTaken, message);
    draft.look_again(Wait::JOB_NAME);
}

/// Reports how far a Job's Pod is, and fails the attempt when a start has taken too long.
pub(super) fn watch(draft: &mut PlanBuilder<'_>, job: &JobView) {
    let view = draft.view;
    let Some(pod) = &view.pod else {
        return without_pod(draft, job);
    };
    if let Some((reason, words)) = &pod.ended_by_node {
        return ended_by_node(draft, pod, reason, words);
    }
    if pod.delete_by.is_some() {
        draft.moves();
        return draft.replacing(LOST);
    }
    if let Some(message) = left_by_node(draft, pod) {
        draft.moves();
        return draft.replacing(&message);
    }
    if let Some(words) = &pod.unschedulable {
        return unschedulable(draft, job, words, pod.scale_up.as_ref());
    }
    let since = pod.scheduled.or(job.begun()).unwrap_or(draft.now());
    on_its_node(draft, pod, since);
}

/// Judges the containers of a Pod that has its node, or waits for one in silence.
fn on_its_node(draft: &mut PlanBuilder<'_>, pod: &PodView, since: Timestamp) {
    let found = cause::trouble_of(pod);
    let stalled = found
        .as_ref()
        .map(|found| draft.blocked_since(found.reason).unwrap_or(draft.now()));
    // Until the scheduler has spoken there is no node that could be late.
    let agents = agents_of(&draft.status);
    let limit = limits::limit(pod, agents, &draft.deadlines(), stalled);
    let over = limit.filter(|limit| draft.now() >= limit.at);
    let lasted = found.as_ref().and_then(|found| lasts(draft, found));
    let has_started = pod.agent_started.is_some();
    let awaits_evaluators = limits::awaits_evaluators(pod, agents);
    match (found, over) {
        (Some(found), _) if found.is_hopeless => draft.fail(cause::failure_of(&found, pod, 0)),
        (Some(found), Some(over)) if found.is_start => draft.fail(cause::failure_of(&found, pod, over.seconds)),
        (Some(found), _) => {
            if let Some(seconds) = lasted {
                return draft.fail(cause::failure_of(&found, pod, seconds));
            }
            show_trouble(draft, &found, has_started);
            if let Some(limit) = limit.filter(|_| found.is_start) {
                draft.requeue_at(limit.at);
            }
        }
        (None, _) if has_started && !awaits_evaluators => show_running(draft, ""),
        (None, Some(over)) => draft.fail(limits::start_deadline(pod, agents, over)),
        (None, None) => {
            if has_started {
                show_running(draft, AGENT_IS_DONE);
            } else {
                show_preparing(draft, pod, since);
            }
            if let Some(limit) = limit {
                draft.requeue_at(limit.at);
            }
        }
    }
}

/// The kubelet ended the Pod as a whole. The Job makes another, unless the node has not even admitted this one: it would not admit the
/// next one either, and looks free to the scheduler.
fn ended_by_node(draft: &mut PlanBuilder<'_>, pod: &PodView, reason: &str, words: &str) {
    let node = cause::node_of(pod);
    if reason == NOT_ADMITTED {
        let what = sentence(&format!(
            "On {node} the kubelet did not admit the Pod ({reason}): {words}"
        ));
        return draft.fail(infrastructure(Reason::NodeCannotStart, &what));
    }
    let what = sentence(&format!("On {node} the kubelet ended the Pod ({reason}): {words}"));
    draft.moves();
    draft.replacing(&format!("{what} A new Pod will resume from the results in S3."));
}

/// For how many seconds a node has not started a container again in mid-run, if that is too long: such a container has no end that would
/// count as a crash. If it is not yet, it is looked at again then.
fn lasts(draft: &mut PlanBuilder<'_>, found: &Trouble) -> Option<i64> {
    if found.is_start || found.cause != Cause::Node {
        return None;
    }
    let seconds = draft.deadlines().start_seconds;
    let since = draft.blocked_since(found.reason).unwrap_or(draft.now());
    (!draft.waits_until(after(since, seconds))).then_some(seconds)
}

/// The message for a run whose node is away, before Kubernetes has given its Pod up.
fn left_by_node(draft: &PlanBuilder<'_>, pod: &PodView) -> Option<String> {
    let node = pod.node.as_deref().filter(|_| draft.is_running())?;
    match draft.view.node.state {
        ObservedNode::Gone => Some(format!(
            "Node {node} is gone, and the Pod with it. A new Pod will resume from the results in S3."
        )),
        ObservedNode::Silent { since } => Some(format!(
            "Node {node} has been silent since {since:.0}. If that lasts, the Pod is given up, and a new Pod will resume from the results in S3."
        )),
        ObservedNode::Reports | ObservedNode::Unknown => None,
    }
}

/// Shows that it runs, with its progress, or these words where there is none.
fn show_running(draft: &mut PlanBuilder<'_>, words: &str) {
    let reason = if draft.status.is_resumed() {
        Reason::Resumed
    } else {
        Reason::Running
    };
    let progress = draft.status.progress.as_ref();
    let message = match progress {
        Some(progress) if words.is_empty() => format!("{} {} done.", progress.text, progress.unit),
        _ => words.to_owned(),
    };
    draft.moves();
    draft.condition(conditions::RUNNING, Truth::True, reason, "");
    draft.show(reason, message);
}

/// Shows what a Pod waits for whose agents have not started.
fn show_wait(draft: &mut PlanBuilder<'_>, reason: Reason, message: &str) {
    if draft.is_running() {
        let what = what_went(draft);
        draft.replacing(&format!("{what}, and the new Pod waits. {message}"));
    } else {
        draft.show(reason, message);
    }
}

/// Why a run is between two Pods.
fn what_went(draft: &PlanBuilder<'_>) -> &'static str {
    if suspend::was_resumed(draft) {
        "The Job was suspended and resumed"
    } else {
        "The Pod was lost"
    }
}

fn show_trouble(draft: &mut PlanBuilder<'_>, found: &Trouble, has_started: bool) {
    draft.stall_with(found.reason, &found.message);
    if has_started {
        draft.show(found.reason, found.message.clone());
    } else {
        show_wait(draft, found.reason, &found.message);
    }
}

fn show_preparing(draft: &mut PlanBuilder<'_>, pod: &PodView, since: Timestamp) {
    draft.moves();
    let silent = draft.now().duration_since(since).as_secs();
    let mut told = [Wait::PREPARATION.silent]
        .into_iter()
        .chain(REPORTED_MINUTES.map(|minutes| minutes * 60));
    if let Some(next) = told.find(|at| silent < *at) {
        draft.requeue_at(after(since, next));
    }
    let message = if silent < Wait::PREPARATION.silent {
        PREPARED.to_owned()
    } else {
        let told = REPORTED_MINUTES.iter().rev().find(|m| silent >= **m * 60);
        let long = told.map_or_else(String::new, |m| format!(", for over {m} min"));
        let node = pod.node.as_deref().map(|n| format!(" on {n}")).unwrap_or_default();
        format!("The Pod is being prepared{node}: {}{long}.", limits::stage(pod))
    };
    if draft.is_running() {
        let what = what_went(draft);
        draft.replacing(&format!("{what}. {message}"));
    } else {
        draft.show(Reason::Preparing, message);
    }
}

fn without_pod(draft: &mut PlanBuilder<'_>, job: &JobView) {
    let had_pod = draft.status.times.scheduled.is_some();
    if let Some(words) = &job.failed_create {
        if settles(draft, job) {
            return;
        }
        let (reason, message) = refused("Pod", words);
        if !is_late(draft, job, reason, &message) {
            draft.stall_with(reason, &message);
            show_wait(draft, reason, &message);
        }
    } else if had_pod {
        draft.replacing(if suspend::was_resumed(draft) {
            suspend::RESUMED
        } else {
            LOST
        });
    } else if let Some(at) = job.begun().map(|at| Wait::POD.shown_at(at)) {
        if draft.waits_until(at) {
            return;
        }
        let message = "The Job has not created a Pod and no event explains why. Look at the Job, and check that the \
                       cluster's controller manager runs.";
        draft.stall_with(Reason::Preparing, message);
        show_wait(draft, Reason::Preparing, message);
    }
}

/// Shows why the API server does not make the Job; each next try asks it again.
fn job_refused(draft: &mut PlanBuilder<'_>, words: &str) {
    let (reason, message) = refused("Job", words);
    draft.stall_with(reason, &message);
    if draft.is_running() {
        draft.replacing(&message);
    } else {
        draft.condition(conditions::RUNNING, Truth::False, reason, "");
        draft.show(reason, message);
    }
}

/// A reason and what to show of an object that the API server refuses.
fn refused(what: &str, words: &str) -> (Reason, String) {
    let is_quota = words.contains("exceeded quota") || words.contains("failed quota");
    let (reason, what) = if is_quota {
        let what = format!("The namespace's quota does not allow the {what}");
        (Reason::QuotaExceeded, what)
    } else {
        (Reason::PodRefused, format!("The API server refuses the {what}"))
    };
    (reason, sentence(&format!("{what}: {words}")))
}

/// Shows nothing yet of a Job that is new.
fn settles(draft: &mut PlanBuilder<'_>, job: &JobView) -> bool {
    job.begun().is_some_and(|at| draft.waits_until(Wait::NODE.shown_at(at)))
}

fn unschedulable(draft: &mut PlanBuilder<'_>, job: &JobView, words: &str, scale_up: Option<&ScaleUp>) {
    if settles(draft, job) {
        return;
    }
    let of_nodes = match scale_up {
        Some(ScaleUp::Coming(words)) => format!(" A node is on its way: {}", sentence(words)),
        Some(ScaleUp::Refused(words)) => format!(" The autoscaler adds no node: {}", sentence(words)),
        None => String::new(),
    };
    let (reason, message) = (Reason::Unschedulable, sentence(words) + &of_nodes);
    if is_late(draft, job, reason, &message) {
        return;
    }
    if matches!(scale_up, Some(ScaleUp::Coming(_))) {
        draft.waits_since(reason, &message);
    } else {
        draft.stalls_after(Wait::NODE, reason, &message);
    }
    show_wait(draft, reason, &message);
}

/// True if no node has had the Pod for as long as `scheduleSeconds` allows: then the attempt fails.
fn is_late(draft: &mut PlanBuilder<'_>, job: &JobView, reason: Reason, message: &str) -> bool {
    let Some(limit) = draft.deadlines().schedule_seconds else {
        return false;
    };
    let had_pod = draft.status.times.scheduled.is_some();
    let since = if had_pod {
        draft.blocked_since(reason)
    } else {
        job.begun()
    };
    let deadline = after(since.unwrap_or(draft.now()), limit);
    if draft.waits_until(deadline) {
        return false;
    }
    let what = format!("No node accepted the Pod within {limit} s: {message}");
    draft.fail(infrastructure(Reason::ScheduleDeadline, &what));
    true
}
