//! Which container of a Pod gets which GPU, and from where. Pure, and the only place that knows NVIDIA's names.
//!
//! On a node whose default runtime is NVIDIA's, the variable decides, not what was requested: an image that sets `all` has every
//! GPU of the node. So each container without a GPU has `void`. The kubelet puts the Pod's variables behind those of a device plugin,
//! and the last one counts: a container that requests a GPU of its own must not have the variable, or it would hide what the plugin
//! gave.

use k8s_openapi::api::core::v1::{EnvVar, ResourceRequirements};
use serde_json::{Value, json};

use super::failed_nodes::{HOSTNAME, REQUIRED};
use super::{JobInput, variable};
use crate::gpu_claims::{source, template_name};
use leaderboard_api::{Agents, GpuSource, LeaderboardSpec, RunPlan, names};
use leaderboard_protocol::files::{Member, Pair, Side};
use leaderboard_protocol::graphics::{INDEX, Needs};

const DEVICES: &str = "NVIDIA_VISIBLE_DEVICES";
const CAPABILITIES: &str = "NVIDIA_DRIVER_CAPABILITIES";
const NO_DEVICE: &str = "void";
/// Prefix of the resources of NVIDIA's device plugin: whole GPUs, shared ones, MIG slices.
const RESOURCES: &str = "nvidia.com/";
/// The source of a container's GPU. A command that merges results has none.
pub(super) fn source_of<'a>(spec: &'a LeaderboardSpec, plan: &RunPlan, member: Member) -> GpuSource<'a> {
    if merges(plan, member) {
        return GpuSource::None;
    }
    source(spec)
}

fn merges(plan: &RunPlan, member: Member) -> bool {
    plan.merger() == Some(member.pair.get().into())
}

/// The variables of a container of a worker.
pub(super) fn variables(source: GpuSource<'_>, member: Member) -> Vec<EnvVar> {
    let index = member.pair.index().to_string();
    let devices = match source {
        // `hide` decides, by what the finished container requests.
        GpuSource::None => return Vec::new(),
        GpuSource::PerContainer(_) => None,
        GpuSource::NodeIndex(_) => Some(index.as_str()),
        // The devices come by CDI, past this variable.
        GpuSource::Claim(_) => Some(NO_DEVICE),
    };
    let devices = devices.map(|devices| variable(DEVICES, devices));
    let index = matches!(member.side, Side::Host(_)).then(|| variable(INDEX, &index));
    devices
        .into_iter()
        .chain([variable(CAPABILITIES, "all")])
        .chain(index)
        .collect()
}

/// Requests and limits of a container of a worker: the host's own, and its GPU. What an agent requests that runs first is free again for
/// the hosts' containers, so that it requests as they do.
pub(super) fn resources(
    spec: &LeaderboardSpec,
    plan: &RunPlan,
    member: Member,
    hosts: Option<&ResourceRequirements>,
) -> Value {
    let mut resources = json!(hosts);
    match source(spec) {
        gpus if merges(plan, member) => drop_gpus(&mut resources, gpus),
        GpuSource::None => {}
        GpuSource::NodeIndex(_) if plan.agents() == Agents::Beside && member.side == Side::Agent => {}
        GpuSource::PerContainer(resource) | GpuSource::NodeIndex(resource) => {
            resources["limits"][resource] = "1".into();
        }
        GpuSource::Claim(_) => {
            let claim = json!({"name": claim_name(member.pair)});
            match resources["claims"].as_array_mut() {
                Some(claims) => claims.push(claim),
                None => resources["claims"] = json!([claim]),
            }
        }
    }
    resources
}

/// Takes the GPUs away that the host's own resources name.
fn drop_gpus(resources: &mut Value, source: GpuSource<'_>) {
    for list in ["limits", "requests"] {
        if let Some(named) = resources.get_mut(list).and_then(Value::as_object_mut) {
            named.retain(|name, _| !is_gpu(name, source));
        }
    }
}

/// One claim for each worker that shares the work, for its two containers.
pub(super) fn claims(input: &JobInput<'_>) -> Option<Vec<Value>> {
    let GpuSource::Claim(claim) = source(input.spec()) else {
        return None;
    };
    let leaderboard = input.leaderboard.metadata.name.as_deref().unwrap_or_default();
    let template = template_name(leaderboard, claim);
    let of_worker = |worker| json!({"name": claim_name(worker), "resourceClaimTemplateName": template});
    Some(Pair::first(input.plan.sharing()).map(of_worker).collect())
}

fn claim_name(worker: Pair) -> String {
    format!("gpu-{worker}")
}

/// Flags of the runner: what it checks before it starts its command, which is nothing where the operator gives no GPU. By its index the
/// agent beside its host has one only if the node's runtime obeys the variable, and else it would be charged for the lack of it: it reports
/// to its host.
pub(super) fn flags(
    source: GpuSource<'_>,
    agents: Agents,
    side: Side,
    draws: Option<Needs>,
) -> impl Iterator<Item = String> {
    let own = draws.filter(|_| source != GpuSource::None);
    let reports = is_by_index(source) && agents == Agents::Beside;
    let of_agent = reports.then(|| match side {
        Side::Host(_) => "--agent-gpu=true".to_owned(),
        Side::Agent => "--report-gpu=true".to_owned(),
    });
    own.map(|needs| format!("--gpu={needs}")).into_iter().chain(of_agent)
}

fn is_by_index(source: GpuSource<'_>) -> bool {
    matches!(source, GpuSource::NodeIndex(_))
}

/// Hides the node's GPUs from a container that neither requests one nor has the variable. It comes first, so that the container's
/// other variables can refer to it.
pub(super) fn hide(container: &mut Value, source: GpuSource<'_>) {
    if !requested(container, source).is_empty() {
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

/// Names of the GPUs that a container requests of a device plugin.
fn requested<'a>(container: &'a Value, source: GpuSource<'_>) -> Vec<&'a str> {
    let is_none = |amount: &Value| amount.is_null() || *amount == json!("0") || *amount == json!(0);
    let lists = ["requests", "limits"].map(|list| container["resources"][list].as_object());
    let named = lists.into_iter().flatten().flatten();
    let named = named.filter(|(name, amount)| is_gpu(name, source) && !is_none(amount));
    named.map(|(name, _)| name.as_str()).collect()
}

/// True if a resource is a GPU: NVIDIA's, or the one that `gpu.resourceName` names.
pub(super) fn is_gpu(resource: &str, source: GpuSource<'_>) -> bool {
    let own = match source {
        GpuSource::PerContainer(own) | GpuSource::NodeIndex(own) => Some(own),
        GpuSource::None | GpuSource::Claim(_) => None,
    };
    resource.starts_with(RESOURCES) || Some(resource) == own
}

/// Why it is not clear which container of a finished template is meant to have which GPU. A resource that a container of a worker names
/// is its own alone: without `gpu` the other one would have none, and with a claim the worker would take two.
pub fn unclear(spec: &LeaderboardSpec, template: &Value) -> Option<String> {
    let (source, kind) = (source(spec), leaderboard_evaluation::of(spec));
    let worker = kind.words().worker;
    let lists = ["initContainers", "containers"].map(|list| template["spec"][list].as_array());
    let mut of_workers = lists
        .into_iter()
        .flatten()
        .flatten()
        .filter(|found| member(found).is_some());
    let (container, resource) =
        of_workers.find_map(|container| Some((container["name"].as_str()?, *requested(container, source).first()?)))?;
    match (&spec.gpu, source) {
        // There is no other one.
        (None, _) if kind.agents() == Agents::Absent => None,
        (None, _) => Some(format!(
            "{container} requests {resource} and the Leaderboard has no field gpu, so it is not known what the other container of the \
             {worker} is to have. Set gpu.resourceName: {resource} and remove it from resources; or set gpu.mode: None, and only the \
             containers that request a GPU themselves have one."
        )),
        (Some(_), GpuSource::Claim(_)) => Some(format!(
            "{container} requests {resource} of a device plugin, and gpu.mode is Claim: a {worker} would take two GPUs. Remove {resource} from \
             resources and podOverrides."
        )),
        (Some(_), GpuSource::None | GpuSource::PerContainer(_) | GpuSource::NodeIndex(_)) => None,
    }
}

/// The container of a worker, by its name.
pub(super) fn member(container: &Value) -> Option<Member> {
    Member::parse(container["name"].as_str()?)
}

/// Keeps a Pod whose workers know their GPU by its index away from nodes with another submission's Pod, whatever its namespace. It comes
/// after the overlay, whose lists would take the place of these.
pub(super) fn place(pod: &mut Value, source: GpuSource<'_>) {
    if !is_by_index(source) {
        return;
    }
    let others = json!({
        "topologyKey": HOSTNAME,
        "namespaceSelector": {},
        "labelSelector": {"matchExpressions": [{"key": names::LABEL_SUBMISSION, "operator": "Exists"}]},
    });
    let terms = &mut pod["affinity"]["podAntiAffinity"][REQUIRED];
    match terms.as_array_mut() {
        Some(terms) => terms.push(others),
        None => *terms = json!([others]),
    }
}
