//! Surroundings of a hub and of its tasks.

#[cfg(any(test, feature = "fixtures"))]
use std::sync::Arc;

use tokio::sync::mpsc;
use tokio::time::Instant;

use super::queue::Timing;
use super::transport::{Connect, Timeouts};
use super::types::{Changed, PayloadReader, SweepRow, WriteGuard};
use leaderboard_base::clock::Clock;
use leaderboard_base::meter::Meter;
use leaderboard_base::tasks::Tasks;

/// Surroundings of a hub.
pub struct Options {
    /// Makes the transport of each token.
    pub connect: Connect,
    /// Tells the time of what EvalAI and people are shown.
    pub clock: Clock,
    pub write_guard: WriteGuard,
    /// Reads what a bucket holds of a result.
    pub payloads: PayloadReader,
    /// No write before: after a takeover, what the process before has sent may still be worked on.
    pub not_before: Instant,
    /// Receives what has changed.
    pub changed: mpsc::UnboundedSender<Changed>,
    /// Receives submissions whose message was lost.
    pub sweep: mpsc::UnboundedSender<SweepRow>,
    pub timing: Timing,
    pub timeouts: Timeouts,
    /// Counts the requests.
    pub meter: Meter,
    /// Starts the task of each token.
    pub tasks: Tasks,
}

#[cfg(any(test, feature = "fixtures"))]
impl Options {
    /// Options of a hub without a listener to its news.
    pub fn unheard(tasks: &Tasks, write_guard: impl Fn() -> bool + Send + Sync + 'static) -> Self {
        Self {
            connect: Arc::new(super::Network::connect),
            clock: Clock::system(),
            write_guard: Arc::new(write_guard),
            payloads: Arc::new(|outline| Box::pin(async move { Ok(super::Payload::bare(&outline)) })),
            not_before: Instant::now(),
            changed: mpsc::unbounded_channel().0,
            sweep: mpsc::unbounded_channel().0,
            timing: Timing::default(),
            timeouts: Timeouts::default(),
            meter: Meter::default(),
            tasks: tasks.clone(),
        }
    }
}
