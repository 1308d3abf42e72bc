//! The GPUs that each container of a Pod really gets, in each mode: its variable, as its first process has it, and its devices.
//!
//! The node's GPUs are a stand-in (local/tools/gpu) with the interfaces of NVIDIA's device plugin and DRA driver. The scheduler, the
//! kubelet and the container engine are real. An engine that knows no CDI gives a claim's containers no device, and a simulator has to
//! find that out.

use std::collections::BTreeMap;
use std::fmt;
use std::fs;
use std::path::PathBuf;
use std::time::Duration;

use k8s_openapi::api::core::v1::{Node, Pod};
use kube::ResourceExt;
use kube::api::{Api, ApiResource, DeleteParams, DynamicObject, GroupVersionKind, ListParams, Patch, PatchParams};
use leaderboard_api::{FailureClass, Reason, State, Submission};
use serde_json::{Value, json};

use super::matrix;
use crate::operator::controller;
use crate::scene::{Scene, USER_AGENT, containers, lay_over, scenario, state};

const LIMIT: Duration = Duration::from_mins(4);
const VARIABLE: &str = "NVIDIA_VISIBLE_DEVICES";
const RESOURCE: &str = "nvidia.com/gpu";
const CLASS: &str = "gpu.nvidia.com";
/// The containers that run as long as the agents do.
const CONTAINERS: [&str; 5] = ["simulator-1", "simulator-2", "agent-1", "agent-2", "logcopy"];

/// The variable and the devices of one container.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Got {
    variable: Option<String>,
    devices: Vec<String>,
}

impl fmt::Display for Got {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let devices = if self.devices.is_empty() {
            "no device".to_owned()
        } else {
            self.devices.join(" ")
        };
        write!(f, "{}, {devices}", self.variable.as_deref().unwrap_or("unset"))
    }
}

type Containers = BTreeMap<&'static str, Got>;

#[tokio::test]
async fn simulator_and_agent_get_a_gpu_each_of_a_device_plugin() {
    scenario("gpu-per-container", async |scene: &Scene| {
        let got = run(scene, json!({"resourceName": RESOURCE})).await;
        for name in &CONTAINERS[..4] {
            let [device] = got[name].devices.as_slice() else {
                panic!("{name}: {}", got[name]);
            };
            // The plugin's own word for the device it gave: nothing of ours is laid over it.
            let number: u32 = device.strip_prefix("nvidia").unwrap().parse().unwrap();
            let uuid = format!("GPU-00000000-0000-0000-0000-{number:012}");
            assert_eq!(got[name].variable, Some(uuid), "{name}");
        }
        assert_eq!(got["logcopy"], none("void"));
        show("PerContainer", &got);
    })
    .await;
}

/// It keeps every other submission away from the node: `restarts` runs it, alone.
pub async fn both_containers_have_the_index_of_their_gpu() {
    scenario("gpu-node-index", async |scene: &Scene| {
        // Each agent gets a device of the plugin too, in place of the one that NVIDIA's runtime would add by the variable.
        let agents = json!([{"name": "agent", "resources": {"limits": {RESOURCE: "1"}}}]);
        let agents = json!({"podOverrides": {"spec": {"containers": agents}}});
        let got = run_with(scene, by_index(), agents).await;
        for (pair, index) in [("1", "0"), ("2", "1")] {
            let simulator = &got[format!("simulator-{pair}").as_str()];
            assert_eq!(
                simulator.variable.as_deref(),
                Some(index),
                "ours stands behind the plugin's"
            );
            assert_eq!(simulator.devices.len(), 1, "simulator-{pair}: {simulator}");
            let agent = &got[format!("agent-{pair}").as_str()];
            assert_eq!(
                agent.variable.as_deref(),
                Some(index),
                "ours stands behind the plugin's"
            );
            assert_eq!(agent.devices.len(), 1, "agent-{pair}: {agent}");
        }
        assert_eq!(got["logcopy"], none("void"));
        show("NodeIndex", &got);
        leave_the_node(scene).await;
    })
    .await;
}

/// This node's runtime obeys no variable, as one whose toolkit is set up otherwise than the mode needs. `restarts` runs it, alone.
pub async fn an_agent_that_gets_no_gpu_by_its_index_is_not_charged() {
    scenario("gpu-node-index-none", async |scene: &Scene| {
        leaderboard(scene, by_index(), json!({})).await;
        let _controller = controller(scene);
        scene.submit("one", "agent:standard").await;
        let failure = finds_no_gpu(scene).await;
        matrix::as_expected(
            "GPU, NodeIndex, agents without a device",
            Reason::NoGPU.as_str(),
            &failure,
        );
        leave_the_node(scene).await;
    })
    .await;
}

fn by_index() -> Value {
    json!({"mode": "NodeIndex", "resourceName": RESOURCE})
}

/// The scheduler notices late that a Pod with the node to itself has gone: no Pod of another test may meet it.
async fn leave_the_node(scene: &Scene) {
    let pods: Api<Pod> = scene.api();
    let pods = pods.list(&ListParams::default()).await.unwrap();
    let submissions = scene.api::<Submission>();
    submissions.delete("one", &DeleteParams::default()).await.unwrap();
    for pod in pods {
        scene
            .wait::<Pod>(&pod.name_any(), "it is gone", LIMIT, |pod| pod.is_none())
            .await;
    }
}

#[tokio::test]
async fn both_containers_of_a_pair_share_one_claim() {
    scenario("gpu-claim", async |scene: &Scene| {
        device_class(scene).await;
        let gpu = json!({"mode": "Claim", "claim": {"deviceClassName": CLASS}});
        if !knows_cdi(scene).await {
            leaderboard(scene, gpu, json!({})).await;
            let _controller = controller(scene);
            scene.submit("one", "agent:standard").await;
            // Claims are allocated and the Pod starts, but no container has a device: the engine ignores what the kubelet asks for.
            let failure = finds_no_gpu(scene).await;
            matrix::as_expected("GPU, Claim, an engine without CDI", Reason::NoGPU.as_str(), &failure);
            return;
        }
        let got = run(scene, gpu).await;
        for pair in ["1", "2"] {
            let [simulator, agent] = ["simulator", "agent"].map(|side| &got[format!("{side}-{pair}").as_str()]);
            assert_eq!(simulator, agent, "pair {pair}");
            assert_eq!(simulator.variable.as_deref(), Some("void"));
            assert_eq!(simulator.devices.len(), 1, "pair {pair}: {simulator}");
        }
        assert_ne!(
            got["simulator-1"].devices, got["simulator-2"].devices,
            "a claim has its own GPU"
        );
        assert_eq!(got["logcopy"], none("void"));
        show("Claim", &got);
    })
    .await;
}

/// Waits for the end as `NoGPU`, which costs no attempt; its message.
async fn finds_no_gpu(scene: &Scene) -> String {
    let failed = scene.settled("one", LIMIT).await;
    assert_eq!(state(&failed), Some(State::Failed));
    let failure = failed.status.unwrap().failure.unwrap();
    assert_eq!(
        (failure.reason.known().unwrap(), failure.class),
        (Reason::NoGPU, FailureClass::Infrastructure),
        "{}",
        failure.message
    );
    failure.message
}

/// Runs two pairs whose agents go silent, and reads what each container got.
async fn run(scene: &Scene, gpu: Value) -> Containers {
    run_with(scene, gpu, json!({})).await
}

/// Like [`run`], with a further change of the Leaderboard.
async fn run_with(scene: &Scene, gpu: Value, more: Value) -> Containers {
    leaderboard(scene, gpu, more).await;
    let _controller = controller(scene);
    scene.submit("one", "agent:standard").await;
    scene.running("one", LIMIT).await;
    let all_run = |pod: Option<&Pod>| {
        let running = pod.map(containers).unwrap_or_default();
        let runs = |name: &&str| {
            let mut found = running.iter().filter(|container| container.name == **name);
            found.any(|container| container.state.as_ref().is_some_and(|state| state.running.is_some()))
        };
        CONTAINERS.iter().all(runs)
    };
    let pod = scene.pod("one").await.name_any();
    let pod = scene
        .wait::<Pod>(&pod, "all its containers run", LIMIT, all_run)
        .await
        .unwrap();
    let of = |name: &'static str| {
        let container = containers(&pod)
            .into_iter()
            .find(|container| container.name == name)
            .unwrap();
        (name, got(&container.container_id.unwrap()))
    };
    CONTAINERS.map(of).into()
}

async fn leaderboard(scene: &Scene, gpu: Value, more: Value) {
    let mut change = json!({
        "evaluation": {"carla": {
            "pairs": 2, "routes": 2,
            "simulator": {"env": [{"name": "VK_DRIVER_FILES", "value": "/home/carla/CarlaUE4.sh"}]},
        }},
        "gpu": gpu,
        "agent": {"env": [{"name": "AGENT_KNOBS", "value": "hang@1"}]},
        "retries": {"infrastructure": 0, "perWorker": 0},
    });
    lay_over(&mut change, more);
    scene.leaderboard("lb", change).await;
}

/// The variable and the devices of a container's first process; the tests run on the node.
fn got(container: &str) -> Got {
    let id = container.rsplit('/').next().unwrap();
    let process = first_process(id).unwrap_or_else(|| panic!("no process of container {id}"));
    let environment = fs::read(process.join("environ")).unwrap();
    let variables = environment.split(|byte| *byte == 0).map(String::from_utf8_lossy);
    let values: Vec<String> = variables
        .filter_map(|variable| Some(variable.strip_prefix(VARIABLE)?.strip_prefix('=')?.to_owned()))
        .collect();
    assert!(values.len() < 2, "{VARIABLE} is set more than once: {values:?}");
    let entries = fs::read_dir(process.join("root/dev")).unwrap();
    let names = entries.map(|entry| entry.unwrap().file_name().into_string().unwrap());
    let mut devices: Vec<String> = names.filter(|name| name.starts_with("nvidia")).collect();
    devices.sort();
    Got {
        variable: values.into_iter().next(),
        devices,
    }
}

/// The folder in /proc of a container's first process: of those in its cgroup the one with the lowest number.
fn first_process(container: &str) -> Option<PathBuf> {
    let all = fs::read_dir("/proc").unwrap().map(|entry| entry.unwrap().path());
    let numbered = all.filter_map(|path| Some((path.file_name()?.to_str()?.parse::<u32>().ok()?, path)));
    let ours =
        numbered.filter(|(_, path)| fs::read_to_string(path.join("cgroup")).is_ok_and(|text| text.contains(container)));
    ours.min_by_key(|(number, _)| *number).map(|(_, path)| path)
}

fn none(variable: &str) -> Got {
    Got {
        variable: Some(variable.to_owned()),
        devices: Vec::new(),
    }
}

/// Writes down what docs/gpu.md shows.
fn show(mode: &str, got: &Containers) {
    for (name, got) in got {
        matrix::as_expected(&format!("GPU, {mode}, {name}"), "as asserted", &got.to_string());
    }
}

/// True if the node's container engine takes CDI devices by default: containerd 2 and newer.
async fn knows_cdi(scene: &Scene) -> bool {
    let nodes: Api<Node> = Api::all(scene.client.clone());
    let node = nodes.list(&ListParams::default()).await.unwrap().items.remove(0);
    let engine = node.status.unwrap().node_info.unwrap().container_runtime_version;
    let major = engine
        .strip_prefix("containerd://")
        .and_then(|version| version.split('.').next());
    major.and_then(|major| major.parse::<u32>().ok()).unwrap() >= 2
}

async fn device_class(scene: &Scene) {
    let kind = GroupVersionKind::gvk("resource.k8s.io", "v1", "DeviceClass");
    let kind = ApiResource::from_gvk_with_plural(&kind, "deviceclasses");
    let classes: Api<DynamicObject> = Api::all_with(scene.client.clone(), &kind);
    let class = json!({
        "apiVersion": "resource.k8s.io/v1",
        "kind": "DeviceClass",
        "metadata": {"name": CLASS},
        "spec": {"selectors": [{"cel": {"expression": format!("device.driver == '{CLASS}'")}}]},
    });
    let params = PatchParams::apply(USER_AGENT);
    classes.patch(CLASS, &params, &Patch::Apply(&class)).await.unwrap();
}
