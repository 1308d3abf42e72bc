//! The controller: drives Submissions through their states and keeps everything they own.
//!
//! The folders show the way of an event, and each imports only what stands after it: `runtime` (watches, Lease, queues) reconciles
//! Leaderboards by `leaderboards` and Submissions by `submissions` (observe, decide, act); both ask `slots` whose turn it is.

pub mod leaderboards;
pub mod objects;
pub mod runtime;
pub mod settings;
pub mod slots;
pub mod stores;
pub mod submissions;
pub mod writes;

#[cfg(test)]
mod tests;
#[cfg(test)]
pub(crate) use tests::fixtures;
