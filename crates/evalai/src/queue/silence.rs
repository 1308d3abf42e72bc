//! Since when the server has not answered, whatever it was asked.
//!
//! Owned by `queue`. Pure.

use std::time::Duration;

use jiff::Timestamp;

use super::{Now, Queue};
use crate::answer::Answer;

/// So long without an answer is worth a word: a server that is restarted is back before.
const SHOWN_AFTER: Duration = Duration::from_mins(1);

/// The first request of several that had no answer, or an error of the server's own.
#[derive(Debug)]
pub(super) struct Silent {
    since: Now,
    why: String,
    is_shown: bool,
}

impl Queue {
    /// Notes what each answer shows about the server.
    pub(super) fn note_silence(&mut self, answer: &Answer<()>, now: &Now) {
        let why = match answer {
            Answer::Unanswered(silence) => &silence.why,
            Answer::Broken(why) => why,
            Answer::Done(()) | Answer::Refused(_) | Answer::Throttled(_) => {
                if self.silent.take().is_some_and(|silent| silent.is_shown) {
                    self.wake_leaderboards(|_| true);
                }
                return;
            }
        };
        let silent = self.silent.get_or_insert_with(|| Silent {
            since: *now,
            why: why.clone(),
            is_shown: false,
        });
        let is_long = now.at.saturating_sub(silent.since.at) >= SHOWN_AFTER;
        if is_long && !std::mem::replace(&mut silent.is_shown, is_long) {
            self.wake_leaderboards(|_| true);
        }
    }

    /// Since when the server has not answered, and what the first request found; none if that is not long.
    pub fn silence(&self) -> Option<(Timestamp, &str)> {
        let silent = self.silent.as_ref().filter(|silent| silent.is_shown)?;
        Some((silent.since.wall, &silent.why))
    }
}
