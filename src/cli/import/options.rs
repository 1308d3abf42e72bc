//! What a person names on the command line of an import.

use super::taint::Taint;
use crate::services::event_sources::QueueArn;

/// What the entries do not hold.
#[derive(Clone, Debug)]
pub(super) struct Options {
    pub(super) namespace: String,
    pub(super) service_account: String,
    pub(super) role_arn: Option<String>,
    /// Of the entries, the buckets, the tables and the log groups.
    pub(super) region: String,
    /// In place of Secrets Manager's own.
    pub(super) endpoint: Option<String>,
    /// A decision may name it instead.
    pub(super) challenge: Option<i64>,
    pub(super) queue: Option<Queue>,
    pub(super) dead_letter: Option<String>,
    pub(super) egress: Vec<String>,
    /// Of the GPU nodes.
    pub(super) taints: Vec<Taint>,
    /// Each Leaderboard has a cluster and an operator of its own.
    pub(super) two_operators: bool,
}

/// The queue of the challenge.
#[derive(Clone, Debug)]
pub(super) struct Queue {
    pub(super) url: String,
    pub(super) arn: QueueArn,
}
