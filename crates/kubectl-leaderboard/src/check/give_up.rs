//! When a check has waited long enough for something that seldom resolves itself. Pure: the time is handed in.

use jiff::{SignedDuration, Timestamp};
use leaderboard_api::{Submission, SubmissionStatus, reasons};

/// How long a check waits for what only a person changes.
const STUCK: SignedDuration = SignedDuration::from_secs(60);
/// How long a check that has ended may take to ask the table.
const TABLE: SignedDuration = SignedDuration::from_secs(60);

/// What a check waits for, and since when.
#[derive(Clone, Debug)]
pub struct Patience {
    /// When the person has waited long enough for whatever it is.
    until: Timestamp,
    limit_seconds: i64,
    reason: Option<String>,
    since: Timestamp,
    /// When its run was first seen to have ended, by the clock of this machine.
    ended: Option<Timestamp>,
    /// It has ended, and the table has answered.
    is_over: bool,
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
            ended: None,
            is_over: false,
        }
    }

    /// Takes in what the check shows.
    pub fn observe(&mut self, submission: &Submission, now: Timestamp) {
        let status = submission.status.as_ref();
        let reason = status.and_then(|status| status.reason.as_deref());
        if reason != self.reason.as_deref() {
            (self.reason, self.since) = (reason.map(str::to_owned), now);
        }
        let has_ended = status.is_some_and(SubmissionStatus::has_ended);
        self.ended = has_ended.then(|| self.ended.unwrap_or(now));
        self.is_over = submission.check_end().is_some();
    }

    /// When there is something to decide, whatever the check shows until then.
    pub fn next(&self) -> Timestamp {
        let stuck = self.is_for_a_person().then(|| later(self.since, STUCK));
        let late = self.ended.map(|ended| later(ended, TABLE));
        [stuck, late].into_iter().flatten().fold(self.until, Timestamp::min)
    }

    /// Whether nothing more is to come: it has ended, and the table has answered, or does not in time.
    pub fn is_over(&self, now: Timestamp) -> bool {
        self.is_over || self.ended.is_some_and(|ended| now >= later(ended, TABLE))
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
        const LASTING: [&str; 5] = [
            reasons::LEADERBOARD_NOT_FOUND,
            reasons::LEADERBOARD_NOT_READY,
            reasons::TRACK_NOT_FOUND,
            reasons::NOT_ISOLATED,
            reasons::JOB_NAME_TAKEN,
        ];
        self.reason.as_deref().is_none_or(|reason| LASTING.contains(&reason))
    }
}

fn later(time: Timestamp, by: SignedDuration) -> Timestamp {
    time.checked_add(by).unwrap_or(Timestamp::MAX)
}
