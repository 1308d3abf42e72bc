//! Whether somebody else reads a Leaderboard's queue, such as the old pipeline's EventBridge Pipe. Pure.
//!
//! SQS counts the messages that some reader has received and not deleted. The bridges' own part of that number is known to nobody:
//! there are several of them, a killed one leaves what it held, and SQS counts a deleted message for up to a minute. So nothing
//! is subtracted. A reading counts only where the bridges hold nothing for certain: nothing is left to receive, no Submission
//! came of a message of late, and no bridge has reported messages that it cannot use. Three such readings running have to lie
//! further apart than a message stays invisible: what a killed bridge held is received again by then, and is one of these.
//!
//! A reader that deletes at once what it takes is in no reading. `foreign: Leave` asks for another reader, and then nothing is read
//! into the number.

use std::time::Duration;

use jiff::{SignedDuration, Timestamp};

use crate::services::queue::Reading;
use leaderboard_api::text::{LONGEST_NAME, one_line};
use leaderboard_api::{Foreign, Ingested, Leaderboard, Queue, Submission, conditions, ingested, reasons};

/// So many readings running, to raise it and to clear it.
const STREAK: u32 = 3;
/// A queue in question is read again after this long; every other one with the other places.
const AGAIN: SignedDuration = SignedDuration::from_mins(1);
/// For so long SQS may count a message that is deleted.
const LAG: Duration = Duration::from_mins(2);

/// What one reading shows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Sign {
    /// Messages are in flight that no bridge holds.
    Foreign,
    /// Nothing is in flight.
    Quiet,
    /// The bridges may hold what is in flight.
    Unclear,
}

/// What the readings of one queue have shown.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct SharedQueue {
    /// The queue; of another one nothing is known.
    url: String,
    /// When it was asked last, with a reading or without.
    asked_at: Option<Timestamp>,
    /// Readings running that show another reader, and the first of them.
    foreign: u32,
    since: Option<Timestamp>,
    /// Readings running without one, while it is shared.
    quiet: u32,
    is_shared: bool,
    arn: Option<String>,
}

impl SharedQueue {
    /// What the status shows: a new process goes on from there.
    pub(super) fn of_status(leaderboard: &Leaderboard) -> Self {
        let url = leaderboard.spec.queue.as_ref().map(|queue| queue.url.clone());
        Self {
            url: url.unwrap_or_default(),
            is_shared: is_shown(leaderboard),
            ..Self::default()
        }
    }

    /// The same for the queue that the Leaderboard names now.
    pub(super) fn of_queue(self, url: &str) -> Self {
        if self.url == url {
            return self;
        }
        Self {
            url: url.to_owned(),
            ..Self::default()
        }
    }

    /// It was asked; a reading need not have come of it.
    pub(super) fn asked(&mut self, now: Timestamp) {
        self.asked_at = Some(now);
    }

    /// Takes a reading in.
    pub(super) fn take(&mut self, reading: &Reading, sign: Sign, now: Timestamp) {
        self.asked(now);
        self.arn.clone_from(&reading.arn);
        match sign {
            Sign::Foreign => {
                self.quiet = 0;
                self.foreign = self.foreign.saturating_add(1);
                // After a clock was set back the time counts anew.
                let since = self.since.map_or(now, |since| since.min(now));
                self.since = Some(since);
                let apart = now.duration_since(since).unsigned_abs();
                self.is_shared |= self.foreign >= STREAK && apart > reading.visibility;
            }
            Sign::Quiet => {
                (self.foreign, self.since) = (0, None);
                self.quiet = if self.is_shared {
                    self.quiet.saturating_add(1)
                } else {
                    0
                };
                if self.quiet >= STREAK {
                    (self.is_shared, self.quiet) = (false, 0);
                }
            }
            Sign::Unclear => (self.foreign, self.since) = (0, None),
        }
    }

    /// Whether it is to be read before its usual time.
    pub(super) fn is_due(&self, now: Timestamp) -> bool {
        self.next().is_some_and(|at| now >= at)
    }

    /// When it is to be read before its usual time.
    pub(super) fn next(&self) -> Option<Timestamp> {
        let in_question = self.is_shared || self.foreign > 0;
        self.asked_at.filter(|_| in_question)?.checked_add(AGAIN).ok()
    }

    /// The note about it. The same text as long as it lasts.
    pub(super) fn message(&self) -> Option<String> {
        let arn = self.arn.as_deref().map(|arn| one_line(arn, LONGEST_NAME));
        let arn = arn.unwrap_or_else(|| "ARN".to_owned());
        self.is_shared.then(|| {
            format!(
                "Queue {} has another reader: in three readings running messages were in flight that no bridge of this operator \
                 holds. Until that ends, the sweep starts nothing. Stop the old pipeline's EventBridge Pipe (aws pipes list-pipes \
                 --current-state RUNNING --source-prefix {arn}; aws pipes stop-pipe --name NAME). If the queue is shared on \
                 purpose, set queue.foreign to Leave.",
                self.url
            )
        })
    }
}

/// Whether the status of a Leaderboard shows it.
pub(crate) fn is_shown(leaderboard: &Leaderboard) -> bool {
    let ready = leaderboard.condition(conditions::READY);
    ready.is_some_and(|ready| ready.reason == reasons::QUEUE_SHARED)
}

/// Whether a Leaderboard of this queue asks for another reader.
pub(super) fn is_shared_on_purpose<'a>(queue: &Queue, all: impl IntoIterator<Item = &'a Leaderboard>) -> bool {
    let of_queue = all.into_iter().filter_map(|board| board.spec.queue.as_ref());
    let leaves = of_queue.filter(|other| other.url == queue.url && other.foreign == Foreign::Leave);
    leaves.count() > 0
}

/// What a reading shows, as far as the number alone shows: None if it depends on what the bridges have done of late.
pub(super) fn by_number(reading: &Reading) -> Option<Sign> {
    match (reading.in_flight, reading.visible) {
        (0, _) => Some(Sign::Quiet),
        // What is left to receive is what the bridges are busy with.
        (_, 1..) => Some(Sign::Unclear),
        (_, 0) => None,
    }
}

/// Whether a message of this Submission may still be counted by SQS.
pub(super) fn is_recent(submission: &Submission, reading: &Reading, now: Timestamp) -> bool {
    let window = SignedDuration::try_from(reading.visibility.max(LAG)).unwrap_or(SignedDuration::MAX);
    let is_young = |at: Timestamp| now.duration_since(at) < window;
    let created = submission.metadata.creation_timestamp.as_ref().map(|time| time.0);
    Ingested::of(submission)
        .filter(|record| record.message != ingested::SWEEP)
        .is_some_and(|record| {
            let sent = Timestamp::from_millisecond(record.sent).ok();
            created.is_some_and(is_young) || sent.is_some_and(is_young)
        })
}

#[cfg(test)]
mod tests {
    use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;
    use serde_json::json;

    use super::Sign::{Foreign as F, Quiet as Q, Unclear as U};
    use super::*;
    use leaderboard_api::names;

    fn at(second: i64) -> Timestamp {
        Timestamp::from_second(1_800_000_000 + second).unwrap()
    }

    fn reading(in_flight: u64, visible: u64) -> Reading {
        Reading {
            arn: Some("arn:aws:sqs:us-west-2:1:q".into()),
            in_flight,
            visible,
            visibility: Duration::from_secs(30),
        }
    }

    fn after(readings: &[(i64, Sign)]) -> SharedQueue {
        let mut queue = SharedQueue::default().of_queue("https://q");
        for (second, sign) in readings {
            queue.take(&reading(1, 0), *sign, at(*second));
        }
        queue
    }

    #[test]
    fn three_readings_running_that_lie_apart_raise_it_and_three_without_clear_it() {
        let shared = [(0, F), (300, F), (360, F)];
        let then = |more: &[(i64, Sign)]| [&shared, more].concat();
        let cases = [
            ("nothing read", vec![], false),
            ("one", vec![(0, F)], false),
            ("two", vec![(0, F), (60, F)], false),
            ("three", shared.to_vec(), true),
            (
                "three within a message's visibility, as after a restart",
                vec![(0, F), (10, F), (30, F)],
                false,
            ),
            ("and one more behind it", vec![(0, F), (10, F), (30, F), (31, F)], true),
            (
                "with a quiet one in between",
                vec![(0, F), (60, F), (120, Q), (180, F), (240, F)],
                false,
            ),
            (
                "with a burst in between",
                vec![(0, F), (60, F), (120, U), (180, F), (240, F)],
                false,
            ),
            ("a burst", vec![(0, U), (60, U), (120, U), (180, U)], false),
            ("two quiet ones", then(&[(420, Q), (480, Q)]), true),
            ("three quiet ones", then(&[(420, Q), (480, Q), (540, Q)]), false),
            (
                "quiet ones around another",
                then(&[(420, Q), (480, Q), (540, F), (600, Q)]),
                true,
            ),
            ("a burst while it lasts", then(&[(420, U), (480, U), (540, U)]), true),
            (
                "quiet ones around a burst",
                then(&[(420, Q), (480, U), (540, Q), (600, Q)]),
                false,
            ),
            ("a clock that was set back", vec![(500, F), (560, F), (0, F)], false),
        ];
        for (name, readings, expected) in cases {
            assert_eq!(after(&readings).message().is_some(), expected, "{name}");
        }
    }

    #[test]
    fn only_a_queue_in_question_is_read_before_its_time() {
        let next = |readings: &[(i64, Sign)]| after(readings).next();
        assert_eq!(next(&[]), None);
        assert_eq!(next(&[(0, Q)]), None);
        assert_eq!(next(&[(0, U)]), None);
        assert_eq!(next(&[(0, F)]), Some(at(60)));
        let shared = after(&[(0, F), (60, F), (120, F), (180, Q)]);
        assert_eq!(shared.next(), Some(at(240)));
        assert!(!shared.is_due(at(239)) && shared.is_due(at(240)));
        let mut silent = shared;
        silent.asked(at(240));
        assert!(
            !silent.is_due(at(299)) && silent.is_due(at(300)),
            "no answer is waited for as long as a reading"
        );
    }

    #[test]
    fn the_number_alone_shows_a_quiet_queue_and_a_burst() {
        let cases = [((0, 0), Some(Q)), ((0, 9), Some(Q)), ((3, 1), Some(U)), ((1, 0), None)];
        for ((in_flight, visible), expected) in cases {
            assert_eq!(
                by_number(&reading(in_flight, visible)),
                expected,
                "{in_flight} {visible}"
            );
        }
    }

    fn submission(message: &str, created: i64, sent: i64) -> Submission {
        let spec = json!({"leaderboardName": "one", "evalai": {"challenge": 1, "phase": 2, "submission": 7}});
        let mut submission = Submission::new("submission-7", serde_json::from_value(spec).unwrap());
        submission.metadata.creation_timestamp = Some(Time(at(created)));
        let record = json!({"message": message, "sent": at(sent).as_millisecond()}).to_string();
        submission.metadata.annotations = Some([(names::ANNOTATION_INGESTED.to_owned(), record)].into());
        submission
    }

    #[test]
    fn what_a_bridge_took_in_of_late_explains_what_is_in_flight() {
        for (message, created, sent, expected) in [
            ("m-1", 0, 0, true),
            ("m-1", 0, -5000, true),
            ("m-1", -119, -119, true),
            ("m-1", -120, -120, false),
            ("m-1", -5000, -60, true),
            (ingested::SWEEP, 0, 0, false),
        ] {
            let found = is_recent(&submission(message, created, sent), &reading(1, 0), at(0));
            assert_eq!(found, expected, "{message} {created} {sent}");
        }
        let patient = Reading {
            visibility: Duration::from_mins(10),
            ..reading(1, 0)
        };
        assert!(
            is_recent(&submission("m-1", -599, -599), &patient, at(0)),
            "it may be in flight that long"
        );
    }

    fn board(url: &str, foreign: &str) -> Leaderboard {
        let spec = json!({
            "evalai": {"apiServer": "https://e", "challenge": 1, "token": {"secretKeyRef": {"name": "t", "key": "k"}}},
            "tracks": [{"name": "sensors", "codename": "SENSORS", "phase": 1}],
            "leaderboardVersion": "V2", "contents": {"image": "c"}, "simulator": {"image": "s"},
            "storage": {"bucket": "bucket"}, "queue": {"url": url, "foreign": foreign},
        });
        Leaderboard::new("one", serde_json::from_value(spec).unwrap())
    }

    #[test]
    fn one_reader_that_leaves_messages_to_others_speaks_for_the_queue() {
        let mine = board("https://q", "DeadLetter");
        let queue = mine.spec.queue.as_ref().unwrap();
        let on_purpose = |other: &Leaderboard| is_shared_on_purpose(queue, [&mine, other]);
        assert!(!on_purpose(&board("https://q", "DeadLetter")));
        assert!(!on_purpose(&board("https://other", "Leave")));
        assert!(on_purpose(&board("https://q", "Leave")));
    }

    #[test]
    fn a_new_process_goes_on_from_the_status_and_another_queue_begins_anew() {
        let mut mine = board("https://q", "DeadLetter");
        assert!(SharedQueue::of_status(&mine).message().is_none());
        let ready = json!([{"type": "Ready", "status": "False", "reason": reasons::QUEUE_SHARED, "message": "",
                            "lastTransitionTime": "2026-11-20T10:00:00Z"}]);
        mine.status.get_or_insert_default().conditions = serde_json::from_value(ready).unwrap();
        let known = SharedQueue::of_status(&mine);
        assert!(known.clone().of_queue("https://q").message().is_some());
        assert_eq!(known.of_queue("https://other").message(), None);
    }
}
