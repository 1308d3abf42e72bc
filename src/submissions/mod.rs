//! The reconcile of a Submission.
//!
//! It observes (`observe`: caches and memory), decides (`decide`: pure) and acts (`act`). What it needs of S3, nodes and tables is asked
//! next to it: `reports`, `fences`, `failure_log`, `rows`, `records`.
//! `job_spec` and `pod_overlay` build what is created in the cluster; they know no client and no clock.

pub mod act;
pub mod external;
pub mod failure_log;
pub mod fences;
pub mod memory;
pub mod observe;
pub mod payloads;
pub mod records;
pub mod reports;
mod result_texts;
pub mod rows;
pub mod spans;
