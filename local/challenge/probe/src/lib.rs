//! A hostile agent image: the table of attacks that an image can try from within its container, and the code that tries them. Each attack
//! has the result that must be seen.
//!
//! One table serves three: the program in the image runs it, `tests/cluster/probes.rs` judges what it printed, and
//! docs/reference/probes.md is written from it. Nothing here uses the operator's code: paths are those that a container finds
//! mounted. No probe sends anything beyond its own Pod, and none does harm where it gets through.

mod call;
pub mod document;
pub mod endings;
pub mod exhaust;
mod files;
mod folders;
mod identity;
mod kernel;
pub mod modes;
pub mod objects;
pub mod probe;
mod processes;
pub mod seen;
pub mod table;
