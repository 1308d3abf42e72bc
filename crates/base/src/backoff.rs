//! Pauses before retries: doubled with each failure in a row up to a limit, and jittered. Used by every part that retries.

use std::time::Duration;

/// How the pauses of one kind of retry grow.
#[derive(Clone, Copy, Debug)]
pub struct Backoff {
    first: Duration,
    longest: Duration,
}

impl Backoff {
    /// From `first`, after one failure, to `longest`.
    pub const fn new(first: Duration, longest: Duration) -> Self {
        Self { first, longest }
    }

    /// The longest pause after so many failures in a row, for callers without a random number.
    pub fn bound(&self, failures: u32) -> Duration {
        let doublings = failures.saturating_sub(1).min(16);
        self.first.saturating_mul(1 << doublings).min(self.longest)
    }

    /// The pause after so many failures in a row: between half of the bound and all of it, since many that retry at the same
    /// moment would fail again.
    pub fn after(&self, failures: u32) -> Duration {
        self.drawn(failures, fastrand::f64())
    }

    fn drawn(&self, failures: u32, random: f64) -> Duration {
        self.bound(failures).mul_f64(0.5 + random / 2.0)
    }
}

/// A period that differs from `period` by up to `share` of it, so that periods of many do not coincide.
pub fn jittered(period: Duration, share: f64) -> Duration {
    period.mul_f64(1.0 - share + 2.0 * share * fastrand::f64())
}

#[cfg(test)]
mod tests {
    use super::*;

    const MINUTE: Duration = Duration::from_mins(1);

    #[test]
    fn pauses_double_up_to_the_longest() {
        let backoff = Backoff::new(Duration::from_secs(1), MINUTE);
        let seconds: Vec<u64> = [0, 1, 2, 3, 6, 7, 40, u32::MAX]
            .map(|n| backoff.bound(n).as_secs())
            .into();
        assert_eq!(seconds, [1, 1, 2, 4, 32, 60, 60, 60]);
    }

    #[test]
    fn the_jitter_is_between_half_of_the_pause_and_all_of_it() {
        let backoff = Backoff::new(Duration::from_secs(1), MINUTE);
        assert_eq!(backoff.drawn(2, 0.0), Duration::from_secs(1));
        assert_eq!(backoff.drawn(2, 1.0), Duration::from_secs(2));
        for failures in 1..20 {
            let pause = backoff.after(failures);
            assert!(backoff.bound(failures) / 2 <= pause && pause <= backoff.bound(failures));
        }
    }

    #[test]
    fn a_jittered_period_stays_within_its_share() {
        for _ in 0..100 {
            let period = jittered(MINUTE, 0.2);
            assert!(
                Duration::from_secs(48) <= period && period <= Duration::from_secs(72),
                "{period:?}"
            );
        }
    }
}
