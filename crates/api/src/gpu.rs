//! The parts of a Leaderboard that define which container gets which GPU and where a simulator draws.
//!
//! Owned by `api`; `leaderboard_parts` hands it on.

use kube::KubeSchema;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// `None`: the operator requests no GPU and checks for none. `PerContainer`: simulator and agent request one `resourceName` each. `NodeIndex`: simulators request one each, and both containers of pair n use the node's GPU n-1. `Claim`: both containers of a pair share one ResourceClaim. Default: `PerContainer` with a `resourceName`, else `None`.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Copy, Debug, PartialEq, Eq)]
pub enum GpuMode {
    /// The operator requests none and checks for none.
    None,
    /// Simulator and agent request one each of a device plugin.
    PerContainer,
    /// Simulators request one each; both containers of pair n have the node's GPU n-1, as in the original.
    NodeIndex,
    /// Both containers of a pair share one ResourceClaim.
    Claim,
}

/// Which container gets which GPU.
#[derive(Serialize, Deserialize, KubeSchema, Clone, Debug, Default, PartialEq, Eq)]
#[serde(rename_all = "camelCase")]
#[x_kube(
    validation = Rule::new("!has(self.mode) || !(self.mode in ['PerContainer', 'NodeIndex']) || has(self.resourceName)").message("gpu.mode PerContainer and NodeIndex need gpu.resourceName: write what the device plugin advertises, for example nvidia.com/gpu"),
    validation = Rule::new("!has(self.resourceName) || !has(self.mode) || self.mode in ['PerContainer', 'NodeIndex']").message("gpu.resourceName is for gpu.mode PerContainer and NodeIndex; leave it out, or change the mode"),
    validation = Rule::new("!has(self.mode) || self.mode != 'Claim' || has(self.claim)").message("gpu.mode Claim needs gpu.claim: write a deviceClassName such as gpu.nvidia.com, or the resourceClaimTemplateName of your own template"),
    validation = Rule::new("!has(self.claim) || (has(self.mode) && self.mode == 'Claim')").message("gpu.claim is for gpu.mode Claim; set that mode, or leave the claim out")
)]
pub struct Gpu {
    /// How the containers of a pair get their GPU.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mode: Option<GpuMode>,
    /// Resource that the device plugin advertises, for example `nvidia.com/gpu`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(
        length(min = 3, max = 317),
        regex(pattern = r"^[a-z0-9]([-a-z0-9.]*[a-z0-9])?/[A-Za-z0-9]([-A-Za-z0-9_.]{0,61}[A-Za-z0-9])?$")
    )]
    pub resource_name: Option<String>,
    /// Devices that are claimed for each pair.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub claim: Option<GpuClaim>,
}

/// What is claimed for each pair: a device of a class, or what a template of the host's asks for.
#[derive(Serialize, Deserialize, KubeSchema, Clone, Debug, Default, PartialEq, Eq)]
#[serde(rename_all = "camelCase")]
#[x_kube(
    validation = Rule::new("has(self.deviceClassName) != has(self.resourceClaimTemplateName)").message("gpu.claim needs exactly one of deviceClassName and resourceClaimTemplateName"),
    validation = Rule::new("!has(self.selectors) || has(self.deviceClassName)").message("gpu.claim.selectors choose among the devices of deviceClassName; write them into your own template instead")
)]
pub struct GpuClaim {
    /// DeviceClass of the device, for example `gpu.nvidia.com`. The operator makes the ResourceClaimTemplate.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(min = 1, max = 253))]
    pub device_class_name: Option<String>,
    /// CEL expressions about `device`, all of which must hold.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[schemars(length(max = 16), inner(length(min = 1, max = 4096)))]
    #[x_kube(merge_strategy = ListMerge::Atomic)]
    pub selectors: Vec<String>,
    /// A ResourceClaimTemplate of your own in the Leaderboard's namespace, for one device.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(min = 1, max = 253))]
    pub resource_claim_template_name: Option<String>,
}

/// Where the GPUs of a [`Gpu`] come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum GpuSource<'a> {
    None,
    /// The resource that each container of a pair requests.
    PerContainer(&'a str),
    /// The resource that each simulator requests.
    NodeIndex(&'a str),
    Claim(ClaimOf<'a>),
}

/// Where the template of the claims comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ClaimOf<'a> {
    /// The operator makes it.
    Devices { class: &'a str, selectors: &'a [String] },
    /// The host has made it; its name.
    Template(&'a str),
}

impl Gpu {
    /// The source of the GPUs that the fields name. `None` for a combination of fields that the definition refuses.
    pub fn source(&self) -> GpuSource<'_> {
        let resource = self.resource_name.as_deref();
        match (self.mode, resource) {
            (Option::None | Some(GpuMode::PerContainer), Some(resource)) => GpuSource::PerContainer(resource),
            (Some(GpuMode::NodeIndex), Some(resource)) => GpuSource::NodeIndex(resource),
            (Some(GpuMode::Claim), _) => self
                .claim
                .as_ref()
                .and_then(GpuClaim::of)
                .map_or(GpuSource::None, GpuSource::Claim),
            _ => GpuSource::None,
        }
    }
}

impl GpuClaim {
    fn of(&self) -> Option<ClaimOf<'_>> {
        let devices = self.device_class_name.as_deref().map(|class| ClaimOf::Devices {
            class,
            selectors: &self.selectors,
        });
        devices.or_else(|| self.resource_claim_template_name.as_deref().map(ClaimOf::Template))
    }
}

/// Where a simulator draws.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Display {
    /// On no screen.
    #[default]
    Offscreen,
    /// On the node's X server, by its socket.
    X11Socket,
}

/// The node's X server.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, PartialEq, Eq)]
pub struct X11 {
    /// DISPLAY of the simulators.
    #[serde(default = "defaults::display")]
    #[schemars(length(min = 2, max = 16), regex(pattern = r"^:[0-9]+([.][0-9]+)?$"))]
    pub display: String,
}

impl Default for X11 {
    fn default() -> Self {
        Self {
            display: defaults::display(),
        }
    }
}

mod defaults {
    pub(super) fn display() -> String {
        ":0".into()
    }
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::*;

    #[test]
    fn gpus_come_from_the_one_source_that_the_fields_name() {
        let selectors = vec!["device.driver == 'gpu.nvidia.com'".to_owned()];
        let class = "gpu.nvidia.com";
        let devices = |selectors| GpuSource::Claim(ClaimOf::Devices { class, selectors });
        let cases: [(Value, GpuSource<'_>); 9] = [
            (json!({}), GpuSource::None),
            (json!({"mode": "None"}), GpuSource::None),
            (
                json!({"resourceName": "nvidia.com/gpu"}),
                GpuSource::PerContainer("nvidia.com/gpu"),
            ),
            (
                json!({"mode": "PerContainer", "resourceName": "a.b/c"}),
                GpuSource::PerContainer("a.b/c"),
            ),
            (
                json!({"mode": "NodeIndex", "resourceName": "nvidia.com/gpu"}),
                GpuSource::NodeIndex("nvidia.com/gpu"),
            ),
            (
                json!({"mode": "Claim", "claim": {"deviceClassName": class}}),
                devices(&[]),
            ),
            (
                json!({"mode": "Claim", "claim": {"deviceClassName": class, "selectors": selectors}}),
                devices(&selectors),
            ),
            (
                json!({"mode": "Claim", "claim": {"resourceClaimTemplateName": "mine"}}),
                GpuSource::Claim(ClaimOf::Template("mine")),
            ),
            // The definition refuses it.
            (json!({"mode": "NodeIndex"}), GpuSource::None),
        ];
        for (gpu, expected) in cases {
            let read: Gpu = serde_json::from_value(gpu.clone()).unwrap();
            assert_eq!(read.source(), expected, "{gpu}");
        }
    }
}
