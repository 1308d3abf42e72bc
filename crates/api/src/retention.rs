//! How long the operator keeps what has ended.
//!
//! Part of a Leaderboard's spec.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// When ended Submissions are deleted.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Copy, Debug, Default, PartialEq, Eq)]
#[serde(rename_all = "camelCase")]
pub struct Retention {
    /// Seconds after its end at which a Submission is deleted, once EvalAI and the table have that end; 0 keeps all. Results and rows stay. Submissions that a tool applies from git would be applied again.
    #[serde(default)]
    #[schemars(range(min = 0, max = 31_536_000))]
    pub finished_seconds: i64,
}
