//! How long the operator keeps what has ended.
//!
//! Part of a Leaderboard's spec.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// When ended Submissions are deleted.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Copy, Debug, Default, PartialEq, Eq)]
#[serde(rename_all = "camelCase")]
pub struct Retention {
    /// Seconds after its end at which a Submission is deleted, once EvalAI and the table have that end. Absent: all are kept. Results and rows stay. Submissions that a tool applies from git would be applied again.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(range(min = 1, max = 31_536_000))]
    pub finished_seconds: Option<i64>,
}
