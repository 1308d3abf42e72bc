//! EvalAI: what it says of submissions, and what it is told of them, as one budget of requests for each token.
//!
//! The controller speaks to [`Hub`] only, which never waits: wishes go in, [`View`]s come out, a channel says what has
//! changed. Behind it each token has one `task` that carries out what `queue` decides. The rules of what may be written over
//! what are in [`guard`], and nowhere else. This room knows no Kubernetes object: a [`Key`] is only handed back.

pub mod answer;
pub mod budget;
pub mod client;
pub mod guard;
pub mod hub;
pub mod labels;
mod payload;
pub mod queue;
pub mod request;
pub mod row;
pub mod status;
mod task;
pub mod types;

pub use client::Timeouts;
pub use hub::{Fence, Hub, Options};
pub use labels::{Labels, Misfit};
pub use queue::Timing;
pub use row::Row;
pub use status::{Outcome, Progress, Status};
pub use types::{Changed, Ended, ImageAnswer, Key, Payload, Run, SweepRow, Swept, Target, View, Wish};
