//! Whether a Pod's node still reports, as the watch of nodes shows it, or read where there is none. Of a Pod that is being deleted
//! the answer decides between waiting for its kubelet and giving the Pod up; of one that runs, people learn of it before
//! Kubernetes has given the Pod up.

use std::collections::HashMap;

use futures::StreamExt;
use kube::runtime::reflector::ObjectRef;
use kube::{Api, Client};

use crate::controller::objects::Wake;
use crate::controller::stores::Stores;
use crate::controller::submissions::view::ObservedNode;
use crate::kubernetes::objects::{Node, Pod};
use crate::kubernetes::{CALL_TIMEOUT, Item, Store, WatchEvents};
use leaderboard_api::{Submission, client_errors};

/// What a watch shows of a node; None without a watch that can be relied on.
pub(super) fn watched(stores: &Stores, name: &str) -> Option<ObservedNode> {
    let nodes = stores.nodes.as_ref().filter(|nodes| nodes.synced.is_true())?;
    let found = nodes.store.get(&ObjectRef::new(name));
    Some(found.map_or(ObservedNode::Gone, |node| of(&node)))
}

/// Wakes the submissions of a node when it falls silent, reports again or goes. All Pods are walked then, which is rare: a node
/// that reports as before is no news.
pub async fn wake(mut nodes: WatchEvents<Node>, pods: Store<Pod>, wake: Wake<Submission>) {
    let mut known: HashMap<Box<str>, ObservedNode> = HashMap::new();
    while let Some(event) = nodes.next().await {
        let name: &str = &event.object.metadata.name;
        let (before, now) = if event.is_gone {
            (known.remove(name), ObservedNode::Gone)
        } else {
            let now = of(&event.object);
            (known.insert(name.into(), now), now)
        };
        if before.unwrap_or(ObservedNode::Reports) != now {
            let pods = pods.state();
            let of_node = pods.iter().filter(|pod| pod.spec.node_name.as_deref() == Some(name));
            of_node.filter_map(|pod| Stores::owner_of(pod.as_ref())).for_each(&wake);
        }
    }
}

/// Reads a node. Without the right to (an operator of one namespace has none) it stays unknown.
pub(super) async fn read(client: &Client, name: &str) -> ObservedNode {
    let nodes: Api<Item<Node>> = Api::all(client.clone());
    match tokio::time::timeout(CALL_TIMEOUT, nodes.get_opt(name)).await {
        Ok(Ok(Some(node))) => node.object.map_or(ObservedNode::Unknown, |node| of(&node)),
        Ok(Ok(None)) => ObservedNode::Gone,
        Ok(Err(error)) => {
            let error = client_errors::kube(&error);
            tracing::debug!(node = %name, error, "a node cannot be read");
            ObservedNode::Unknown
        }
        Err(_) => ObservedNode::Unknown,
    }
}

/// The node controller says `Unknown` of a kubelet whose lease and status have run out; `False` is the kubelet's own word.
fn of(node: &Node) -> ObservedNode {
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
            let conditions = json!([{"type": "Ready", "status": ready, "lastTransitionTime": "2026-01-01T00:00:00Z"}]);
            serde_json::from_value(
                json!({"metadata": {"name": name, "uid": name}, "status": {"conditions": conditions}}),
            )
            .unwrap()
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
            assert_eq!(of(&serde_json::from_value(node.clone()).unwrap()), expected, "{node}");
        }
        assert_eq!(of(&Node::default()), ObservedNode::Unknown);
    }
}
