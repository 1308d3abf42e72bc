//! The fence: whether this process may write to EvalAI, DynamoDB and Kubernetes at this very moment.
//!
//! Written by the election alone, asked by every such write. Cheap, without a lock or a call. Counts by the boot clock,
//! which goes on while the process or the machine is paused: a leader that wakes up late finds its fence closed.

use std::fmt;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use nix::time::{ClockId, clock_gettime};
use tokio::time::Instant;

/// Marks a fence that was never opened.
const NEVER: u64 = u64::MAX;

/// A clock that never goes back and counts pauses.
#[derive(Clone)]
pub struct Clock(Arc<dyn Fn() -> Duration + Send + Sync>);

impl Clock {
    /// The kernel's boot clock.
    pub fn boot() -> Self {
        // The kernel has had it since 2.6.39. Should it fail all the same, every renewal counts as too old.
        Self::new(|| clock_gettime(ClockId::CLOCK_BOOTTIME).map_or(Duration::MAX, Duration::from))
    }

    /// Any other one, for tests.
    pub fn new(now: impl Fn() -> Duration + Send + Sync + 'static) -> Self {
        Self(Arc::new(now))
    }

    /// Time since some moment that stays the same for this clock.
    pub fn now(&self) -> Duration {
        (self.0)()
    }
}

impl fmt::Debug for Clock {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Clock").field(&self.now()).finish()
    }
}

/// Clones are the same fence.
#[derive(Clone, Debug)]
pub struct Fence(Arc<Inner>);

#[derive(Debug)]
struct Inner {
    clock: Clock,
    limit: Duration,
    /// Nanoseconds of the clock at which the last successful renewal was sent.
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
        self.0.clock.now().saturating_sub(Duration::from_nanos(renewed)) < self.0.limit
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

    /// A renewal that was sent at this time has succeeded.
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
        (
            seconds,
            Clock::new(move || Duration::from_secs(hand.load(Ordering::SeqCst))),
        )
    }

    #[test]
    fn it_opens_with_a_renewal_and_closes_when_the_clock_jumps_over_a_pause() {
        let (seconds, clock) = hand_clock();
        let fence = Fence::new(clock.clone(), LIMIT);
        assert!(!fence.may_write(), "no renewal yet");
        fence.renewed(clock.now());
        assert!(fence.may_write());
        seconds.fetch_add(9, Ordering::SeqCst);
        assert!(fence.may_write());
        seconds.fetch_add(1, Ordering::SeqCst);
        assert!(!fence.may_write(), "10 s are not less than 10 s");
        fence.renewed(clock.now());
        assert!(fence.clone().may_write());
    }

    #[test]
    fn a_closed_fence_stays_closed() {
        let (_, clock) = hand_clock();
        let fence = Fence::new(clock.clone(), LIMIT);
        fence.renewed(clock.now());
        fence.close();
        fence.renewed(clock.now());
        assert!(!fence.may_write());
    }

    #[test]
    fn a_broken_clock_closes_it() {
        let fence = Fence::new(Clock::new(|| Duration::MAX), LIMIT);
        fence.renewed(Duration::MAX);
        assert!(!fence.may_write());
        fence.renewed(Duration::from_secs(5));
        assert!(!fence.may_write());
    }

    #[test]
    fn the_boot_clock_goes_forward() {
        let clock = Clock::boot();
        let first = clock.now();
        assert!(first > Duration::ZERO && first < Duration::MAX && clock.now() >= first);
    }
}
