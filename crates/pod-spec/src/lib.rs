//! The objects that the operator makes in the cluster, from the API's types alone: the Job of an attempt (`job`), what a host lays over
//! its Pod (`overlay`), the NetworkPolicy and the ResourceClaimTemplate of a Leaderboard, and what its host should know of its Pods (`notes`).
//!
//! Pure: the same input makes the same bytes. Knows no client, no cluster and no clock.

pub mod gpu_claims;
pub mod job;
pub mod layout;
pub mod network_policy;
pub mod notes;
pub mod overlay;
mod owner;
