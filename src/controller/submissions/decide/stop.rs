//! The way to an end that is not the run's own: stops, deleted Jobs, lost Pods. Every path ends in bounded time.

use std::time::Duration;

use jiff::Timestamp;
use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;

use super::plan::Action;
use super::status::PlanBuilder;
use super::waits::{Wait, after};
use super::{failure, interruption, log, run, start};
use crate::controller::submissions::view::{JobView, ObservedNode, PodView};
use leaderboard_api::reasons;
use leaderboard_contract::run::Stop;

/// Brings a Job to its end: first by word, then by deletion, then by force.
pub(super) fn decide(draft: &mut PlanBuilder<'_>, job: &JobView) {
    let since = stopping_since(draft);
    show(draft);
    let log_left = log::keep_while_there(draft);
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
    } else if is_leaving && pod.delete_by.is_some() {
        // It stores all by itself; the Job must make no other Pod meanwhile.
        let left = delete_at.duration_since(draft.now()).as_secs();
        end_job(draft, job, left.max(grace), log_left);
    } else {
        annotate(draft, pod);
        draft.requeue_at(delete_at);
    }
}

/// Whether the Job ends because its node is about to go.
fn is_leaving(draft: &PlanBuilder<'_>) -> bool {
    !draft.is_cancelled() && draft.status.failure.as_deref().is_some_and(interruption::is_one)
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
    let message = match failure {
        Some(failure) if failure.reason == reasons::NODE_LOST => {
            let what = failure.message.clone();
            return start::replacing(draft, &what);
        }
        Some(failure) if interruption::is_one(failure) => {
            let what = format!(
                "{} Its results are being stored; a new Job resumes from them.",
                failure.message
            );
            return start::replacing(draft, &what);
        }
        Some(failure) => format!(
            "{} The run is being stopped; completed routes are kept.",
            failure.message
        ),
        None if draft.is_cancelled() => "Stopping as requested; completed routes are kept.".to_owned(),
        None => {
            let wanted = draft.spec().attempt;
            let what =
                format!("The run stops for attempt {wanted}, which resumes from its results; they are being stored.");
            return start::replacing(draft, &what);
        }
    };
    draft.show(reasons::STOPPING, message);
}

fn annotate(draft: &mut PlanBuilder<'_>, pod: &PodView) {
    if pod.stop.is_some() {
        return;
    }
    let stop = if draft.is_cancelled() {
        Stop::Cancel
    } else {
        failure::stop_of(draft.status.failure.as_deref())
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

/// Removes a Pod that we can't reach. The fence goes first: what it still writes counts for nobody. Returns whether it did.
fn force(draft: &mut PlanBuilder<'_>, pod: &PodView) -> bool {
    draft.act(Action::TakeOwnership);
    if let Some(left) = run::fence_left(draft) {
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
        start::replacing(draft, "The Job is being deleted by somebody else; it is created again.");
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

/// A Pod that goes away although nobody asked it to stop, on a node that is gone: the Job would wait for the node.
pub(super) fn lost_pod<'a>(draft: &mut PlanBuilder<'a>) -> Option<&'a PodView> {
    let is_given_up = |f: &leaderboard_api::Failure| f.reason == reasons::NODE_LOST;
    let other_end = draft.is_cancelled() || draft.status.failure.as_deref().is_some_and(|f| !is_given_up(f));
    let pod = draft.view.pod.as_ref().filter(|_| !other_end)?;
    let at = given_up_at(draft.view.node.state, pod)?;
    if draft.now() >= at {
        return Some(pod);
    }
    draft.requeue_at(at);
    None
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

/// Ends the Job of a lost Pod; once it is gone, the infrastructure's retry follows.
pub(super) fn leave_lost_pod(draft: &mut PlanBuilder<'_>, job: &JobView, pod: &PodView) {
    let found = failure::node_lost(pod.node.as_deref(), draft.view.node.state);
    start::replacing(draft, &found.message);
    draft.fail(found);
    if force(draft, pod) {
        draft.act(delete(job, 0));
        draft.look_again(Wait::DELETION);
    }
}
