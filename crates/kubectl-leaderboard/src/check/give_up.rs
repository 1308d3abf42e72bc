//! When a check has waited long enough for something that seldom resolves itself. Pure: the time is handed in.

use jiff::{SignedDuration, Timestamp};
use leaderboard_api::{Submission, reasons};

/// How long a check waits for what only a person changes.
const STUCK: SignedDuration = SignedDuration::from_secs(60);

/// What a check waits for, and since when.
#[derive(Clone, Debug)]
pub struct Patience {
    /// When the person has waited long enough for whatever it is.
    until: Timestamp,
    limit_seconds: i64,
    reason: Option<String>,
    since: Timestamp,
}

impl Patience {
    /// Patience of so many seconds from now on.
    pub fn new(now: Timestamp, limit_seconds: i64) -> Self {
        let limit = SignedDuration::from_secs(limit_seconds);
        Self {
            until: now.checked_add(limit).unwrap_or(Timestamp::MAX),
            limit_seconds,
            reason: None,
            since: now,
        }
    }

    /// Takes in what the check shows.
    pub fn observe(&mut self, submission: &Submission, now: Timestamp) {
        let status = submission.status.as_ref();
        let reason = status.and_then(|status| status.reason.as_deref());
        if reason != self.reason.as_deref() {
            (self.reason, self.since) = (reason.map(str::to_owned), now);
        }
    }

    /// When there is something to decide, whatever the check shows until then.
    pub fn next(&self) -> Timestamp {
        if self.is_for_a_person() {
            self.until.min(self.since.checked_add(STUCK).unwrap_or(Timestamp::MAX))
        } else {
            self.until
        }
    }

    /// Why it is given up; none as long as waiting may help.
    pub fn given_up(&self, now: Timestamp) -> Option<String> {
        if now >= self.until {
            return Some(format!(
                "The check did not end within {} s (--timeout).",
                self.limit_seconds
            ));
        }
        let is_stuck = self.is_for_a_person() && now.duration_since(self.since) >= STUCK;
        is_stuck.then(|| match &self.reason {
            None => format!(
                "The operator has not processed the check for {} s. Check that it runs and serves this namespace.",
                STUCK.as_secs()
            ),
            Some(_) => format!("Nothing has changed for {} s.", STUCK.as_secs()),
        })
    }

    fn is_for_a_person(&self) -> bool {
        const LASTING: [&str; 6] = [
            reasons::LEADERBOARD_NOT_FOUND,
            reasons::LEADERBOARD_NOT_READY,
            reasons::TRACK_NOT_FOUND,
            reasons::NOT_ISOLATED,
            reasons::NAME_NOT_RESOLVED,
            reasons::JOB_NAME_TAKEN,
        ];
        self.reason.as_deref().is_none_or(|reason| LASTING.contains(&reason))
    }
}
