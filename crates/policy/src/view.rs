//! The world of one submission, as one reconcile has read it. `observe` fills it, `decide` reads it; it holds no client and no clock.

use std::sync::Arc;
use std::time::Duration;

use jiff::Timestamp;

use super::report_digest::ReportDigest;
use crate::ask::Lookup;
use crate::questions::{Input, Row};
pub use crate::slots::turns::Turn;
use leaderboard_api::evalai_status::Status;
use leaderboard_api::{Attempt, JobNumber, Leaderboard, SharedText, Submission, names};
use leaderboard_contract::run::Stop;
use leaderboard_contract::verdict::WorkspaceReason;
use leaderboard_protocol::files::{Member, Side};
use leaderboard_protocol::verdict::Verdict;

/// Everything a decision may depend on. By default nothing has been seen yet.
#[derive(Clone, Debug, Default)]
pub struct View {
    pub now: Timestamp,
    pub submission: Arc<Submission>,
    pub leaderboard: Option<Arc<Leaderboard>>,
    /// The first name that the Leaderboard may not use, in words.
    pub not_allowed: Option<String>,
    /// True if the NetworkPolicy of the Leaderboard's present spec is in place; only meaningful while the submission has no Job.
    pub is_policy_in_place: bool,
    /// The row that another program may have written of it.
    pub row: Lookup<Row>,
    /// The copy of its submitted file.
    pub input: Lookup<Input>,
    /// Its permission to start; only meaningful while it has no Job and all else is settled.
    pub turn: Turn,
    pub job: ObservedJob,
    pub pod: Option<PodView>,
    pub node: NodeView,
    pub report: ReportView,
    pub requested: Requested,
    /// None for a submission that is not EvalAI's.
    pub evalai: Option<EvalaiView>,
    /// How long ago this process wrote the status; None: it has not.
    pub written_ago: Option<Duration>,
    /// None if the Leaderboard has no table.
    pub record: Option<RecordView>,
}

impl View {
    /// When the run of the present Job ended, by the Job or by its Pod.
    pub fn ended_at(&self) -> Option<Timestamp> {
        match self.job.ours()?.end.as_ref() {
            Some(end) => end.at(),
            None => self.pod.as_ref()?.run_ended,
        }
    }
}

/// The Job that the present attempt should have.
#[derive(Clone, Debug, PartialEq)]
pub enum ObservedJob {
    /// It is not there; with the words of the API server, if it refuses that Job.
    Absent {
        refused: Option<String>,
    },
    /// We created it a moment ago, and the cache does not show it yet.
    Created,
    /// It has the right name but another owner: an older object's, going away.
    Foreign,
    Ours(JobView),
}

impl Default for ObservedJob {
    fn default() -> Self {
        Self::Absent { refused: None }
    }
}

impl ObservedJob {
    /// The Job, if it is ours.
    pub fn ours(&self) -> Option<&JobView> {
        match self {
            Self::Ours(job) => Some(job),
            Self::Absent { .. } | Self::Created | Self::Foreign => None,
        }
    }
}

/// A Job, reduced to what matters.
#[derive(Clone, Debug, PartialEq)]
pub struct JobView {
    pub name: String,
    pub uid: String,
    pub created: Option<Timestamp>,
    /// When the Job controller began with it; a resume begins anew. None while it is suspended.
    pub started: Option<Timestamp>,
    /// None while its Pods may run.
    pub suspension: Option<Box<Suspension>>,
    pub end: Option<JobEnd>,
    pub deleting: bool,
    /// The words of its last FailedCreate event, while it has no Pod.
    pub failed_create: Option<String>,
}

impl JobView {
    /// When its Pod could first be made: of a Job that was suspended, when it was resumed last.
    pub fn begun(&self) -> Option<Timestamp> {
        self.created.max(self.started)
    }
}

/// A Job that is to have no Pod: its `spec.suspend` is true.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Suspension {
    /// When the Job controller carried it out; None before.
    pub since: Option<Timestamp>,
    /// The queue of Kueue that its label names.
    pub queue: Option<SharedText>,
}

/// How a Job ended; both wait for the end of its Pods.
#[derive(Clone, Debug, PartialEq)]
pub enum JobEnd {
    Complete {
        at: Option<Timestamp>,
    },
    Failed {
        at: Option<Timestamp>,
        reason: String,
        message: String,
    },
}

impl JobEnd {
    /// When it ended.
    pub fn at(&self) -> Option<Timestamp> {
        match self {
            Self::Complete { at } | Self::Failed { at, .. } => *at,
        }
    }
}

/// The newest Pod of the Job.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PodView {
    pub name: String,
    pub uid: String,
    pub node: Option<String>,
    pub created: Option<Timestamp>,
    pub scheduled: Option<Timestamp>,
    /// The scheduler's words, while no node fits.
    pub unschedulable: Option<String>,
    /// An autoscaler's report about that.
    pub scale_up: Option<ScaleUp>,
    /// When it has to be gone, once it is being deleted (its grace included).
    pub delete_by: Option<Timestamp>,
    /// When its deletion was asked for.
    pub deleted: Option<Timestamp>,
    /// When its first agent started; where it has none, its first evaluator.
    pub agent_started: Option<Timestamp>,
    pub logcopy_running: bool,
    /// When the last container of its workers ended, once all of them have ended well.
    pub run_ended: Option<Timestamp>,
    pub containers: Vec<ContainerView>,
    /// Why the kubelet ended it as a whole: reason and message, for example `Evicted`.
    pub ended_by_node: Option<(String, String)>,
    /// Cause of its removal: the reason of its condition `DisruptionTarget`.
    pub disruption: Option<String>,
    pub stop: Option<Stop>,
}

impl PodView {
    /// True if it has not ended, so that its node matters.
    pub fn needs_node(&self) -> bool {
        self.delete_by.is_some() || self.run_ended.is_none()
    }

    /// Its container of this name.
    pub fn container(&self, name: &str) -> Option<&ContainerView> {
        self.containers.iter().find(|container| container.name == name)
    }
}

/// The Pod's node, while the Pod runs or is being deleted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ObservedNode {
    /// There was no reason to look, or no right to.
    #[default]
    Unknown,
    /// Its kubelet speaks to the API server.
    Reports,
    /// Its kubelet has not been heard of since.
    Silent { since: Timestamp },
    /// There is no such node any more.
    Gone,
}

/// A node, as far as it matters to a run on it.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct NodeView {
    pub state: ObservedNode,
    /// The taint that announces its end.
    pub leaving: Option<String>,
}

/// The report of an autoscaler about a Pod that no node accepts.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ScaleUp {
    /// A node was asked for.
    Coming(String),
    /// None will be.
    Refused(String),
}

/// One container of the Pod.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ContainerView {
    pub name: SharedText,
    /// Its node's name of the image that it runs or ran: `NAME@sha256:…`, if a registry gave it to the node.
    pub image_id: Option<SharedText>,
    pub restarts: i32,
    pub running: bool,
    /// Its next life is counted among the restarts and does not run yet.
    pub begins_anew: bool,
    /// When its present life began, while it runs.
    pub began: Option<Timestamp>,
    /// Reason and message, while it waits.
    pub waiting: Option<(String, String)>,
    pub last: Option<EndView>,
}

impl ContainerView {
    /// True if it is one of the Pod's own containers, which run before the agents.
    pub fn is_before_agents(&self) -> bool {
        names::INIT_CONTAINERS.contains(&self.name.as_str())
    }

    /// True if it is one of the Pod's own containers, for which those after it wait.
    pub fn prepares(&self) -> bool {
        self.is_before_agents() || self.name == names::CONTAINER_COLLECT
    }

    /// True if it is an agent's.
    pub fn is_agents(&self) -> bool {
        Member::parse(&self.name).is_some_and(|member| member.side == Side::Agent)
    }

    /// True if its last life ended with exit code 0.
    pub fn has_ended_well(&self) -> bool {
        self.last.as_ref().is_some_and(|end| end.exit_code == 0)
    }

    /// True if the restarts count a life after the last end.
    pub fn has_next_life(&self) -> bool {
        self.running || self.begins_anew
    }
}

/// How a container last ended.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct EndView {
    /// Kubernetes' reason: `Completed`, `Error`, `OOMKilled`, `StartError`, …
    pub reason: String,
    pub exit_code: i32,
    /// When this life of it began.
    pub began: Option<Timestamp>,
    pub at: Option<Timestamp>,
    /// The runner's verdict. An agent can forge its own.
    pub verdict: Option<Verdict>,
    /// The reason that `workspace` or `collect` reported, with its sentence in `why`.
    pub own_reason: Option<WorkspaceReason>,
    /// The sentence of a container of the host's, or Kubernetes' own.
    pub why: Option<String>,
}

impl EndView {
    /// True if the kubelet could not start it at all.
    pub fn is_start_error(&self) -> bool {
        matches!(self.reason.as_str(), "StartError" | "ContainerCannotRun")
    }
}

/// Progress of a run when its report was asked for. The answer lacks everything that is stored later.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Stage {
    /// Its agents may still run.
    Live,
    /// The containers of its workers had ended.
    RunEnded,
    /// The Job had ended, or was gone.
    JobEnded,
}

/// Which report a decision needs.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ReportDemand {
    pub job: JobNumber,
    /// UID of the Pod.
    pub pod: Option<SharedText>,
    pub stage: Stage,
    /// How often the report of a live run is read.
    pub period: Duration,
}

/// A place where a log may be.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LogPlace {
    /// Whose log it is.
    pub container: String,
    pub at: LogAt,
}

/// Where a log is kept.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum LogAt {
    /// On the Pod's node; `previous`: of the container's last run, since it runs again.
    Node { pod: String, previous: bool },
    /// In S3, at this key below the run's prefix.
    Bucket { key: String },
}

/// The report in S3, as far as it was read.
#[derive(Clone, Debug, Default, PartialEq)]
pub enum ObservedReport {
    /// It was not read, or not asked for.
    #[default]
    NotRead,
    Absent,
    /// Another object's or attempt's.
    Foreign,
    /// S3 did not answer, or not with a report.
    Unreadable(String),
    Ours(Arc<ReportDigest>),
}

/// The answer to the last question for the report, and for how long a newer one has waited.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ReportView {
    pub stored: ObservedReport,
    /// The state of the run when that was asked for; None: nothing was read for this Job.
    pub stage: Option<Stage>,
    /// How long the present question has waited.
    pub waited: Duration,
}

impl ReportView {
    /// The report, if it is ours.
    pub fn ours(&self) -> Option<&Arc<ReportDigest>> {
        match &self.stored {
            ObservedReport::Ours(report) => Some(report),
            _ => None,
        }
    }
}

/// Requests to store something as a run ends.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Requested {
    pub fence: ObservedFence,
    pub log: ObservedLog,
}

/// State of our own mark in `logcopy/owner`. While it is there, a lost Pod stores nothing more.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ObservedFence {
    #[default]
    NotRequested,
    /// Requested this long ago.
    Pending(Duration),
    /// The last write failed; it is tried again. Requested this long ago.
    Failed(Duration),
    Held,
}

/// State of the log that explains a failure.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ObservedLog {
    #[default]
    NotRequested,
    /// Requested this long ago.
    Pending(Duration),
    Kept,
    /// There is none.
    None,
    /// It could not be read or stored.
    GivenUp,
}

/// The operator's knowledge of the submission in EvalAI.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct EvalaiView {
    /// EvalAI's last report of it; None until it was asked.
    pub info: Option<EvalaiInfo>,
    /// How long it has been asked whether the present attempt is to run.
    pub waited: Duration,
    /// Until when nothing is written there, because the controller before may still have requests under way.
    pub writes_from: Option<Timestamp>,
    /// When its row was read.
    pub read_at: Option<Timestamp>,
    /// It was cancelled there, after this attempt was announced.
    pub cancelled: bool,
    /// When the list was asked for that shows it as cancelled, of one that has its end and is not followed any more.
    pub cancelled_as_of: Option<Timestamp>,
    /// A write of ours may have undone that cancel in EvalAI.
    pub overtaken: bool,
    /// Outcome of the final result of this attempt. None until EvalAI has answered.
    pub end: Option<EvalaiEnd>,
    /// Why what the bucket holds of that result cannot be read.
    pub unread: Option<String>,
    /// Units of work in the last partial result of this attempt that EvalAI has answered.
    pub partial_done: Option<u32>,
    /// True if the leaderboards of its phase show partial results; false as long as that is not known.
    pub shows_partial: bool,
    /// Team of its row, as last read.
    pub team_id: Option<String>,
    /// Why the last request failed.
    pub error: Option<String>,
}

/// A submission in EvalAI.
#[derive(Clone, Debug, PartialEq)]
pub struct EvalaiInfo {
    pub standing: Standing,
    pub status: Status,
    /// Phase of its row; none where EvalAI does not show one.
    pub phase: Option<i64>,
    pub team_id: String,
    pub team_name: Option<String>,
    pub submitted_at: Option<Timestamp>,
    /// When it was last re-run or resumed there.
    pub resumed_at: Option<Timestamp>,
    /// The highest attempt whose Job its row names.
    pub last_attempt: Option<Attempt>,
    pub image: Option<String>,
    /// Why the uploaded file names no image, which no later read changes; none while it has not been read.
    pub image_problem: Option<String>,
}

/// The meaning of EvalAI's status for a run of this attempt.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Standing {
    /// It wants to run.
    Wanted,
    /// It was resumed there: its stored results are taken up.
    Resumed,
    /// It has come to its end there without us.
    Ended,
}

/// The outcome of a final result.
#[derive(Clone, Debug, PartialEq)]
pub enum EvalaiEnd {
    /// EvalAI has it.
    Published { at: Timestamp },
    /// EvalAI had ended it before: cancelled, archived, ignored, or it is gone.
    Ended(Status),
    /// EvalAI does not take it, and why.
    Refused { message: String },
}

/// The operator's knowledge of the row in DynamoDB.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RecordView {
    /// The end of this attempt is written.
    pub end_written: bool,
    /// The attempt of the row that the table keeps in place of this end.
    pub superseded_by: Option<i64>,
    /// Why the last write failed.
    pub error: Option<String>,
}
