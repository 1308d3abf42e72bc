//! One budget for all queues of a namespace whose tokens name the same user: EvalAI counts by user, over all tokens.
//!
//! Owned by `hub`, and drawn on by each `queue` through a share of its own. Knows no token and no request. A queue that waits for the
//! budget leaves a claim, and what ranks after it in another queue takes no request of it: so two queues keep one order.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::Duration;

use jiff::Timestamp;

use super::choose::Priority;
use crate::lock::lock;
use crate::services::evalai::budget::Budget;

/// Less comes first.
pub(super) type Rank = (Priority, Option<Timestamp>, Duration);

/// See the module's text.
#[derive(Debug)]
pub struct Purse(Mutex<Inner>);

#[derive(Debug)]
struct Inner {
    budget: Budget,
    shares: BTreeMap<u64, Claim>,
    /// Of the last share.
    last: u64,
}

/// A share as the other queues see it.
#[derive(Debug)]
struct Claim {
    /// Requests a minute; the smallest of all shares holds.
    limit: u32,
    /// Requests that follow those on their way.
    reserved: u32,
    /// What waits first, and the requests that it needs.
    waits: Option<(Rank, u32)>,
}

/// The hand of one queue in the purse.
#[derive(Debug)]
pub struct Share {
    purse: Arc<Purse>,
    id: u64,
}

/// A request that one wants to pay for.
#[derive(Clone, Copy, Debug)]
pub(super) struct Price {
    pub rank: Rank,
    /// So many requests, with those that have to follow.
    pub count: u32,
    /// Requests of the minute that are left for what comes at any time.
    pub keep: u32,
    /// Whether what others have begun has to be paid for before.
    pub is_after_reserved: bool,
}

impl Purse {
    /// A purse that starts empty.
    pub fn new(limit: u32, now: Duration) -> Arc<Self> {
        Arc::new(Self(Mutex::new(Inner {
            budget: Budget::new(limit, now),
            shares: BTreeMap::new(),
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
        let claim = inner.shares.entry(self.id).or_insert(Claim {
            limit,
            reserved: 0,
            waits: None,
        });
        claim.limit = limit;
        inner.fit(now);
    }

    /// When a request may be made, if nothing that comes before it in any queue is made meanwhile.
    pub(super) fn ready_at(&self, price: Price, now: Duration) -> Duration {
        let inner = self.purse.open();
        let others = inner.shares.iter().filter(|(id, _)| **id != self.id);
        let ahead = others.map(|(_, claim)| {
            let waits = claim.waits.filter(|(rank, _)| *rank < price.rank);
            let reserved = if price.is_after_reserved { claim.reserved } else { 0 };
            waits.map_or(0, |(_, count)| count).saturating_add(reserved)
        });
        inner.budget.ready_behind(now, price.count, price.keep, ahead.sum())
    }

    /// Spends one request.
    pub(super) fn take(&self, now: Duration) {
        self.purse.open().budget.take(now);
    }

    /// Tells the other queues how many requests follow those on their way, and what waits first.
    pub(super) fn claim(&self, reserved: u32, waits: Option<(Rank, u32)>) {
        if let Some(claim) = self.purse.open().shares.get_mut(&self.id) {
            (claim.reserved, claim.waits) = (reserved, waits);
        }
    }
}

impl Drop for Share {
    fn drop(&mut self) {
        let mut inner = self.purse.open();
        inner.shares.remove(&self.id);
        inner.fit(Duration::ZERO);
    }
}

impl Inner {
    fn fit(&mut self, now: Duration) {
        if let Some(limit) = self.shares.values().map(|claim| claim.limit).min() {
            self.budget.set_limit(limit, now);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const NOW: Duration = Duration::from_mins(1);

    fn price(priority: Priority, count: u32) -> Price {
        Price {
            rank: (priority, None, NOW),
            count,
            keep: 0,
            is_after_reserved: true,
        }
    }

    /// Two queues of one purse that has earned one request.
    fn two() -> (Share, Share) {
        let purse = Purse::new(60, Duration::from_secs(59));
        (purse.share(60, NOW), purse.share(60, NOW))
    }

    #[test]
    fn what_one_queue_spends_the_other_has_no_more() {
        let (one, other) = two();
        assert_eq!(other.ready_at(price(Priority::Rest, 1), NOW), NOW);
        one.take(NOW);
        let next = other.ready_at(price(Priority::Rest, 1), NOW);
        assert_eq!(next, NOW + Duration::from_secs(1));
    }

    #[test]
    fn the_rest_of_one_queue_never_keeps_an_end_of_the_other_waiting() {
        let (one, other) = two();
        let end = price(Priority::End, 2);
        let ready = one.ready_at(end, NOW);
        assert_eq!(ready, NOW + Duration::from_secs(1));
        one.claim(0, Some((end.rank, end.count)));
        assert!(
            other.ready_at(price(Priority::Rest, 1), ready) > ready,
            "it would take one of the two"
        );
        assert_eq!(
            other.ready_at(price(Priority::Overdue, 1), NOW),
            NOW,
            "what ranks before"
        );
        one.claim(0, None);
        assert_eq!(other.ready_at(price(Priority::Rest, 1), NOW), NOW);
    }

    #[test]
    fn a_write_that_follows_a_read_is_paid_for_before_reads_of_another_queue() {
        let (one, other) = two();
        one.claim(1, None);
        assert!(other.ready_at(price(Priority::End, 1), NOW) > NOW);
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
