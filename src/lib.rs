//! Runs the submissions of an AI challenge on Kubernetes and keeps EvalAI, S3 and DynamoDB in sync.
//!
//! The folders show the way of an event. `bridge` reads SQS. `intake` makes a Submission of a message from there or from EvalAI's own
//! queue. `runtime` (watches, Lease, queues) reconciles Leaderboards by `leaderboards` and Submissions by `submissions` (observe, decide,
//! act). Both ask `slots` whose turn it is, and `ask` about the facts of other services. crates/policy decides. docs/architecture.md
//! draws it.
// A test may compare with the system's time.
#![cfg_attr(test, allow(clippy::disallowed_methods))]

pub mod ask;
pub mod bridge;
pub mod cli;
pub mod crds;
pub mod intake;
pub mod kubernetes;
pub mod leaderboards;
pub mod metrics;
pub mod observability;
pub mod page;
mod revision;
pub mod runtime;
pub mod slots;
pub mod submissions;

#[cfg(test)]
mod tests;
#[cfg(test)]
pub(crate) use tests::fixtures;
