//! Attempts that ended because of the infrastructure, in ways that an agent can cause as well: counted by submission and by team.

use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;
use kube::KubeSchema;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::reasons;

/// Infrastructure failures that an agent can cause: it can crash its simulator, store more than its time allows, fill a disk, use up its
/// node until that falls silent or starts nothing more, or be an image that no node takes. A pull counts only where it is that of an agent's image.
pub const CAN_BE_CAUSED: [&str; 7] = [
    reasons::SIMULATION_CRASHED,
    reasons::RESULTS_NOT_STORED,
    reasons::JOB_FAILED,
    reasons::NODE_LOST,
    reasons::NODE_CANNOT_START,
    reasons::DISK_FULL,
    reasons::IMAGE_PULL,
];

/// Nodes that are remembered of a submission.
pub const MAX_NODES: usize = 8;

/// Ends of a submission whose times are remembered: as many as decide whether another Job follows.
pub const MAX_RECENT_TIMES: usize = 3;

/// Teams that a Leaderboard shows.
pub const MAX_TEAMS: usize = 32;

/// What becomes of a team's attempt that ends so after others of the same team.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum OnRepeatedInfrastructure {
    /// It does not count as an attempt, as ever.
    #[default]
    Forgive,
    /// It counts as an attempt if other teams' runs with the same simulator finish meanwhile.
    Charge,
}

/// Attempts of a submission that ended so, since it last finished.
#[derive(Serialize, Deserialize, KubeSchema, Clone, Debug, PartialEq)]
#[serde(rename_all = "camelCase")]
pub struct InfrastructureFailures {
    /// How many.
    pub number: i32,
    /// When the first of them ended.
    pub first_time: Time,
    /// When the last of them ended.
    pub last_time: Time,
    /// When each of the last ones ended, the oldest first.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[x_kube(merge_strategy = ListMerge::Atomic)]
    #[schemars(length(max = MAX_RECENT_TIMES))]
    pub recent_times: Vec<Time>,
    /// Nodes of their last Pods.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[x_kube(merge_strategy = ListMerge::Set)]
    #[schemars(length(max = MAX_NODES), inner(length(max = 253)))]
    pub nodes: Vec<String>,
}

impl InfrastructureFailures {
    /// When the last ones ended, the oldest first, as far as that is known: an operator before `recentTimes` has noted the last one alone.
    pub fn known_times(&self) -> &[Time] {
        if self.recent_times.is_empty() && self.number > 0 {
            return std::slice::from_ref(&self.last_time);
        }
        &self.recent_times
    }
}

/// Attempts of a team that ended so, since one of the team's last finished.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, PartialEq)]
#[serde(rename_all = "camelCase")]
pub struct TeamFailures {
    /// Id of the team, or its name if it has none.
    #[schemars(length(max = 256))]
    pub team: String,
    /// How many.
    pub number: i32,
    /// When the last of them ended.
    pub last_time: Time,
}
