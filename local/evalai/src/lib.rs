//! A stand-in for EvalAI's API: the demo's participants push into it, the operator reports to it, the tests read it.
//!
//! Started by the binary `evalai-stand-in` and, inside tests, by [`serve`]. It does not know the operator. It behaves as EvalAI's own
//! server was observed to, faults included: no state machine, duplicate leaderboard rows after concurrent results, whole rows saved late.
//!
//! The pure part ([`state`], [`update`], [`submissions`], [`edit`], [`views`], [`python`], [`throttle`], [`routes`])
//! knows no network and no clock. Requests share `app`, and [`server`] puts HTTP around `handlers`.

mod app;
pub mod body;
pub mod control;
pub mod edit;
pub mod errors;
pub mod faults;
mod handlers;
mod idle;
mod leaderboards;
pub mod log;
mod media;
pub mod model;
mod pages;
pub mod python;
pub mod queue;
pub mod reply;
pub mod routes;
pub mod seed;
pub mod server;
pub mod sqs;
pub mod state;
pub mod submissions;
pub mod throttle;
pub mod update;
pub mod views;

pub use app::Config;
pub use faults::Knobs;
pub use queue::{MemoryQueues, Message, Queues};
pub use seed::Seed;
pub use server::{Handle, serve};
pub use state::State;
