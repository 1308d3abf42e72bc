//! The verdict of `workspace` or `collect`: why it could not prepare the Pod, or what it measured. The controller reads it.

use serde::{Deserialize, Serialize};

/// Version of the verdict.
pub const VERDICT_SCHEMA: u32 = 1;
/// Most bytes of a verdict: eleven containers share 12 KiB.
pub const VERDICT_BYTES: usize = 1000;

/// Why the workspace could not be prepared, or what it has found, as the controller needs to know it.
#[derive(Serialize, Deserialize, Clone, Copy, Debug, PartialEq, Eq)]
pub enum WorkspaceReason {
    /// The prefix holds another submission's results.
    PrefixInUse,
    /// The plan of the run contradicts itself.
    PlanInvalid,
    /// S3 can't be used.
    StorageFailed,
    /// A volume of the Pod can't be used.
    VolumeFailed,
    /// The Pod's NetworkPolicy has to be enforced, and is not.
    NotIsolated,
    /// The Pod's NetworkPolicy has to be enforced, and whether it is could not be measured.
    NotKnownIsolated,
    /// The agent has left files that cannot be taken, or none. Of `collect` alone.
    InputRefused,
    /// The submitted file is not in the bucket, or another one.
    InputMissing,
    /// No failure: the policy is enforced.
    Enforced,
    /// No failure: it is not.
    NotEnforced,
    /// No failure: it is not known.
    NotMeasured,
}

/// The container's termination message.
#[derive(Serialize, Deserialize, Clone, Debug, PartialEq, Eq)]
pub struct WorkspaceVerdict {
    /// [`VERDICT_SCHEMA`].
    pub schema: u32,
    /// For the controller.
    pub reason: WorkspaceReason,
    /// For people, with the next step.
    pub message: String,
}

/// Why a termination message is no verdict.
#[derive(thiserror::Error, Debug, PartialEq, Eq)]
pub enum NotAVerdict {
    /// Longer than any version writes.
    #[error("the termination message has {0} bytes, more than the {VERDICT_BYTES} of a verdict of `workspace`")]
    TooLong(usize),
    /// A schema number that this version does not read.
    #[error("the verdict of `workspace` has schema {0}, and this operator reads {VERDICT_SCHEMA}")]
    Schema(u32),
    /// Not the JSON of a verdict.
    #[error("the termination message is no verdict of `workspace`: {0}")]
    Malformed(String),
}

impl WorkspaceVerdict {
    /// A verdict of this version.
    pub fn new(reason: WorkspaceReason, message: String) -> Self {
        Self {
            schema: VERDICT_SCHEMA,
            reason,
            message,
        }
    }

    /// Its JSON, cut to what a termination message may have.
    pub fn to_json(&self) -> String {
        let mut verdict = self.clone();
        loop {
            let json = serde_json::to_string(&verdict).unwrap_or_default();
            if json.len() <= VERDICT_BYTES || verdict.message.is_empty() {
                return json;
            }
            let characters = verdict.message.chars().count();
            let keep = characters.saturating_sub(characters.div_ceil(4));
            verdict.message = verdict.message.chars().take(keep).collect();
        }
    }

    /// Reads a container's termination message.
    pub fn parse(message: &str) -> Result<Self, NotAVerdict> {
        #[derive(Deserialize)]
        struct Numbered {
            schema: u32,
        }
        if message.len() > VERDICT_BYTES {
            return Err(NotAVerdict::TooLong(message.len()));
        }
        let malformed = |error: serde_json::Error| NotAVerdict::Malformed(error.to_string());
        // Another version may know other reasons.
        let Numbered { schema } = serde_json::from_str(message).map_err(malformed)?;
        if schema != VERDICT_SCHEMA {
            return Err(NotAVerdict::Schema(schema));
        }
        serde_json::from_str(message).map_err(malformed)
    }
}
