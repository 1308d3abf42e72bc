//! Nodes that have failed Jobs of an attempt, so that the next ones keep off them.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Nodes that one status names at most.
pub const MAX_FAILED_NODES: usize = 8;

/// A node that gave a Job no GPU, or could not start its Pod.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, PartialEq, Eq)]
#[serde(rename_all = "camelCase")]
pub struct FailedNode {
    /// The node.
    #[schemars(length(max = 253))]
    pub node_name: String,
    /// Jobs of this attempt that ended so on it.
    pub jobs: i32,
}
