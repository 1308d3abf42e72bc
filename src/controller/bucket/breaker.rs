//! Whether a bucket is asked at all: not while it is known to hang, but for one call from time to time.
//!
//! One for each bucket, owned by `bucket`. Pure: knows no client, and no clock but the times handed in. Only silence opens it;
//! a refusal is an answer like any other.

use std::time::Duration;

use tokio::time::Instant;

/// How long a bucket that was silent once is left alone; doubles with each silence that follows.
const FIRST_PAUSE: Duration = Duration::from_secs(5);
/// Longest pause: results that wait for a bucket are taken up this soon after it is back.
const LONGEST_PAUSE: Duration = Duration::from_secs(30);
/// How long an old call may still come back after the bucket was found well.
const AFTERMATH: Duration = Duration::from_mins(2);
/// A bucket that nobody has asked for so long is forgotten.
const FORGOTTEN: Duration = Duration::from_mins(10);

/// What is known of one bucket.
#[derive(Clone, Debug)]
pub(super) struct Breaker {
    state: State,
    /// When it was last found well after a silence.
    closed: Option<Instant>,
    asked: Instant,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    /// It is asked.
    Closed,
    /// It is not asked before.
    Open { silences: u32, probe_at: Instant },
    /// One call finds out whether it answers.
    HalfOpen { silences: u32 },
}

/// The right to ask once.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Permit {
    asked: Instant,
    is_probe: bool,
}

/// What an operator is told of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Change {
    Opened,
    Closed,
}

impl Permit {
    /// For a bucket that nothing is known of.
    pub(super) fn free(now: Instant) -> Self {
        Self {
            asked: now,
            is_probe: false,
        }
    }
}

impl Breaker {
    pub(super) fn new(now: Instant) -> Self {
        Self {
            state: State::Closed,
            closed: None,
            asked: now,
        }
    }

    /// None: the bucket does not answer, and is not asked.
    pub(super) fn ask(&mut self, now: Instant) -> Option<Permit> {
        self.asked = now;
        match self.state {
            State::Closed => Some(Permit::free(now)),
            State::Open { silences, probe_at } if now >= probe_at => {
                self.state = State::HalfOpen { silences };
                Some(Permit {
                    asked: now,
                    is_probe: true,
                })
            }
            State::Open { .. } | State::HalfOpen { .. } => None,
        }
    }

    /// Whether it is known to hang.
    pub(super) fn is_open(&self) -> bool {
        self.state != State::Closed
    }

    /// A call was answered, whatever the answer says.
    pub(super) fn answered(&mut self, now: Instant) -> Option<Change> {
        if self.state == State::Closed {
            return None;
        }
        self.state = State::Closed;
        self.closed = Some(now);
        Some(Change::Closed)
    }

    /// A call was not answered in time.
    pub(super) fn silent(&mut self, permit: Permit, now: Instant) -> Option<Change> {
        if self.is_of_the_past(permit) {
            return None;
        }
        match self.state {
            State::Closed => {
                self.open(1, now);
                Some(Change::Opened)
            }
            State::HalfOpen { silences } if permit.is_probe => {
                self.open(silences.saturating_add(1), now);
                None
            }
            // It began before the silence was noticed, and says nothing new.
            State::Open { .. } | State::HalfOpen { .. } => None,
        }
    }

    /// A call was given up by its caller before anything was known: another one has to find out.
    pub(super) fn given_up(&mut self, permit: Permit, now: Instant) {
        if let State::HalfOpen { silences } = self.state
            && permit.is_probe
            && !self.is_of_the_past(permit)
        {
            self.open(silences, now);
        }
    }

    /// Whether something would be lost with it.
    pub(super) fn is_of_use(&self, now: Instant) -> bool {
        match self.state {
            State::Closed => self.closed.is_some_and(|at| now.duration_since(at) < AFTERMATH),
            State::Open { .. } | State::HalfOpen { .. } => now.duration_since(self.asked) < FORGOTTEN,
        }
    }

    fn open(&mut self, silences: u32, now: Instant) {
        let doublings = silences.saturating_sub(1).min(16);
        let pause = FIRST_PAUSE.saturating_mul(1 << doublings).min(LONGEST_PAUSE);
        self.state = State::Open {
            silences,
            probe_at: now + pause,
        };
    }

    /// It was asked before the bucket was found well, so its silence is of before, too.
    fn is_of_the_past(&self, permit: Permit) -> bool {
        self.closed.is_some_and(|closed| permit.asked < closed)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What happens to a bucket, at a second. Calls are numbered by their `Ask`, from 0.
    #[derive(Clone, Copy, Debug)]
    enum Step {
        /// Somebody wants to ask it, and may or may not.
        Ask(bool),
        Answered,
        Silent(usize),
        GivenUp(usize),
    }

    use Step::{Answered, Ask, GivenUp, Silent};

    const OPENED: Option<Change> = Some(Change::Opened);
    const CLOSED: Option<Change> = Some(Change::Closed);

    /// Goes through a story; each step names the second, what happens, and what is to be told of it.
    fn play(name: &str, story: &[(u64, Step, Option<Change>)]) {
        let begin = Instant::now();
        let mut breaker = Breaker::new(begin);
        let mut permits = Vec::new();
        for (index, (second, step, told)) in story.iter().enumerate() {
            let now = begin + Duration::from_secs(*second);
            let change = match *step {
                Ask(allowed) => {
                    let permit = breaker.ask(now);
                    assert_eq!(permit.is_some(), allowed, "{name}, step {index}: {breaker:?}");
                    permits.push(permit);
                    None
                }
                Answered => breaker.answered(now),
                Silent(call) => breaker.silent(permits[call].unwrap(), now),
                GivenUp(call) => {
                    breaker.given_up(permits[call].unwrap(), now);
                    None
                }
            };
            assert_eq!(change, *told, "{name}, step {index}: {breaker:?}");
        }
    }

    #[test]
    fn a_silent_bucket_is_left_alone_until_one_call_is_answered() {
        play(
            "answers change nothing",
            &[(0, Ask(true), None), (1, Answered, None), (1, Ask(true), None)],
        );
        play(
            "one probe, then all again",
            &[
                (0, Ask(true), None),
                (10, Silent(0), OPENED),
                (10, Ask(false), None),
                (14, Ask(false), None),
                (15, Ask(true), None),
                (15, Ask(false), None),
                (16, Answered, CLOSED),
                (16, Ask(true), None),
                (16, Ask(true), None),
            ],
        );
        play(
            "pauses double up to half a minute",
            &[
                (0, Ask(true), None),
                (10, Silent(0), OPENED),
                (15, Ask(true), None),
                (25, Silent(1), None),
                (34, Ask(false), None),
                (35, Ask(true), None),
                (45, Silent(3), None),
                (64, Ask(false), None),
                (65, Ask(true), None),
                (75, Silent(5), None),
                (104, Ask(false), None),
                (105, Ask(true), None),
                (115, Silent(7), None),
                (144, Ask(false), None),
                (145, Ask(true), None),
                (146, Answered, CLOSED),
                (150, Ask(true), None),
                (160, Silent(10), OPENED),
                (165, Ask(true), None),
            ],
        );
    }

    #[test]
    fn calls_that_were_under_way_are_told_of_once_and_hold_no_probe_up() {
        play(
            "many at once",
            &[
                (0, Ask(true), None),
                (0, Ask(true), None),
                (9, Ask(true), None),
                (10, Silent(0), OPENED),
                (10, Silent(1), None),
                (15, Ask(true), None),
                (19, Silent(2), None),
                (19, Ask(false), None),
                (20, Answered, CLOSED),
            ],
        );
        play(
            "one of them is answered",
            &[
                (0, Ask(true), None),
                (9, Ask(true), None),
                (10, Silent(0), OPENED),
                (11, Answered, CLOSED),
                (11, Ask(true), None),
            ],
        );
        play(
            "a silence from before the answer",
            &[
                (0, Ask(true), None),
                (5, Ask(true), None),
                (10, Silent(0), OPENED),
                (15, Ask(true), None),
                (16, Answered, CLOSED),
                (25, Silent(1), None),
                (25, Ask(true), None),
            ],
        );
    }

    #[test]
    fn a_probe_that_was_given_up_is_made_again() {
        play(
            "a pause later",
            &[
                (0, Ask(true), None),
                (1, GivenUp(0), None),
                (1, Ask(true), None),
                (11, Silent(1), OPENED),
                (16, Ask(true), None),
                (18, GivenUp(2), None),
                (22, Ask(false), None),
                (23, Ask(true), None),
            ],
        );
        play(
            "an old probe is nobody's any more",
            &[
                (0, Ask(true), None),
                (0, Ask(true), None),
                (10, Silent(0), OPENED),
                (15, Ask(true), None),
                (16, Answered, CLOSED),
                (16, Ask(true), None),
                (26, Silent(3), OPENED),
                (31, Ask(true), None),
                (32, GivenUp(2), None),
                (32, Ask(false), None),
                (33, Silent(2), None),
                (34, Answered, CLOSED),
            ],
        );
    }

    #[test]
    fn what_nobody_asks_for_is_forgotten() {
        let begin = Instant::now();
        let mut breaker = Breaker::new(begin);
        assert!(!breaker.is_of_use(begin));
        let permit = breaker.ask(begin).unwrap();
        breaker.silent(permit, begin);
        assert!(breaker.is_of_use(begin + FORGOTTEN / 2));
        assert!(!breaker.is_of_use(begin + FORGOTTEN));
        breaker.answered(begin);
        assert!(breaker.is_of_use(begin + AFTERMATH / 2));
        assert!(!breaker.is_of_use(begin + AFTERMATH));
    }
}
