//! The last observed status of a Submission. The controller's leader alone writes it; people and the bridge read it.
//!
//! `state` is for people: it is computed from the conditions and never read back.

use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;
use kube::KubeSchema;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::attempt::Attempt;
use super::carla::CarlaPlan;
use super::conditions::Condition;
use super::container::ContainerPlan;
use super::failed_node::{FailedNode, MAX_FAILED_NODES};
use super::leaderboard_services::Storage;
use super::progress::{MAX_METRICS, Metric, Progress, Score};
use super::reasons::ReasonName;
use super::run_id::RunId;
use super::shared_text::SharedText;
use super::submission_use::{Interruptions, Use};
use super::submitted_file::SubmittedFile;
use super::team::TeamStatus;
use super::waiting::Waiting;
use super::worker_status::WorkerStatus;

/// Characters of a message in a status.
pub const MAX_MESSAGE: usize = 4096;

/// Where a submission stands, for people.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum State {
    Pending,
    Running,
    /// Running, with what an earlier attempt had stored.
    Resumed,
    Finished,
    Failed,
    Cancelled,
}

impl State {
    /// True for states that only a higher attempt leaves.
    pub fn is_terminal(self) -> bool {
        matches!(self, Self::Finished | Self::Failed | Self::Cancelled)
    }

    /// The text of the STATE column.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Pending => "Pending",
            Self::Running => "Running",
            Self::Resumed => "Resumed",
            Self::Finished => "Finished",
            Self::Failed => "Failed",
            Self::Cancelled => "Cancelled",
        }
    }
}

/// State of a Submission as the operator last observed it.
#[derive(Serialize, Deserialize, KubeSchema, Clone, Debug, Default, PartialEq)]
#[serde(rename_all = "camelCase")]
pub struct SubmissionStatus {
    /// For people, computed from the conditions.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub state: Option<State>,
    /// Generation of the spec that this status speaks of.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub observed_generation: Option<i64>,
    /// Attempt that this status speaks of.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub attempt: Option<Attempt>,
    /// Jobs of this attempt that infrastructure failures ended, `interruptions` among them.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub retry: i32,
    /// Jobs whose node was taken away, which use up no retry.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub interruptions: Option<Box<Interruptions>>,
    /// Times the Job of this attempt had to be created again after somebody deleted it.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub recreated: i32,
    /// Seconds that earlier Pods of the present Job have run, each from its first agent. They count against `deadlines.runSeconds`; the
    /// wait of a Pod for its node, and its preparation, do not.
    #[serde(default, skip_serializing_if = "is_none")]
    pub ran_seconds: i64,
    /// When the next Job of this attempt is made, after an infrastructure failure.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub next_retry_time: Option<Time>,
    /// Reason names in one word why the submission is in its state. It is absent where it would repeat the state, as with Running or Finished;
    /// conditions have it then, too.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reason: Option<ReasonName>,
    /// Sentence for people that explains the reason.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(max = MAX_MESSAGE))]
    pub message: Option<SharedText>,
    /// Reason that holds the submission up at present, and since when.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub blocked_since: Option<Box<BlockedSince>>,
    /// Team that submitted.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub team: Option<TeamStatus>,
    /// Name of the track.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(max = 32))]
    pub track: Option<String>,
    /// Plan of the run, pinned at acceptance.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub plan: Option<RunPlan>,
    /// The participant's image as the first agent ran it. Every later Job runs the same, wherever its tag moves.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub image: Option<PinnedImage>,
    /// The submitted file in the bucket, below the run's prefix at `input/file`. Every Job reads the same.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub input: Option<SubmittedFile>,
    /// Progress shows how much of the run is done.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub progress: Option<Progress>,
    /// Workers lists the parts that share out the run and go on at once, such as a simulator with its agent.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[x_kube(merge_strategy = ListMerge::Map(vec!["id".into()]))]
    #[schemars(length(max = 64))]
    pub workers: Vec<WorkerStatus>,
    /// Score is the number that ranks the run.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub score: Option<Score>,
    /// Metrics lists further numbers of the run, over what is done so far.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[x_kube(merge_strategy = ListMerge::Map(vec!["name".into()]))]
    #[schemars(length(max = MAX_METRICS))]
    pub metrics: Vec<Metric>,
    /// Place of the submission in the line for a slot.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub waiting: Option<Box<Waiting>>,
    /// Times at which the submission reached each stage.
    #[serde(default, skip_serializing_if = "Times::is_empty")]
    pub times: Times,
    /// Duration of the run for people, such as `1h25m`; only once it has ended. `times` has it exactly.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(max = 32))]
    pub duration: Option<String>,
    /// Name of the present Job.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(max = 253))]
    pub job_name: Option<String>,
    /// Node of the present Pod.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(max = 253))]
    pub node_name: Option<String>,
    /// Nodes on which Jobs of this attempt failed because of the infrastructure. The next Job prefers other nodes; a node that gave two Jobs
    /// no GPU, or could not start their Pods, gets no further Job of the attempt.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[x_kube(merge_strategy = ListMerge::Map(vec!["nodeName".into()]))]
    #[schemars(length(max = MAX_FAILED_NODES))]
    pub failed_nodes: Vec<FailedNode>,
    /// Where the results are, `s3://bucket/prefix/id`.
    #[serde(rename = "resultsURL", default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(max = 2048))]
    pub results_url: Option<String>,
    /// Failure of the submission, with its cause and next step.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub failure: Option<Box<Failure>>,
    /// DoneBefore counts the units that were stored when the present Job was due. It is absent until an infrastructure failure that an
    /// agent can cause has ended a Job of this attempt. After another such failure a further Job follows only if more are stored.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub done_before: Option<i32>,
    /// Resources that its Jobs have used. A resume keeps them.
    #[serde(rename = "use", default, skip_serializing_if = "Option::is_none")]
    pub usage: Option<Use>,
    /// Conditions lists one condition of each type: `Accepted`, `Running`, `Archived`, `Recorded`, `Published`, `Stalled`, `Finished`,
    /// `Succeeded`, and where there is something to show `Plausible` and `Logged`.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[schemars(schema_with = "super::conditions::schema")]
    pub conditions: Vec<Condition>,
}

impl SubmissionStatus {
    /// Cuts texts to what the definition allows: parts of them are a stranger's, and the API server refuses a status whose
    /// text is too long.
    pub fn fit(&mut self) {
        let failure = self.failure.iter_mut();
        let of_failure = failure.flat_map(|failure| {
            let others = [failure.next_step.as_mut(), failure.participant_message.as_mut()];
            others.into_iter().flatten().chain([&mut failure.message])
        });
        of_failure.for_each(|text| {
            if let Some(end) = end(text) {
                text.truncate(end);
            }
        });
        let of_conditions = self.conditions.iter_mut().map(|condition| &mut condition.message);
        for text in self.message.iter_mut().chain(of_conditions) {
            if let Some(end) = end(text) {
                *text = text[..end].into();
            }
        }
    }

    /// All texts that other submissions are likely to have as well.
    pub fn shared_texts(&mut self) -> impl Iterator<Item = &mut SharedText> {
        let of_plan = self.plan.iter_mut().flat_map(|plan| {
            let of_kind: Vec<_> = match &mut plan.evaluation {
                PlannedEvaluation::Carla(carla) => vec![
                    &mut carla.codename,
                    &mut carla.contents_image,
                    &mut carla.simulator_image,
                ],
                PlannedEvaluation::Container(container) => vec![&mut container.image],
            };
            of_kind.into_iter().chain([&mut plan.track])
        });
        let of_conditions = self.conditions.iter_mut().flat_map(Condition::shared_texts);
        self.message.iter_mut().chain(of_plan).chain(of_conditions)
    }
}

/// Where a text ends that is too long.
fn end(text: &str) -> Option<usize> {
    text.char_indices().nth(MAX_MESSAGE).map(|(end, _)| end)
}

/// What a run consists of, pinned when the submission is first accepted, so that an edited Leaderboard leaves it alone.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, PartialEq)]
#[serde(rename_all = "camelCase")]
pub struct RunPlan {
    /// Run id: S3 prefix, sort key, log streams.
    #[schemars(length(max = 128))]
    pub run_id: RunId,
    /// Name of the track.
    #[schemars(length(max = 32))]
    pub track: SharedText,
    /// Number of the EvalAI phase.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub phase: Option<i64>,
    /// Bucket and prefix that receive the results.
    pub storage: Storage,
    /// The participant's image; absent for a submission that is a file.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(max = 1024))]
    pub image: Option<String>,
    /// The plan of the kind of evaluation.
    #[serde(flatten)]
    pub evaluation: PlannedEvaluation,
    /// True if the stored results of an earlier run are taken up.
    #[serde(default)]
    pub resume: bool,
    /// Attempts of an earlier Submission of this run, which is gone: the table's row counts on from them.
    #[serde(default, skip_serializing_if = "is_none")]
    pub earlier_attempts: i64,
    /// UID of the object whose Pods store the results. After a restore from a backup the object has another one.
    #[schemars(length(max = 128))]
    #[serde(default, rename = "submissionUID", skip_serializing_if = "Option::is_none")]
    pub submission_uid: Option<String>,
}

/// The plan of a kind of evaluation: exactly one of its members.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, PartialEq)]
#[serde(rename_all = "camelCase")]
pub enum PlannedEvaluation {
    /// The plan of CARLA's evaluation.
    Carla(CarlaPlan),
    /// The plan of an evaluation by a container of the host's.
    Container(ContainerPlan),
}

/// The participant's image as the first agent ran it.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, PartialEq, Eq)]
#[serde(rename_all = "camelCase")]
pub struct PinnedImage {
    /// Digest in its repository.
    #[schemars(length(max = 71), regex(pattern = r"^sha256:[0-9a-f]{64}$"))]
    pub digest: String,
}

/// What holds a submission up, and since when.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, PartialEq, Eq)]
pub struct BlockedSince {
    /// Reason names the cause in one word.
    pub reason: ReasonName,
    /// Since when it has been the same reason.
    pub time: Time,
}

/// When what happened; from the timestamps of messages, Pods and Jobs.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, Default, PartialEq)]
#[serde(rename_all = "camelCase")]
pub struct Times {
    /// When the participant submitted it to EvalAI; of a local submission, when its object was made.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub submitted: Option<Time>,
    /// When the operator accepted this attempt.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub accepted: Option<Time>,
    /// When the present Pod got its node.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub scheduled: Option<Time>,
    /// When the first agent of this attempt started.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub started: Option<Time>,
    /// When the first agent of the present Pod started. `deadlines.runSeconds` counts from here on.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub agent_started: Option<Time>,
    /// When it was asked to stop.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stopping: Option<Time>,
    /// When it ended, in whichever way.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub finished: Option<Time>,
    /// When EvalAI had the end.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub published: Option<Time>,
}

impl Times {
    fn is_empty(&self) -> bool {
        *self == Self::default()
    }
}

/// Side that caused the failure.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum FailureClass {
    Participant,
    Infrastructure,
}

impl FailureClass {
    /// As in the status.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Participant => "Participant",
            Self::Infrastructure => "Infrastructure",
        }
    }
}

/// Failure of the submission, with its cause and next step.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, PartialEq, Eq)]
#[serde(rename_all = "camelCase")]
pub struct Failure {
    pub class: FailureClass,
    /// Reason names the cause in one word.
    pub reason: ReasonName,
    /// A sentence with the next step, for the challenge's hosts.
    #[schemars(length(max = MAX_MESSAGE))]
    pub message: String,
    /// Next step for the host, without the cause.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(max = MAX_MESSAGE))]
    pub next_step: Option<String>,
    /// Text that the participant reads of it in EvalAI; absent where that is `message`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(max = MAX_MESSAGE))]
    pub participant_message: Option<String>,
    /// Number (`id`) of the worker in which it happened; absent if the failure concerns the whole run.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub worker: Option<i32>,
}

#[allow(clippy::trivially_copy_pass_by_ref, reason = "the signature is serde's")]
fn is_none(number: &i64) -> bool {
    *number == 0
}

#[allow(clippy::trivially_copy_pass_by_ref, reason = "the signature is serde's")]
fn is_zero(value: &i32) -> bool {
    *value == 0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn texts_of_strangers_are_cut_to_what_the_definition_allows() {
        let long = "é".repeat(MAX_MESSAGE + 1);
        let mut status = SubmissionStatus {
            message: Some(long.as_str().into()),
            ..SubmissionStatus::default()
        };
        status.fit();
        assert_eq!(status.message.unwrap().chars().count(), MAX_MESSAGE);
    }
}
