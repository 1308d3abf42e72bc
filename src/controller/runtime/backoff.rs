//! How long an object that failed waits for its next pass: 1 s, doubled with each failure up to 5 minutes, jittered.
//!
//! Called by the wrapper round a pass. Keyed by UID, so that an object created again under the same name starts anew.
//! Knows no client and no clock.

use std::collections::HashMap;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use crate::backoff::Backoff;

/// Its pauses: half of one of these and more.
const RETRY: Backoff = Backoff::new(Duration::from_secs(1), Duration::from_mins(5));

/// Failures in a row of each object.
#[derive(Debug, Default)]
pub struct BackoffMap(Mutex<HashMap<String, u32>>);

impl BackoffMap {
    /// A pass has failed: the time until the next one.
    pub fn failed(&self, uid: &str) -> Duration {
        let mut map = self.lock();
        let failures = map.entry(uid.to_owned()).or_default();
        *failures = failures.saturating_add(1);
        RETRY.after(*failures)
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

#[cfg(test)]
mod tests {
    use super::*;

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
        assert!(map.failed("a") <= Duration::from_secs(1));
        assert_eq!(map.lock().len(), 1, "what is well or gone takes no memory");
    }
}
