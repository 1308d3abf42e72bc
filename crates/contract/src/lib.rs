//! The contract between the controller and the programs in a Pod:
//!
//! - `run`: the controller's input for a Pod.
//! - `report`: the Pod's report after each round.
//! - `verdict`: the end of `workspace` or `collect`.
//! - `collected`: the list of what `collect` has copied.
//! - `keys`: the names of stored objects.
//!
//! ```text
//! controller ── run (variable LEADERBOARD_RUN) ──▶ workspace, logcopy, collect
//! controller ◀── report (logcopy/report.json in S3) ── logcopy
//! controller ◀── verdict (termination message) ── workspace, collect
//! ```
//!
//! Pods and controller may be of different versions, so that each document has a number. Golden files hold each version that was.
#![cfg_attr(not(test), deny(clippy::indexing_slicing, clippy::arithmetic_side_effects))]

pub mod collected;
pub mod keys;
pub mod report;
pub mod run;
#[cfg(test)]
mod schema_tests;
pub mod verdict;
