//! The evaluation of a host's own evaluator in the spec and the status of a Leaderboard: a container beside the participant's agent, which
//! writes the result.
//!
//! Owned by `api`. A track lays its own fields over those of the Leaderboard; `api::effective` computes the result.

use k8s_openapi::api::core::v1::{EnvVar, ResourceRequirements, SecurityContext};
use kube::KubeSchema;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::agents::Agents;
use super::byte_quantity::ByteQuantity;
use super::order::Order;
use super::progress::MAX_NAME;
use super::shared_text::SharedText;
use super::track_container::TrackContainer;

/// Ports of two evaluators of one Pod are so far apart.
pub const PORT_STEP: i32 = 100;

/// A way in which an evaluator and the participant's image meet.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Copy, Debug, PartialEq, Eq)]
pub enum EvaluationMode {
    /// The evaluator and the agent run side by side in one Pod and talk over a port.
    Interactive,
    /// One agent runs first and leaves files; the evaluators read them once it has ended.
    Batch,
    /// A submission is a file and no image: the evaluators read it.
    Predictions,
}

impl EvaluationMode {
    /// How its agents stand to the evaluators.
    pub const fn agents(self) -> Agents {
        match self {
            Self::Interactive => Agents::Beside,
            Self::Batch => Agents::First,
            Self::Predictions => Agents::Absent,
        }
    }

    /// True if a submission is an image, whose agent runs.
    pub const fn has_agent(self) -> bool {
        !matches!(self.agents(), Agents::Absent)
    }

    /// True if the evaluators read files at `/input`.
    pub const fn has_input(self) -> bool {
        !matches!(self, Self::Interactive)
    }
}

/// Treatment of the results of several workers.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum MergeMethod {
    /// Each metric is the mean of all workers, weighted by the units that each has done. A metric that is no mean over units, such as F1,
    /// needs Command or one worker.
    #[default]
    Mean,
    /// Each metric is the sum of all workers.
    Sum,
    /// The evaluator's command once more, with `WORKER=merge`. It begins when the results of all workers are final, reads what they have left,
    /// and writes the result of the run.
    Command,
}

/// The evaluation by a container of the host's.
#[derive(Serialize, Deserialize, KubeSchema, Clone, Debug, PartialEq)]
#[serde(rename_all = "camelCase")]
#[x_kube(
    validation = Rule::new("quantity(string(self.shmSize)).compareTo(quantity('1Mi')) >= 0").message("evaluation.container.shmSize must be 1Mi or more"),
    validation = Rule::new("quantity(string(self.shmSize)).compareTo(quantity('1Ti')) <= 0").message("evaluation.container.shmSize must be 1Ti or less"),
    validation = Rule::new("self.mode == oldSelf.mode").message("evaluation.container.mode is immutable: results of one mode cannot be compared with another's; make a new Leaderboard"),
    validation = Rule::new("!has(self.port) || self.mode == 'Interactive'").message("evaluation.container.port is for Interactive: in other modes no agent talks to the evaluator; leave it out"),
    validation = Rule::new("!has(self.input) || self.mode != 'Interactive'").message("evaluation.container.input is for Batch and Predictions: in Interactive the evaluator reads no files of the participant's; leave it out"),
    validation = Rule::new("!has(self.datasetForAgent) || (has(self.dataset) && self.mode != 'Predictions')").message("evaluation.container.datasetForAgent needs a dataset and a mode with an agent; leave it out")
)]
pub struct ContainerEvaluation {
    /// Mode in which the evaluator and the participant's image meet.
    pub mode: EvaluationMode,
    /// Image of the evaluator.
    #[schemars(length(min = 1, max = 512), regex(pattern = r"^[^\s]+$"))]
    pub image: String,
    /// Command of the evaluator. It has no default, since the image's own entrypoint is not known.
    #[schemars(length(min = 1, max = 64))]
    pub command: Vec<String>,
    /// Arguments of the command.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub args: Option<Vec<String>>,
    /// Environment variables beside those that the operator sets.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[x_kube(merge_strategy = ListMerge::Map(vec!["name".into()]))]
    pub env: Vec<EnvVar>,
    /// Requests and limits; GPUs are requested by the field `gpu` of the Leaderboard.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub resources: Option<ResourceRequirements>,
    /// Laid over the safe default field by field. To remove one of its fields, set it to null in podOverrides.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub security_context: Option<SecurityContext>,
    /// Number of workers, each with an evaluator of its own; in Interactive with an agent, too.
    #[serde(default = "defaults::workers")]
    #[schemars(range(min = 1, max = 16))]
    pub workers: i32,
    /// Port on which the first worker's evaluator listens; each further worker's is 100 higher. The agent starts once the evaluator listens
    /// there. Absent: the agent starts at once.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(range(min = 1024, max = 64000))]
    pub port: Option<i32>,
    /// Size of each evaluator's and each agent's `/dev/shm`, in memory: `1Mi` to `1Ti`. `agent.shmSize` takes its place for agents.
    #[serde(default = "defaults::shm_size")]
    pub shm_size: ByteQuantity,
    /// Seconds from the regular end of an agent to the final result of its evaluator; where no agent runs beside it, from its own start.
    #[serde(default = "defaults::answer_seconds")]
    #[schemars(range(min = 1, max = 31_536_000))]
    pub answer_seconds: i64,
    /// Treatment of the results of several workers.
    #[serde(default)]
    pub merge: MergeMethod,
    /// Data of the challenge, read-only at `/dataset` in every evaluator, and in the agents as `datasetForAgent` says.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub dataset: Option<DataSource>,
    /// True if agents get the dataset, too. Absent: they do in Batch alone.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub dataset_for_agent: Option<bool>,
    /// Data that no agent ever gets, such as the right answers: read-only at `/labels` in every evaluator.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub labels: Option<DataSource>,
    /// Bounds of what a submission brings at `/input`, in Batch and Predictions.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub input: Option<InputBounds>,
}

/// A source of read-only data: exactly one of its members.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, PartialEq, Eq)]
#[serde(rename_all = "camelCase")]
pub enum DataSource {
    /// A folder of an image, which each Pod copies before its work begins.
    Image(DataImage),
    /// A claim in the namespace of the Leaderboard.
    PersistentVolumeClaim(DataClaim),
}

impl DataSource {
    /// The image, if it is one.
    pub fn image(&self) -> Option<&DataImage> {
        match self {
            Self::Image(image) => Some(image),
            Self::PersistentVolumeClaim(_) => None,
        }
    }
}

/// A folder of an image. The image needs no shell and no program.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, PartialEq, Eq)]
pub struct DataImage {
    /// The image.
    #[schemars(length(min = 1, max = 512), regex(pattern = r"^[^\s]+$"))]
    pub reference: String,
    /// The folder in it; `/dataset` by default, for labels, too.
    #[serde(default = "defaults::data_path")]
    #[schemars(length(min = 1, max = 512), regex(pattern = r"^/[^\s]*$"))]
    pub path: String,
}

/// A claim whose volume is mounted read-only. Its access modes must let all Pods of submissions mount it: `ReadOnlyMany` or
/// `ReadWriteMany`.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, PartialEq, Eq)]
#[serde(rename_all = "camelCase")]
pub struct DataClaim {
    /// Name of the claim.
    #[schemars(length(min = 1, max = 253))]
    pub claim_name: String,
}

/// Bounds of what a submission brings.
#[derive(Serialize, Deserialize, KubeSchema, Clone, Debug, PartialEq, Eq)]
#[serde(rename_all = "camelCase")]
#[x_kube(
    validation = Rule::new("quantity(string(self.maxBytes)).compareTo(quantity('1')) >= 0").message("evaluation.container.input.maxBytes must be 1 or more"),
    validation = Rule::new("quantity(string(self.maxBytes)).compareTo(quantity('100Gi')) <= 0").message("evaluation.container.input.maxBytes must be 100Gi or less")
)]
pub struct InputBounds {
    /// Bytes of all files together, at most.
    #[serde(default = "defaults::max_bytes")]
    pub max_bytes: ByteQuantity,
    /// Number of files, at most. A submission to Predictions is one.
    #[serde(default = "defaults::max_files")]
    #[schemars(range(min = 1, max = 10_000))]
    pub max_files: i32,
}

impl Default for InputBounds {
    fn default() -> Self {
        Self {
            max_bytes: defaults::max_bytes(),
            max_files: defaults::max_files(),
        }
    }
}

impl ContainerPlan {
    /// The number of the worker whose command merges the results of all before it, if there is one.
    pub fn merger(&self) -> Option<usize> {
        let sharing = usize::try_from(self.workers).unwrap_or(1);
        (self.merge == MergeMethod::Command).then(|| sharing.saturating_add(1))
    }
}

impl ContainerEvaluation {
    /// True if an agent gets the dataset.
    pub fn agent_has_dataset(&self) -> bool {
        let usual = self.mode == EvaluationMode::Batch;
        self.dataset.is_some() && self.mode.has_agent() && self.dataset_for_agent.unwrap_or(usual)
    }

    /// Bounds of what a submission brings.
    pub fn input_bounds(&self) -> InputBounds {
        self.input.clone().unwrap_or_default()
    }

    /// The whole command of the evaluator.
    pub fn words(&self) -> Vec<String> {
        let arguments = self.args.iter().flatten();
        self.command.iter().chain(arguments).cloned().collect()
    }
}

/// The overlay of one track over `evaluation.container`.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, PartialEq)]
#[serde(rename_all = "camelCase")]
pub struct TrackEvaluator {
    /// Number of workers, in place of the Leaderboard's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(range(min = 1, max = 16))]
    pub workers: Option<i32>,
    /// Metric of the result that is the score of a submission.
    pub score: ScoreMetric,
    /// Overrides of the Leaderboard's evaluator.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub evaluator: Option<TrackContainer>,
}

/// The metric of a result that is its score.
#[derive(Serialize, Deserialize, KubeSchema, Clone, Debug, PartialEq, Eq)]
#[x_kube(
    validation = Rule::new("!has(self.split) || size(self.split) + size(self.metric) < 64").message("container.score: split and metric have at most 63 characters together, because `<split>_<metric>` is the name of the score")
)]
pub struct ScoreMetric {
    /// Codename of the split that has the metric. Absent: the result has one split. Present: each metric's name is `<split>_<metric>`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(min = 1, max = MAX_NAME))]
    pub split: Option<String>,
    /// Name of the metric.
    #[schemars(length(min = 1, max = MAX_NAME))]
    pub metric: String,
    /// `Descending` if the highest value leads. The order that EvalAI has for the phase takes its place.
    #[serde(default)]
    pub order: Order,
}

impl ScoreMetric {
    /// Its name in a status, a row and the standings.
    pub fn name(&self) -> String {
        self.name_of(self.split.as_deref().unwrap_or_default(), &self.metric)
    }

    /// Name of any metric of the result: that of the metric, and where the score names a split, behind the metric's own split.
    pub fn name_of(&self, split: &str, metric: &str) -> String {
        match self.split {
            Some(_) => format!("{split}_{metric}"),
            None => metric.to_owned(),
        }
    }
}

/// What a run by a host's evaluator consists of.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, PartialEq)]
#[serde(rename_all = "camelCase")]
pub struct ContainerPlan {
    /// Mode in which the evaluator and the participant's image meet.
    pub mode: EvaluationMode,
    /// Number of workers that share the work, each with an evaluator of its own; in Interactive with an agent, too.
    pub workers: i32,
    /// Treatment of the results of several workers.
    pub merge: MergeMethod,
    /// Metric of the result that is the score of the submission.
    pub score: ScoreMetric,
    /// Image of the evaluator, renewed by each attempt.
    #[schemars(length(max = 512))]
    pub image: SharedText,
    /// Bounds of what a submission brings, in Batch and Predictions.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub input: Option<InputBounds>,
}

/// The numbers of what a track effectively runs.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, Default, PartialEq, Eq)]
pub struct ContainerShape {
    /// Number of workers, each with an evaluator of its own; in Interactive with an agent, too.
    pub workers: i32,
}

mod defaults {
    use super::ByteQuantity;

    pub(super) fn workers() -> i32 {
        1
    }
    pub(super) fn shm_size() -> ByteQuantity {
        ByteQuantity::mebibytes(64)
    }
    pub(super) fn answer_seconds() -> i64 {
        600
    }
    pub(super) fn data_path() -> String {
        "/dataset".to_owned()
    }
    pub(super) fn max_bytes() -> ByteQuantity {
        ByteQuantity::gibibytes(1)
    }
    pub(super) fn max_files() -> i32 {
        1000
    }
}
