//! The server's throttle: a sliding window per user over all endpoints, as Django REST framework keeps it.
//! Pure: the caller hands the time in.

use std::collections::{HashMap, VecDeque};
use std::time::Duration;

/// How long a request counts.
const WINDOW: Duration = Duration::from_mins(1);

/// The times of the last minute's requests, by key.
#[derive(Debug, Default)]
pub struct Throttle {
    history: HashMap<String, VecDeque<Duration>>,
}

impl Throttle {
    /// Lets a request of `key` at the time `now` (since any fixed moment) through, or hands back how many whole seconds it
    /// has to wait. A refused request does not count. `limit` 0 lets everything through.
    pub fn check(&mut self, key: &str, limit: usize, now: Duration) -> Result<(), u64> {
        if limit == 0 {
            return Ok(());
        }
        let history = self.history.entry(key.to_owned()).or_default();
        while history.front().is_some_and(|at| *at + WINDOW <= now) {
            history.pop_front();
        }
        let oldest = history.front().copied().unwrap_or(now);
        if history.len() < limit {
            history.push_back(now);
            return Ok(());
        }
        Err(seconds_up((oldest + WINDOW).saturating_sub(now)))
    }

    /// Forgets all requests.
    pub fn clear(&mut self) {
        self.history.clear();
    }
}

fn seconds_up(wait: Duration) -> u64 {
    wait.as_secs() + u64::from(wait.subsec_nanos() > 0)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(millis: u64) -> Duration {
        Duration::from_millis(1_000_000 + millis)
    }

    #[test]
    fn exactly_sixty_pass_in_any_minute() {
        let mut throttle = Throttle::default();
        for index in 0..60 {
            assert_eq!(throttle.check("host", 60, at(index * 60)), Ok(()), "request {index}");
        }
        assert_eq!(throttle.check("host", 60, at(4_000)), Err(56));
        assert_eq!(throttle.check("other", 60, at(4_000)), Ok(()));
        assert_eq!(throttle.check("host", 60, at(59_999)), Err(1));
        assert_eq!(
            throttle.check("host", 60, at(60_000)),
            Ok(()),
            "the first request has left the window"
        );
        assert_eq!(
            throttle.check("host", 60, at(60_001)),
            Err(1),
            "one place, and it is taken"
        );
    }

    #[test]
    fn refused_requests_do_not_count_and_zero_is_no_limit() {
        let mut throttle = Throttle::default();
        assert_eq!(throttle.check("a", 1, at(0)), Ok(()));
        for _ in 0..100 {
            assert_eq!(throttle.check("a", 1, at(1)), Err(60));
        }
        assert_eq!(throttle.check("a", 1, at(60_000)), Ok(()));
        assert_eq!(throttle.check("a", 0, at(60_000)), Ok(()));
    }
}
