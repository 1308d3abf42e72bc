//! How old the messages of a queue are that were received and are not deleted yet. Pure.
//!
//! SQS shows the age of a queue's oldest message in CloudWatch alone, but each message with the time at which it was sent. A message that
//! could not be used comes back. One that does not come back in time was taken by another replica, or deleted by a person, and counts no
//! longer.

use std::collections::HashMap;

use tokio::time::Instant;

/// More messages than these are not remembered: the oldest of so many shows enough.
const MOST: usize = 10_000;

/// The messages of one queue.
#[derive(Debug, Default)]
pub struct Ages(HashMap<String, KnownMessage>);

#[derive(Debug)]
struct KnownMessage {
    sent_ms: i64,
    /// By then it has come back, if it is still there.
    until: Instant,
}

impl Ages {
    /// A message is there, in hand or back in its queue, and is seen again before `until`.
    pub fn keep(&mut self, id: &str, sent_ms: i64, until: Instant) {
        if let Some(seen) = self.0.get_mut(id) {
            seen.until = until;
        } else if self.0.len() < MOST {
            self.0.insert(id.to_owned(), KnownMessage { sent_ms, until });
        }
    }

    /// It is deleted, or another reader's.
    pub fn forget(&mut self, id: &str) {
        self.0.remove(id);
    }

    /// Forgets what has not come back in time.
    pub fn expire(&mut self, now: Instant) {
        self.0.retain(|_, seen| seen.until > now);
    }

    /// When the oldest was sent, in milliseconds since 1970.
    pub fn oldest_ms(&self) -> Option<i64> {
        self.0.values().map(|seen| seen.sent_ms).min()
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    const MINUTE: Duration = Duration::from_mins(1);

    #[test]
    fn the_oldest_counts_until_it_is_deleted() {
        let (mut ages, soon) = (Ages::default(), Instant::now() + MINUTE);
        assert_eq!(ages.oldest_ms(), None);
        for (id, sent) in [("b", 200), ("a", 100), ("c", 300)] {
            ages.keep(id, sent, soon);
        }
        assert_eq!(ages.oldest_ms(), Some(100));
        ages.forget("a");
        assert_eq!(ages.oldest_ms(), Some(200));
        ages.forget("b");
        ages.forget("c");
        assert_eq!(ages.oldest_ms(), None);
    }

    #[test]
    fn one_that_does_not_come_back_in_time_counts_no_longer() {
        let (mut ages, now) = (Ages::default(), Instant::now());
        ages.keep("a", 100, now + MINUTE);
        ages.keep("b", 200, now + 2 * MINUTE);
        ages.expire(now + MINUTE / 2);
        assert_eq!(ages.oldest_ms(), Some(100));
        // It was received again.
        ages.keep("a", 100, now + 3 * MINUTE);
        ages.expire(now + 2 * MINUTE);
        assert_eq!(ages.oldest_ms(), Some(100));
        ages.expire(now + 3 * MINUTE);
        assert_eq!(ages.oldest_ms(), None);
    }

    #[test]
    fn no_more_than_so_many_are_remembered() {
        let (mut ages, soon) = (Ages::default(), Instant::now() + MINUTE);
        for number in 0..=MOST {
            ages.keep(&number.to_string(), 0, soon);
        }
        assert_eq!(ages.0.len(), MOST);
    }
}
