//! Which container of a Pod gets which GPU. Pure, and the only place that knows NVIDIA's names.
//!
//! On a node whose default runtime is NVIDIA's, the variable decides, not what was requested: an image that says `all` has every
//! GPU of the node. So each container has the variable, and `void` is no GPU.

use k8s_openapi::api::core::v1::{EnvVar, ResourceRequirements};
use serde_json::{Value, json};

use super::{JobInput, variable};
use leaderboard_api::effective;

const DEVICES: &str = "NVIDIA_VISIBLE_DEVICES";
const CAPABILITIES: &str = "NVIDIA_DRIVER_CAPABILITIES";
const NO_DEVICE: &str = "void";
/// What the resources of NVIDIA's device plugin begin with: whole GPUs, shared ones, MIG slices.
const RESOURCES: &str = "nvidia.com/";

/// How a Pod's pairs get their GPUs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Gpus {
    /// Nobody requests one.
    None,
    /// Simulator and agent of pair n see the node's GPU n-1, as in the original.
    NodeIndex,
}

impl Gpus {
    /// What follows from the resources that the host requests for simulators and agents.
    pub(super) fn of(input: &JobInput<'_>) -> Self {
        let (spec, track) = (input.spec(), input.track());
        let simulators = track.and_then(|track| track.simulator.as_ref());
        let agents = track.and_then(|track| track.agent.as_ref());
        let resources = [
            effective::resources(simulators, spec.simulator.resources.as_ref()),
            effective::resources(agents, spec.agent.resources.as_ref()),
        ];
        let overlay = spec.pod_overrides.as_ref();
        let overlay = overlay.and_then(|overlay| overlay.pointer("/spec/containers")?.as_array());
        let asked = resources.iter().flatten().any(requests)
            || overlay.is_some_and(|containers| containers.iter().any(|one| requests_in(&one["resources"])));
        if asked { Self::NodeIndex } else { Self::None }
    }

    /// The variables of both containers of a pair; pairs count from 1.
    pub(super) fn variables(self, pair: usize) -> Vec<EnvVar> {
        match self {
            Self::None => vec![variable(DEVICES, NO_DEVICE)],
            Self::NodeIndex => vec![
                variable(DEVICES, &(pair - 1).to_string()),
                variable(CAPABILITIES, "all"),
            ],
        }
    }
}

/// Hides the node's GPUs from a container that neither requests one nor has the variable. It comes first, so that the container's
/// other variables can refer to it.
pub(super) fn hide(container: &mut Value) {
    if requests_in(&container["resources"]) {
        return;
    }
    let Some(container) = container.as_object_mut() else {
        return;
    };
    let env = container.entry("env").or_insert_with(|| json!([]));
    if let Some(env) = env.as_array_mut()
        && env.iter().all(|variable| variable["name"] != DEVICES)
    {
        env.insert(0, json!({"name": DEVICES, "value": NO_DEVICE}));
    }
}

fn requests(resources: &ResourceRequirements) -> bool {
    serde_json::to_value(resources).is_ok_and(|resources| requests_in(&resources))
}

/// Whether a container's resources, as JSON, name a GPU.
fn requests_in(resources: &Value) -> bool {
    let is_none = |amount: &Value| amount.is_null() || *amount == json!("0") || *amount == json!(0);
    let lists = ["requests", "limits"].map(|list| resources[list].as_object());
    let mut named = lists.into_iter().flatten().flatten();
    named.any(|(name, amount)| name.starts_with(RESOURCES) && !is_none(amount))
}
