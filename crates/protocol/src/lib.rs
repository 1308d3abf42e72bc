//! What the runner, logcopy and the controller have to agree on: the status files of a run (`files`), what a container ends with
//! (`verdict`), and what a simulator draws with (`graphics`).
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
