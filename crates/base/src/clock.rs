//! The time of a process. Each replica is handed a [`Clock`] of its own, so that a test can let one run ahead of another.
//!
//! Waits and ages within a process count by tokio's clock, which all replicas of a test share; no wait goes through here.

use std::fmt;
use std::sync::Arc;
use std::time::Duration;

use jiff::Timestamp;
use nix::time::{ClockId, clock_gettime};

type Read<T> = Arc<dyn Fn() -> T + Send + Sync>;

/// Wall time and boot time. Clones are the same clock.
#[derive(Clone)]
pub struct Clock {
    wall: Read<Timestamp>,
    boot: Read<Duration>,
}

impl Clock {
    /// The kernel's clocks.
    #[allow(clippy::disallowed_methods, reason = "everything else asks the clock")]
    pub fn system() -> Self {
        // The kernel has had it since 2.6.39. Should it fail all the same, whatever was noted by it counts as too old.
        let boot = || clock_gettime(ClockId::CLOCK_BOOTTIME).map_or(Duration::MAX, Duration::from);
        Self {
            wall: Arc::new(Timestamp::now),
            boot: Arc::new(boot),
        }
    }

    /// Wall time, which other machines and people share, and which may jump.
    pub fn now(&self) -> Timestamp {
        (self.wall)()
    }

    /// Time since some moment that stays the same for this clock. It never goes back, and counts pauses of process and machine.
    pub fn since_boot(&self) -> Duration {
        (self.boot)()
    }
}

#[cfg(any(test, feature = "fixtures"))]
impl Clock {
    /// This clock with another wall time.
    #[must_use]
    pub fn with_wall(self, now: impl Fn() -> Timestamp + Send + Sync + 'static) -> Self {
        let wall = Arc::new(now);
        Self { wall, ..self }
    }

    /// This clock with another boot time.
    #[must_use]
    pub fn with_boot(self, since_boot: impl Fn() -> Duration + Send + Sync + 'static) -> Self {
        let boot = Arc::new(since_boot);
        Self { boot, ..self }
    }

    /// This clock with its wall time ahead by `by`, or behind if `by` is negative.
    #[must_use]
    pub fn ahead(self, by: jiff::SignedDuration) -> Self {
        let wall = Arc::clone(&self.wall);
        self.with_wall(move || wall() + by)
    }
}

impl fmt::Debug for Clock {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (wall, boot) = (self.now(), self.since_boot());
        f.debug_struct("Clock")
            .field("wall", &wall)
            .field("boot", &boot)
            .finish()
    }
}

#[cfg(test)]
mod tests {
    use jiff::SignedDuration;

    use super::*;

    #[test]
    fn the_boot_time_goes_forward() {
        let clock = Clock::system();
        let first = clock.since_boot();
        assert!(first > Duration::ZERO && first < Duration::MAX && clock.since_boot() >= first);
    }

    #[test]
    fn a_clock_that_is_ahead_differs_in_its_wall_time_alone() {
        let (at, hour) = (Timestamp::UNIX_EPOCH, SignedDuration::from_hours(1));
        let clock = Clock::system()
            .with_wall(move || at)
            .with_boot(|| Duration::from_secs(5));
        let ahead = clock.clone().ahead(hour);
        assert_eq!((clock.now(), ahead.now()), (at, at + hour));
        assert_eq!(ahead.clone().ahead(-hour).now(), at);
        assert_eq!(ahead.since_boot(), clock.since_boot());
    }
}
