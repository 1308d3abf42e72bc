//! Nodes that have failed Jobs of an attempt, so that the next ones keep off them.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Nodes that one status names at most.
pub const MAX_FAILED_NODES: usize = 8;

/// A node on which a Job failed because of the infrastructure.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, PartialEq, Eq)]
#[serde(rename_all = "camelCase")]
pub struct FailedNode {
    /// The node.
    #[schemars(length(max = 253))]
    pub node_name: String,
    /// Jobs of this attempt that it gave no GPU, or could not start; 0 if they ended otherwise.
    pub jobs: i32,
}
