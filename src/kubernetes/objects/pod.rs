//! A Pod as it is cached: its names, its node, and how its containers fare.

use std::borrow::Cow;
use std::hash::{DefaultHasher, Hash, Hasher};

use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;
use kube::core::NamespaceResourceScope;
use serde::{Deserialize, Deserializer};

use super::meta::Meta;
use super::texts::{Text, Texts, cut};
use super::watchable;

/// Part of a Pod that is read.
#[derive(Deserialize, Clone, Debug, Default, PartialEq)]
#[serde(default)]
pub struct Pod {
    pub metadata: Meta,
    pub spec: PodSpec,
    pub status: PodStatus,
}

#[derive(Deserialize, Clone, Debug, Default, PartialEq)]
#[serde(rename_all = "camelCase", default)]
pub struct PodSpec {
    pub node_name: Option<Text>,
    pub containers: Box<[ContainerName]>,
}

#[derive(Deserialize, Clone, Debug, Default, PartialEq)]
#[serde(default)]
pub struct ContainerName {
    pub name: Text,
}

#[derive(Deserialize, Clone, Debug, Default, PartialEq)]
#[serde(rename_all = "camelCase", default)]
pub struct PodStatus {
    pub phase: Option<Text>,
    pub reason: Option<Text>,
    #[serde(deserialize_with = "cut")]
    pub message: Option<Box<str>>,
    #[serde(deserialize_with = "conditions")]
    pub conditions: Conditions,
    pub init_container_statuses: Box<[ContainerStatus]>,
    pub container_statuses: Box<[ContainerStatus]>,
}

/// Part of a Pod's conditions that is read.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Conditions {
    /// `PodScheduled`.
    pub scheduled: Option<Box<Condition>>,
    /// The reason of `DisruptionTarget`, where it is True: who takes the Pod away.
    pub disruption: Option<Text>,
}

#[derive(Deserialize, Clone, Debug, Default, PartialEq)]
#[serde(rename_all = "camelCase", default)]
pub struct Condition {
    #[serde(rename = "type")]
    type_: Text,
    pub status: Text,
    reason: Option<Text>,
    pub last_transition_time: Option<Time>,
    #[serde(deserialize_with = "cut")]
    pub message: Option<Box<str>>,
}

#[derive(Deserialize, Clone, Debug, Default, PartialEq)]
#[serde(from = "Seen")]
pub struct ContainerStatus {
    pub name: Text,
    /// Name of its image on the node; empty before it has the image.
    pub image_id: Text,
    pub restart_count: i32,
    /// The kubelet has made the container of the next life, and counts it, before that runs. It says that the container waits, as after an end.
    pub begins_anew: bool,
    pub state: ContainerState,
    /// How the life before the present one ended.
    pub last_ended: Option<Box<Ended>>,
}

#[derive(Deserialize, Default)]
#[serde(rename_all = "camelCase", default)]
struct Seen {
    name: Text,
    #[serde(rename = "imageID")]
    image_id: Text,
    restart_count: i32,
    #[serde(rename = "containerID", deserialize_with = "digest")]
    id: u64,
    state: States,
    last_state: States,
}

/// State of a container: one of the three that Kubernetes has.
#[derive(Clone, Debug, Default, PartialEq)]
pub enum ContainerState {
    #[default]
    Unknown,
    Running(Running),
    Waiting(Box<Waiting>),
    Ended(Box<Ended>),
}

#[derive(Deserialize, Default)]
#[serde(default)]
struct States {
    running: Option<Running>,
    waiting: Option<Box<Waiting>>,
    terminated: Option<Box<Ended>>,
}

#[derive(Deserialize, Clone, Debug, Default, PartialEq)]
#[serde(rename_all = "camelCase", default)]
pub struct Running {
    pub started_at: Option<Time>,
}

#[derive(Deserialize, Clone, Debug, Default, PartialEq)]
#[serde(default)]
pub struct Waiting {
    pub reason: Option<Text>,
    #[serde(deserialize_with = "cut")]
    pub message: Option<Box<str>>,
}

/// How a container ended.
#[derive(Deserialize, Clone, Debug, Default, PartialEq)]
#[serde(rename_all = "camelCase", default)]
pub struct Ended {
    pub exit_code: i32,
    pub reason: Option<Text>,
    #[serde(deserialize_with = "cut")]
    pub message: Option<Box<str>>,
    pub started_at: Option<Time>,
    pub finished_at: Option<Time>,
    #[serde(rename = "containerID", deserialize_with = "digest")]
    id: u64,
}

fn conditions<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Conditions, D::Error> {
    let all = Option::<Vec<Condition>>::deserialize(deserializer)?;
    let mut found = Conditions::default();
    for condition in all.into_iter().flatten() {
        match &*condition.type_ {
            "PodScheduled" => found.scheduled = Some(Box::new(condition)),
            "DisruptionTarget" if &*condition.status == "True" => found.disruption = condition.reason,
            _ => {}
        }
    }
    Ok(found)
}

/// A container's id as a number, which is enough to compare two; 0 without one.
fn digest<'de, D: Deserializer<'de>>(deserializer: D) -> Result<u64, D::Error> {
    let id = Option::<Cow<'_, str>>::deserialize(deserializer)?.unwrap_or_default();
    if id.is_empty() {
        return Ok(0);
    }
    let mut hasher = DefaultHasher::new();
    id.hash(&mut hasher);
    Ok(hasher.finish())
}

impl From<Seen> for ContainerStatus {
    fn from(seen: Seen) -> Self {
        let state = ContainerState::from(seen.state);
        let last_ended = seen.last_state.terminated;
        let is_of_another = |last: &Ended| ![last.id, 0].contains(&seen.id) && last.id != 0;
        Self {
            begins_anew: state.waiting().is_some() && last_ended.as_deref().is_some_and(is_of_another),
            name: seen.name,
            image_id: seen.image_id,
            restart_count: seen.restart_count,
            state,
            last_ended,
        }
    }
}

impl From<States> for ContainerState {
    fn from(states: States) -> Self {
        let ended = states.terminated.map(Self::Ended);
        let running = || states.running.map(Self::Running);
        let waiting = || states.waiting.map(Self::Waiting);
        ended.or_else(running).or_else(waiting).unwrap_or_default()
    }
}

impl ContainerState {
    pub fn running(&self) -> Option<&Running> {
        match self {
            Self::Running(running) => Some(running),
            _ => None,
        }
    }

    pub fn waiting(&self) -> Option<&Waiting> {
        match self {
            Self::Waiting(waiting) => Some(waiting),
            _ => None,
        }
    }

    pub fn ended(&self) -> Option<&Ended> {
        match self {
            Self::Ended(ended) => Some(ended),
            _ => None,
        }
    }
}

impl PodStatus {
    /// The status of every container, those first that run first.
    pub fn all_containers(&self) -> impl Iterator<Item = &ContainerStatus> {
        self.init_container_statuses.iter().chain(&self.container_statuses)
    }
}

impl ContainerStatus {
    /// How it ended last.
    pub fn ended(&self) -> Option<&Ended> {
        self.state.ended().or(self.last_ended.as_deref())
    }
}

impl Pod {
    fn share_texts(&mut self, texts: &mut Texts) {
        self.metadata.share_texts(texts);
        let Self { spec, status, .. } = self;
        let mut shared: Vec<&mut Text> = Vec::new();
        shared.extend(&mut spec.node_name);
        shared.extend(spec.containers.iter_mut().map(|container| &mut container.name));
        shared.extend(&mut status.phase);
        shared.extend(&mut status.reason);
        if let Some(scheduled) = &mut status.conditions.scheduled {
            shared.extend([&mut scheduled.type_, &mut scheduled.status]);
            shared.extend(&mut scheduled.reason);
        }
        shared.extend(&mut status.conditions.disruption);
        let all = [&mut status.init_container_statuses, &mut status.container_statuses];
        for container in all.into_iter().flat_map(|containers| containers.iter_mut()) {
            shared.extend([&mut container.name, &mut container.image_id]);
            shared.extend(match &mut container.state {
                ContainerState::Waiting(waiting) => waiting.reason.as_mut(),
                ContainerState::Ended(ended) => ended.reason.as_mut(),
                _ => None,
            });
            let last = container.last_ended.iter_mut();
            shared.extend(last.filter_map(|ended| ended.reason.as_mut()));
        }
        for text in shared {
            texts.share(text);
        }
    }
}

watchable!(Pod, NamespaceResourceScope, "Pod", "", "v1", "pods");
