//! A node that is about to be taken away under a run, or a Pod that is evicted: the results are stored while there is time, and
//! another Job resumes from them elsewhere.
//!
//! Called by `live` and `end`. How the Pod is brought to its end is in `stop`. Such an end uses up neither an attempt nor a retry, so
//! nothing counts here that an agent could bring about: no pressure on its node, and no node that falls silent.

use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;

use super::failure::infrastructure;
use super::status::PlanBuilder;
use crate::controller::submissions::view::PodView;
use leaderboard_api::{Failure, Interruptions, MAX_INTERRUPTED_NODES, SubmissionStatus, reasons};

/// Interruptions of an attempt that use up no retry. A cluster that takes every node away must not keep a run going in circles.
const FREE: i32 = 20;

/// Ends the present Job if its node is about to go, or its Pod.
pub(super) fn notice(draft: &mut PlanBuilder<'_>) {
    let view = draft.view;
    let pod = view.pod.as_ref();
    let Some(pod) = pod.filter(|pod| pod.run_ended.is_none() && pod.ended_by_node.is_none()) else {
        return;
    };
    if let Some(what) = cause(draft, pod) {
        draft.fail(infrastructure(reasons::NODE_INTERRUPTED, &what));
    }
}

fn cause(draft: &PlanBuilder<'_>, pod: &PodView) -> Option<String> {
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

/// Who evicts a Pod, unless its own containers may be the cause: they can use up the node's memory, so that the kubelet evicts them, or
/// the node is not ready and the taint manager does.
fn taken_by(pod: &PodView) -> Option<&str> {
    let who = pod.disruption.as_deref()?;
    ["EvictionByEvictionAPI", "PreemptionByScheduler"]
        .contains(&who)
        .then_some(who)
}

/// Whether a failure is one.
pub(super) fn is_one(found: &Failure) -> bool {
    found.reason == reasons::NODE_INTERRUPTED
}

/// Jobs of the attempt that ended otherwise, because of the infrastructure.
pub(super) fn other_failures(status: &SubmissionStatus) -> i32 {
    let interruptions = status.interruptions.as_ref().map_or(0, |past| past.number);
    status.retry.saturating_sub(interruptions)
}

/// One more.
pub(super) fn note(draft: &mut PlanBuilder<'_>) {
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
