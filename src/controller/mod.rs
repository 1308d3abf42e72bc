//! The controller: drives Submissions through their states and keeps everything they own.
//!
//! A reconcile observes (`observe`: caches and memory), decides (`decide`: pure) and acts (`act`). What it needs of S3 the workers
//! of `archive` read and write next to it.
//! `job_spec`, `pod_overlay` and `network_policy` build what is created in the cluster; they know no client and no clock.
//! `run` wires it all together for the replica that leads.

pub mod act;
pub mod archive;
pub mod backoff;
pub mod context;
pub mod decide;
pub mod failure_log;
#[cfg(test)]
pub(crate) mod fixtures;
pub mod job_spec;
pub mod leader;
pub mod leaderboards;
pub mod memory;
pub mod network_policy;
pub mod objects;
pub mod observe;
mod pod_layout;
pub mod pod_overlay;
pub mod reruns;
mod result_texts;
pub mod run;
pub mod settings;
pub mod significance;
pub mod slots;
pub mod stores;
pub mod sync;
pub mod turns;
pub mod view;
