//! Every request of this module, and the form of its answer. `queue` chooses them, `client` sends them.

use std::sync::Arc;

use jiff::Timestamp;

use super::answer::Answer;
use super::row::{Challenge, DatasetSplit, FileUrl, Phase, PhaseSplit, Received, Row, Split};
use super::types::{ImageAnswer, Key, Payload};
use leaderboard_api::Attempt;
use leaderboard_api::evalai_status::{Outcome, Progress};
use leaderboard_base::spans::LogSpan;

/// Whom a request is about.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SubmissionRef {
    pub key: Key,
    pub challenge: i64,
    /// Id of the submission.
    pub pk: i64,
    pub attempt: Attempt,
    /// For the log.
    pub log: LogSpan,
}

/// Purpose of a list.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Purpose {
    /// `cancelled`: whose runs are to stop.
    Cancel,
    /// `submitted`: whose message was lost, and which wait here to hear whether they may run.
    SweepSubmitted,
    /// `resuming`: whose message was lost.
    SweepResuming,
}

impl Purpose {
    /// The status that is listed.
    pub fn status(self) -> &'static str {
        match self {
            Self::Cancel => "cancelled",
            Self::SweepSubmitted => "submitted",
            Self::SweepResuming => "resuming",
        }
    }
}

/// One request.
#[derive(Clone, Debug)]
pub enum Request {
    Get(SubmissionRef),
    /// The uploaded file: not of the API, and not counted by it.
    Image(SubmissionRef, FileUrl),
    Progress(SubmissionRef, Progress, Option<String>),
    Partial(SubmissionRef, Arc<Payload>),
    Final(SubmissionRef, Outcome, Arc<Payload>),
    List {
        challenge: i64,
        purpose: Purpose,
        after: Timestamp,
    },
    Phases(i64),
    Splits(i64),
    DatasetSplit(i64, i64),
    /// The settings of a leaderboard of a challenge.
    PhaseSplit(i64, i64),
    /// The settings of a challenge.
    Challenge(i64),
    /// One message of a challenge's queue, by the queue's name.
    Receive(String),
    /// The row of a message's submission.
    MessageRow(i64),
    /// Deletes a message, by what was received with it.
    DeleteMessage(String, String),
}

impl Request {
    /// True if it changes anything.
    pub fn is_write(&self) -> bool {
        matches!(self, Self::Progress(..) | Self::Partial(..) | Self::Final(..))
    }

    /// True if the server counts it.
    pub fn counts(&self) -> bool {
        !matches!(self, Self::Image(..))
    }

    /// Whom it is about, if a submission.
    pub fn submission(&self) -> Option<&SubmissionRef> {
        match self {
            Self::Get(subject)
            | Self::Image(subject, _)
            | Self::Progress(subject, ..)
            | Self::Partial(subject, _)
            | Self::Final(subject, ..) => Some(subject),
            Self::List { .. }
            | Self::Phases(_)
            | Self::Splits(_)
            | Self::DatasetSplit(..)
            | Self::PhaseSplit(..)
            | Self::Challenge(_)
            | Self::Receive(_)
            | Self::MessageRow(_)
            | Self::DeleteMessage(..) => None,
        }
    }

    /// For metrics and logs: the method and what it is about, without a submission's id.
    pub fn op(&self) -> &'static str {
        match self {
            Self::Get(_) => "get_submission",
            Self::Image(..) => "get_image",
            Self::Progress(_, Progress::Queued, _) => "patch_queued",
            Self::Progress(_, Progress::Running, _) => "patch_running",
            Self::Partial(..) => "put_partial",
            Self::Final(_, Outcome::Finished, _) => "put_finished",
            Self::Final(_, Outcome::Failed, _) => "put_failed",
            Self::Final(_, Outcome::Cancelled, _) => "put_cancelled",
            Self::List { purpose, .. } => match purpose {
                Purpose::Cancel => "list_cancelled",
                Purpose::SweepSubmitted => "sweep_submitted",
                Purpose::SweepResuming => "sweep_resuming",
            },
            Self::Phases(_) => "get_phases",
            Self::Splits(_) => "get_splits",
            Self::DatasetSplit(..) => "get_dataset_split",
            Self::PhaseSplit(..) => "get_phase_split",
            Self::Challenge(_) => "get_challenge",
            Self::Receive(_) => "receive_message",
            Self::MessageRow(_) => "get_message_row",
            Self::DeleteMessage(..) => "delete_message",
        }
    }
}

/// An answer, in the form its request asks for.
#[derive(Clone, Debug)]
pub enum Reply {
    Row(Answer<Row>),
    Rows(Answer<Vec<Row>>),
    Written(Answer<()>),
    /// Done only if the file was read.
    Image(Answer<ImageAnswer>),
    Phases(Answer<Vec<Phase>>),
    Splits(Answer<Vec<Split>>),
    DatasetSplit(Answer<DatasetSplit>),
    PhaseSplit(Answer<PhaseSplit>),
    Challenge(Answer<Challenge>),
    Message(Answer<Received>),
}

impl Reply {
    /// The end without its content.
    pub fn answer(&self) -> Answer<()> {
        fn bare<T>(answer: &Answer<T>) -> Answer<()> {
            match answer {
                Answer::Done(_) => Answer::Done(()),
                Answer::Refused(refusal) => Answer::Refused(refusal.clone()),
                Answer::Broken(message) => Answer::Broken(message.clone()),
                Answer::Throttled(wait) => Answer::Throttled(*wait),
                Answer::Unanswered(silence) => Answer::Unanswered(silence.clone()),
            }
        }
        match self {
            Self::Row(answer) => bare(answer),
            Self::Rows(answer) => bare(answer),
            Self::Written(answer) => bare(answer),
            Self::Image(answer) => bare(answer),
            Self::Phases(answer) => bare(answer),
            Self::Splits(answer) => bare(answer),
            Self::DatasetSplit(answer) => bare(answer),
            Self::PhaseSplit(answer) => bare(answer),
            Self::Challenge(answer) => bare(answer),
            Self::Message(answer) => bare(answer),
        }
    }
}
