//! Checkpoint files of the CARLA Leaderboard: read, merge, judge, render.
//!
//! Owns the two checkpoint formats, the merge of the partial files of several workers, the global statistics and the
//! files EvalAI gets. Called by `logcopy` in the Pod and by the `results` command on a person's machine. Knows no network,
//! no clock and no file system: bytes in, texts out.
//!
//! The numbers are those of the Leaderboard's own merge script, bit for bit; where the outcome differs on purpose,
//! `docs/results.md` describes it and [`Plan::as_original`] switches the differences off.
//!
//! ```
//! use leaderboard_results::{Format, Plan, offline};
//!
//! let plan = Plan::lenient(Format::V2);
//! let (merged, files) = offline(&plan, &[None])?;
//! assert!(!merged.is_final);
//! assert!(files.stdout_txt.starts_with("Here is a summary"));
//! # Ok::<(), leaderboard_results::Refusal>(())
//! ```

#![cfg_attr(not(test), deny(clippy::indexing_slicing, clippy::arithmetic_side_effects))]

mod checkpoint;
mod json;
mod merge;
mod names;
mod number;
mod plan;
mod refusal;
mod render;
mod statistics;
mod verdict;

pub use checkpoint::{Checkpoint, read_worker};
pub use json::{FileLimits, Limit};
pub use merge::{Merged, PairProgress, merge};
pub use names::{Metric, Score, Source, metrics};
pub use number::number_text;
pub use plan::{Format, Plan, Slice, Strictness, Verify};
pub use refusal::{RecordName, RecordProblem, Refusal};
pub use render::{Files, render};
pub use verdict::Outcome;

/// Reads, merges and renders the workers' files in one go, as a command on a person's machine does.
///
/// `inputs` are the files in the order of the workers; `None` is a file that does not exist.
pub fn offline(plan: &Plan, inputs: &[Option<Vec<u8>>]) -> Result<(Merged, Files), Refusal> {
    let mut read = Vec::with_capacity(inputs.len());
    for (pair, bytes) in inputs.iter().enumerate() {
        read.push(match bytes {
            Some(bytes) => read_worker(plan, pair, bytes)?,
            None => None,
        });
    }
    let workers: Vec<Option<&Checkpoint>> = read.iter().map(Option::as_ref).collect();
    let merged = merge(plan, &workers)?;
    let files = render(plan, Some(&merged))?;
    Ok((merged, files))
}
