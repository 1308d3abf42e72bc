//! How many requests a token may make: at most `limit` in any 60 s, a small burst, nothing at the start.
//!
//! Called by `queue` before each request. Pure: the time is handed in, as the time since any fixed moment.

use std::collections::VecDeque;
use std::time::Duration;

/// The server counts over this time.
pub const WINDOW: Duration = Duration::from_mins(1);

/// Two rules at once: credit that grows by one request each `60 s / limit` up to a burst, and a record of the last 60 s.
/// The first spreads the requests, the second is the promise.
#[derive(Debug, Clone)]
pub struct Budget {
    limit: u32,
    /// Unspent time, worth one request each [`Budget::interval`].
    credit: Duration,
    /// When `credit` was last brought up to date.
    at: Duration,
    sent: VecDeque<Duration>,
    closed_until: Duration,
}

impl Budget {
    /// A budget that starts empty: what an earlier holder of the token has just spent is not known.
    pub fn new(limit: u32, now: Duration) -> Self {
        Self {
            limit: limit.max(1),
            credit: Duration::ZERO,
            at: now,
            sent: VecDeque::new(),
            closed_until: Duration::ZERO,
        }
    }

    /// Time that one request is worth.
    pub fn interval(&self) -> Duration {
        WINDOW / self.limit
    }

    /// Requests that may be made at once after a rest.
    pub fn burst(&self) -> u32 {
        (self.limit / 6).max(3).min(self.limit)
    }

    /// Requests of a minute that are kept for lists of cancelled submissions: after a burst nothing else is left for ten
    /// seconds in each minute.
    pub fn kept(&self) -> u32 {
        self.limit / 18
    }

    /// Requests in any 60 s.
    pub fn limit(&self) -> u32 {
        self.limit
    }

    /// Changes the limit from now on.
    pub fn set_limit(&mut self, limit: u32, now: Duration) {
        self.earn(now);
        self.limit = limit.max(1);
        self.credit = self.credit.min(self.interval() * self.burst());
    }

    /// When `count` requests may be made, one after the other, if nothing else is, and `keep` more of the minute's are left. More than a burst
    /// has to wait until there are fewer.
    pub fn ready_at(&self, now: Duration, count: u32, keep: u32) -> Duration {
        let credit = self.credit_at(now);
        let earned = now + (self.interval().saturating_mul(count)).saturating_sub(credit);
        let recent = self.sent.iter().filter(|at| **at + WINDOW > now);
        let wanted = recent.clone().count() + count as usize + keep as usize;
        let excess = wanted.saturating_sub(self.limit as usize);
        let room = match excess {
            0 => now,
            excess => recent.clone().nth(excess - 1).map_or(now, |at| *at + WINDOW),
        };
        earned.max(room).max(self.closed_until)
    }

    /// Spends one request.
    pub fn take(&mut self, now: Duration) {
        self.earn(now);
        self.credit = self.credit.saturating_sub(self.interval());
        while self.sent.front().is_some_and(|at| *at + WINDOW <= now) {
            self.sent.pop_front();
        }
        self.sent.push_back(now);
    }

    /// The server asked for silence.
    pub fn close_until(&mut self, until: Duration) {
        self.closed_until = self.closed_until.max(until);
    }

    /// Requests of the last 60 s.
    pub fn used(&self, now: Duration) -> u32 {
        let recent = self.sent.iter().filter(|at| **at + WINDOW > now).count();
        u32::try_from(recent).unwrap_or(u32::MAX)
    }

    fn credit_at(&self, now: Duration) -> Duration {
        (self.credit + now.saturating_sub(self.at)).min(self.interval() * self.burst())
    }

    fn earn(&mut self, now: Duration) {
        self.credit = self.credit_at(now);
        self.at = self.at.max(now);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn seconds(value: f64) -> Duration {
        Duration::from_secs_f64(value)
    }

    #[test]
    fn it_starts_empty_and_earns_a_burst() {
        let start = seconds(100.0);
        let mut budget = Budget::new(54, start);
        assert_eq!(budget.ready_at(start, 1, 0), start + budget.interval());
        let later = start + seconds(60.0);
        for _ in 0..9 {
            assert_eq!(budget.ready_at(later, 1, 0), later);
            budget.take(later);
        }
        assert_eq!(budget.ready_at(later, 1, 0), later + budget.interval());
        assert_eq!((budget.used(later), budget.limit()), (9, 54));
        assert_eq!(budget.used(later + WINDOW), 0);
    }

    #[test]
    fn silence_is_kept_as_long_as_asked() {
        let mut budget = Budget::new(54, Duration::ZERO);
        budget.close_until(seconds(200.0));
        budget.close_until(seconds(150.0));
        assert_eq!(budget.ready_at(seconds(100.0), 1, 0), seconds(200.0));
        assert_eq!(budget.ready_at(seconds(201.0), 1, 0), seconds(201.0));
    }

    #[test]
    fn a_small_budget_still_has_room_for_a_read_and_a_write() {
        let budget = Budget::new(6, Duration::ZERO);
        assert_eq!(budget.burst(), 3);
        assert_eq!(budget.ready_at(seconds(60.0), 3, 0), seconds(60.0));
    }

    #[test]
    fn a_lower_limit_holds_at_once() {
        let mut budget = Budget::new(6000, Duration::ZERO);
        for _ in 0..20 {
            budget.take(seconds(10.0));
        }
        budget.set_limit(12, seconds(10.0));
        assert_eq!(budget.ready_at(seconds(11.0), 1, 0), seconds(70.0));
    }

    proptest! {
        #[test]
        fn never_more_than_the_limit_in_any_minute(limit in 1_u32..120, waits in prop::collection::vec(0_u64..4_000, 1..600)) {
            let mut budget = Budget::new(limit, Duration::ZERO);
            let mut now = Duration::ZERO;
            let mut sent: Vec<Duration> = Vec::new();
            for wait in waits {
                // Mostly greedy: a long pause now and then earns the burst.
                now += if wait > 3_990 { seconds(90.0) } else if wait > 2_000 { Duration::from_millis(wait) } else { Duration::ZERO };
                now = budget.ready_at(now, 1, 0);
                budget.take(now);
                sent.push(now);
            }
            for (index, at) in sent.iter().enumerate() {
                let within = sent[..=index].iter().filter(|other| **other + WINDOW > *at).count();
                prop_assert!(within <= limit as usize, "{within} requests within 60 s, limit {limit}");
            }
        }

        #[test]
        fn a_steady_load_gets_the_whole_limit(limit in 6_u32..120) {
            let mut budget = Budget::new(limit, Duration::ZERO);
            let mut now = Duration::ZERO;
            let mut count = 0;
            while now < seconds(600.0) {
                now = budget.ready_at(now, 1, 0);
                budget.take(now);
                count += 1;
            }
            prop_assert!(count >= limit * 10 - 1, "{count} requests in ten minutes, limit {limit}");
        }
    }
}
