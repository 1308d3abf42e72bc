//! The contract between the runner, logcopy and the controller:
//!
//! - `files`: the status files of a run.
//! - `verdict`: the end of a container.
//! - `graphics`: the graphics API of a simulator.
//!
//! ```text
//! runners of a pair ◀── files (empty, in /status) ──▶ logcopy
//! runner ── verdict (termination message) ──▶ kubelet ──▶ controller
//! ```
//!
//! The runner is PID 1 in containers of any image, so that this depends on serde alone.

pub mod files;
pub mod graphics;
pub mod verdict;
