//! The Kubernetes API of the operator: the kinds, their rules, and every name that more than one room uses.
//!
//! Called by everyone. Knows no network and no clock: types, constants and pure functions only.

pub mod byte_quantity;
#[cfg(feature = "client-errors")]
pub mod client_errors;
pub mod conditions;
pub mod effective;
pub mod image;
pub mod ingested;
pub mod leaderboard;
pub mod leaderboard_parts;
pub mod leaderboard_services;
pub mod names;
pub mod ranges;
pub mod reasons;
pub mod submission;
pub mod submission_status;
pub mod text;

pub use image::{ImageReference, NotAnImage};
pub use ingested::{Ingested, RefusedAttempt};
pub use leaderboard::{EvalaiUse, JOB_SECONDS, Leaderboard, LeaderboardSpec, LeaderboardStatus, TrackStatus};
pub use leaderboard_parts::*;
pub use submission::{EvalaiRef, Submission, SubmissionSpec, Team};
pub use submission_status::*;

/// API group of both kinds.
pub const GROUP: &str = "leaderboard.carla.org";
/// The served and stored version.
pub const VERSION: &str = "v1alpha1";
