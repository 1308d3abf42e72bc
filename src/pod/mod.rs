//! Programs that run inside a submission's Pod, and the two documents they share with the controller.
//!
//! `run` is what the controller tells the Pod, `report` what the Pod tells the controller. The programs know S3 and the
//! Pod's volumes; they know no Kubernetes API, no EvalAI and no DynamoDB.

#[cfg(test)]
pub(crate) mod fixtures;
pub mod gather;
pub mod identity;
pub mod isolation;
pub mod judge;
pub mod logcopy;
pub mod ownlog;
pub mod places;
pub mod report;
pub mod run;
pub mod ship;
pub mod tree;
pub mod upload;
pub mod watch;
pub mod workspace;
