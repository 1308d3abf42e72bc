//! What the runner shares with the rest of the operator: the status files by which the containers of a Pod agree
//! ([`protocol`]), the verdict a container leaves behind ([`verdict`]), and what a simulator needs of a GPU ([`graphics`]).
//!
//! Used by the runner itself, by `logcopy` (which reads all status files and writes two) and by the controller (which
//! parses verdicts). It may not know Kubernetes, S3 or EvalAI. `README.md` next to it describes the whole protocol.

pub mod args;
pub mod expand;
pub mod graphics;
pub mod needs;
pub mod protocol;
pub mod verdict;
