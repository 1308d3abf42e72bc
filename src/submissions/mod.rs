//! The reconcile of a Submission.
//!
//! It observes (`observe`: caches and memory), decides (crates/policy: pure) and acts (`act`). Tasks next to it read S3, nodes,
//! tables and submitted files: `reports`, `fences`, `failure_log`, `rows`, `records`, `inputs`. The objects that are created in the cluster are built by
//! crates/pod-spec, which knows no client and no clock.

pub mod act;
pub mod external;
pub mod failure_log;
pub mod fences;
pub mod inputs;
pub mod memory;
pub mod observe;
pub mod payloads;
pub mod records;
pub mod reports;
mod result_texts;
pub mod rows;
pub mod spans;
