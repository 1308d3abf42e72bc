//! What waits for EvalAI, and when the last of it is expected there.
//!
//! Owned by `queue`. Pure.

use std::time::Duration;

use jiff::{SignedDuration, Timestamp};

use super::{Now, Queue};
use crate::services::evalai::budget::WINDOW;
use crate::services::evalai::types::Usage;

/// A read, and the write that follows it.
const REQUESTS_OF_AN_END: u32 = 2;
/// The moment is given to the minute: what shifts it by less is no news.
const STEP: i64 = 60;

impl Queue {
    /// Requests of the last minute, and the ends that wait for one.
    pub fn usage(&self, now: Now) -> Usage {
        let waiting = self.subs.values().filter(|sub| sub.has_end_to_publish()).count();
        Usage {
            used: self.share.budget(|budget| budget.used(now.at)),
            limit: self.share.budget(|budget| budget.limit()),
            waiting,
            last_expected: (waiting > 0).then(|| next_step(now.wall, self.time_for(waiting, &now))),
        }
    }

    /// How long so many ends take. Only the lists of cancelled submissions come in between for long.
    fn time_for(&self, ends: usize, now: &Now) -> Duration {
        let requests = u32::try_from(ends)
            .unwrap_or(u32::MAX)
            .saturating_mul(REQUESTS_OF_AN_END);
        let (limit, kept, ready) =
            (self.share).budget(|budget| (budget.limit(), budget.kept(), budget.ready_at(now.at, 1)));
        let others = self.lists_a_minute().saturating_add(kept);
        let free = limit.saturating_sub(others).max(limit / 2).max(1);
        let token = self.token_refused.as_ref().map_or(now.at, |(_, until)| *until);
        let begin = ready.max(self.not_before).max(token);
        begin.saturating_sub(now.at) + WINDOW.saturating_mul(requests) / free
    }

    fn lists_a_minute(&self) -> u32 {
        let live = |id: i64| self.subs.values().any(|sub| sub.challenge == id && sub.live.is_some());
        let periods = self.challenges.iter().filter(|(id, _)| live(**id));
        let lists: u128 = periods
            .map(|(_, challenge)| WINDOW.as_millis() / challenge.period.as_millis().max(1))
            .sum();
        u32::try_from(lists).unwrap_or(u32::MAX)
    }
}

fn next_step(now: Timestamp, after: Duration) -> Timestamp {
    let after = SignedDuration::try_from(after).unwrap_or(SignedDuration::MAX);
    let at = now.checked_add(after).unwrap_or(Timestamp::MAX).as_second();
    let next = at.saturating_add(STEP - at.rem_euclid(STEP));
    Timestamp::from_second(next).unwrap_or(Timestamp::MAX)
}
