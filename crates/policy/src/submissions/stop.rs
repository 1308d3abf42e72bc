//! The way to an end that is not the run's own: a cancel, a lost Pod, a node that is about to be taken away. Every path ends in bounded time.
//!
//! An interruption uses up neither an attempt nor a retry, so nothing counts as one that an agent could bring about: no pressure on its node, and
//! no node that falls silent.

use std::time::Duration;

use jiff::Timestamp;
use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;

use super::failure::{self, infrastructure};
use super::plan::Action;
use super::status::PlanBuilder;
use super::waits::{Wait, after};
use super::workers::agents_of;
use super::{limits, logs};
use crate::view::{JobView, ObservedFence, ObservedLog, ObservedNode, PodView};
use leaderboard_api::{Agents, Failure, Interruptions, MAX_INTERRUPTED_NODES, Reason, SubmissionStatus};
use leaderboard_contract::run::Stop;

/// Brings a Job to its end: first by word, then by deletion, then by force.
pub(super) fn decide(draft: &mut PlanBuilder<'_>, job: &JobView) {
    let since = stopping_since(draft);
    show(draft);
    let log_left = keep_while_there(draft);
    let view = draft.view;
    let is_leaving = is_leaving(draft);
    let (seconds, grace) = if is_leaving {
        (Wait::LEAVING.longest, Wait::LEAVING_GRACE.longest)
    } else {
        (
            draft.deadlines().cancel_seconds + Wait::STOP_MARGIN.longest,
            Wait::DELETION.longest,
        )
    };
    // Before the first agent there is nothing to store, and none may ever begin: logcopy alone would wait for the end of all.
    let Some(pod) = view.pod.as_ref().filter(|pod| pod.agent_started.is_some()) else {
        return end_job(draft, job, grace, log_left);
    };
    let delete_at = after(since, seconds);
    let force_at = Wait::STOP_MARGIN.over_at(after(delete_at, grace));
    if draft.now() >= force_at {
        if log_left.is_none() && force(draft, pod) {
            end_job(draft, job, 0, None);
        }
        draft.look_again(Wait::DELETION);
    } else if draft.now() >= delete_at {
        end_job(draft, job, grace, log_left);
        draft.requeue_at(force_at);
    } else if (is_leaving && pod.delete_by.is_some()) || needs_no_evaluators(draft, pod) {
        // It stores all by itself; the Job must make no other Pod meanwhile.
        let left = delete_at.duration_since(draft.now()).as_secs();
        end_job(draft, job, left.max(grace), log_left);
    } else {
        annotate(draft, pod);
        draft.requeue_at(delete_at);
    }
}

/// True if a run has its final report and no evaluator yet. The kubelet would still pull the evaluators' images, to start what ends at once.
fn needs_no_evaluators(draft: &PlanBuilder<'_>, pod: &PodView) -> bool {
    let report = draft.view.report.ours().filter(|report| report.pod_uid == pod.uid);
    let is_first = agents_of(&draft.status) == Agents::First;
    is_first && report.is_some_and(|report| report.is_final) && !limits::have_hosts_begun(pod)
}

/// True if the Job ends because its node is about to go.
fn is_leaving(draft: &PlanBuilder<'_>) -> bool {
    !draft.is_cancelled() && draft.status.failure.as_deref().is_some_and(is_interruption)
}

/// Deletes a Job, once the log that goes with its Pod is kept or was waited for long enough.
fn end_job(draft: &mut PlanBuilder<'_>, job: &JobView, grace_seconds: i64, log_left: Option<Duration>) {
    if let Some(left) = log_left {
        return draft.requeue_in(left);
    }
    draft.act(delete(job, grace_seconds));
    draft.look_again(Wait::DELETION);
}

/// When the stop began. A clock that was set back must not put its end off, so the stop begins anew then.
fn stopping_since(draft: &mut PlanBuilder<'_>) -> Timestamp {
    let now = draft.now();
    let since = draft.status.times.stopping.as_ref().map_or(now, |t| t.0.min(now));
    draft.status.times.stopping = Some(Time(since));
    since
}

fn show(draft: &mut PlanBuilder<'_>) {
    let failure = draft.status.failure.as_deref().filter(|_| !draft.is_cancelled());
    let what = failure.map_or("", |failure| failure.message.as_str());
    let (units, wanted) = (draft.words().units, draft.spec().attempt);
    let (is_replaced, message) = match failure {
        Some(failure) if failure.reason == Reason::NodeLost => (true, what.to_owned()),
        Some(failure) if is_interruption(failure) => (
            true,
            format!("{what} Its results are being stored; a new Job resumes from them."),
        ),
        Some(_) => (
            false,
            format!("{what} The run is being stopped; completed {units} are kept."),
        ),
        None if draft.is_cancelled() => (false, format!("Stopping as requested; completed {units} are kept.")),
        None => (
            true,
            format!("The run stops for attempt {wanted}, which resumes from its results; they are being stored."),
        ),
    };
    if is_replaced {
        draft.replacing(&message);
    } else {
        draft.show(Reason::Stopping, message);
    }
}

fn annotate(draft: &mut PlanBuilder<'_>, pod: &PodView) {
    if pod.stop.is_some() {
        return;
    }
    let failure = draft.status.failure.as_deref();
    let stop = match failure.map(|failure| failure.reason.known()) {
        _ if draft.is_cancelled() => Stop::Cancel,
        Some(Some(Reason::TimeLimit)) => Stop::RunDeadline,
        // Without a failure it is stopped for a higher attempt.
        Some(Some(Reason::NodeInterrupted)) | None => Stop::Interruption,
        _ => Stop::Retries,
    };
    draft.act(Action::StopPod {
        pod: pod.name.clone(),
        stop,
    });
}

/// Deletes a Job with its Pods.
pub(super) fn delete(job: &JobView, grace_seconds: i64) -> Action {
    Action::DeleteJob {
        name: job.name.clone(),
        uid: job.uid.clone(),
        grace_seconds,
    }
}

/// Removes a Pod that we can't reach. The fence goes first, so that its later writes do not count. Returns true once it deletes the Pod.
fn force(draft: &mut PlanBuilder<'_>, pod: &PodView) -> bool {
    draft.act(Action::TakeOwnership);
    if let Some(left) = fence_left(draft) {
        draft.requeue_in(left);
        return false;
    }
    draft.act(Action::DeletePod {
        name: pod.name.clone(),
        uid: pod.uid.clone(),
    });
    true
}

/// We, or somebody else, deleted the Job; it goes with its Pod.
pub(super) fn being_deleted(draft: &mut PlanBuilder<'_>) {
    if draft.is_to_stop() {
        stopping_since(draft);
        show(draft);
    } else {
        draft.replacing("The Job is being deleted by somebody else; it is created again.");
    }
    remove_overdue_pod(draft);
    draft.look_again(Wait::OTHERS_DELETION);
}

/// Removes by force a Pod that outstays its grace.
pub(super) fn remove_overdue_pod(draft: &mut PlanBuilder<'_>) {
    let view = draft.view;
    let overdue = |pod: &&PodView| {
        pod.delete_by
            .is_some_and(|by| view.now >= Wait::STOP_MARGIN.over_at(by))
    };
    if let Some(pod) = view.pod.as_ref().filter(overdue) {
        force(draft, pod);
    }
}

/// When a Pod that is being deleted is given up. While the kubelet reports it has the whole grace, and then some.
fn given_up_at(node: ObservedNode, pod: &PodView) -> Option<Timestamp> {
    let by = pod.delete_by?;
    let deleted = pod.deleted.unwrap_or(by);
    let at = match node {
        ObservedNode::Unknown => Wait::LOST_POD.over_at(by),
        ObservedNode::Reports => Wait::STUCK_POD.over_at(by),
        ObservedNode::Silent { since } => Wait::SILENT_NODE.over_at(deleted.max(since)),
        ObservedNode::Gone => Wait::SILENT_NODE.over_at(deleted),
    };
    // A grace that is shorter than the silence is over all the same.
    Some(at.min(Wait::STUCK_POD.over_at(by)))
}

/// Ends the Job of a Pod that goes away unasked, on a node that is gone: the Job would wait for the node. Once it is
/// gone, the infrastructure's retry follows. Returns true if the Pod is given up.
pub(super) fn leaves_lost_pod(draft: &mut PlanBuilder<'_>, job: &JobView) -> bool {
    let failure = draft.status.failure.as_deref();
    let other_end = draft.is_cancelled() || failure.is_some_and(|f| f.reason != Reason::NodeLost);
    let pod = draft.view.pod.as_ref().filter(|_| !other_end);
    let Some((pod, at)) = pod.and_then(|pod| Some((pod, given_up_at(draft.view.node.state, pod)?))) else {
        return false;
    };
    if draft.waits_until(at) {
        return false;
    }
    let found = failure::node_lost(pod.node.as_deref(), draft.view.node.state, draft.words());
    draft.replacing(&found.message);
    draft.fail(found);
    if force(draft, pod) {
        draft.act(delete(job, 0));
        draft.look_again(Wait::DELETION);
    }
    true
}

/// How long a lost Pod still waits for the fence.
fn fence_left(draft: &PlanBuilder<'_>) -> Option<Duration> {
    let waited = match draft.view.requested.fence {
        // Without a plan the place of the fence is unknown.
        _ if draft.status.plan.is_none() => return None,
        ObservedFence::Held => return None,
        ObservedFence::NotRequested => Duration::ZERO,
        ObservedFence::Pending(waited) | ObservedFence::Failed(waited) => waited,
    };
    Wait::FENCE.left(waited)
}

/// How long the steps after the Pod wait for the fence: only for one that was requested.
pub(super) fn requested_fence_left(draft: &PlanBuilder<'_>) -> Option<Duration> {
    fence_left(draft).filter(|_| draft.view.requested.fence != ObservedFence::NotRequested)
}

/// Requests the log of a run that is being stopped for a failure, as far as the end of its Pod would take it away. Returns how
/// long that end waits for it.
fn keep_while_there(draft: &mut PlanBuilder<'_>) -> Option<Duration> {
    if draft.is_cancelled() {
        return None;
    }
    let mut places = logs::log_places(&draft.status, draft.view.pod.as_ref());
    // The log in S3 is complete only when the Pod has ended; it is read then, and the best place first.
    if !places.first().is_some_and(logs::is_on_node) {
        return None;
    }
    places.retain(logs::is_on_node);
    draft.act(Action::KeepLog { places });
    log_left(draft.view.requested.log, Wait::LOG.left(Duration::ZERO))
}

/// How long a log is still waited for, None if not at all. `at_first` is the answer before the log is requested.
pub(super) fn log_left(log: ObservedLog, at_first: Option<Duration>) -> Option<Duration> {
    match log {
        ObservedLog::NotRequested => at_first,
        ObservedLog::Pending(waited) => Wait::LOG.left(waited),
        ObservedLog::Kept | ObservedLog::None | ObservedLog::GivenUp => None,
    }
}

/// Interruptions of an attempt that use up no retry. A cluster that takes every node away must not keep a run going in circles.
const FREE: i32 = 20;

/// Ends the present Job if its node is about to go, or its Pod.
pub(super) fn notice(draft: &mut PlanBuilder<'_>) {
    let view = draft.view;
    let pod = view.pod.as_ref();
    let Some(pod) = pod.filter(|pod| pod.run_ended.is_none() && pod.ended_by_node.is_none()) else {
        return;
    };
    if let Some(what) = interruption(draft, pod) {
        draft.fail(infrastructure(Reason::NodeInterrupted, &what));
    }
}

fn interruption(draft: &PlanBuilder<'_>, pod: &PodView) -> Option<String> {
    let past = draft.status.interruptions.as_ref();
    if past.is_some_and(|past| past.number >= FREE) {
        return None;
    }
    let node = pod.node.as_deref()?;
    if let Some(who) = taken_by(pod) {
        return Some(format!("Pod {} is taken from node {node} ({who}).", pod.name));
    }
    let taint = draft.view.node.leaving.as_deref()?;
    // A Pod that tolerates the taint can come back to the same node.
    let was_here = past.is_some_and(|past| past.nodes.iter().any(|known| known == node));
    (!was_here).then(|| format!("Node {node} is about to be taken away (taint {taint})."))
}

/// The evictor of a Pod, unless its own containers may be the cause: they can use up the node's memory, so that the kubelet evicts them, or
/// the node is not ready and the taint manager does.
fn taken_by(pod: &PodView) -> Option<&str> {
    let who = pod.disruption.as_deref()?;
    ["EvictionByEvictionAPI", "PreemptionByScheduler"]
        .contains(&who)
        .then_some(who)
}

/// True if a failure is an interruption.
pub(super) fn is_interruption(found: &Failure) -> bool {
    found.reason == Reason::NodeInterrupted
}

/// Jobs of the attempt that ended otherwise, because of the infrastructure.
pub(super) fn other_failures(status: &SubmissionStatus) -> i32 {
    let interruptions = status.interruptions.as_ref().map_or(0, |past| past.number);
    status.retry.saturating_sub(interruptions)
}

/// Counts an interruption.
pub(super) fn note_interruption(draft: &mut PlanBuilder<'_>) {
    let now = Time(draft.now());
    let node = draft.status.node_name.clone();
    let none = || Interruptions {
        number: 0,
        last_time: now.clone(),
        nodes: Vec::new(),
    };
    let known = draft.status.interruptions.get_or_insert_with(|| Box::new(none()));
    known.number = known.number.saturating_add(1);
    known.last_time = now;
    let Some(node) = node else { return };
    known.nodes.retain(|other| *other != node);
    if known.nodes.len() >= MAX_INTERRUPTED_NODES {
        known.nodes.remove(0);
    }
    known.nodes.push(node);
}
