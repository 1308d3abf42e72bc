//! What a bucket's worker is asked for, does, and brings.

use std::sync::Arc;
use std::time::Duration;

use tokio::time::Instant;
use tracing::Span;

use crate::controller::submissions::failure_log::{LogAnswer, LogDemand, Tail};
use crate::controller::submissions::report_digest::ReportDigest;
use crate::controller::submissions::view::ReportDemand;
use leaderboard_api::{Attempt, JobNumber};
use leaderboard_base::spans as about;

pub(super) type Uid = Arc<str>;

/// The kinds of work, the most urgent first.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    Fence,
    Ended,
    Log,
    Live,
}

pub(super) const KINDS: [Kind; 4] = [Kind::Fence, Kind::Ended, Kind::Log, Kind::Live];
/// How much of each kind is under way at once.
pub(super) const LIMITS: [usize; 4] = [16, 32, 8, 32];

/// Where a run's files are, and which object they belong to.
#[derive(Clone, Debug, PartialEq)]
pub struct Target {
    pub namespace: Box<str>,
    pub name: Box<str>,
    pub leaderboard: Box<str>,
    /// Key prefix of the run in the bucket, with the final slash.
    pub prefix: Box<str>,
    /// UID that its reports name.
    pub submission_uid: Uid,
    pub attempt: Attempt,
    /// When its run ended: of several that have, the oldest end is read first. None: it goes on.
    pub ended: Option<Instant>,
}

impl Target {
    /// Since when a read that is to be made at once has been due.
    pub(super) fn due(&self, now: Instant) -> Instant {
        self.ended.map_or(now, |ended| ended.min(now))
    }
}

/// Something to do now.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Work {
    pub kind: Kind,
    pub uid: Uid,
    pub target: Arc<Target>,
    pub what: What,
}

#[derive(Clone, Debug, PartialEq)]
pub(super) enum What {
    Report {
        sent: Sent,
        etag: Option<String>,
    },
    Fence {
        job: JobNumber,
        mark: String,
        left: Duration,
    },
    Log {
        demand: LogDemand,
        tail: Option<Tail>,
    },
}

impl Work {
    /// What its log lines are written in.
    pub(super) fn span(&self) -> Span {
        let Target {
            namespace,
            name,
            leaderboard,
            attempt,
            ..
        } = &*self.target;
        about::submission(format_args!("{namespace}/{name}"), leaderboard, attempt.0, &self.uid)
    }
}

/// What was known when a read was sent.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Sent {
    pub demand: ReportDemand,
    /// Of which memory of the run: what was dropped since is not answered.
    pub memory: u64,
}

/// What a read of the report brought.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Answer {
    NotModified,
    Absent,
    /// It is another object's.
    Foreign {
        etag: Option<String>,
    },
    Found {
        etag: Option<String>,
        report: Arc<ReportDigest>,
    },
    Failed(String),
}

/// What came of work.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Done {
    Report(Answer),
    Fence(Result<(), String>),
    Log(LogAnswer),
}
