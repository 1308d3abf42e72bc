//! The status of a submission in EvalAI, and the updates that we request.
//!
//! Pure. Used by the crate `evalai` and by the controller.

use std::fmt;

/// Where a submission stands in EvalAI.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Status {
    Submitted,
    Submitting,
    Resuming,
    Queued,
    Running,
    PartiallyEvaluated,
    Finished,
    Failed,
    Cancelled,
    Archived,
    /// Deleted by its participant before its end. EvalAI keeps the row and its status, sets `ignore_submission`, and goes on
    /// counting it as being processed: three of them, and the team may submit nothing more.
    Deleted,
    /// Deleted by its participant after its end.
    Ignored,
    /// EvalAI has no such submission.
    Missing,
    /// A status that this program does not know.
    Unknown,
}

impl Status {
    /// All of them.
    pub const ALL: [Self; 14] = [
        Self::Submitted,
        Self::Submitting,
        Self::Resuming,
        Self::Queued,
        Self::Running,
        Self::PartiallyEvaluated,
        Self::Finished,
        Self::Failed,
        Self::Cancelled,
        Self::Archived,
        Self::Deleted,
        Self::Ignored,
        Self::Missing,
        Self::Unknown,
    ];

    /// Reads EvalAI's name of a status.
    pub fn parse(name: &str) -> Self {
        let name = name.to_ascii_lowercase();
        let ours = |status: &Self| matches!(status, Self::Deleted | Self::Ignored | Self::Missing | Self::Unknown);
        let found = Self::ALL
            .into_iter()
            .find(|status| !ours(status) && status.as_str() == name);
        found.unwrap_or(Self::Unknown)
    }

    /// True if EvalAI waits for this submission to end.
    pub fn is_live(self) -> bool {
        matches!(
            self,
            Self::Submitted
                | Self::Submitting
                | Self::Resuming
                | Self::Queued
                | Self::Running
                | Self::PartiallyEvaluated
        )
    }

    /// Its name, EvalAI's where it has one.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Submitted => "submitted",
            Self::Submitting => "submitting",
            Self::Resuming => "resuming",
            Self::Queued => "queued",
            Self::Running => "running",
            Self::PartiallyEvaluated => "partially_evaluated",
            Self::Finished => "finished",
            Self::Failed => "failed",
            Self::Cancelled => "cancelled",
            Self::Archived => "archived",
            Self::Deleted => "deleted",
            Self::Ignored => "ignored",
            Self::Missing => "missing",
            Self::Unknown => "unknown",
        }
    }
}

impl fmt::Display for Status {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.as_str())
    }
}

/// How far a run is, as EvalAI shows it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Progress {
    Queued,
    Running,
}

impl Progress {
    /// EvalAI's name of it.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Queued => "queued",
            Self::Running => "running",
        }
    }

    /// The status it leads to.
    pub fn status(self) -> Status {
        match self {
            Self::Queued => Status::Queued,
            Self::Running => Status::Running,
        }
    }
}

/// How a run has ended, as EvalAI shows it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Outcome {
    Finished,
    Failed,
    Cancelled,
}

impl Outcome {
    /// EvalAI's name of it.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Finished => "finished",
            Self::Failed => "failed",
            Self::Cancelled => "cancelled",
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn evalais_names_are_read_and_ours_are_not() {
        for status in Status::ALL {
            let ours = matches!(
                status,
                Status::Deleted | Status::Ignored | Status::Missing | Status::Unknown
            );
            let expected = if ours { Status::Unknown } else { status };
            assert_eq!(Status::parse(status.as_str()), expected);
        }
        assert_eq!(Status::parse("Finished"), Status::Finished);
        assert_eq!(Status::parse("evaluating"), Status::Unknown);
    }
}
