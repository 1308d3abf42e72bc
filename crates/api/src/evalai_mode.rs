//! How a Leaderboard uses EvalAI.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Whether results go to EvalAI.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum EvalaiMode {
    /// EvalAI gets states and results.
    #[default]
    Publish,
    /// Nothing is written to EvalAI: the submissions that another program runs are run once more.
    Observe,
}
