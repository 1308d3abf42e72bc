//! Whether a Pod's node still reports, read from the API server. Of a Pod that is being deleted the answer decides between waiting
//! for its kubelet and giving the Pod up; of one that runs, people learn of it before Kubernetes has given the Pod up.

use k8s_openapi::api::core::v1::Node;
use kube::{Api, Client};

use crate::controller::submissions::view::ObservedNode;
use crate::kubernetes::CALL_TIMEOUT;
use leaderboard_api::client_errors;

/// Reads a node. Without the right to (an operator of one namespace has none) it stays unknown.
pub(super) async fn read(client: &Client, name: &str) -> ObservedNode {
    let nodes: Api<Node> = Api::all(client.clone());
    match tokio::time::timeout(CALL_TIMEOUT, nodes.get_opt(name)).await {
        Ok(Ok(Some(node))) => of(&node),
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
    let conditions = node.status.as_ref().and_then(|s| s.conditions.as_deref());
    let ready = conditions.unwrap_or_default().iter().find(|c| c.type_ == "Ready");
    match ready {
        Some(ready) if ready.status != "Unknown" => ObservedNode::Reports,
        Some(ready) => ready
            .last_transition_time
            .as_ref()
            .map_or(ObservedNode::Unknown, |since| ObservedNode::Silent { since: since.0 }),
        None => ObservedNode::Unknown,
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn only_unknown_is_silence() {
        let since = "2026-01-01T00:00:00Z";
        let silent = ObservedNode::Silent {
            since: since.parse().unwrap(),
        };
        let ready = |status: &str| json!([{"type": "Ready", "status": status, "lastTransitionTime": since}]);
        for (conditions, sight) in [
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
            assert_eq!(of(&serde_json::from_value(node.clone()).unwrap()), sight, "{node}");
        }
        assert_eq!(of(&Node::default()), ObservedNode::Unknown);
    }
}
