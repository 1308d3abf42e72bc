//! What every container of a Pod may do and use at most. Pure.

use std::collections::BTreeMap;

use k8s_openapi::api::core::v1::{Capabilities, ResourceRequirements, SeccompProfile, SecurityContext};
use k8s_openapi::apimachinery::pkg::api::resource::Quantity;

/// No limit on local storage: Kubernetes would take it for the limit of the whole Pod and evict that.
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
