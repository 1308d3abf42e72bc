//! A Pod's report to the controller: `logcopy/report.json`, written in each round after the results; and the mark of the
//! prefix's owner.
//!
//! The report is written by `logcopy` and read by the controller as hostile text: bounded in size, checked in every number. Pure.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use leaderboard_api::text::one_line;
use leaderboard_api::{Attempt, MAX_METRICS, MAX_NAME, Metric, WorkerState};

/// Key of the report below the run's prefix.
pub const REPORT_KEY: &str = "logcopy/report.json";
/// Key of the [`Owner`], which names the Pod whose writes count.
pub const OWNER_KEY: &str = "logcopy/owner";
/// Largest report that is read or written, in bytes.
pub const MAX_BYTES: usize = 1 << 20;
/// Characters of a reason or a warning.
pub const LONGEST_TEXT: usize = 2000;
/// Version of the report.
pub const SCHEMA: u32 = 1;
/// Version of the owner's mark.
pub const OWNER_SCHEMA: u32 = 1;

/// Whose writes below the prefix count.
#[derive(Serialize, Deserialize, Clone, Debug, PartialEq, Eq)]
#[serde(rename_all = "camelCase")]
pub struct Owner {
    /// [`OWNER_SCHEMA`].
    pub schema: u32,
    /// UID of the Pod; the controller's own mark while it holds the prefix.
    pub owner: String,
}

impl Owner {
    /// The mark of a Pod, or of the controller.
    pub fn new(owner: impl Into<String>) -> Self {
        Self {
            schema: OWNER_SCHEMA,
            owner: owner.into(),
        }
    }

    /// The JSON that is stored.
    pub fn to_json(&self) -> Vec<u8> {
        serde_json::to_vec(self).unwrap_or_default()
    }

    /// Reads a stored mark; `None` for one of an unknown version, which no Pod of this version wrote.
    pub fn parse(bytes: &[u8]) -> Option<Self> {
        let owner: Self = serde_json::from_slice(bytes).ok()?;
        (owner.schema == OWNER_SCHEMA).then_some(owner)
    }
}

/// One round of logcopy.
#[derive(Serialize, Deserialize, Clone, Debug, PartialEq)]
#[serde(rename_all = "camelCase")]
pub struct Report {
    /// [`SCHEMA`].
    pub schema: u32,
    /// UID of the Submission.
    pub submission_uid: String,
    /// Attempt it belongs to.
    pub attempt: Attempt,
    /// UID of the Pod that wrote it.
    pub pod_uid: String,
    /// Counts the rounds of this Pod.
    pub round: u64,
    /// Units done, over all workers.
    pub done: u32,
    /// Units in all.
    pub total: u32,
    /// Name of the units, in the plural.
    pub unit: String,
    /// Each worker, from 1.
    pub workers: Vec<ReportWorker>,
    /// The worker among them whose command merges the results of all others, if there is one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub merger: Option<u32>,
    /// The number that ranks the run: over what is done, or of the whole run when final.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub score: Option<Metric>,
    /// Further numbers, over the same units.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub metrics: Vec<Metric>,
    /// True when the merge is complete against the plan and nothing more will come.
    #[serde(rename = "final")]
    pub is_final: bool,
    /// True if the results count.
    pub eligible: bool,
    /// How the run ended, as its results show it.
    pub outcome: Outcome,
    /// Which stop was obeyed, if any.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stopped: Option<super::run::Stop>,
    /// Results that are refused, for the participant.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub refused: Option<RefusedResults>,
    /// Results that the host's own evaluator wrote and that cannot be used, for hosts.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub unusable: Option<RefusedResults>,
    /// Findings of `verify`, one sentence each.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub warnings: Vec<String>,
    /// State of the run's lines in CloudWatch. Absent without a log group, and until it is known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub logs: Option<Logs>,
    /// Text of `evalai/results.json`.
    pub results: String,
    /// Text of `evalai/results.json` with the metrics so far, in place of zeros. Absent before the first unit and after the last.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub partial_results: Option<String>,
    /// Most of what is on the volume of the logs, and enough to fill one, is in the agents' folders.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub agents_fill_disk: bool,
    /// Files of `evalai/` as stored in this round, by key below the prefix.
    #[serde(default)]
    pub files: BTreeMap<String, StoredFile>,
}

/// End of a run by its results, whatever its kind of evaluation calls it.
#[derive(Serialize, Deserialize, Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Outcome {
    /// Units are missing.
    #[default]
    Running,
    /// All units were done and count.
    Finished,
    /// The workers' host crashed, so the results do not count.
    Crashed,
    /// The agent used what it may not use, so the results do not count.
    Rejected,
    /// The results contradict themselves, so they do not count.
    Invalid,
}

impl fmt::Display for Outcome {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(out, "{self:?}")
    }
}

/// Results that cannot be used.
#[derive(Serialize, Deserialize, Clone, Debug, PartialEq, Eq)]
#[serde(rename_all = "camelCase")]
pub struct RefusedResults {
    /// Worker that wrote them, from 1; absent where they are of several.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub worker: Option<u32>,
    /// Cause and next step, in sentences.
    pub why: String,
}

impl RefusedResults {
    /// Results of one worker, or of several.
    pub fn new(worker: Option<u32>, why: impl Into<String>) -> Self {
        let why = why.into();
        Self { worker, why }
    }
}

impl fmt::Display for RefusedResults {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str(&self.why)
    }
}

/// One worker as its status files and checkpoint show it.
#[derive(Serialize, Deserialize, Clone, Debug, PartialEq, Eq)]
pub struct ReportWorker {
    /// From 1.
    pub id: u32,
    /// Units done.
    pub done: u32,
    /// Units in all.
    pub total: u32,
    /// Crashes of the agent's or the environment's side, whichever is more.
    pub crashes: u32,
    /// State of the worker.
    pub state: WorkerState,
    /// Its checkpoint has a record that names a crash of the simulation.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub names_crash: bool,
}

/// State of the lines for CloudWatch.
#[derive(Serialize, Deserialize, Clone, Debug, PartialEq, Eq)]
pub enum Logs {
    /// It has taken some, and refuses none.
    Sent,
    /// Why it refuses them.
    Refused(String),
}

/// Size and digest of a stored file.
#[derive(Serialize, Deserialize, Clone, Debug, PartialEq, Eq)]
pub struct StoredFile {
    /// Bytes.
    pub size: u64,
    /// Hexadecimal SHA-256.
    pub sha256: String,
}

/// Why a report is not used.
#[derive(thiserror::Error, Debug, PartialEq, Eq)]
pub enum ReportError {
    /// Larger than [`MAX_BYTES`].
    #[error("the report has {0} bytes, more than the {MAX_BYTES} that are read")]
    TooLarge(usize),
    /// Not a report.
    #[error("the report is not one of ours: {0}")]
    Malformed(String),
    /// A schema number that this version does not read.
    #[error("the report has schema {0}, and this operator reads {SCHEMA}")]
    Schema(u32),
    /// A number that no run can have.
    #[error("the report is implausible: {0}")]
    Implausible(String),
}

impl Report {
    /// Reads a report as hostile text.
    pub fn parse(bytes: &[u8]) -> Result<Self, ReportError> {
        if bytes.len() > MAX_BYTES {
            return Err(ReportError::TooLarge(bytes.len()));
        }
        let report: Self = serde_json::from_slice(bytes).map_err(|e| ReportError::Malformed(e.to_string()))?;
        report.check()?;
        Ok(report.shown())
    }

    /// Results are a stranger's or the host's own, and reasons and warnings repeat parts of them.
    fn shown(self) -> Self {
        let line = |text: &String| one_line(text, LONGEST_TEXT);
        let fault = |fault: &RefusedResults| RefusedResults {
            why: line(&fault.why),
            ..*fault
        };
        Self {
            unit: one_line(&self.unit, MAX_NAME),
            refused: self.refused.as_ref().map(fault),
            unusable: self.unusable.as_ref().map(fault),
            logs: self.logs.as_ref().map(|logs| match logs {
                Logs::Sent => Logs::Sent,
                Logs::Refused(why) => Logs::Refused(line(why)),
            }),
            warnings: self.warnings.iter().map(line).collect(),
            ..self
        }
    }

    fn check(&self) -> Result<(), ReportError> {
        let implausible = |what: &str| Err(ReportError::Implausible(what.into()));
        if self.schema != SCHEMA {
            return Err(ReportError::Schema(self.schema));
        }
        if self.done > self.total {
            return implausible("more units done than there are");
        }
        let is_cut = self.stopped.is_some() || self.refused.is_some() || self.unusable.is_some();
        if self.is_final && !is_cut && self.done != self.total {
            return implausible("final, but units are missing");
        }
        if !self.score.iter().chain(&self.metrics).all(Metric::is_plausible) {
            return implausible("a score or a metric that is no number with a name");
        }
        let names: BTreeSet<&str> = self.metrics.iter().map(|metric| metric.name.as_str()).collect();
        if self.metrics.len() > MAX_METRICS || names.len() != self.metrics.len() {
            return implausible("too many metrics, or two of one name");
        }
        if self.workers.len() > 64 || self.workers.iter().any(|worker| worker.done > worker.total) {
            return implausible("a worker that did more than its share");
        }
        Ok(())
    }

    /// True if the report is from this attempt of the Submission with this UID.
    pub fn belongs_to(&self, uid: &str, attempt: Attempt) -> bool {
        self.submission_uid == uid && self.attempt == attempt
    }
}

/// Tells one stored object from another by its bytes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ContentId([u8; 16]);

impl ContentId {
    pub fn of(bytes: &[u8]) -> Self {
        Self(Sha256::digest(bytes).first_chunk().copied().unwrap_or_default())
    }
}

/// Until when what cannot be read is waited for. After that it is left out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Patience {
    /// Texts that are of another round than the report: they hardly change.
    pub unfit: Timestamp,
    /// Texts that the bucket does not give out.
    pub unread: Timestamp,
    /// The report itself.
    pub report: Timestamp,
}

impl Patience {
    /// Nothing is left out.
    pub const ENDLESS: Self = Self {
        unfit: Timestamp::MAX,
        unread: Timestamp::MAX,
        report: Timestamp::MAX,
    };
}
