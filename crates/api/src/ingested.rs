//! The annotation that records the message or the sweep behind a Submission's attempts: `ingest` writes it, the controller reads it.
//!
//! Pure.

use serde::{Deserialize, Serialize};

use super::{Attempt, Submission, names};

/// Value of [`Ingested::message`] if the sweep of EvalAI's rows took the place of a message.
pub const SWEEP: &str = "sweep";

/// The value of `leaderboard.carla.org/ingested`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct Ingested {
    /// Id of the message, or [`SWEEP`].
    pub message: String,
    /// When it was sent, in milliseconds since 1970; of the sweep, when EvalAI's row asked to be run.
    pub sent: i64,
    /// The attempt that it began. Absent: no message began one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub attempt: Option<Attempt>,
    /// The attempts that began without a message since the last one that came.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub without_message: Vec<Attempt>,
    /// The attempt that EvalAI's row asked for and that did not begin.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub refused: Option<RefusedAttempt>,
}

/// An attempt that no message has announced, and that is one too many.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct RefusedAttempt {
    /// Its number, had it begun.
    pub attempt: Attempt,
    /// When the row first asked for it, in milliseconds since 1970.
    pub at: i64,
}

impl Ingested {
    /// Reads a Submission's; none of one that people made.
    pub fn of(submission: &Submission) -> Option<Self> {
        let annotations = submission.metadata.annotations.as_ref()?;
        serde_json::from_str(annotations.get(names::ANNOTATION_INGESTED)?).ok()
    }

    /// True if EvalAI asked for this attempt, by a message or by its row. A person asked for every other attempt.
    pub fn has_begun(&self, attempt: Attempt) -> bool {
        self.attempt == Some(attempt) || self.without_message.contains(&attempt)
    }
}
