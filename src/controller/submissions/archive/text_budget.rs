//! The memory that texts of results may take up: in one bucket, and in all together. A text has its place from before it is read
//! until EvalAI has it, or nobody wants it any more.
//!
//! Agents decide how large these texts are, so without a bound a few submissions take the memory of all. Each bucket has half of
//! the whole: an EvalAI server that takes no ends for hours keeps the texts of another's waiting no longer than those need.

use std::sync::Arc;
use std::time::Duration;

use tokio::sync::{OwnedSemaphorePermit, Semaphore, TryAcquireError};

use crate::services::held_text::HeldMemory;

/// Largest text that is passed on to EvalAI, in bytes.
pub(super) const MAX_TEXT: u64 = 4 << 20;
/// What all texts together may take up, in bytes.
const ALL: u64 = 56 << 20;
/// The same of one bucket: the largest texts of one submission, with their copies, fit.
const OF_BUCKET: u64 = ALL / 2;
/// A text takes up so many times its size: itself, and its copy in a request, where each quotation mark takes two bytes.
const COPIES: u64 = 3;
/// What is counted in: a permit of a semaphore.
const UNIT: u64 = 1024;
/// How long a place is waited for before the status shows it.
const WAITS: Duration = Duration::from_mins(1);

/// The places of one bucket's texts.
#[derive(Clone, Debug)]
pub(super) struct TextBudget {
    all: Arc<Semaphore>,
    of_bucket: Arc<Semaphore>,
}

/// There is no place, or not in time.
#[derive(thiserror::Error, Debug, PartialEq, Eq)]
#[error(
    "the operator holds as many texts of results as it has memory for; this one follows once EvalAI has taken others"
)]
pub(super) struct NoPlace;

impl TextBudget {
    /// Of a first bucket.
    pub(super) fn new() -> Self {
        Self {
            all: Arc::new(semaphore(ALL)),
            of_bucket: Arc::new(semaphore(OF_BUCKET)),
        }
    }

    /// Of another bucket.
    pub(super) fn of_another(&self) -> Self {
        Self {
            all: Arc::clone(&self.all),
            of_bucket: Arc::new(semaphore(OF_BUCKET)),
        }
    }

    /// A place for texts of so many bytes. That of an end waits; a live run's has another text soon, and leaves half to the ends.
    pub(super) async fn place(&self, bytes: u64, is_end: bool) -> Result<HeldMemory, NoPlace> {
        let units = permits(bytes * COPIES).max(1);
        let found = if is_end {
            let wait = self.wait(units);
            tokio::time::timeout(WAITS, wait).await.map_err(|_| NoPlace)?
        } else {
            self.now(units)
        };
        found.map(|permits| Arc::new(permits) as HeldMemory)
    }

    async fn wait(&self, units: u32) -> Result<[OwnedSemaphorePermit; 2], NoPlace> {
        let of_bucket = Arc::clone(&self.of_bucket).acquire_many_owned(units).await;
        let of_all = Arc::clone(&self.all).acquire_many_owned(units).await;
        Ok([of_bucket.map_err(|_| NoPlace)?, of_all.map_err(|_| NoPlace)?])
    }

    fn now(&self, units: u32) -> Result<[OwnedSemaphorePermit; 2], NoPlace> {
        let is_left =
            |places: &Semaphore, whole: u64| places.available_permits() >= (permits(whole / 2) + units) as usize;
        if !is_left(&self.of_bucket, OF_BUCKET) || !is_left(&self.all, ALL) {
            return Err(NoPlace);
        }
        let none = |_: TryAcquireError| NoPlace;
        let of_bucket = Arc::clone(&self.of_bucket)
            .try_acquire_many_owned(units)
            .map_err(none)?;
        let of_all = Arc::clone(&self.all).try_acquire_many_owned(units).map_err(none)?;
        Ok([of_bucket, of_all])
    }
}

fn semaphore(bytes: u64) -> Semaphore {
    Semaphore::new(permits(bytes) as usize)
}

fn permits(bytes: u64) -> u32 {
    u32::try_from(bytes.div_ceil(UNIT)).unwrap_or(u32::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test(start_paused = true)]
    async fn the_largest_texts_of_one_submission_fit_and_those_of_the_next_wait_for_them() {
        let budget = TextBudget::new();
        let first = budget.place(2 * MAX_TEXT, true).await.unwrap();
        assert_eq!(budget.place(2 * MAX_TEXT, true).await.err(), Some(NoPlace));
        // Another bucket's have a place of their own; a third's do not, since all together are bounded.
        let other = budget.of_another();
        let second = other.place(2 * MAX_TEXT, true).await.unwrap();
        assert_eq!(budget.of_another().place(2 * MAX_TEXT, true).await.err(), Some(NoPlace));
        let waiting = tokio::spawn(async move { budget.place(2 * MAX_TEXT, true).await });
        tokio::task::yield_now().await;
        assert!(!waiting.is_finished());
        drop(first);
        assert!(waiting.await.unwrap().is_ok());
        drop(second);
    }

    #[tokio::test(start_paused = true)]
    async fn live_runs_leave_half_of_the_places_to_the_ends() {
        let budget = TextBudget::new();
        let mut live = Vec::new();
        while let Ok(place) = budget.place(300 << 10, false).await {
            live.push(place);
        }
        assert_eq!(live.len(), 15, "28 MiB, halved, by three times 300 KiB");
        assert!(budget.place(4 << 20, true).await.is_ok());
    }
}
