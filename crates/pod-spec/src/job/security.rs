//! Security context of every container of a Pod, and the resources of our own. Pure.

use k8s_openapi::api::core::v1::SecurityContext;
use serde_json::{Value, json};

use crate::overlay as pod_overlay;

/// CPU and memory that a container of ours requests, and its limit of memory; what is shown of the disk is in `disk`.
pub(super) fn resources([cpu, memory, most]: [&str; 3]) -> Value {
    json!({"requests": {"cpu": cpu, "memory": memory}, "limits": {"memory": most}})
}

/// The default for every container: no capability, no new privileges. The uid stays the image's.
pub(super) fn confined() -> Value {
    json!({
        "allowPrivilegeEscalation": false,
        "capabilities": {"drop": ["ALL"]},
        "seccompProfile": {"type": "RuntimeDefault"},
    })
}

/// The default with the host's fields laid over it, each by itself: who sets a uid does not give up the rest. A list takes the
/// place of ours.
pub(super) fn context(hosts: Option<&SecurityContext>) -> Value {
    let mut merged = confined();
    if let Some(hosts) = hosts {
        pod_overlay::apply(&mut merged, &json!(hosts));
    }
    merged
}

/// Kubernetes refuses a privileged container that may not escalate privileges, so a host that asks for the one gives up the other.
pub(super) fn settle(container: &mut Value) {
    let context = container.get_mut("securityContext").and_then(Value::as_object_mut);
    if let Some(context) = context
        && context.get("privileged") == Some(&Value::Bool(true))
    {
        context.remove("allowPrivilegeEscalation");
    }
}
