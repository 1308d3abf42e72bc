//! The programs of the operator that run inside a submission's Pod: `workspace` prepares its volumes and restores what an earlier attempt
//! stored, `logcopy` stores results and logs round by round and reports, `collect` copies what an agent has left for the evaluators.
//!
//! They know S3, CloudWatch and the Pod's volumes. They know no Kubernetes API, no EvalAI and no DynamoDB, and read nothing of a stranger's
//! but through `leaderboard-evidence`.
#![cfg_attr(not(test), deny(clippy::indexing_slicing, clippy::arithmetic_side_effects))]

pub mod collect;
pub mod daily;
pub mod identity;
pub mod isolation;
pub mod logcopy;
mod name_files;
pub mod ownlog;
pub mod places;
pub mod ship;
pub mod upload;
pub mod watch;
pub mod workspace;

/// Does what may wait for a disk, on a thread that may block. The runtime's own threads serve what must never wait, above
/// all the watch of the stop annotation.
pub(crate) async fn blocking<T, E>(work: impl FnOnce() -> Result<T, E> + Send + 'static) -> Result<T, E>
where
    T: Send + 'static,
    E: From<std::io::Error> + Send + 'static,
{
    let done = tokio::task::spawn_blocking(work).await;
    done.map_err(std::io::Error::other)?
}
