//! How long an object that failed waits for its next pass: 1 s, doubled with each failure up to 5 minutes, jittered.
//!
//! Called by the wrapper round a pass. Keyed by UID, so that an object created again under the same name starts anew.
//! Knows no client and no clock.

use std::collections::HashMap;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

/// Bound of the wait after the first failure.
const FIRST: Duration = Duration::from_secs(1);
/// Bound of any wait.
const LONGEST: Duration = Duration::from_mins(5);
/// No wait is shorter: full jitter may draw nearly nothing, and many objects that do so at once are a storm.
const SHORTEST: Duration = Duration::from_millis(100);

/// Failures in a row of each object.
#[derive(Debug, Default)]
pub struct BackoffMap(Mutex<HashMap<String, u32>>);

impl BackoffMap {
    /// A pass has failed: the time until the next one.
    pub fn failed(&self, uid: &str) -> Duration {
        let mut map = self.lock();
        let failures = map.entry(uid.to_owned()).or_default();
        *failures = failures.saturating_add(1);
        delay(*failures, fastrand::f64())
    }

    /// A pass has succeeded: the next failure counts as the first.
    pub fn succeeded(&self, uid: &str) {
        self.lock().remove(uid);
    }

    /// The object is gone.
    pub fn dropped(&self, uid: &str) {
        self.lock().remove(uid);
    }

    /// Failures in a row, 0 for an object that is well.
    pub fn failures(&self, uid: &str) -> u32 {
        self.lock().get(uid).copied().unwrap_or(0)
    }

    fn lock(&self) -> MutexGuard<'_, HashMap<String, u32>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The wait after so many failures in a row; `random` is drawn evenly from 0 to 1.
fn delay(failures: u32, random: f64) -> Duration {
    let doublings = failures.saturating_sub(1).min(16);
    let bound = (FIRST * (1 << doublings)).min(LONGEST);
    bound.mul_f64(random.clamp(0.0, 1.0)).max(SHORTEST)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_bound_doubles_from_one_second_to_five_minutes() {
        let bounds: Vec<_> = (1..=11).map(|failures| delay(failures, 1.0).as_secs()).collect();
        assert_eq!(bounds, [1, 2, 4, 8, 16, 32, 64, 128, 256, 300, 300]);
        assert_eq!(delay(u32::MAX, 1.0), LONGEST);
        assert_eq!(delay(0, 1.0), FIRST);
    }

    #[test]
    fn the_jitter_is_full_and_never_nothing() {
        assert_eq!(delay(5, 0.5), Duration::from_secs(8));
        assert_eq!(delay(10, 0.0), SHORTEST);
        assert_eq!(delay(10, f64::from(u8::MAX)), LONGEST);
    }

    #[test]
    fn each_object_has_its_own_row_which_success_and_deletion_end() {
        let map = BackoffMap::default();
        for _ in 0..3 {
            assert!(map.failed("a") <= Duration::from_secs(4));
        }
        map.failed("b");
        assert_eq!((map.failures("a"), map.failures("b"), map.failures("c")), (3, 1, 0));
        map.succeeded("a");
        map.dropped("b");
        assert_eq!((map.failures("a"), map.failures("b")), (0, 0));
        assert!(map.failed("a") <= FIRST);
        assert_eq!(map.lock().len(), 1, "what is well or gone takes no memory");
    }
}
