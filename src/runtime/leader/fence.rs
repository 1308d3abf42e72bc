//! The fence: shows if this process may write to EvalAI, DynamoDB and Kubernetes at this very moment.
//!
//! Written by the election alone, asked by every such write. Cheap, without a lock or a call. It counts by the boot clock, which goes on
//! while the process or the machine is paused. So a leader that wakes up late finds its fence closed.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use tokio::time::Instant;

use leaderboard_base::clock::Clock;

/// Marks a fence that was never opened.
const NEVER: u64 = u64::MAX;

/// Clones are the same fence.
#[derive(Clone, Debug)]
pub struct Fence(Arc<Inner>);

#[derive(Debug)]
struct Inner {
    clock: Clock,
    limit: Duration,
    /// Boot time, in nanoseconds, at which the last successful renewal was sent.
    renewed: AtomicU64,
    is_closed: AtomicBool,
    /// Set once this process leads.
    evalai_not_before: OnceLock<Instant>,
}

impl Fence {
    /// A fence that is closed until the first renewal. `limit`: how long a renewal opens it.
    pub(super) fn new(clock: Clock, limit: Duration) -> Self {
        let renewed = AtomicU64::new(NEVER);
        Self(Arc::new(Inner {
            clock,
            limit,
            renewed,
            is_closed: AtomicBool::new(false),
            evalai_not_before: OnceLock::new(),
        }))
    }

    /// True while the last successful renewal was sent less than 10 s ago and the process is not handing over. To be
    /// asked right before each write to EvalAI, DynamoDB and Kubernetes.
    pub fn may_write(&self) -> bool {
        let renewed = self.0.renewed.load(Ordering::SeqCst);
        if renewed == NEVER || self.0.is_closed.load(Ordering::SeqCst) {
            return false;
        }
        self.0.clock.since_boot().saturating_sub(Duration::from_nanos(renewed)) < self.0.limit
    }

    /// No write to EvalAI before this moment, since the leader before may have left some under way. None until this
    /// process leads.
    pub fn evalai_not_before(&self) -> Option<Instant> {
        self.0.evalai_not_before.get().copied()
    }

    /// This process leads from now on.
    pub(super) fn begin(&self, evalai_not_before: Instant) {
        // A process leads once, so that a second start is none.
        let _ = self.0.evalai_not_before.set(evalai_not_before);
    }

    /// A renewal that was sent at this boot time has succeeded.
    pub(super) fn renewed(&self, sent: Duration) {
        let nanos = u64::try_from(sent.as_nanos()).unwrap_or(NEVER);
        self.0.renewed.store(nanos, Ordering::SeqCst);
    }

    /// Closed for good.
    pub(super) fn close(&self) {
        self.0.is_closed.store(true, Ordering::SeqCst);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LIMIT: Duration = Duration::from_secs(10);

    fn hand_clock() -> (Arc<AtomicU64>, Clock) {
        let seconds = Arc::new(AtomicU64::new(1000));
        let hand = seconds.clone();
        let clock = Clock::system().with_boot(move || Duration::from_secs(hand.load(Ordering::SeqCst)));
        (seconds, clock)
    }

    #[test]
    fn it_opens_with_a_renewal_and_closes_when_the_clock_jumps_over_a_pause() {
        let (seconds, clock) = hand_clock();
        let fence = Fence::new(clock.clone(), LIMIT);
        assert!(!fence.may_write(), "no renewal yet");
        fence.renewed(clock.since_boot());
        assert!(fence.may_write());
        seconds.fetch_add(9, Ordering::SeqCst);
        assert!(fence.may_write());
        seconds.fetch_add(1, Ordering::SeqCst);
        assert!(!fence.may_write(), "10 s are not less than 10 s");
        fence.renewed(clock.since_boot());
        assert!(fence.clone().may_write());
    }

    #[test]
    fn a_closed_fence_stays_closed() {
        let (_, clock) = hand_clock();
        let fence = Fence::new(clock.clone(), LIMIT);
        fence.renewed(clock.since_boot());
        fence.close();
        fence.renewed(clock.since_boot());
        assert!(!fence.may_write());
    }

    #[test]
    fn a_broken_clock_closes_it() {
        let fence = Fence::new(Clock::system().with_boot(|| Duration::MAX), LIMIT);
        fence.renewed(Duration::MAX);
        assert!(!fence.may_write());
        fence.renewed(Duration::from_secs(5));
        assert!(!fence.may_write());
    }
}
