//! EvalAI: what it shows of submissions, and what is written there, within a budget of requests.
//!
//! The controller calls [`Hub`] only, which never waits: a [`DesiredUpdate`] goes in, a [`SubmissionState`] comes out, a channel
//! reports what has changed. Behind it each token of a namespace has one `task` that carries out what `queue` decides; a request
//! carries the token of its own Leaderboard, and no other. The rules of what may
//! be written over what are in [`guard`], and nowhere else. This crate knows no Kubernetes object: a [`Key`] is only handed
//! back.
//!
//! EvalAI is reached through a [`Transport`] alone: `client` and `files` make requests and read answers. [`Network`] is the one over TCP,
//! and `network.rs` the only file that knows reqwest.

pub mod answer;
pub mod budget;
pub mod client;
mod files;
pub mod guard;
pub mod hub;
mod job_names;
pub mod labels;
mod network;
mod options;
mod payload;
pub mod queue;
pub mod reach;
pub mod request;
pub mod row;
mod task;
pub mod token;
mod transport;
pub mod types;

pub use files::{InputAddress, InputError, InputStream};
pub use hub::Hub;
pub use labels::{Labels, Misfit};
pub use leaderboard_api::evalai_status::{Outcome, Progress, Status};
pub use leaderboard_contract::report::Patience;
pub use network::Network;
pub use options::Options;
pub use queue::Timing;
pub use row::Row;
pub use transport::{Body, ClientError, Connect, Failure, Timeouts, Transport};
pub use types::{
    Changed, DesiredUpdate, Ended, ImageAnswer, InboxTrouble, Key, Metrics, Outline, Payload, PayloadProblem,
    PayloadReader, Publisher, Run, StoredResult, Subject, SubmissionState, SweepRow, Swept, Target, Usage,
};
