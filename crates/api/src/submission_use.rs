//! Cluster resources that a submission has used, and how often the cluster has taken its nodes away.

use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;
use kube::KubeSchema;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Nodes that are remembered of an attempt.
pub const MAX_INTERRUPTED_NODES: usize = 8;

/// Jobs of an attempt whose node was taken away. They use up no retry.
#[derive(Serialize, Deserialize, KubeSchema, Clone, Debug, PartialEq)]
#[serde(rename_all = "camelCase")]
pub struct Interruptions {
    /// Number of interruptions.
    pub number: i32,
    /// When the last of them ended.
    pub last_time: Time,
    /// Nodes of the last ones.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[x_kube(merge_strategy = ListMerge::Set)]
    #[schemars(length(max = MAX_INTERRUPTED_NODES), inner(length(max = 253)))]
    pub nodes: Vec<String>,
}

/// Teams that a Leaderboard shows.
pub const MAX_USING_TEAMS: usize = 10;

/// Use of GPUs by the submissions of a team, as far as they still exist.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, PartialEq, Eq)]
#[serde(rename_all = "camelCase")]
pub struct TeamUse {
    /// Id of the team, or its name if it has none.
    #[schemars(length(max = 256))]
    pub team: String,
    /// GPUs times seconds of the Jobs that have ended.
    pub gpu_seconds: i64,
}

/// What a submission has used, over all its attempts.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Copy, Debug, Default, PartialEq, Eq)]
#[serde(rename_all = "camelCase")]
pub struct Use {
    /// Number of GPUs of the present or last Job.
    pub gpus: i64,
    /// GPUs times seconds from the Pod's scheduling to its end, summed over the Jobs that have ended.
    pub gpu_seconds: i64,
}

impl Use {
    /// Adds a Job that had its GPUs for so long.
    pub fn add(&mut self, seconds: i64) {
        let used = self.gpus.max(0).saturating_mul(seconds.max(0));
        self.gpu_seconds = self.gpu_seconds.saturating_add(used);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gpu_seconds_add_up_and_never_fall() {
        let mut used = Use {
            gpus: 4,
            gpu_seconds: 0,
        };
        for (seconds, sum) in [
            (100, 400),
            (0, 400),
            (-5, 400),
            (1, 404),
            (i64::MAX, i64::MAX),
            (1, i64::MAX),
        ] {
            used.add(seconds);
            assert_eq!(used.gpu_seconds, sum, "{seconds}");
        }
        let mut none = Use::default();
        none.add(1000);
        assert_eq!(none.gpu_seconds, 0);
    }
}
