//! What the operator knows of the evaluation that it runs: the words of its commands, where its parts lie, what its pairs have so far,
//! and when a run has ended. Everything that is the CARLA Leaderboard's own is below `carla`.
//!
//! Plain data comes out: no type of Kubernetes, no client of any service. Files are read through `leaderboard-evidence` only.
#![cfg_attr(not(test), deny(clippy::indexing_slicing, clippy::arithmetic_side_effects))]

pub mod carla;
#[cfg(any(test, feature = "fixtures"))]
pub mod fixtures;
pub mod judge;
pub mod workload;
