//! The ResourceClaimTemplate of a Leaderboard whose workers claim their GPU. Pure; the reconcile of the Leaderboard applies it, and its
//! Jobs name it.
//!
//! Its name holds the hash of what it asks for: a template cannot be edited under the Jobs that are running.

use kube::core::{ApiResource, DynamicObject, GroupVersionKind};
use serde_json::{Value, json};
use sha2::{Digest, Sha256};

use crate::owner::child_of;
use leaderboard_api::{ClaimOf, GpuSource, Leaderboard, LeaderboardSpec};

/// Bytes of the hash in a name.
const HASH_BYTES: usize = 5;
/// Name of the one request of a claim.
const REQUEST: &str = "gpu";

/// The API resource of a ResourceClaimTemplate.
pub fn resource() -> ApiResource {
    ApiResource::from_gvk(&GroupVersionKind::gvk("resource.k8s.io", "v1", "ResourceClaimTemplate"))
}

/// The source of the GPUs of a Leaderboard's workers.
pub fn source(spec: &LeaderboardSpec) -> GpuSource<'_> {
    spec.gpu.as_ref().map_or(GpuSource::None, leaderboard_api::Gpu::source)
}

/// Name of the template that a claim is made from: the operator's, or the host's own.
pub fn template_name(leaderboard: &str, claim: ClaimOf<'_>) -> String {
    match claim {
        ClaimOf::Template(name) => name.to_owned(),
        ClaimOf::Devices { .. } => {
            // A map in the order of its keys, so that the same claim has the same text.
            let digest = Sha256::digest(spec_of(claim).to_string());
            format!("{leaderboard}-gpu-{}", hex::encode(&digest[..HASH_BYTES]))
        }
    }
}

/// The template that the operator makes; none where no GPU is claimed, or the host has made it.
pub fn template(leaderboard: &Leaderboard) -> Option<DynamicObject> {
    let GpuSource::Claim(claim @ ClaimOf::Devices { .. }) = source(&leaderboard.spec) else {
        return None;
    };
    let name = leaderboard.metadata.name.as_deref().unwrap_or_default();
    let name = template_name(name, claim);
    let mut template = DynamicObject::new(&name, &resource());
    template.metadata = child_of(leaderboard, name);
    template.data = json!({ "spec": { "spec": spec_of(claim) } });
    Some(template)
}

fn spec_of(claim: ClaimOf<'_>) -> Value {
    let ClaimOf::Devices { class, selectors } = claim else {
        return Value::Null;
    };
    let mut device = json!({ "deviceClassName": class });
    if !selectors.is_empty() {
        let selectors = selectors
            .iter()
            .map(|expression| json!({"cel": {"expression": expression}}));
        device["selectors"] = selectors.collect();
    }
    json!({"devices": {"requests": [{"name": REQUEST, "exactly": device}]}})
}

#[cfg(test)]
mod tests {
    use super::*;

    fn leaderboard(gpu: &Value) -> Leaderboard {
        let leaderboard = serde_json::from_value(json!({
            "apiVersion": "leaderboard.carla.org/v1alpha1", "kind": "Leaderboard",
            "metadata": {"name": "carla", "namespace": "challenge", "uid": "u-1"},
            "spec": {
                "evaluation": {"carla": {
                    "version": "V2", "contents": {"image": "contents"}, "simulator": {"image": "simulator"},
                }}, "tracks": [{"name": "sensors"}],
                "storage": {"s3": {"bucket": "bucket"}}, "gpu": gpu,
            },
        }));
        leaderboard.unwrap()
    }

    fn claimed(claim: &Value) -> Option<Value> {
        let template = template(&leaderboard(&json!({"mode": "Claim", "claim": claim})))?;
        Some(serde_json::to_value(template).unwrap())
    }

    #[test]
    fn a_template_asks_for_one_device_and_is_the_leaderboards() {
        let selectors = json!(["device.attributes['gpu.nvidia.com'].productName == 'A10G'"]);
        let template = claimed(&json!({"deviceClassName": "gpu.nvidia.com", "selectors": selectors})).unwrap();
        assert_eq!(template["apiVersion"], "resource.k8s.io/v1");
        assert_eq!(template["kind"], "ResourceClaimTemplate");
        assert_eq!(template["metadata"]["namespace"], "challenge");
        assert_eq!(template["metadata"]["ownerReferences"][0]["uid"], "u-1");
        let labels = json!({
            "app.kubernetes.io/managed-by": "leaderboard-operator",
            "leaderboard.carla.org/leaderboard": "carla",
        });
        assert_eq!(template["metadata"]["labels"], labels);
        let exactly =
            json!({"deviceClassName": "gpu.nvidia.com", "selectors": [{"cel": {"expression": selectors[0]}}]});
        let requests = json!([{"name": "gpu", "exactly": exactly}]);
        assert_eq!(template["spec"], json!({"spec": {"devices": {"requests": requests}}}));
    }

    #[test]
    fn another_claim_has_another_name_and_the_same_one_the_same() {
        let name = |claim: &Value| claimed(claim).unwrap()["metadata"]["name"].as_str().unwrap().to_owned();
        let one = name(&json!({"deviceClassName": "gpu.nvidia.com"}));
        assert!(
            one.starts_with("carla-gpu-") && one.len() == "carla-gpu-".len() + 10,
            "{one}"
        );
        assert_eq!(
            one,
            name(&json!({"deviceClassName": "gpu.nvidia.com", "selectors": []}))
        );
        assert_ne!(
            one,
            name(&json!({"deviceClassName": "gpu.nvidia.com", "selectors": ["true"]}))
        );
        assert_ne!(one, name(&json!({"deviceClassName": "mig.nvidia.com"})));
    }

    #[test]
    fn the_hosts_own_template_is_named_and_not_made() {
        assert_eq!(claimed(&json!({"resourceClaimTemplateName": "mine"})), None);
        assert_eq!(template_name("carla", ClaimOf::Template("mine")), "mine");
        assert!(template(&leaderboard(&json!({"resourceName": "nvidia.com/gpu"}))).is_none());
    }
}
