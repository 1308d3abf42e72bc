//! The kind `Leaderboard`: one version of a leaderboard, what it runs and where its results go.
//!
//! Owns the top level of the spec, its cross-field rules and the status. The parts are in `leaderboard_parts`.
//! A value that depends on another field has no schema default: `api::effective` computes it.

use std::collections::BTreeMap;

use jiff::Timestamp;
use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;
use kube::CustomResource;
use kube::KubeSchema;
use kube::ResourceExt;
use serde::{Deserialize, Serialize};

use super::carla::CarlaShape;
use super::conditions::{self, Condition};
use super::container::ContainerShape;
use super::evalai_mode::EvalaiMode;
use super::evalai_queue::EvalaiQueue;
use super::leaderboard_parts::{
    AgentContainer, CheckImage, Concurrency, Deadlines, DynamoTable, Evalai, Evaluation, Gpu, LogGroup, Logs, Network,
    PodIdentity, Queue, Retries, SqsQueue, Storage, Table, Track,
};
use super::retention::Retention;
use super::standings::{MAX_STANDINGS, Ranking, Standing};
use super::submission_use::{MAX_USING_TEAMS, TeamUse};

/// One leaderboard version: its tracks, the images that run it, and the services its results go to.
#[derive(CustomResource, KubeSchema, Serialize, Deserialize, Clone, Debug, PartialEq)]
#[kube(
    group = "leaderboard.carla.org",
    version = "v1alpha1",
    kind = "Leaderboard",
    plural = "leaderboards",
    shortname = "lb",
    category = "challenges",
    namespaced,
    status = "LeaderboardStatus",
    doc = "One leaderboard version: its tracks, the images that run it, and the services its results go to.",
    derive = "PartialEq",
    validation = Rule::new("size(self.metadata.name) <= 52").message("metadata.name may have at most 52 characters: labels and policies are named after it"),
    validation = Rule::new("!self.metadata.name.contains('.')").message("metadata.name may not contain a dot: it becomes a label and part of other names"),
    printcolumn = r#"{"name":"Ready","type":"string","jsonPath":".status.conditions[?(@.type==\"Ready\")].status"}"#,
    printcolumn = r#"{"name":"Reason","type":"string","jsonPath":".status.conditions[?(@.type==\"Ready\")].reason"}"#,
    printcolumn = r#"{"name":"Paused","type":"boolean","jsonPath":".spec.paused"}"#,
    printcolumn = r#"{"name":"Pending","type":"integer","jsonPath":".status.counts.pending"}"#,
    printcolumn = r#"{"name":"Running","type":"integer","jsonPath":".status.counts.running"}"#,
    printcolumn = r#"{"name":"Finished","type":"integer","jsonPath":".status.counts.finished"}"#,
    printcolumn = r#"{"name":"Failed","type":"integer","jsonPath":".status.counts.failed"}"#,
    printcolumn = r#"{"name":"Cancelled","type":"integer","jsonPath":".status.counts.cancelled"}"#,
    printcolumn = r#"{"name":"Age","type":"date","jsonPath":".metadata.creationTimestamp"}"#
)]
#[serde(rename_all = "camelCase")]
#[x_kube(
    validation = Rule::new("has(self.evaluation.carla) == has(oldSelf.evaluation.carla)").message("the kind of evaluation is immutable: results of one cannot be compared with the other's; make a new Leaderboard"),
    validation = Rule::new("!has(self.evaluation.carla) || !has(oldSelf.evaluation.carla) || self.evaluation.carla.version == oldSelf.evaluation.carla.version").message("evaluation.carla.version is immutable: checkpoints of one format cannot be merged with the other's; make a new Leaderboard"),
    validation = Rule::new("!has(self.evaluation.container) || self.evaluation.container.mode == 'Predictions' || has(self.agent) && has(self.agent.command)").message("agent.command is missing: evaluation.container knows no default command of the submitted image"),
    validation = Rule::new("self.tracks.all(t, has(t.container) == has(self.evaluation.container))").message("each track needs container.score if evaluation.container is set, and only then: it names the metric that is the score"),
    validation = Rule::new("!has(self.evaluation.container) || !self.tracks.exists(t, has(t.carla))").message("a track has carla, but evaluation.container is set: write its fields into the track's container"),
    validation = Rule::new("!has(self.evaluation.container) || self.evaluation.container.merge != 'Command' || self.tracks.all(t, (has(t.container) && has(t.container.workers) ? t.container.workers : self.evaluation.container.workers) <= 15)").message("with evaluation.container.merge Command a track has at most 15 workers: the command that merges takes the place of one more; lower workers"),
    validation = Rule::new("self.storage.s3.bucket == oldSelf.storage.s3.bucket").message("storage.s3.bucket is immutable: finished results would no longer be found; make a new Leaderboard"),
    validation = Rule::new("has(self.storage.s3.prefix) == has(oldSelf.storage.s3.prefix) && (!has(self.storage.s3.prefix) || self.storage.s3.prefix == oldSelf.storage.s3.prefix)").message("storage.s3.prefix is immutable: finished results would no longer be found; make a new Leaderboard"),
    validation = Rule::new("!has(oldSelf.evalai) || has(self.evalai)").message("evalai cannot be removed: its submissions would never be published; make a new Leaderboard"),
    validation = Rule::new("!has(oldSelf.evalai) || !has(self.evalai) || self.evalai.challenge == oldSelf.evalai.challenge").message("evalai.challenge is immutable: its submissions belong to that challenge; make a new Leaderboard"),
    validation = Rule::new("!has(oldSelf.evalai) || !has(self.evalai) || self.evalai.mode == oldSelf.evalai.mode").message("evalai.mode is immutable: what was only observed would be published; make a new Leaderboard"),
    validation = Rule::new("!has(self.evalai) || self.evalai.mode != 'Observe' || (!has(self.queue) && !has(self.table) && has(self.storage.s3.prefix))").message("evalai.mode Observe needs a storage.s3.prefix of its own, no queue and no table: those are the other program's"),
    validation = Rule::new("self.tracks.filter(t, has(t.phase)).all(t, self.tracks.exists_one(u, has(u.phase) && u.phase == t.phase))").message("two tracks have the same phase: a message could not be told which one it is for"),
    validation = Rule::new("!has(self.evalai) || self.tracks.exists(t, has(t.phase))").message("evalai is set but no track has a phase: no submission of the challenge could be served; give a track the id of its phase"),
    validation = Rule::new("has(self.evalai) || !self.tracks.exists(t, has(t.phase))").message("a track has a phase but evalai is missing: set evalai, or leave the phase out for a local leaderboard"),
    validation = Rule::new("!has(self.queue) || has(self.evalai)").message("queue needs evalai: its messages name a challenge and a phase of it"),
    validation = Rule::new("!has(self.evaluation.carla) || self.tracks.all(t, (has(t.carla) && has(t.carla.pairs) ? t.carla.pairs : self.evaluation.carla.pairs) <= (has(t.carla) && has(t.carla.routes) ? t.carla.routes : self.evaluation.carla.routes))").message("a track has more pairs than routes, so a pair would have nothing to drive; lower pairs, or set the track's own"),
    validation = Rule::new("!has(self.evaluation.carla) || self.tracks.all(t, !has(t.carla) || !has(t.carla.routeSubsets) || size(t.carla.routeSubsets) == (has(t.carla) && has(t.carla.pairs) ? t.carla.pairs : self.evaluation.carla.pairs))").message("a track's routeSubsets must have one entry for each of its pairs"),
    validation = Rule::new("!has(self.evaluation.carla) || self.tracks.all(t, !has(t.carla) || !has(t.carla.routeSubsets) || t.carla.routeSubsets.map(s, int(s.split('-')[1]) - int(s.split('-')[0]) + 1).sum() == (has(t.carla) && has(t.carla.routes) ? t.carla.routes : self.evaluation.carla.routes))").message("a track's routeSubsets must hold each of its routes once: their lengths do not add up to routes"),
    validation = Rule::new("!has(self.evaluation.carla) || self.evaluation.carla.version == 'V1' || !self.tracks.exists(t, has(t.carla) && has(t.carla.scenariosFile))").message("a track has a scenariosFile, but only V1 reads one: the scenarios of V2 are in its routes; leave it out"),
    validation = Rule::new("self.tracks.all(t, !has(t.deadlines) || !has(t.deadlines.runSeconds) || (self.deadlines.idleSeconds < t.deadlines.runSeconds && self.deadlines.readySeconds < t.deadlines.runSeconds))").message("a track's deadlines.runSeconds must be longer than deadlines.idleSeconds and deadlines.readySeconds: the run would end before they could be reached"),
    validation = Rule::new("!has(self.retention.finishedSeconds) || self.retention.finishedSeconds >= self.ttlSecondsAfterFinished").message("retention.finishedSeconds must be at least ttlSecondsAfterFinished: the Job would be removed with its Submission before its own time; raise one or lower the other"),
    validation = Rule::new("!has(self.evaluation.carla) || !has(self.gpu) || !has(self.gpu.resourceName) || !(has(self.evaluation.carla.simulator.resources) && ((has(self.evaluation.carla.simulator.resources.limits) && self.gpu.resourceName in self.evaluation.carla.simulator.resources.limits) || (has(self.evaluation.carla.simulator.resources.requests) && self.gpu.resourceName in self.evaluation.carla.simulator.resources.requests)))").message("evaluation.carla.simulator.resources names gpu.resourceName too; leave it out there: the operator requests it as gpu.mode says"),
    validation = Rule::new("!has(self.gpu) || !has(self.gpu.resourceName) || !self.tracks.exists(t, (has(t.carla) && has(t.carla.simulator) && (has(t.carla.simulator.resources) && ((has(t.carla.simulator.resources.limits) && self.gpu.resourceName in t.carla.simulator.resources.limits) || (has(t.carla.simulator.resources.requests) && self.gpu.resourceName in t.carla.simulator.resources.requests)))))").message("the carla.simulator.resources of a track name gpu.resourceName too; leave it out there: the operator requests it as gpu.mode says"),
    validation = Rule::new("!has(self.evaluation.carla) || has(self.gpu) || !(has(self.evaluation.carla.simulator.resources) && ((has(self.evaluation.carla.simulator.resources.limits) && 'nvidia.com/gpu' in self.evaluation.carla.simulator.resources.limits) || (has(self.evaluation.carla.simulator.resources.requests) && 'nvidia.com/gpu' in self.evaluation.carla.simulator.resources.requests)))").message("evaluation.carla.simulator.resources names nvidia.com/gpu and gpu is missing, so the other container of a pair would have no GPU; write gpu.resourceName: nvidia.com/gpu in place of it, or gpu.mode: None if that is meant"),
    validation = Rule::new("!has(self.evaluation.container) || !has(self.gpu) || !has(self.gpu.resourceName) || !(has(self.evaluation.container.resources) && ((has(self.evaluation.container.resources.limits) && self.gpu.resourceName in self.evaluation.container.resources.limits) || (has(self.evaluation.container.resources.requests) && self.gpu.resourceName in self.evaluation.container.resources.requests)))").message("evaluation.container.resources names gpu.resourceName too; leave it out there: the operator requests it as gpu.mode says"),
    validation = Rule::new("!has(self.gpu) || !has(self.gpu.resourceName) || !self.tracks.exists(t, has(t.container) && has(t.container.evaluator) && (has(t.container.evaluator.resources) && ((has(t.container.evaluator.resources.limits) && self.gpu.resourceName in t.container.evaluator.resources.limits) || (has(t.container.evaluator.resources.requests) && self.gpu.resourceName in t.container.evaluator.resources.requests))))").message("the container.evaluator.resources of a track name gpu.resourceName too; leave it out there: the operator requests it as gpu.mode says"),
    validation = Rule::new("!has(self.evaluation.container) || self.evaluation.container.mode == 'Predictions' || has(self.gpu) || !(has(self.evaluation.container.resources) && ((has(self.evaluation.container.resources.limits) && 'nvidia.com/gpu' in self.evaluation.container.resources.limits) || (has(self.evaluation.container.resources.requests) && 'nvidia.com/gpu' in self.evaluation.container.resources.requests)))").message("evaluation.container.resources names nvidia.com/gpu and gpu is missing, so the other container of a worker would have no GPU; write gpu.resourceName: nvidia.com/gpu in place of it, or gpu.mode: None if that is meant"),
    validation = Rule::new("!has(self.gpu) || !has(self.gpu.resourceName) || !(has(self.agent.resources) && ((has(self.agent.resources.limits) && self.gpu.resourceName in self.agent.resources.limits) || (has(self.agent.resources.requests) && self.gpu.resourceName in self.agent.resources.requests)))").message("agent.resources names gpu.resourceName too; leave it out there: the operator requests it as gpu.mode says"),
    validation = Rule::new("!has(self.gpu) || !has(self.gpu.resourceName) || !self.tracks.exists(t, (has(t.agent) && (has(t.agent.resources) && ((has(t.agent.resources.limits) && self.gpu.resourceName in t.agent.resources.limits) || (has(t.agent.resources.requests) && self.gpu.resourceName in t.agent.resources.requests)))))").message("the agent.resources of a track name gpu.resourceName too; leave it out there: the operator requests it as gpu.mode says"),
    validation = Rule::new("has(self.gpu) || !(has(self.agent.resources) && ((has(self.agent.resources.limits) && 'nvidia.com/gpu' in self.agent.resources.limits) || (has(self.agent.resources.requests) && 'nvidia.com/gpu' in self.agent.resources.requests)))").message("agent.resources names nvidia.com/gpu and gpu is missing, so the other container of a pair would have no GPU; write gpu.resourceName: nvidia.com/gpu in place of it, or gpu.mode: None if that is meant"),
    validation = Rule::new("!has(self.evaluation.carla) || self.evaluation.carla.version == 'V2' || !has(self.evaluation.carla.simulator.graphicsAdapter)").message("evaluation.carla.simulator.graphicsAdapter is for V2: the simulator of V1 draws with OpenGL, which takes no adapter; leave it out"),
    validation = Rule::new("!has(self.jobLabels) || !self.jobLabels.exists(k, k == 'app.kubernetes.io/managed-by' || k.startsWith('leaderboard.carla.org/'))").message("jobLabels has app.kubernetes.io/managed-by or a key of leaderboard.carla.org/: by those labels the operator finds its own Jobs; take another key"),
    validation = Rule::new("!has(self.jobLabels) || !self.jobLabels.exists(k, k in ['controller-uid', 'job-name'] || k.startsWith('batch.kubernetes.io/'))").message("jobLabels has controller-uid, job-name or a key of batch.kubernetes.io/: those labels are the Job controller's; take another key"),
    validation = Rule::new("self.deadlines.idleSeconds > self.syncPeriodSeconds").message("deadlines.idleSeconds must be longer than syncPeriodSeconds: an agent would be stopped before its first report")
)]
pub struct LeaderboardSpec {
    /// Where submissions come from and scores are published. Absent: a local leaderboard, nothing is reported.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub evalai: Option<Evalai>,
    /// Tracks that participants submit to: sensors, map, and so on.
    #[schemars(length(min = 1, max = 32))]
    #[x_kube(merge_strategy = ListMerge::Map(vec!["name".into()]))]
    pub tracks: Vec<Track>,
    /// The kind of evaluation: exactly one member.
    pub evaluation: Evaluation,
    /// Settings by which the submitted image is run.
    #[serde(default)]
    pub agent: AgentContainer,
    /// Assignment of GPUs to containers. Absent: none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub gpu: Option<Gpu>,
    /// Image and settings that `kubectl leaderboard check` runs.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub check: Option<CheckImage>,
    /// Crashes and infrastructure failures that are forgiven.
    #[serde(default)]
    pub retries: Retries,
    /// When waiting, starting, running and stopping have taken too long.
    #[serde(default)]
    pub deadlines: Deadlines,
    /// The queue of the challenge's messages. Absent: EvalAI is asked for submissions that wait, and no message is read.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub queue: Option<Queue>,
    /// The store of results and logs.
    pub storage: Storage,
    /// The table of submissions. Absent: no row is written.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub table: Option<Table>,
    /// The store of container logs. Absent: they are in the store of the results alone.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub logs: Option<Logs>,
    /// AWS identity by which `workspace` and `logcopy` read and write S3 and CloudWatch.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pod_identity: Option<PodIdentity>,
    /// Addresses that the Pods of submissions may reach.
    #[serde(default)]
    pub network: Network,
    /// RuntimeClass of the Pods, for example `gvisor`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(max = 253))]
    pub runtime_class_name: Option<String>,
    /// Numbers of submissions that may run at once.
    #[serde(default)]
    pub concurrency: Concurrency,
    /// No new submission starts while true; running ones go on.
    #[serde(default)]
    pub paused: bool,
    /// A partial PodTemplateSpec laid over ours: objects deep, lists by name, `simulator`, `evaluator` and `agent` address those of all workers, null removes.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(schema_with = "super::leaderboard_parts::raw_object")]
    pub pod_overrides: Option<serde_json::Value>,
    /// Labels added to the Jobs of submissions, for example `kueue.x-k8s.io/queue-name`. Those of Pods are in podOverrides.metadata.labels.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    #[schemars(schema_with = "super::leaderboard_parts::label_map")]
    pub job_labels: BTreeMap<String, String>,
    /// Time between two rounds of merging, uploading and reporting.
    #[serde(default = "defaults::sync_period_seconds")]
    #[schemars(range(min = 1, max = 600))]
    pub sync_period_seconds: i64,
    /// Seconds that a finished Job is kept, once every system has its end.
    #[serde(default = "defaults::ttl_seconds_after_finished")]
    #[schemars(range(min = 0, max = 31_536_000))]
    pub ttl_seconds_after_finished: i32,
    /// Time for which ended Submissions are kept.
    #[serde(default)]
    pub retention: Retention,
}

/// Kubernetes keeps a finished Job at least so long: within it a controller that was away, or a bucket that could not be read, is
/// back, and the end is read.
pub const JOB_SECONDS: i32 = 7 * 86_400;

impl LeaderboardSpec {
    /// True if the Pods prove their identity with a token of their ServiceAccount.
    pub fn has_role(&self) -> bool {
        let identity = self.pod_identity.as_ref();
        identity.is_some_and(|identity| identity.role_arn.is_some())
    }

    /// True if the operator writes nothing to EvalAI for this Leaderboard.
    pub fn observes(&self) -> bool {
        self.evalai
            .as_ref()
            .is_some_and(|evalai| evalai.mode == EvalaiMode::Observe)
    }

    /// The queue in SQS.
    pub fn sqs(&self) -> Option<&SqsQueue> {
        self.queue.as_ref()?.sqs.as_ref()
    }

    /// The queue in EvalAI's account.
    pub fn evalai_queue(&self) -> Option<&EvalaiQueue> {
        self.queue.as_ref()?.evalai.as_ref()
    }

    /// The table of DynamoDB.
    pub fn dynamo_table(&self) -> Option<&DynamoTable> {
        self.table.as_ref().map(|table| &table.dynamo_db)
    }

    /// The log group of CloudWatch Logs.
    pub fn log_group(&self) -> Option<&LogGroup> {
        self.logs.as_ref().map(|logs| &logs.cloud_watch)
    }

    /// How long Kubernetes keeps a finished Job. A shorter time of the host's is carried out by the controller.
    pub fn job_seconds(&self) -> i32 {
        self.ttl_seconds_after_finished.max(JOB_SECONDS)
    }
}

impl Leaderboard {
    /// A condition, if it was ever set.
    pub fn condition(&self, type_: &str) -> Option<&Condition> {
        conditions::get(&self.status.as_ref()?.conditions, type_)
    }

    /// True if one of the tracks is this phase of this EvalAI challenge.
    pub fn serves(&self, challenge: i64, phase: i64) -> bool {
        let is_of_challenge = self.spec.evalai.as_ref().is_some_and(|e| e.challenge == challenge);
        is_of_challenge && self.spec.tracks.iter().any(|track| track.phase == Some(phase))
    }

    /// Sorts the older one first: it serves a phase that several claim.
    pub fn seniority(&self) -> (Option<Timestamp>, String, String) {
        let created = self.metadata.creation_timestamp.as_ref().map(|time| time.0);
        (created, self.name_any(), self.namespace().unwrap_or_default())
    }
}

/// State of a Leaderboard as the operator last observed it.
#[derive(Serialize, Deserialize, KubeSchema, Clone, Debug, Default, PartialEq)]
#[serde(rename_all = "camelCase")]
pub struct LeaderboardStatus {
    /// Generation of the spec that this status speaks of.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub observed_generation: Option<i64>,
    /// The installation of the operator that drives it, by its Lease: `<namespace>/<name>`. Every other one leaves it alone.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(max = 512))]
    pub operator: Option<String>,
    /// Submissions by state.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub counts: Option<Counts>,
    /// Use of EvalAI; absent for a local leaderboard.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub evalai: Option<EvalaiUse>,
    /// Use of the table; absent while no row waits for it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub table: Option<TableUse>,
    /// Teams whose submissions have used the most GPU seconds; the most come first.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[x_kube(merge_strategy = ListMerge::Map(vec!["team".into()]))]
    #[schemars(length(max = MAX_USING_TEAMS))]
    pub gpu_use: Vec<TeamUse>,
    /// Tracks as they effectively run.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[x_kube(merge_strategy = ListMerge::Map(vec!["name".into()]))]
    #[schemars(length(max = 32))]
    pub tracks: Vec<TrackStatus>,
    /// `Ready`, `Isolated`, `Terminating`.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[schemars(schema_with = "super::conditions::schema")]
    pub conditions: Vec<Condition>,
}

/// Requests to EvalAI with this Leaderboard's token.
#[derive(Serialize, Deserialize, schemars::JsonSchema, Clone, Debug, Default, PartialEq, Eq)]
#[serde(rename_all = "camelCase")]
pub struct EvalaiUse {
    /// Sent in the last minute.
    pub requests_last_minute: i32,
    /// Limit of requests per minute, as `spec.evalai.requestsPerMinute` sets it.
    pub requests_per_minute: i32,
    /// Results that EvalAI does not have yet; absent if it has all.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub backlog: Option<EvalaiBacklog>,
}

/// Ends of submissions that wait for a request to EvalAI, of all Leaderboards with the same token.
#[derive(Serialize, Deserialize, schemars::JsonSchema, Clone, Debug, PartialEq, Eq)]
#[serde(rename_all = "camelCase")]
pub struct EvalaiBacklog {
    /// Number of results that wait.
    pub waiting: i32,
    /// When the last of them is expected to be in EvalAI, to the minute.
    pub last_expected_time: Time,
}

/// Rows that the table does not have yet, of all Leaderboards that write to it.
#[derive(Serialize, Deserialize, schemars::JsonSchema, Clone, Debug, PartialEq, Eq)]
#[serde(rename_all = "camelCase")]
pub struct TableUse {
    /// Number of rows that wait for more than 10 s. The table gets one in 2 s.
    pub waiting: i32,
}

/// Track as it effectively runs.
#[derive(Serialize, Deserialize, schemars::JsonSchema, Clone, Debug, Default, PartialEq, Eq)]
pub struct TrackStatus {
    /// Name of the track.
    #[schemars(length(max = 32))]
    pub name: String,
    /// The numbers of CARLA's evaluation.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub carla: Option<CarlaShape>,
    /// The numbers of an evaluation by a container of the host's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub container: Option<ContainerShape>,
    /// Metric by which its results rank, and in which direction: as the leaderboard of its phase in EvalAI has them, else those of the
    /// evaluation.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ranking: Option<Ranking>,
    /// Best result of each team, the leader first, at most 20. Rows stay when their Submissions are deleted.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[schemars(length(max = MAX_STANDINGS))]
    pub standings: Vec<Standing>,
}

/// Submissions of a Leaderboard by state; `resumed` counts as running.
#[derive(Serialize, Deserialize, schemars::JsonSchema, Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Number of submissions that wait.
    pub pending: i32,
    /// Number of submissions that run, also after a resume.
    pub running: i32,
    /// Number of submissions that ended with results that count.
    pub finished: i32,
    /// Number of submissions that ended without results that count.
    pub failed: i32,
    /// Number of submissions that a person, EvalAI or a deletion ended.
    pub cancelled: i32,
}

mod defaults {
    pub(super) fn sync_period_seconds() -> i64 {
        10
    }
    pub(super) fn ttl_seconds_after_finished() -> i32 {
        super::JOB_SECONDS
    }
}
