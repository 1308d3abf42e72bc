//! Types that the controller hands in, and that it gets back.
//!
//! Pure. A [`Key`] names the object that is woken, a [`Run`] the attempt that an update is about.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use futures::future::BoxFuture;
use jiff::Timestamp;

use super::row::Row;
use crate::token::Token;
use leaderboard_api::evalai_status::{Outcome, Progress, Status};
use leaderboard_api::{Attempt, S3Bucket};
pub use leaderboard_base::object_key::ObjectKey as Key;
use leaderboard_base::spans::LogSpan;
use leaderboard_contract::report::ContentId;
use leaderboard_contract::report::Patience;

/// The challenge of a Leaderboard and how it is asked.
#[derive(Clone, Debug, PartialEq)]
pub struct Target {
    /// The Leaderboard itself.
    pub leaderboard: Key,
    /// Root of the server.
    pub api_server: String,
    /// Id of the challenge.
    pub challenge: i64,
    /// Codename of the dataset split.
    pub split: String,
    /// A host's token.
    pub token: Arc<Token>,
    /// Requests per minute; the smallest of all Leaderboards of the namespace whose tokens name this one's user holds.
    pub requests_per_minute: u32,
    /// Time between two sweeps.
    pub sweep: Duration,
    /// Time between two lists of cancelled submissions.
    pub period: Duration,
    /// Phases of the Leaderboard's tracks.
    pub phases: Arc<[i64]>,
    /// What of its results is published.
    pub metrics: Metrics,
    /// Name of the challenge's queue, if it is to be read here.
    pub inbox: Option<String>,
    /// Nothing is written there.
    pub is_observed: bool,
    /// Its submissions are files, which EvalAI's own worker could evaluate, too.
    pub takes_files: bool,
    /// When the Leaderboard was created: the sweep leaves alone what asked to be run before.
    pub since: Timestamp,
}

/// The metrics that a Leaderboard publishes.
#[derive(Clone, Debug, PartialEq)]
pub enum Metrics {
    /// These, for the split of the target.
    Fixed(Arc<[String]>),
    /// Of each split that EvalAI lists for a phase, those that it lists there. By phase, the split that has the score; none: its only one.
    Listed(Arc<BTreeMap<i64, Option<String>>>),
}

/// Answers, right before each write, whether this process still leads: true while the lease was renewed less than 10 s ago, by a clock that
/// counts pauses of the machine.
pub type WriteGuard = Arc<dyn Fn() -> bool + Send + Sync>;

/// An attempt of a submission, and whom to ask about it.
#[derive(Clone, Debug)]
pub struct Subject {
    pub target: Arc<Target>,
    /// The object that is woken.
    pub key: Key,
    /// Id of the submission in EvalAI.
    pub pk: i64,
    pub run: Run,
}

/// A submission whose Leaderboard publishes to EvalAI. Only it can be updated there, so that one which only observes is never
/// written to.
#[derive(Clone, Debug)]
pub struct Publisher(Subject);

impl Publisher {
    /// None for a submission of a Leaderboard that only observes.
    pub fn of(subject: Subject) -> Option<Self> {
        (!subject.target.is_observed).then_some(Self(subject))
    }

    pub(super) fn subject(&self) -> &Subject {
        &self.0
    }
}

/// One attempt of a submission.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Run {
    pub attempt: Attempt,
    /// Name of the attempt's first Job, sent to EvalAI with `queued`: found there again, it shows that EvalAI knows of the
    /// attempt.
    pub job: String,
    /// A person has begun it here: EvalAI has not asked for it by a message, nor by its row.
    pub by_hand: bool,
    /// The Job was created.
    pub has_job: bool,
    /// When it ended: the oldest end is published first, also by a process that has just begun to lead.
    pub ended: Option<Timestamp>,
    /// For the log.
    pub log: LogSpan,
}

/// Status that EvalAI is to show.
#[derive(Clone, Debug)]
pub enum DesiredUpdate {
    /// The run waits for its Pod.
    Queued,
    /// An agent runs.
    Running,
    /// Results so far.
    Partial(Arc<Outline>),
    /// The end.
    Final(Outcome, Arc<Outline>),
}

/// Content of a result or an end, but for what the bucket holds: that is read right before.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Outline {
    /// Phase whose leaderboard gets the results.
    pub phase: i64,
    /// Shown to the participant.
    pub stderr: String,
    /// Shown to the hosts; only with an end.
    pub environment_log: String,
    /// Where results and other texts are; none where nothing is stored.
    pub stored: Option<StoredResult>,
}

/// The results and texts that one report names.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct StoredResult {
    pub storage: S3Bucket,
    /// Key prefix of the run, with the final slash.
    pub prefix: String,
    /// The report that was decided on.
    pub report: ContentId,
    /// Units of work that it counts.
    pub done: u32,
    /// The metrics over the work so far are wanted, where it has them.
    pub so_far: bool,
    pub patience: Patience,
}

/// Texts of an evaluation.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Payload {
    /// Phase whose leaderboard gets the results.
    pub phase: i64,
    /// JSON text of the list of results; not sent with `failed` and `cancelled`.
    pub result: String,
    /// Shown to the participant.
    pub stdout: String,
    /// Shown to the participant.
    pub stderr: String,
    /// JSON text, shown to the hosts.
    pub metadata: String,
    /// Shown to the hosts; only with an end.
    pub environment_log: String,
}

impl Payload {
    /// Without results and texts of its own.
    pub fn bare(outline: &Outline) -> Self {
        Self {
            phase: outline.phase,
            result: "[]".to_owned(),
            stderr: outline.stderr.clone(),
            environment_log: outline.environment_log.clone(),
            ..Self::default()
        }
    }
}

/// Why a payload cannot be read, in one sentence.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum PayloadProblem {
    /// The bucket does not give it out.
    Unread(String),
    /// The bucket holds another content than the report names, or another report: the Pod ended between the two, or goes on.
    Unfit(String),
}

/// Reads what an outline lacks.
pub type PayloadReader = Arc<dyn Fn(Arc<Outline>) -> BoxFuture<'static, Result<Payload, PayloadProblem>> + Send + Sync>;

/// State of a submission in EvalAI, as far as it is known. Memory only.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SubmissionState {
    /// Its row, as last read.
    pub row: Option<Arc<Row>>,
    /// When the row was read.
    pub read_at: Option<Timestamp>,
    /// The newest attempt whose `ask` the row answers.
    pub answered: Option<Attempt>,
    /// Image that the uploaded file names; none before it was asked for and answered.
    pub image: Option<ImageAnswer>,
    /// The attempt that all below is about.
    pub attempt: Attempt,
    /// How far EvalAI knows this attempt to be.
    pub progress: Option<Progress>,
    /// EvalAI has ended this attempt, and not because of us.
    pub ended: Option<Status>,
    /// EvalAI may yet show another status: a write of ours was under way when it was ended there and may have undone that, or it was
    /// deleted, which ends nothing there.
    pub overtaken: bool,
    /// Outcome of the update to an end.
    pub end: Option<Ended>,
    /// Units of work in the partial results that were last answered.
    pub partial_done: Option<u32>,
    /// Why what the bucket holds of an end cannot be read.
    pub unread: Option<String>,
    /// The last error; none after the next success.
    pub last_error: Option<String>,
}

/// Image that the uploaded file names, or why it names none.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ImageAnswer {
    /// It names this one.
    Named(String),
    /// It was read and names none that could be pulled, and why: no later read changes that.
    NotAnImage(String),
    /// It could not be read yet, and why. It is retried.
    Unread(String),
}

/// Outcome of an update to an end.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Ended {
    /// EvalAI has taken it.
    Published { outcome: Outcome, at: Timestamp },
    /// EvalAI showed it already, when that was first read; nothing was written.
    Agreed { status: Status, at: Timestamp },
    /// EvalAI has ended the run itself: the outcome becomes Cancelled, nothing was written.
    Otherwise(Status),
    /// EvalAI refuses it, or would file it wrongly. It is retried from time to time, and at once with other results; a cancel
    /// that such a try finds makes it `Otherwise`.
    Refused(String),
}

/// How a token's requests are used, and what waits for one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Usage {
    /// Requests of the last minute.
    pub used: u32,
    /// Requests that may be made in a minute.
    pub limit: u32,
    /// Ends that EvalAI does not have yet, but for those that it refuses.
    pub waiting: usize,
    /// When the last of them is expected there; none if none waits.
    pub last_expected: Option<Timestamp>,
}

/// A change, by the object that it wakes.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Changed {
    /// The view of a Submission.
    Submission(Key),
    /// Labels or token of a Leaderboard.
    Leaderboard(Key),
}

/// Kind of run that a swept row asks for. Its participant can edit all of it but when it was submitted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Swept {
    /// `submitted`, and nothing of it was ever run.
    New,
    /// `submitted`, as a host's re-run of another submission makes it.
    Rerun,
    /// `submitted`, although it was run before, or is older than the Leaderboard.
    Edited,
    /// `resuming`.
    Resuming,
}

/// A submission that asks to be run and that no object here is for: its message may be lost.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SweepRow {
    /// Root of the server that has the row, as in [`Target::api_server`]: ids are unique within a server only.
    pub server: String,
    pub challenge: i64,
    pub phase: i64,
    pub submission: i64,
    pub kind: Swept,
    /// The challenge's submissions are static code uploads, as far as its settings were read.
    pub is_static_code_upload: bool,
    /// When it asked to be run: its re-run or resume, else its submission.
    pub time: Timestamp,
}

/// Why a challenge's queue in EvalAI is not read.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct InboxTrouble {
    /// EvalAI refuses it; else it has only failed for a while.
    pub is_refused: bool,
    /// EvalAI's answer.
    pub why: String,
}

/// How busy a budget is, or several together.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Load {
    /// Requests of the last minute.
    pub used: usize,
    /// Requests that are allowed within a minute.
    pub limit: usize,
    /// Updates and questions that wait for a request.
    pub waiting: usize,
}
