//! A file that is a submission, in a spec and in a status.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// A file in the bucket that is a submission.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, PartialEq, Eq)]
pub struct SubmittedFile {
    /// SHA-256 of its content, in hexadecimal digits.
    #[schemars(length(max = 64), regex(pattern = r"^[0-9a-f]{64}$"))]
    pub sha256: String,
    /// Number of its bytes.
    #[schemars(range(min = 0))]
    pub size: i64,
}
