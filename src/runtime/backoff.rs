//! How long an object that failed waits for its next reconcile: 1 s, doubled with each failure up to 5 minutes, jittered.
//!
//! Called by the wrapper of a reconcile. Keyed by UID, so that an object created again under the same name starts anew.
//! Knows no client and no clock.

use std::collections::HashMap;
use std::sync::Mutex;
use std::time::Duration;

use leaderboard_base::backoff::Backoff;
use leaderboard_base::lock::lock;

/// Its pauses: half of one of these and more.
const RETRY: Backoff = Backoff::new(Duration::from_secs(1), Duration::from_mins(5));

/// Failures in a row of each object.
#[derive(Debug, Default)]
pub struct BackoffMap(Mutex<HashMap<String, u32>>);

impl BackoffMap {
    /// A reconcile has failed: the time until the next one.
    pub fn failed(&self, uid: &str) -> Duration {
        let mut map = lock(&self.0);
        let failures = map.entry(uid.to_owned()).or_default();
        *failures = failures.saturating_add(1);
        RETRY.after(*failures)
    }

    /// A reconcile has succeeded, so that the next failure counts as the first; or the object is gone.
    pub fn forget(&self, uid: &str) {
        lock(&self.0).remove(uid);
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
        let known = HashMap::from([("a".to_owned(), 3), ("b".to_owned(), 1)]);
        assert_eq!(*lock(&map.0), known);
        map.forget("a");
        map.forget("b");
        assert!(lock(&map.0).is_empty(), "what is well or gone takes no memory");
        assert!(map.failed("a") <= Duration::from_secs(1));
    }
}
