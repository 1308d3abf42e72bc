//! Requests and bytes sent to a service on a day, by purse: they cost money, and have a bound for each day. Pure.
//!
//! Used for S3 (`upload`) and CloudWatch (`ship`), which note it next to the files, so that a restart does not begin anew.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use leaderboard_base::clock::Clock;

/// Seconds of a day.
const DAY: u64 = 24 * 60 * 60;

/// Requests and bytes.
#[derive(Serialize, Deserialize, Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Spent {
    /// Requests.
    pub requests: u64,
    /// Bytes that are sent, without headers.
    pub bytes: u64,
}

impl Spent {
    /// An allowance without a bound.
    pub const ENDLESS: Self = Self {
        requests: u64::MAX,
        bytes: u64::MAX,
    };

    /// Both together.
    #[must_use]
    pub fn plus(self, more: Self) -> Self {
        Self {
            requests: self.requests.saturating_add(more.requests),
            bytes: self.bytes.saturating_add(more.bytes),
        }
    }

    /// True if neither is more than what is allowed.
    pub fn fits(self, allowed: Self) -> bool {
        self.requests <= allowed.requests && self.bytes <= allowed.bytes
    }
}

/// Requests and bytes of one day.
#[derive(Serialize, Deserialize, Clone, Debug, Default, PartialEq, Eq)]
pub struct Daily {
    day: u64,
    spent: BTreeMap<String, Spent>,
}

impl Daily {
    /// Begins anew on another day.
    pub fn begin(&mut self, day: u64) {
        if self.day != day {
            *self = Self {
                day,
                spent: BTreeMap::new(),
            };
        }
    }

    /// Requests and bytes of a purse.
    pub fn of(&self, purse: &str) -> Spent {
        self.spent.get(purse).copied().unwrap_or_default()
    }

    /// Notes what is spent.
    pub fn add(&mut self, purse: &str, more: Spent) {
        let spent = self.of(purse).plus(more);
        self.spent.insert(purse.to_owned(), spent);
    }
}

/// The day in UTC, counted from 1970.
pub fn today() -> u64 {
    let seconds = u64::try_from(Clock::system().now().as_second()).unwrap_or_default();
    seconds.checked_div(DAY).unwrap_or(0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_purse_is_full_again_on_another_day() {
        let allowed = Spent { requests: 2, bytes: 10 };
        let one = Spent { requests: 1, bytes: 5 };
        let mut daily = Daily::default();
        daily.begin(7);
        daily.add("a", one);
        daily.add("a", one);
        assert!(daily.of("a").fits(allowed) && !daily.of("a").plus(one).fits(allowed));
        assert_eq!(daily.of("b"), Spent::default());
        daily.begin(7);
        assert_eq!(daily.of("a"), one.plus(one));
        daily.begin(8);
        assert_eq!(daily.of("a"), Spent::default());
        assert!(today() > 20_000, "days since 1970");
    }
}
