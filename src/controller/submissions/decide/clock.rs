//! How long a run has gone on, and what its Jobs have used. A Pod that waits for a node takes neither time nor GPUs; one that is prepared
//! has its GPUs, and takes no time before its first agent.
//!
//! Called by the stages of a live submission and of its end. Pure. The Pods of one Job share one time: an agent wins nothing by
//! having its Pod evicted. A Job that replaces one which the infrastructure took away has the whole time again.

use jiff::Timestamp;
use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;

use super::status::PlanBuilder;
use crate::controller::submissions::view::PodView;
use leaderboard_api::conditions;

/// Notes when the Pod got its node. What the Pod before it has run and used is counted.
pub(super) fn take_node(draft: &mut PlanBuilder<'_>, pod: &PodView) {
    let Some(scheduled) = pod.scheduled else { return };
    if let Some(before) = scheduled_at(draft) {
        let is_another = scheduled > before && pod.created.is_some_and(|made| made > before);
        if !is_another {
            return;
        }
        let lost = lost_at(draft, before);
        draft.status.ran_seconds += began_at(draft).map_or(0, |began| seconds(began, lost));
        count_use(draft, lost);
        draft.status.times.agent_started = None;
    }
    draft.status.times.scheduled = Some(Time(scheduled));
}

/// Notes when the first agent of the attempt started, and that of its present Pod. What a Pod shows of it moves when its containers are
/// started again.
pub(super) fn take_agents(draft: &mut PlanBuilder<'_>, pod: &PodView) {
    let Some(first) = pod.agent_started.map(Time) else {
        return;
    };
    let is_known = began_at(draft).is_some();
    let times = &mut draft.status.times;
    if !is_known && times.agent_started.is_none() {
        times.agent_started = Some(first.clone());
    }
    if times.started.is_none() {
        times.started = Some(first);
    }
}

/// The present Job is gone, and another one begins anew.
pub(super) fn restart(draft: &mut PlanBuilder<'_>) {
    draft.status.times.scheduled = None;
    draft.status.times.agent_started = None;
    draft.status.ran_seconds = 0;
}

/// How long the present Job has run; None before its first agent.
pub(super) fn run_seconds(draft: &PlanBuilder<'_>) -> Option<i64> {
    let before = draft.status.ran_seconds;
    let Some(began) = began_at(draft) else {
        return (before > 0).then_some(before);
    };
    let until = until(draft, draft.now());
    Some(before.saturating_add(seconds(began, until)))
}

/// Counts what the present Pod of the Job has used, from its scheduling until its end.
pub(super) fn count_use(draft: &mut PlanBuilder<'_>, end: Timestamp) {
    let end = until(draft, end);
    if let (Some(scheduled), Some(usage)) = (scheduled_at(draft), draft.status.usage.as_mut()) {
        usage.add(seconds(scheduled, end));
    }
}

/// Whether the run takes time at present: the Pod that is there has a node, and an agent of it has started.
pub(super) fn goes_on(draft: &PlanBuilder<'_>) -> bool {
    has_node(draft) && began_at(draft).is_some()
}

fn has_node(draft: &PlanBuilder<'_>) -> bool {
    draft.view.pod.as_ref().is_some_and(|pod| pod.scheduled.is_some())
}

fn scheduled_at(draft: &PlanBuilder<'_>) -> Option<Timestamp> {
    draft.status.times.scheduled.as_ref().map(|time| time.0)
}

/// From when on the Pod that had a node last takes time: its first agent. Its clock may be behind that of its scheduling.
fn began_at(draft: &PlanBuilder<'_>) -> Option<Timestamp> {
    let times = &draft.status.times;
    let started = times.started.as_ref()?.0;
    let Some(scheduled) = scheduled_at(draft) else {
        return draft.is_first_job().then_some(started);
    };
    // An operator before this field has left it out: the attempt's first agent is that of this Pod if the Pod had its node before.
    let older = (started >= scheduled).then_some(started);
    let agent = times.agent_started.as_ref().map(|time| time.0).or(older)?;
    Some(agent.max(scheduled))
}

/// The end of what runs: it has ended with the Pod that had a node, if none has one.
fn until(draft: &PlanBuilder<'_>, end: Timestamp) -> Timestamp {
    match scheduled_at(draft) {
        Some(scheduled) if !has_node(draft) => end.min(lost_at(draft, scheduled)),
        _ => end,
    }
}

/// When the Pod was lost that had got its node at that time: its successor was made then, or it was seen that its agents no longer
/// ran; else now.
fn lost_at(draft: &PlanBuilder<'_>, scheduled: Timestamp) -> Timestamp {
    let made = draft.view.pod.as_ref().and_then(|pod| pod.created);
    let running = draft.status.condition(conditions::RUNNING);
    let stopped = running
        .filter(|running| running.status != "True")
        .map(|running| running.last_transition_time.0);
    let known = [made, stopped].into_iter().flatten().filter(|at| *at > scheduled);
    known.min().unwrap_or(draft.now())
}

fn seconds(from: Timestamp, until: Timestamp) -> i64 {
    until.duration_since(from).as_secs().max(0)
}
