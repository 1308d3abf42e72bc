//! The rows of the server's database, as far as anybody reads or writes them here. Data only: no behavior but parsing.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

/// A submission's status.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Status {
    /// New; also the new row of a re-run.
    Submitted,
    /// Under way.
    Running,
    /// Ended without a result.
    Failed,
    /// Ended by somebody.
    Cancelled,
    /// A failed one, to be continued.
    Resuming,
    /// A worker has taken it.
    Queued,
    /// Ended with a result.
    Finished,
    /// A status of old rows only.
    Submitting,
    /// Put away by a host.
    Archived,
    /// Under way, with a first result.
    PartiallyEvaluated,
}

impl Status {
    /// All of the model's choices.
    pub const ALL: [Self; 10] = [
        Self::Submitted,
        Self::Running,
        Self::Failed,
        Self::Cancelled,
        Self::Resuming,
        Self::Queued,
        Self::Finished,
        Self::Submitting,
        Self::Archived,
        Self::PartiallyEvaluated,
    ];

    /// Its name on the server.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Submitted => "submitted",
            Self::Running => "running",
            Self::Failed => "failed",
            Self::Cancelled => "cancelled",
            Self::Resuming => "resuming",
            Self::Queued => "queued",
            Self::Finished => "finished",
            Self::Submitting => "submitting",
            Self::Archived => "archived",
            Self::PartiallyEvaluated => "partially_evaluated",
        }
    }

    /// Reads its name on the server, exactly.
    pub fn parse(text: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|status| status.as_str() == text)
    }

    /// Counts against `max_concurrent_submissions_allowed`.
    pub fn in_progress(self) -> bool {
        matches!(
            self,
            Self::Submitted | Self::Submitting | Self::Resuming | Self::Queued | Self::Running
        )
    }
}

/// Result when somebody fetches a submission's input file: a worker, or EvalAI for a re-run or a resume.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum FileState {
    /// The file.
    #[default]
    Stored,
    /// 404: the message goes out without an image.
    Missing,
    /// 410, otherwise as `Missing`.
    Gone,
    /// The connection is closed: no message goes out, and the request ends in a 500.
    Unreachable,
    /// No answer for as long as the client waits, otherwise as `Unreachable`.
    Silent,
    /// The first half of it, and then the connection is closed.
    Cut,
    /// So many zeros in its place.
    Zeros(u64),
}

/// How a token is used.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum TokenKind {
    /// `Bearer`, taken.
    Refresh,
    /// `Bearer`, refused: of the wrong type.
    Access,
    /// `Token`, taken.
    Key,
}

/// One token of a user.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Token {
    /// The text after the scheme.
    pub value: String,
    /// How it is used.
    pub kind: TokenKind,
    /// Past its life.
    #[serde(default)]
    pub expired: bool,
}

/// A user.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct User {
    /// Primary key.
    pub id: u64,
    /// The name to log in with.
    pub username: String,
    /// Member of EvalAI's own staff.
    #[serde(default)]
    pub staff: bool,
    /// Has a confirmed e-mail address.
    #[serde(default = "yes")]
    pub verified: bool,
    /// Not switched off.
    #[serde(default = "yes")]
    pub active: bool,
    /// The tokens that sign the user's requests.
    #[serde(default)]
    pub tokens: Vec<Token>,
}

/// A participant team. It takes part in every challenge.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Team {
    /// Primary key.
    pub id: u64,
    /// Its name.
    pub name: String,
    /// Users.
    pub members: Vec<u64>,
}

/// A challenge.
#[allow(clippy::struct_excessive_bools, reason = "the columns of the server's table")]
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Challenge {
    /// Primary key.
    pub id: u64,
    /// Its name.
    pub title: String,
    /// The SQS queue of its messages; FIFO if it ends in `.fifo`.
    pub queue: String,
    /// Users of its host team.
    pub hosts: Vec<u64>,
    /// Evaluated by the host.
    #[serde(default = "yes")]
    pub remote_evaluation: bool,
    /// Participants push images.
    #[serde(default = "yes")]
    pub is_docker_based: bool,
    /// These images leave files, which are evaluated once they have ended.
    #[serde(default)]
    pub is_static_dataset_code_upload: bool,
    /// Between its dates.
    #[serde(default = "yes")]
    pub is_active: bool,
    /// Hosts may resume a failed submission.
    #[serde(default = "yes")]
    pub allow_resuming_submissions: bool,
    /// Read by the web pages only.
    #[serde(default = "yes")]
    pub allow_host_cancel_submissions: bool,
    /// Read by the web pages only.
    #[serde(default = "yes")]
    pub allow_cancel_running_submissions: bool,
    /// Participants may re-run and resume.
    #[serde(default)]
    pub allow_participants_resubmissions: bool,
    /// Its phases.
    pub phases: Vec<Phase>,
}

/// A phase of a challenge.
#[allow(clippy::struct_excessive_bools, reason = "the columns of the server's table")]
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Phase {
    /// Primary key.
    pub id: u64,
    /// Its name for people.
    pub name: String,
    /// Its name for programs.
    pub codename: String,
    /// Between its dates.
    #[serde(default = "yes")]
    pub is_active: bool,
    /// Open to participants.
    #[serde(default = "yes")]
    pub is_public: bool,
    /// A team's submissions under way at once.
    #[serde(default = "three")]
    pub max_concurrent_submissions_allowed: usize,
    /// Partial results are shown, and may carry unknown metrics.
    #[serde(default)]
    pub is_partial_submission_evaluation_enabled: bool,
    /// Its splits.
    pub splits: Vec<Split>,
}

/// A phase split: one leaderboard of one phase.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Split {
    /// Primary key.
    pub id: u64,
    /// The dataset split behind it.
    pub dataset_split: DatasetSplit,
    /// Everybody may read it.
    #[serde(default = "yes")]
    pub public: bool,
    /// The highest value leads, where the schema says nothing of the metric.
    #[serde(default = "yes")]
    pub is_leaderboard_order_descending: bool,
    /// Primary key of its leaderboard.
    pub leaderboard: u64,
    /// The leaderboard's columns.
    pub schema: Schema,
}

/// A dataset split.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct DatasetSplit {
    /// Primary key.
    pub id: u64,
    /// Its name for people.
    pub name: String,
    /// Its name in results.
    pub codename: String,
}

/// A leaderboard's columns.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Schema {
    /// The metrics, in the order they are shown.
    pub labels: Vec<String>,
    /// The metric that ranks.
    pub default_order_by: String,
    /// Settings of each metric, such as `{"A": {"sort_ascending": true}}`.
    #[serde(default, skip_serializing_if = "Value::is_null")]
    pub metadata: Value,
}

/// A submission: the whole row, as the server reads it and saves it.
#[allow(clippy::struct_excessive_bools, reason = "the columns of the server's table")]
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Submission {
    /// Primary key.
    pub id: u64,
    /// Its team.
    pub participant_team: u64,
    /// Its phase.
    pub challenge_phase: u64,
    /// The user who pushed it.
    pub created_by: u64,
    /// Its status.
    pub status: Status,
    /// The uploaded file.
    pub input_file: Option<String>,
    /// The second file of two-stage challenges.
    pub submission_input_file: Option<String>,
    /// Output of the evaluation.
    pub stdout_file: Option<String>,
    /// Errors of the evaluation.
    pub stderr_file: Option<String>,
    /// The log that only hosts may read.
    pub environment_log_file: Option<String>,
    /// The shown results.
    pub submission_result_file: Option<String>,
    /// The metadata of the result; in no answer of the API.
    pub submission_metadata_file: Option<String>,
    /// Set by every progress PATCH.
    pub started_at: Option<Timestamp>,
    /// Set by every PUT.
    pub completed_at: Option<Timestamp>,
    /// Kept by a re-run.
    pub submitted_at: Timestamp,
    /// Set by re-run (on the new row) and resume.
    pub rerun_resumed_at: Option<Timestamp>,
    /// When it was made public.
    pub when_made_public: Option<Timestamp>,
    /// A text of the participant.
    pub method_name: String,
    /// A text of the participant.
    pub method_description: String,
    /// A text of the participant.
    pub project_url: String,
    /// A text of the participant.
    pub publication_url: String,
    /// On the public leaderboard.
    pub is_public: bool,
    /// Taken off the leaderboard by a host.
    pub is_flagged: bool,
    /// Deleted.
    pub ignore_submission: bool,
    /// A host's baseline.
    pub is_baseline: bool,
    /// Marked by a host.
    pub is_verified_by_host: bool,
    /// Every `job_name` ever sent.
    pub job_name: Vec<String>,
    /// The participant's answers to the phase's questions.
    pub submission_metadata: Value,
    /// Counts within team and phase.
    pub submission_number: u64,
    /// Result of fetching `input_file`.
    pub file_state: FileState,
}

/// One row of a leaderboard.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LeaderboardRow {
    /// Primary key.
    pub id: u64,
    /// The submission it belongs to.
    pub submission: u64,
    /// The phase split it stands on.
    pub split: u64,
    /// The metrics.
    pub result: Map<String, Value>,
}

fn yes() -> bool {
    true
}

fn three() -> usize {
    3
}
