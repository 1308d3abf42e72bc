//! What the operator last saw of a Submission. Written by the controller's leader alone; read by people and the bridge.
//!
//! `state` is for people: it is computed from the conditions and never read back.

use k8s_openapi::apimachinery::pkg::apis::meta::v1::{Condition, Time};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::leaderboard_parts::{LeaderboardVersion, Storage};
use super::submission::Team;

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

/// What the operator last saw of a Submission.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, Default, PartialEq)]
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
    pub attempt: Option<i64>,
    /// Jobs of this attempt that infrastructure failures ended.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub retry: i32,
    /// Times the Job of this attempt had to be created again after somebody deleted it.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub recreated: i32,
    /// When the next Job of this attempt is made, after an infrastructure failure.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub next_retry_time: Option<Time>,
    /// Why it stands there, one of `api::reasons`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reason: Option<String>,
    /// The same as a sentence.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub message: Option<String>,
    /// Who submitted.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub team: Option<Team>,
    /// Name of the track.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub track: Option<String>,
    /// What is run, pinned at acceptance.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub plan: Option<RunPlan>,
    /// Routes that are done.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub progress: Option<Progress>,
    /// Each simulator-agent pair.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub pairs: Vec<PairStatus>,
    /// Driving score: `~41.20` over the routes so far, `43.13` when final.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub score: Option<String>,
    /// Place in line.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub waiting: Option<Waiting>,
    /// When what happened.
    #[serde(default, skip_serializing_if = "Times::is_empty")]
    pub times: Times,
    /// Name of the present Job.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub job_name: Option<String>,
    /// Node of the present Pod.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub node_name: Option<String>,
    /// The submission that this one re-runs: EvalAI made a new row for it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rerun_of: Option<Rerun>,
    /// The submission that re-runs this one: EvalAI has cancelled this one's result. State, score and the table's row stay.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rerun_as: Option<Rerun>,
    /// Where the results are, `s3://bucket/prefix/id`.
    #[serde(rename = "resultsURL", default, skip_serializing_if = "Option::is_none")]
    pub results_url: Option<String>,
    /// What went wrong.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub failure: Option<Failure>,
    /// `Accepted`, `Running`, `Archived`, `Recorded`, `Published`, `Stalled`, `Finished`.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[schemars(schema_with = "super::conditions::schema")]
    pub conditions: Vec<Condition>,
}

/// What a run consists of, pinned when the submission is first accepted, so that an edited Leaderboard leaves it alone.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, PartialEq)]
#[serde(rename_all = "camelCase")]
pub struct RunPlan {
    /// Run id: S3 prefix, sort key, log streams.
    pub run_id: String,
    /// Which Leaderboard it is of: chooses the format of the checkpoints, flags and defaults.
    pub leaderboard_version: LeaderboardVersion,
    /// Name of the track.
    pub track: String,
    /// CHALLENGE_TRACK_CODENAME.
    pub codename: String,
    /// EvalAI phase.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub phase: Option<i64>,
    /// ROUTES_SUBSET of each pair, as `first-last`; their number is the number of pairs.
    pub slices: Vec<String>,
    /// Routes, not counting repetitions.
    pub routes: i32,
    /// Repetitions of each route.
    pub repetitions: i32,
    /// Where the results go.
    pub storage: Storage,
    /// The participant's image.
    pub image: String,
    /// Image of the contents, renewed by each attempt.
    pub contents_image: String,
    /// Image of the simulator, renewed by each attempt.
    pub simulator_image: String,
    /// True if the stored results of an earlier run are taken up.
    #[serde(default)]
    pub resume: bool,
}

/// The other submission of a re-run.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, PartialEq, Eq)]
#[serde(rename_all = "camelCase")]
pub struct Rerun {
    /// Its name, in the same namespace.
    pub submission_name: String,
    /// When EvalAI made the new row.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub time: Option<Time>,
}

/// Routes that are done, over all pairs and repetitions.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, PartialEq, Eq)]
pub struct Progress {
    pub done: i32,
    pub total: i32,
    /// `12/20`.
    pub text: String,
}

impl Progress {
    /// Progress with its text.
    pub fn new(done: i32, total: i32) -> Self {
        Self {
            done,
            total,
            text: format!("{done}/{total}"),
        }
    }
}

/// One simulator-agent pair.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, PartialEq)]
pub struct PairStatus {
    /// From 1.
    pub id: i32,
    /// Routes done.
    pub done: i32,
    /// Routes of its slice, times repetitions.
    pub total: i32,
    /// Crashes so far.
    pub crashes: i32,
    /// `Waiting`, `Running`, `Done`, `Crashed`.
    pub state: String,
    /// How its last container ended.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub last: Option<LastEnd>,
}

/// How a container ended.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, PartialEq)]
#[serde(rename_all = "camelCase")]
pub struct LastEnd {
    /// For example `exited`, `idle`, `OOMKilled`.
    pub reason: String,
    /// Exit code of the process.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub exit_code: Option<i32>,
    /// When.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub time: Option<Time>,
}

/// Place in line.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, PartialEq, Eq)]
pub struct Waiting {
    /// From 1.
    pub position: i32,
    /// Until it starts, a band such as `20-35 min`; absent until runs of this track have ended.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub eta: Option<String>,
}

/// When what happened; from the timestamps of messages, Pods and Jobs.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, Default, PartialEq)]
pub struct Times {
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub submitted: Option<Time>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub accepted: Option<Time>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub scheduled: Option<Time>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub started: Option<Time>,
    /// When it was told to stop.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stopping: Option<Time>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub finished: Option<Time>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub published: Option<Time>,
}

impl Times {
    fn is_empty(&self) -> bool {
        *self == Self::default()
    }
}

/// Whose failure it is.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum FailureClass {
    Participant,
    Infrastructure,
}

/// What went wrong.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, PartialEq, Eq)]
#[serde(rename_all = "camelCase")]
pub struct Failure {
    pub class: FailureClass,
    /// One of `api::reasons`.
    pub reason: String,
    /// A sentence with the next step, for the challenge's hosts.
    pub message: String,
    /// What the participant reads of it in EvalAI; absent where that is `message`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub participant_message: Option<String>,
    /// Whether it should cost the participant an attempt.
    pub charged: bool,
    /// The pair that it happened in, from 1; absent if it concerns the whole run.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pair: Option<i32>,
}

#[allow(clippy::trivially_copy_pass_by_ref, reason = "the signature is serde's")]
fn is_zero(value: &i32) -> bool {
    *value == 0
}
