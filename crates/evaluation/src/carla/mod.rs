//! What the operator knows of the CARLA Leaderboard inside a Pod.

pub mod commands;
mod display;
pub mod gather;
pub mod layout;
pub mod measures;
pub mod workload;

use leaderboard_api::LeaderboardVersion;
use leaderboard_results::{Format, metrics};

/// The format of the results of a version.
pub fn results_format(version: LeaderboardVersion) -> Format {
    match version {
        LeaderboardVersion::V1 => Format::V1,
        LeaderboardVersion::V2 => Format::V2,
    }
}

/// The names of the metrics that a table has columns for, of either version.
pub fn columns() -> impl Iterator<Item = &'static str> {
    [Format::V1, Format::V2]
        .into_iter()
        .flat_map(metrics)
        .map(|metric| metric.name)
}
