//! The parts that every measurement uses: the parameters of a run, and one kind of error.

use std::path::PathBuf;

type Fault = Box<dyn std::error::Error + Send + Sync>;
/// Every error is for a person to read.
pub type Outcome<T> = Result<T, Fault>;

/// The settings that all cases share.
pub struct Bench {
    pub tools: PathBuf,
    pub operator: PathBuf,
    pub quick: bool,
    pub scale: f64,
    pub cores: usize,
}

impl Bench {
    /// A number of submissions at this run's scale.
    pub fn count(&self, full: usize) -> usize {
        #[allow(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "a count is small and positive"
        )]
        let scaled = (full as f64 * self.scale).round() as usize;
        scaled.max(2)
    }

    /// How often both sides run.
    pub fn pairs(&self, full: usize) -> usize {
        if self.quick { 1 } else { full }
    }
}
