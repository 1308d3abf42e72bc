//! The challenge's queue where it is EvalAI's own: read over EvalAI's REST interface, for hosts without a queue in SQS.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The challenge's queue in EvalAI's own account, read by the controller with the token and within its budget of requests.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, PartialEq, Eq)]
#[serde(rename_all = "camelCase")]
pub struct EvalaiQueue {
    /// Its name: what EvalAI calls QUEUE_NAME.
    #[schemars(length(min = 1, max = 80), regex(pattern = r"^[A-Za-z0-9_-]+(\.fifo)?$"))]
    pub name: String,
    /// Seconds after its submission that a message may wait for its Leaderboard to be applied, before it is dropped.
    #[serde(default = "unknown_after_seconds")]
    #[schemars(range(min = 0, max = 1_209_600))]
    pub unknown_after_seconds: i64,
}

fn unknown_after_seconds() -> i64 {
    900
}
