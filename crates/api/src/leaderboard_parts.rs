//! The parts of a Leaderboard's spec, each with its own rules and defaults: what runs, where, how long, and who may do what.
//!
//! Owned by `api`. Every object with defaulted children implements `Default` by the same functions its fields use,
//! so that a half-filled object reads back whole.

#![allow(
    clippy::struct_field_names,
    reason = "durations are named by their unit; the derived schema repeats the struct without its attributes"
)]

use std::collections::BTreeMap;

use k8s_openapi::api::core::v1::{EnvVar, ResourceRequirements, SecurityContext, Toleration};
use kube::KubeSchema;
use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::{Deserialize, Serialize};

pub use super::byte_quantity::ByteQuantity;
use super::carla::{Carla, TrackCarla};
use super::container::{ContainerEvaluation, TrackEvaluator};
pub use super::gpu::*;
use super::image_pattern::ImagePattern;
pub use super::leaderboard_network::*;
pub use super::leaderboard_services::*;
pub use super::track_container::TrackContainer;

/// A kind of evaluation: exactly one of its members.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, PartialEq)]
#[serde(rename_all = "camelCase")]
pub enum Evaluation {
    /// The CARLA Leaderboard: pairs of a simulator and an agent drive routes.
    Carla(Box<Carla>),
    /// A container of the host's evaluates the participant's agent, and writes the result.
    Container(Box<ContainerEvaluation>),
}

impl Evaluation {
    /// That of the CARLA Leaderboard, if it is one.
    pub fn carla(&self) -> Option<&Carla> {
        match self {
            Self::Carla(carla) => Some(carla),
            Self::Container(_) => None,
        }
    }

    /// That of the CARLA Leaderboard, to change it.
    pub fn carla_mut(&mut self) -> Option<&mut Carla> {
        match self {
            Self::Carla(carla) => Some(carla),
            Self::Container(_) => None,
        }
    }

    /// That by a container of the host's, if it is one.
    pub fn container(&self) -> Option<&ContainerEvaluation> {
        match self {
            Self::Carla(_) => None,
            Self::Container(container) => Some(container),
        }
    }

    /// True if a submission is a file and no image.
    pub fn takes_files(&self) -> bool {
        self.container().is_some_and(|container| !container.mode.has_agent())
    }
}

/// A track: what one phase of the challenge asks for.
#[derive(Serialize, Deserialize, KubeSchema, Clone, Debug, PartialEq)]
#[serde(rename_all = "camelCase")]
pub struct Track {
    /// Name of the track in this Leaderboard, a DNS label.
    #[schemars(length(min = 1, max = 32), regex(pattern = r"^[a-z0-9]([-a-z0-9]*[a-z0-9])?$"))]
    pub name: String,
    /// Id of the EvalAI phase; absent for a local track.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(range(min = 1))]
    pub phase: Option<i64>,
    /// Overrides fields of `evaluation.carla`.
    #[serde(default, skip_serializing_if = "TrackCarla::is_empty")]
    pub carla: TrackCarla,
    /// Overrides fields of `evaluation.container`, and names the score.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub container: Option<TrackEvaluator>,
    /// Overrides deadlines of the Leaderboard.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub deadlines: Option<TrackDeadlines>,
    /// Overrides of the Leaderboard's agent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub agent: Option<TrackContainer>,
    /// Nodes that may run this track.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    #[schemars(extend("maxProperties" = 32))]
    pub node_selector: BTreeMap<String, String>,
    /// Taints its Pods tolerate.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[schemars(length(max = 32))]
    pub tolerations: Vec<Toleration>,
    /// PriorityClass of its Pods. The class needs `preemptionPolicy: Never`: a run that preempts another one costs it the route that it drives.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(min = 1, max = 253), regex(pattern = r"^[a-z0-9]([-.a-z0-9]*[a-z0-9])?$"))]
    pub priority_class_name: Option<String>,
}

/// Deadlines of one track's runs in place of the Leaderboard's.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Copy, Debug, Default, PartialEq, Eq)]
#[serde(rename_all = "camelCase")]
pub struct TrackDeadlines {
    /// Seconds for the pulls of all images of a Pod.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(range(min = 1, max = 31_536_000))]
    pub pull_seconds: Option<i64>,
    /// Seconds from the Pod's scheduling, or from the end of its last pull, to its first agent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(range(min = 1, max = 31_536_000))]
    pub start_seconds: Option<i64>,
    /// Seconds of a run, from its first agent, or without agents from its first evaluator. A track can set another limit than the Leaderboard's, and cannot remove it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(range(min = 1, max = 31_536_000))]
    pub run_seconds: Option<i64>,
}

/// Image and settings that `kubectl leaderboard check` runs.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, PartialEq, Eq)]
pub struct CheckImage {
    /// The image of an agent of the host's own, which drives one route. `agent.images` need not allow it.
    #[schemars(length(min = 1, max = 512), regex(pattern = r"^[a-z0-9][!-~]*$"))]
    pub image: String,
}

/// How the submitted image is run by each worker.
#[derive(Serialize, Deserialize, KubeSchema, Clone, Debug, PartialEq)]
#[serde(rename_all = "camelCase")]
#[x_kube(
    validation = Rule::new("!has(self.logSizeLimit) || quantity(string(self.logSizeLimit)).compareTo(quantity('1Mi')) >= 0").message("agent.logSizeLimit must be 1Mi or more"),
    validation = Rule::new("!has(self.logSizeLimit) || quantity(string(self.logSizeLimit)).compareTo(quantity('1Ti')) <= 0").message("agent.logSizeLimit must be 1Ti or less"),
    validation = Rule::new("!has(self.shmSize) || quantity(string(self.shmSize)).compareTo(quantity('1Mi')) >= 0").message("agent.shmSize must be 1Mi or more"),
    validation = Rule::new("!has(self.shmSize) || quantity(string(self.shmSize)).compareTo(quantity('1Ti')) <= 0").message("agent.shmSize must be 1Ti or less"),
    validation = Rule::new("!has(self.images) || self.images.all(p, !p.matches('[a-z0-9*}][{]team[}]|[{]team[}][a-z0-9*{]'))").message("an entry of agent.images has a letter, a digit or * next to {team}: team 7 would get the images of team 17; put -, _, . or / between"),
    validation = Rule::new("!has(self.args) || has(self.command)").message("agent.args without agent.command would be added to the default command; write the command too")
)]
pub struct AgentContainer {
    /// Default: the Leaderboard's evaluator with the flags of the version.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub command: Option<Vec<String>>,
    /// Arguments of the command.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub args: Option<Vec<String>>,
    /// Environment variables beside those that the operator sets.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[x_kube(merge_strategy = ListMerge::Map(vec!["name".into()]))]
    pub env: Vec<EnvVar>,
    /// Requests and limits of the container.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub resources: Option<ResourceRequirements>,
    /// Laid over the safe default field by field. To remove one of its fields, set it to null in podOverrides.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub security_context: Option<SecurityContext>,
    /// Size of `leaderboard.log` at which it is no longer written: `1Mi` to `1Ti`.
    #[serde(default = "defaults::log_size_limit")]
    pub log_size_limit: ByteQuantity,
    /// Size of each agent's `/dev/shm`, in memory: `1Mi` to `1Ti`. What lies there counts to the agent's memory limit. Absent: `evaluation.container.shmSize`, and with CARLA 64 MiB, as the container runtime makes it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub shm_size: Option<ByteQuantity>,
    /// Images that may be submitted, such as `registry.example/team-{team}/*`: `{team}` is the id of the submission's team, `*` one or more characters between two slashes. Default for EvalAI's submissions: `*.dkr.ecr.*.amazonaws.com/*-participant-team-{team}`. `[]`: any image. The host's own images are never among them.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(max = 32))]
    #[x_kube(merge_strategy = ListMerge::Atomic)]
    pub images: Option<Vec<ImagePattern>>,
}

/// What is forgiven before a submission fails.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Copy, Debug, PartialEq, Eq)]
#[serde(rename_all = "camelCase")]
pub struct Retries {
    /// Number of times that a worker may be started again after a crash; 0 ends the run at the first one.
    #[serde(default = "defaults::retries_per_worker")]
    #[schemars(range(min = 0, max = 100))]
    pub per_worker: i32,
    /// New Jobs after infrastructure failures. After a second failure of an attempt that an agent can cause a Job follows only if the one
    /// before has finished a route.
    #[serde(default = "defaults::retries_infrastructure")]
    #[schemars(range(min = 0, max = 100))]
    pub infrastructure: i32,
}

/// Time limits.
#[derive(Serialize, Deserialize, KubeSchema, Clone, Copy, Debug, PartialEq, Eq)]
#[serde(rename_all = "camelCase")]
#[x_kube(
    validation = Rule::new("!has(self.runSeconds) || self.idleSeconds < self.runSeconds").message("deadlines.idleSeconds (800 by default) must be shorter than runSeconds: it could never be reached"),
    validation = Rule::new("!has(self.runSeconds) || self.readySeconds < self.runSeconds").message("deadlines.readySeconds (3600 by default) must be shorter than runSeconds: the run would end before a simulator or an evaluator may be ready"),
    validation = Rule::new("self.cancelSeconds <= self.flushSeconds").message("deadlines.cancelSeconds may not be longer than flushSeconds: a cancelled run would be given more time for its results than a finished one")
)]
#[allow(
    clippy::struct_field_names,
    reason = "the unit belongs into the name of every duration of the API"
)]
pub struct Deadlines {
    /// Seconds until a node is found. Absent: the Pod waits without an end, and the status shows why.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(range(min = 1, max = 31_536_000))]
    pub schedule_seconds: Option<i64>,
    /// Seconds for the pulls of all images of a Pod. While a container waits for its image, `startSeconds` does not count.
    #[serde(default = "defaults::pull_seconds")]
    #[schemars(range(min = 1, max = 31_536_000))]
    pub pull_seconds: i64,
    /// Seconds from the Pod's scheduling, or from the end of its last pull, to its first agent.
    #[serde(default = "defaults::start_seconds")]
    #[schemars(range(min = 1, max = 31_536_000))]
    pub start_seconds: i64,
    /// Seconds until a simulator or an evaluator must answer.
    #[serde(default = "defaults::ready_seconds")]
    #[schemars(range(min = 1, max = 31_536_000))]
    pub ready_seconds: i64,
    /// Seconds without output after which an agent is stopped. Evaluators may be silent.
    #[serde(default = "defaults::idle_seconds")]
    #[schemars(range(min = 1, max = 31_536_000))]
    pub idle_seconds: i64,
    /// Seconds of a run, from its first agent, or without agents from its first evaluator. Absent: no limit, so one that does not end keeps its nodes until a person cancels it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(range(min = 1, max = 31_536_000))]
    pub run_seconds: Option<i64>,
    /// Seconds from a cancel to the end of the Pod.
    #[serde(default = "defaults::cancel_seconds")]
    #[schemars(range(min = 1, max = 31_536_000))]
    pub cancel_seconds: i64,
    /// Seconds that a finished Pod waits for its results to be stored.
    #[serde(default = "defaults::flush_seconds")]
    #[schemars(range(min = 1, max = 31_536_000))]
    pub flush_seconds: i64,
    /// Seconds that a deleted Submission waits for its results to be published.
    #[serde(default = "defaults::finalize_seconds")]
    #[schemars(range(min = 1, max = 604_800))]
    pub finalize_seconds: i64,
}

/// Who `workspace` and `logcopy` are towards S3. No other container of the Pod gets it.
#[derive(Serialize, Deserialize, KubeSchema, Clone, Debug, PartialEq, Eq)]
#[serde(rename_all = "camelCase")]
#[x_kube(
    validation = Rule::new("has(self.roleARN) != has(self.secretName)").message("podIdentity needs exactly one of roleARN and secretName"),
    validation = Rule::new("!has(self.roleARN) || has(self.serviceAccountName)").message("podIdentity.roleARN needs serviceAccountName: the role trusts the token of that account")
)]
pub struct PodIdentity {
    /// ServiceAccount of the Pod; it needs no rights in the cluster.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(min = 1, max = 253))]
    pub service_account_name: Option<String>,
    /// Role assumed with the account's own token, limited to the run's prefix.
    #[serde(rename = "roleARN", default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(max = 2048), regex(pattern = r"^arn:"))]
    pub role_arn: Option<String>,
    /// Secret with `AWS_ACCESS_KEY_ID` and `AWS_SECRET_ACCESS_KEY`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(min = 1, max = 253))]
    pub secret_name: Option<String>,
}

/// How many submissions run at once; absent means no limit.
#[derive(Serialize, Deserialize, KubeSchema, Clone, Copy, Debug, Default, PartialEq, Eq)]
#[serde(rename_all = "camelCase")]
#[x_kube(validation = Rule::new("!has(self.total) || !has(self.perTeam) || self.perTeam <= self.total").message("concurrency.perTeam is larger than concurrency.total: it could never be reached"))]
pub struct Concurrency {
    /// Maximum number of running submissions of this Leaderboard.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(range(min = 1))]
    pub total: Option<i32>,
    /// Maximum number of running submissions of one team.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(range(min = 1))]
    pub per_team: Option<i32>,
}

impl Default for AgentContainer {
    fn default() -> Self {
        Self {
            command: None,
            args: None,
            env: Vec::new(),
            resources: None,
            security_context: None,
            log_size_limit: defaults::log_size_limit(),
            shm_size: None,
            images: None,
        }
    }
}

impl Default for Retries {
    fn default() -> Self {
        Self {
            per_worker: defaults::retries_per_worker(),
            infrastructure: defaults::retries_infrastructure(),
        }
    }
}

impl Default for Deadlines {
    fn default() -> Self {
        Self {
            schedule_seconds: None,
            pull_seconds: defaults::pull_seconds(),
            start_seconds: defaults::start_seconds(),
            ready_seconds: defaults::ready_seconds(),
            idle_seconds: defaults::idle_seconds(),
            run_seconds: None,
            cancel_seconds: defaults::cancel_seconds(),
            flush_seconds: defaults::flush_seconds(),
            finalize_seconds: defaults::finalize_seconds(),
        }
    }
}

/// An object that the API server keeps as it is.
pub(super) fn raw_object(_: &mut SchemaGenerator) -> Schema {
    json_schema!({ "type": "object", "nullable": true, "x-kubernetes-preserve-unknown-fields": true })
}

/// Labels, within the API server's own bounds of a value.
pub(super) fn label_map(_: &mut SchemaGenerator) -> Schema {
    json_schema!({ "type": "object", "maxProperties": 16, "additionalProperties": { "type": "string", "maxLength": 63 } })
}

mod defaults {
    use super::ByteQuantity;

    pub(super) fn log_size_limit() -> ByteQuantity {
        ByteQuantity::gibibytes(2)
    }
    pub(super) fn retries_per_worker() -> i32 {
        3
    }
    pub(super) fn retries_infrastructure() -> i32 {
        2
    }
    pub(super) fn pull_seconds() -> i64 {
        5400
    }
    pub(super) fn start_seconds() -> i64 {
        1800
    }
    pub(super) fn ready_seconds() -> i64 {
        3600
    }
    pub(super) fn idle_seconds() -> i64 {
        800
    }
    pub(super) fn cancel_seconds() -> i64 {
        120
    }
    pub(super) fn flush_seconds() -> i64 {
        1800
    }
    pub(super) fn finalize_seconds() -> i64 {
        900
    }
}
