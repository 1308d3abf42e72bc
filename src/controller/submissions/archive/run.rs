//! What one bucket's worker remembers of one run.

use std::sync::Arc;

use tokio::time::Instant;

use super::request::{Answer, KINDS, Sent, Target};
use crate::controller::submissions::failure_log::{LogDemand, Tail};
use crate::controller::submissions::report_digest::ReportDigest;
use crate::controller::submissions::view::{ObservedLog, ObservedReport, ReportDemand, Stage};
use leaderboard_api::{Attempt, JobNumber};

pub(super) struct Run {
    pub target: Arc<Target>,
    pub due: [Option<Instant>; KINDS.len()],
    pub report: Option<ReportRun>,
    /// Boxed, as most runs have none of these most of the time.
    pub fence: Option<Box<FenceRun>>,
    pub log: Option<Box<LogRun>>,
}

pub(super) struct ReportRun {
    pub memory: u64,
    pub wanted: ReportDemand,
    pub since: Instant,
    pub is_under_way: bool,
    /// What was known when the last answer was asked for.
    pub of: Option<ReportDemand>,
    pub error: Option<String>,
    pub etag: Option<String>,
    pub content: Option<Content>,
}

#[derive(Clone, PartialEq)]
pub(super) enum Content {
    Absent,
    Foreign,
    Report(Arc<ReportDigest>),
}

pub(super) struct FenceRun {
    pub job: JobNumber,
    pub mark: String,
    pub since: Instant,
    pub is_held: bool,
    pub has_failed: bool,
}

pub(super) struct LogRun {
    pub demand: LogDemand,
    pub since: Instant,
    pub tries: u32,
    pub is_under_way: bool,
    pub tail: Option<Tail>,
    pub end: Option<ObservedLog>,
}

/// Whether an answer that was asked for by one demand is one to the other.
pub(super) fn answers(sent: &ReportDemand, wanted: &ReportDemand) -> bool {
    let is_of_pod = sent.pod == wanted.pod || sent.stage == Stage::JobEnded;
    sent.job == wanted.job && is_of_pod && sent.stage >= wanted.stage
}

impl ReportRun {
    pub fn sent(&self) -> Sent {
        Sent {
            demand: self.wanted.clone(),
            memory: self.memory,
        }
    }

    /// The report as that of an attempt. `is_former`: what is read is of the time before the object was restored from a backup, and may be
    /// of a later attempt than the object knows of. Its own Pods store reports of its attempt alone.
    pub fn shown(&self, wanted: Attempt, is_former: bool) -> ObservedReport {
        let is_of = |attempt: Attempt| attempt == wanted || (is_former && attempt > wanted);
        match (&self.error, &self.content) {
            (Some(why), _) => ObservedReport::Unreadable(why.clone()),
            (None, None) => ObservedReport::NotRead,
            (None, Some(Content::Absent)) => ObservedReport::Absent,
            (None, Some(Content::Report(report))) if is_of(report.attempt) => ObservedReport::Ours(Arc::clone(report)),
            (None, Some(Content::Foreign | Content::Report(_))) => ObservedReport::Foreign,
        }
    }

    /// Returns whether there is something new to decide on.
    pub fn take(&mut self, sent: &ReportDemand, answer: Answer) -> bool {
        let sent = &ReportDemand {
            stage: sent.stage.min(self.wanted.stage),
            ..sent.clone()
        };
        let (error, etag, content) = match answer {
            Answer::NotModified => (None, self.etag.take(), self.content.clone()),
            Answer::Absent => (None, None, Some(Content::Absent)),
            Answer::Foreign { etag } => (None, etag, Some(Content::Foreign)),
            Answer::Found { etag, report } => (None, etag, Some(Content::Report(report))),
            Answer::Failed(why) => (Some(why), self.etag.take(), self.content.clone()),
        };
        let is_first = !self.of.as_ref().is_some_and(|of| answers(of, sent));
        let is_new = is_first || error.is_some() != self.error.is_some() || content != self.content;
        self.of = Some(sent.clone());
        (self.error, self.etag, self.content) = (error, etag, content);
        is_new
    }
}
