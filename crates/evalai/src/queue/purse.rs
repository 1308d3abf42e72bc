//! One budget for all queues of a namespace whose tokens name the same user: EvalAI counts by user, over all tokens.
//!
//! Owned by `hub`, and drawn on by each `queue` through a share of its own. Knows no token and no request.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::Duration;

use crate::budget::Budget;
use leaderboard_base::lock::lock;

/// See the module's text.
#[derive(Debug)]
pub struct Purse(Mutex<Inner>);

#[derive(Debug)]
struct Inner {
    budget: Budget,
    /// Requests a minute that each share may use; the smallest holds.
    limits: BTreeMap<u64, u32>,
    /// Time of the last share.
    last: u64,
}

/// The hand of one queue in the purse.
#[derive(Debug)]
pub struct Share {
    purse: Arc<Purse>,
    id: u64,
}

impl Purse {
    /// A purse that starts empty.
    pub fn new(limit: u32, now: Duration) -> Arc<Self> {
        Arc::new(Self(Mutex::new(Inner {
            budget: Budget::new(limit, now),
            limits: BTreeMap::new(),
            last: 0,
        })))
    }

    /// A share for one more queue.
    pub fn share(self: &Arc<Self>, limit: u32, now: Duration) -> Share {
        let id = {
            let mut inner = self.open();
            inner.last += 1;
            inner.last
        };
        let share = Share {
            purse: self.clone(),
            id,
        };
        share.set_limit(limit, now);
        share
    }

    /// Requests of the last minute, and those that are allowed within one.
    pub fn use_at(&self, now: Duration) -> (u32, u32) {
        let inner = self.open();
        (inner.budget.used(now), inner.budget.limit())
    }

    fn open(&self) -> MutexGuard<'_, Inner> {
        lock(&self.0)
    }
}

impl Share {
    /// Something of the budget.
    pub(super) fn budget<T>(&self, of: impl FnOnce(&mut Budget) -> T) -> T {
        of(&mut self.purse.open().budget)
    }

    /// Sets what this queue may use at most. The budget of all is the least of that.
    pub(super) fn set_limit(&self, limit: u32, now: Duration) {
        let mut inner = self.purse.open();
        inner.limits.insert(self.id, limit);
        inner.fit(now);
    }
}

impl Drop for Share {
    fn drop(&mut self) {
        let mut inner = self.purse.open();
        inner.limits.remove(&self.id);
        inner.fit(Duration::ZERO);
    }
}

impl Inner {
    fn fit(&mut self, now: Duration) {
        if let Some(limit) = self.limits.values().min() {
            self.budget.set_limit(*limit, now);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const NOW: Duration = Duration::from_mins(1);

    /// Two queues of one purse that has earned one request.
    fn two() -> (Share, Share) {
        let purse = Purse::new(60, Duration::from_secs(59));
        (purse.share(60, NOW), purse.share(60, NOW))
    }

    #[test]
    fn what_one_queue_spends_the_other_has_no_more() {
        let (one, other) = two();
        let ready = || other.budget(|budget| budget.ready_at(NOW, 1, 0));
        assert_eq!(ready(), NOW);
        one.budget(|budget| budget.take(NOW));
        assert_eq!(ready(), NOW + Duration::from_secs(1));
    }

    #[test]
    fn the_least_limit_holds_for_as_long_as_its_queue_is_there() {
        let (one, other) = two();
        other.set_limit(10, NOW);
        assert_eq!(one.budget(|budget| budget.limit()), 10);
        drop(other);
        assert_eq!(one.budget(|budget| budget.limit()), 60);
    }
}
