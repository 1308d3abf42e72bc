//! Whether a Pod's node still speaks. Read from the API server: at once while the Pod is being deleted, when the answer decides
//! between waiting for its kubelet and giving the Pod up; now and then while the Pod runs, to tell people before Kubernetes
//! has given the Pod up. A node is asked for once in a while, however many Pods run on it.

use std::collections::HashMap;
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use k8s_openapi::api::core::v1::Node;
use kube::Api;
use tokio::time::Instant;

use crate::controller::context::{CALL_TIMEOUT, Context};
use crate::controller::view::{NodeSight, PodView};
use leaderboard_api::client_errors;

/// How long what a node has said is passed on to the Pods that run on it.
const FRESH: Duration = Duration::from_secs(15);

/// What nodes have said last, by name.
#[derive(Default)]
pub struct Nodes(Mutex<HashMap<String, (Instant, NodeSight)>>);

impl Nodes {
    fn get(&self, name: &str) -> Option<NodeSight> {
        let mut known = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        known.retain(|_, (asked, _)| asked.elapsed() < FRESH);
        known.get(name).map(|(_, sight)| *sight)
    }

    fn put(&self, name: &str, sight: NodeSight) {
        let mut known = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        known.insert(name.to_owned(), (Instant::now(), sight));
    }
}

/// The node of a Pod that runs, as it was seen not long ago.
pub(super) async fn recent_sight(context: &Context, pod: &PodView) -> NodeSight {
    let Some(name) = &pod.node else {
        return NodeSight::Unknown;
    };
    if let Some(known) = context.nodes.get(name) {
        return known;
    }
    let seen = sight(context, pod).await;
    context.nodes.put(name, seen);
    seen
}

/// Looks at the node of a Pod. Without the right to (an operator of one namespace has none) it stays unknown.
pub(super) async fn sight(context: &Context, pod: &PodView) -> NodeSight {
    let Some(name) = &pod.node else {
        return NodeSight::Unknown;
    };
    let nodes: Api<Node> = Api::all(context.client.clone());
    match tokio::time::timeout(CALL_TIMEOUT, nodes.get_opt(name)).await {
        Ok(Ok(Some(node))) => of(&node),
        Ok(Ok(None)) => NodeSight::Gone,
        Ok(Err(error)) => {
            let error = client_errors::kube(&error);
            tracing::debug!(node = %name, error, "the node of a lost Pod cannot be read");
            NodeSight::Unknown
        }
        Err(_) => NodeSight::Unknown,
    }
}

/// The node controller says `Unknown` of a kubelet whose lease and status have run out; `False` is the kubelet's own word.
fn of(node: &Node) -> NodeSight {
    let conditions = node.status.as_ref().and_then(|s| s.conditions.as_deref());
    let ready = conditions.unwrap_or_default().iter().find(|c| c.type_ == "Ready");
    match ready {
        Some(ready) if ready.status != "Unknown" => NodeSight::Reports,
        Some(ready) => ready
            .last_transition_time
            .as_ref()
            .map_or(NodeSight::Unknown, |since| NodeSight::Silent { since: since.0 }),
        None => NodeSight::Unknown,
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[tokio::test(start_paused = true)]
    async fn what_a_node_has_said_is_forgotten() {
        let nodes = Nodes::default();
        nodes.put("a", NodeSight::Gone);
        tokio::time::advance(FRESH / 2).await;
        nodes.put("b", NodeSight::Reports);
        assert_eq!((nodes.get("a"), nodes.get("c")), (Some(NodeSight::Gone), None));
        tokio::time::advance(FRESH / 2).await;
        assert_eq!((nodes.get("a"), nodes.get("b")), (None, Some(NodeSight::Reports)));
        assert_eq!(nodes.0.lock().unwrap().len(), 1);
    }

    #[test]
    fn only_unknown_is_silence() {
        let since = "2026-01-01T00:00:00Z";
        let silent = NodeSight::Silent {
            since: since.parse().unwrap(),
        };
        let ready = |status: &str| json!([{"type": "Ready", "status": status, "lastTransitionTime": since}]);
        for (conditions, sight) in [
            (ready("True"), NodeSight::Reports),
            (ready("False"), NodeSight::Reports),
            (ready("Unknown"), silent),
            (json!([{"type": "Ready", "status": "Unknown"}]), NodeSight::Unknown),
            (
                json!([{"type": "DiskPressure", "status": "Unknown"}]),
                NodeSight::Unknown,
            ),
            (json!([]), NodeSight::Unknown),
        ] {
            let node = json!({"metadata": {"name": "n"}, "status": {"conditions": conditions}});
            assert_eq!(of(&serde_json::from_value(node.clone()).unwrap()), sight, "{node}");
        }
        assert_eq!(of(&Node::default()), NodeSight::Unknown);
    }
}
