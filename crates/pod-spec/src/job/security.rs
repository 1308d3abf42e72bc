//! Security context of every container of a Pod, and the resources of our own. Pure.

use std::collections::BTreeMap;

use k8s_openapi::api::core::v1::{Capabilities, ResourceRequirements, SeccompProfile, SecurityContext};
use k8s_openapi::apimachinery::pkg::api::resource::Quantity;
use serde_json::Value;

use crate::overlay as pod_overlay;

/// CPU and memory of a container of ours; what is shown of the disk is in `disk`.
pub(super) fn resources(requests: [&str; 2], memory: &str) -> ResourceRequirements {
    let quantity = |text: &str| Quantity(text.into());
    let [cpu, requested] = requests.map(quantity);
    ResourceRequirements {
        requests: Some(BTreeMap::from([("cpu".into(), cpu), ("memory".into(), requested)])),
        limits: Some(BTreeMap::from([("memory".into(), quantity(memory))])),
        ..ResourceRequirements::default()
    }
}

/// The default for every container: no capability, no new privileges. The uid stays the image's.
pub(super) fn confined() -> SecurityContext {
    SecurityContext {
        allow_privilege_escalation: Some(false),
        capabilities: Some(Capabilities {
            drop: Some(vec!["ALL".into()]),
            add: None,
        }),
        seccomp_profile: Some(SeccompProfile {
            type_: "RuntimeDefault".into(),
            localhost_profile: None,
        }),
        ..SecurityContext::default()
    }
}

/// The default with the host's fields laid over it, each by itself: who sets a uid does not give up the rest. A list takes the
/// place of ours.
pub(super) fn context(hosts: Option<&SecurityContext>) -> SecurityContext {
    let Some(hosts) = hosts else { return confined() };
    // Both are maps with text as keys, so that neither way can fail.
    let mut merged = serde_json::to_value(confined()).unwrap_or_default();
    pod_overlay::apply(&mut merged, &serde_json::to_value(hosts).unwrap_or_default());
    serde_json::from_value(merged).unwrap_or_else(|_| confined())
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
