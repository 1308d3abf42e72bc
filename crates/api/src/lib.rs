//! The Kubernetes API of the operator: the kinds, their rules, and every name that more than one module uses.
//!
//! Called by everyone. Knows no network and no clock: types, constants and pure functions only.

mod agents;
mod attempt;
pub mod byte_quantity;
mod carla;
#[cfg(feature = "client-errors")]
pub mod client_errors;
pub mod conditions;
mod container;
pub mod definitions;
pub mod effective;
mod evalai_mode;
mod evalai_queue;
pub mod evalai_status;
pub mod evaluator_result;
mod failed_node;
pub mod gpu;
pub mod image;
pub mod image_pattern;
pub mod ingested;
mod job_number;
pub mod keeping;
pub mod leaderboard;
pub mod leaderboard_network;
pub mod leaderboard_parts;
pub mod leaderboard_services;
pub mod names;
mod order;
mod progress;
pub mod ranges;
pub mod reasons;
mod retention;
mod route_slice;
mod route_subset;
mod run_id;
mod run_plan;
mod shared_text;
pub mod standings;
mod state;
pub mod submission;
pub mod submission_status;
mod submission_use;
mod submitted_file;
mod team;
pub mod text;
mod track_container;
mod waiting;
mod worker_status;

/// Name, namespace and UID of an object.
pub use kube::ResourceExt;

pub use agents::Agents;
pub use attempt::Attempt;
pub use carla::*;
pub use conditions::Condition;
pub use container::*;
pub use evalai_mode::EvalaiMode;
pub use evalai_queue::EvalaiQueue;
pub use failed_node::{FailedNode, MAX_FAILED_NODES};
pub use image::{ImageReference, NotAnImage};
pub use image_pattern::{ImagePattern, Repository};
pub use ingested::{Ingested, RefusedAttempt};
pub use job_number::JobNumber;
pub use keeping::StorageClass;
pub use leaderboard::{
    EvalaiBacklog, EvalaiUse, JOB_SECONDS, Leaderboard, LeaderboardSpec, LeaderboardStatus, TableUse, TrackStatus,
};
pub use leaderboard_parts::*;
pub use names::{DOCUMENTS, GROUP, VERSION};
pub use progress::{MAX_METRICS, MAX_NAME, Metric, Progress, Score};
pub use reasons::{Reason, ReasonName};
pub use retention::Retention;
pub use route_slice::{NotASlice, RouteSlice};
pub use run_id::{NotARunId, RunId};
pub use run_plan::{Given, Part};
pub use shared_text::SharedText;
pub use standings::{MAX_STANDINGS, Order, RankedScore, Ranking, Standing};
pub use submission::{EvalaiRef, Submission, SubmissionSpec};
pub use submission_status::*;
pub use submission_use::{Interruptions, MAX_INTERRUPTED_NODES, MAX_USING_TEAMS, TeamUse, Use};
pub use submitted_file::SubmittedFile;
pub use team::{Team, TeamStatus};
pub use waiting::{Eta, Waiting};
pub use worker_status::{EndReason, LastEnd, WorkerState, WorkerStatus};
