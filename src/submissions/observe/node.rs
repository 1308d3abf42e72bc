//! The node of a Pod as the watch of nodes shows it: it reports, is silent, is about to go, or is gone. For a Pod that is being deleted
//! this decides between waiting for its kubelet and giving the Pod up. For a running Pod, people see a silent node before Kubernetes has
//! given the Pod up. The results are stored before the node is gone.

use std::collections::HashMap;

use futures::StreamExt;
use kube::runtime::reflector::ObjectRef;

use crate::kubernetes::objects::{Node, Pod};
use crate::kubernetes::{Store, WatchEvents};
use crate::runtime::objects::Wake;
use crate::runtime::stores::Stores;
use leaderboard_api::Submission;
use leaderboard_policy::view::{NodeView, ObservedNode};

/// Taints with which a cluster announces that a node is about to go. Karpenter, cluster-autoscaler, and a person or a controller that
/// knows a node to be off set them.
const LEAVING: [&str; 3] = [
    "karpenter.sh/disrupted",
    "ToBeDeletedByClusterAutoscaler",
    "node.kubernetes.io/out-of-service",
];
/// Prefix of the taints of the AWS Node Termination Handler: `spot-itn`, `scheduled-maintenance`, and others.
const TERMINATION_HANDLER: &str = "aws-node-termination-handler/";

/// A node as its watch shows it. It is unknown without the right to watch nodes, and while the API server does not answer the watch.
pub(super) fn watched(stores: &Stores, name: &str) -> NodeView {
    let Some(nodes) = stores.nodes.as_ref().filter(|nodes| nodes.synced.is_true()) else {
        return NodeView::default();
    };
    let found = nodes.store.get(&ObjectRef::new(name));
    found.map_or_else(|| in_state(ObservedNode::Gone), |node| of(&node))
}

/// Wakes the submissions of a node when it falls silent, reports again, is about to go or goes. All Pods are walked then, which is
/// rare: a node that reports as before is no news.
pub async fn wake(mut nodes: WatchEvents<Node>, pods: Store<Pod>, wake: Wake<Submission>) {
    let mut known: HashMap<Box<str>, NodeView> = HashMap::new();
    while let Some(event) = nodes.next().await {
        let name: &str = &event.object.metadata.name;
        let (before, now) = if event.is_gone {
            (known.remove(name), in_state(ObservedNode::Gone))
        } else {
            let now = of(&event.object);
            (known.insert(name.into(), now.clone()), now)
        };
        // Before it is first observed, it counts as one that reports.
        if before.unwrap_or_else(|| in_state(ObservedNode::Reports)) != now {
            let pods = pods.state();
            let of_node = pods.iter().filter(|pod| pod.spec.node_name.as_deref() == Some(name));
            of_node
                .filter_map(|pod| Stores::owner_of(&pod.metadata))
                .for_each(&wake);
        }
    }
}

/// A node whose end is not announced.
fn in_state(state: ObservedNode) -> NodeView {
    let leaving = None;
    NodeView { state, leaving }
}

fn of(node: &Node) -> NodeView {
    NodeView {
        state: state(node),
        leaving: leaving(node),
    }
}

/// The key of the taint that announces the node's end. A taint that only asks new Pods to prefer other nodes announces none.
fn leaving(node: &Node) -> Option<String> {
    let mut taints = node.spec.taints.iter();
    let found = taints.find(|taint| {
        let keeps_off = ["NoSchedule", "NoExecute"].contains(&&*taint.effect);
        keeps_off && (LEAVING.contains(&&*taint.key) || taint.key.starts_with(TERMINATION_HANDLER))
    })?;
    Some(found.key.to_string())
}

/// The node controller reports `Unknown` for a kubelet whose lease and status have run out; `False` is the kubelet's own report.
fn state(node: &Node) -> ObservedNode {
    match &node.status.ready {
        Some(ready) if &*ready.status != "Unknown" => ObservedNode::Reports,
        Some(ready) => ready
            .last_transition_time
            .as_ref()
            .map_or(ObservedNode::Unknown, |since| ObservedNode::Silent { since: since.0 }),
        None => ObservedNode::Unknown,
    }
}

#[cfg(test)]
mod tests {
    use std::sync::{Arc, Mutex};

    use futures::FutureExt;
    use leaderboard_api::names;
    use serde_json::json;

    use super::*;

    #[tokio::test]
    async fn only_the_submissions_of_a_node_that_has_changed_are_woken() {
        let node = |name: &str, ready: &str| -> Node {
            let (ready, taint) = ready.split_once(' ').unwrap_or((ready, ""));
            let conditions = json!([{"type": "Ready", "status": ready, "lastTransitionTime": "2026-01-01T00:00:00Z"}]);
            let taints = json!([{"key": taint, "effect": "NoSchedule"}]);
            let metadata = json!({"name": name, "uid": name});
            let node = json!({"metadata": metadata, "spec": {"taints": taints}, "status": {"conditions": conditions}});
            serde_json::from_value(node).unwrap()
        };
        let pod = |name: &str, node: &str| -> Pod {
            let metadata = json!({"name": name, "namespace": "n", "labels": {names::LABEL_SUBMISSION: name}});
            serde_json::from_value(json!({"metadata": metadata, "spec": {"nodeName": node}})).unwrap()
        };
        let pods = Store::of([pod("one", "a"), pod("two", "b")], |_| None);
        let (feed, events) = WatchEvents::by_hand();
        let woken = Arc::new(Mutex::new(Vec::new()));
        let queue = Arc::clone(&woken);
        let mut waking = Box::pin(wake(
            events,
            pods,
            Box::new(move |submission| queue.lock().unwrap().push(submission.name)),
        ));
        let mut shows = |name: &str, ready: &str, is_gone: bool| {
            feed(node(name, ready), is_gone);
            assert_eq!((&mut waking).now_or_never(), None);
            std::mem::take(&mut *woken.lock().unwrap())
        };
        assert!(shows("a", "True", false).is_empty() && shows("b", "True", false).is_empty());
        assert!(shows("a", "True", false).is_empty(), "a node reports all the time");
        assert_eq!(shows("a", "Unknown", false), ["one"]);
        assert_eq!(shows("a", "True", false), ["one"]);
        assert_eq!(shows("a", "True karpenter.sh/disrupted", false), ["one"]);
        assert!(shows("a", "True karpenter.sh/disrupted", false).is_empty());
        assert_eq!(shows("b", "True", true), ["two"]);
        assert_eq!(
            shows("b", "Unknown", false),
            ["two"],
            "silent when it is first observed"
        );
    }

    #[test]
    fn only_unknown_is_silence() {
        let since = "2026-01-01T00:00:00Z";
        let silent = ObservedNode::Silent {
            since: since.parse().unwrap(),
        };
        let ready = |status: &str| json!([{"type": "Ready", "status": status, "lastTransitionTime": since}]);
        for (conditions, expected) in [
            (ready("True"), ObservedNode::Reports),
            (ready("False"), ObservedNode::Reports),
            (ready("Unknown"), silent),
            (json!([{"type": "Ready", "status": "Unknown"}]), ObservedNode::Unknown),
            (
                json!([{"type": "DiskPressure", "status": "Unknown"}]),
                ObservedNode::Unknown,
            ),
            (json!([]), ObservedNode::Unknown),
        ] {
            let node = json!({"metadata": {"name": "n"}, "status": {"conditions": conditions}});
            let seen = of(&serde_json::from_value(node.clone()).unwrap());
            assert_eq!((seen.state, seen.leaving), (expected, None), "{node}");
        }
        assert_eq!(of(&Node::default()), NodeView::default());
    }

    #[test]
    fn a_taint_that_keeps_new_pods_off_announces_the_end_of_its_node() {
        for (key, effect, announces) in [
            ("karpenter.sh/disrupted", "NoSchedule", true),
            ("ToBeDeletedByClusterAutoscaler", "NoSchedule", true),
            ("aws-node-termination-handler/spot-itn", "NoSchedule", true),
            ("aws-node-termination-handler/scheduled-maintenance", "NoExecute", true),
            ("node.kubernetes.io/out-of-service", "NoExecute", true),
            ("karpenter.sh/disrupted", "PreferNoSchedule", false),
            ("DeletionCandidateOfClusterAutoscaler", "PreferNoSchedule", false),
            ("node.kubernetes.io/unschedulable", "NoSchedule", false),
            ("node.kubernetes.io/unreachable", "NoExecute", false),
            ("nvidia.com/gpu", "NoSchedule", false),
        ] {
            let others = json!({"key": "nvidia.com/gpu", "value": "true", "effect": "NoSchedule"});
            let node = json!({"spec": {"taints": [others, {"key": key, "effect": effect}]}});
            let seen = of(&serde_json::from_value(node).unwrap()).leaving;
            assert_eq!(seen.as_deref(), announces.then_some(key), "{key}:{effect}");
        }
    }
}
