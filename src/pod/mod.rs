//! Programs that run inside a submission's Pod, and the two documents they share with the controller.
//!
//! `run` is what the controller gives to the Pod, `report` what the Pod reports to the controller, `schema` which versions of both
//! are read. The programs know S3 and the Pod's volumes; they know no Kubernetes API, no EvalAI and no DynamoDB.
#![cfg_attr(not(test), deny(clippy::indexing_slicing, clippy::arithmetic_side_effects))]

pub mod carla;
pub mod daily;
#[cfg(test)]
#[path = "tests/fixtures.rs"]
pub(crate) mod fixtures;
pub mod gather;
pub mod identity;
pub mod isolation;
pub mod judge;
pub mod layout;
pub mod logcopy;
pub mod measures;
mod name_files;
pub mod ownlog;
pub mod places;
pub mod ship;
pub mod upload;
pub mod watch;
pub mod workspace;

/// Does what may wait for a disk, on a thread that may block. The runtime's own threads serve what must never wait, above
/// all the watch of the stop annotation.
pub(crate) async fn blocking<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> std::io::Result<T> {
    tokio::task::spawn_blocking(work).await.map_err(std::io::Error::other)
}
