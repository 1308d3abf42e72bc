//! Failures of `workspace`, each with its verdict.

use std::io;

use crate::isolation::Finding;
use leaderboard_aws::archive::ArchiveError;
use leaderboard_contract::verdict::{WorkspaceReason, WorkspaceVerdict};
use leaderboard_evaluation::Refused;
use leaderboard_evidence::TreeError;

/// Why the workspace could not be prepared.
#[derive(thiserror::Error, Debug)]
pub enum WorkspaceError {
    /// The results of another submission are there.
    #[error("s3://{0} already holds results of something else.")]
    PrefixInUse(String),
    /// `network.enforcement` is `Require`.
    #[error("{0} The run is not started, because network.enforcement is Require.")]
    NotIsolated(Finding),
    /// The plan does not hold.
    #[error(transparent)]
    Plan(#[from] Refused),
    /// The submitted file of the mode Predictions.
    #[error(
        "The submitted file s3://{place} {why}. Put the file of the submission there and resume it, or submit the file again."
    )]
    InputMissing {
        /// Bucket and key.
        place: String,
        /// What is there.
        why: &'static str,
    },
    /// S3.
    #[error(transparent)]
    Storage(#[from] ArchiveError),
    /// A file below the volume's root.
    #[error("{path} on the logs volume can't be used: {error}. Look at the node's disk and the Pod's volumes.")]
    Volume {
        /// Which.
        path: String,
        /// The system's own text.
        error: TreeError,
    },
    /// The files by which names are resolved.
    #[error("{path} can't be written: {error}. Look at the node's disk and the Pod's volumes.")]
    NameFile {
        /// Where to.
        path: String,
        /// The system's own text.
        error: io::Error,
    },
    /// The runner.
    #[error("the runner can't be copied to {path}: {error}. Use the operator's own image for this container.")]
    Runner {
        /// Where to.
        path: String,
        /// The system's own text.
        error: io::Error,
    },
}

impl WorkspaceError {
    /// For the termination message.
    pub fn verdict(&self) -> WorkspaceVerdict {
        let reason = match self {
            Self::PrefixInUse(_) => WorkspaceReason::PrefixInUse,
            Self::NotIsolated(Finding::Unmeasured(_)) => WorkspaceReason::NotKnownIsolated,
            Self::NotIsolated(_) => WorkspaceReason::NotIsolated,
            Self::Plan(_) => WorkspaceReason::PlanInvalid,
            Self::InputMissing { .. } => WorkspaceReason::InputMissing,
            Self::Storage(_) => WorkspaceReason::StorageFailed,
            Self::Volume { .. } | Self::NameFile { .. } | Self::Runner { .. } => WorkspaceReason::VolumeFailed,
        };
        WorkspaceVerdict::new(reason, self.to_string())
    }
}
