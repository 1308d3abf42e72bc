//! Whether a Leaderboard's bucket, table, queues and log group can be reached: when each is asked again, and what is reported.
//!
//! Pure: `places` asks, `decide` turns what is shown into the condition `Ready`. An answer counts at once. Silence counts
//! when it has lasted for [`PATIENCE`], and then as `Unknown`: a service that is away for a minute makes nothing flap, and
//! nobody knows yet what is wrong with one that never answers.

use std::collections::BTreeMap;
use std::time::Duration;

use jiff::{SignedDuration, Timestamp};

use crate::controller::leaderboards::view::Unreachable;
use leaderboard_api::conditions::Truth;
use leaderboard_api::reasons;
use leaderboard_api::text::sentence;
use leaderboard_base::backoff::Backoff;

/// What was good is looked at again after this long.
const AGAIN: SignedDuration = SignedDuration::from_mins(5);
/// The waits after checks that found something wrong, up to [`AGAIN`].
const RETRY: Backoff = Backoff::new(Duration::from_secs(5), Duration::from_mins(5));
/// How long what was last found is held to be true while there is no answer.
const PATIENCE: SignedDuration = SignedDuration::from_mins(2);

/// What a Leaderboard names in AWS, the gravest first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum AwsResource {
    Bucket,
    Table,
    Rows,
    Queue,
    DeadLetterQueue,
    LogGroup,
}

impl AwsResource {
    /// The reason of a Leaderboard that cannot do without it.
    fn reason(self) -> Option<&'static str> {
        match self {
            Self::Bucket => Some(reasons::BUCKET_UNREACHABLE),
            Self::Table => Some(reasons::TABLE_UNREACHABLE),
            Self::Queue => Some(reasons::QUEUE_UNREACHABLE),
            Self::DeadLetterQueue => Some(reasons::DEAD_LETTER_QUEUE_UNREACHABLE),
            // No result depends on lines in CloudWatch, and rows wait for their table.
            Self::Rows | Self::LogGroup => None,
        }
    }
}

/// What one look has found. The sentences have the next step.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Finding {
    Good,
    /// It is not there, or not for the operator.
    Bad(String),
    /// The controller may not look; who uses it may all the same be allowed to.
    Hidden(String),
    /// No answer, or one that asks to ask later.
    Silent(String),
}

/// What is known of all places of one Leaderboard.
#[derive(Clone, Debug, Default)]
pub struct Reach(BTreeMap<AwsResource, Known>);

#[derive(Clone, Debug)]
struct Known {
    /// Where it is, as the Leaderboard says it; elsewhere it is another one.
    address: String,
    generation: i64,
    at: Timestamp,
    failures: u32,
    /// The last answer; none yet.
    answer: Option<Finding>,
    /// Since when there is no answer, and why.
    silent: Option<(Timestamp, String)>,
}

impl Reach {
    /// Forgets places that the Leaderboard no longer names.
    pub fn retain(&mut self, named: &[AwsResource]) {
        self.0.retain(|place, _| named.contains(place));
    }

    /// Whether a place has to be asked now: it is new, it was edited, or its time has come.
    pub fn is_due(&self, place: AwsResource, address: &str, generation: i64, now: Timestamp) -> bool {
        self.0.get(&place).is_none_or(|known| {
            // A clock that was set back makes it due as well.
            let edited = known.address != address || known.generation != generation;
            edited || now < known.at || now >= later(known.at, pause(known.failures))
        })
    }

    /// Takes in what a look has found.
    pub fn take(&mut self, place: AwsResource, address: &str, generation: i64, found: Finding, now: Timestamp) {
        let before = self.0.remove(&place).filter(|known| known.address == address);
        let mut known = before.unwrap_or_else(|| Known {
            address: address.to_owned(),
            generation,
            at: now,
            failures: 0,
            answer: None,
            silent: None,
        });
        let edited = known.generation != generation;
        (known.at, known.generation) = (now, generation);
        known.failures = match found {
            Finding::Good => 0,
            _ if edited => 1,
            _ => known.failures.saturating_add(1),
        };
        match found {
            Finding::Silent(why) => {
                let since = known.silent.map_or(now, |(since, _)| since);
                known.silent = Some((since, why));
            }
            answer => (known.answer, known.silent) = (Some(answer), None),
        }
        self.0.insert(place, known);
    }

    /// When something has to be asked, or shown, next; none while nothing was asked.
    pub fn next(&self, now: Timestamp) -> Option<Timestamp> {
        let asked = self.0.values().map(|known| later(known.at, pause(known.failures)));
        let said = self.0.values().filter_map(|known| known.silent.as_ref());
        let said = said.map(|(since, _)| later(*since, PATIENCE)).filter(|at| *at > now);
        asked.chain(said).min()
    }

    /// What is to be shown at this moment; nothing if all is well, or may still be.
    pub fn unreachable(&self, now: Timestamp) -> Option<Unreachable> {
        let mut said: Vec<_> = self
            .0
            .iter()
            .filter_map(|(place, known)| Some((place.reason()?, known)))
            .filter_map(|(reason, known)| known.said(now).map(|(truth, why)| (reason, truth, why)))
            .collect();
        // What is surely wrong comes before what nobody knows; among equals the gravest is first already.
        said.sort_by_key(|(_, truth, _)| *truth != Truth::False);
        let (reason, truth, _) = said.first()?;
        Some(Unreachable {
            truth: *truth,
            reason,
            message: said
                .iter()
                .map(|(_, _, why)| capitalized(why))
                .collect::<Vec<_>>()
                .join(" "),
        })
    }

    /// What a host should know of places that a Leaderboard can do without.
    pub fn notes(&self, now: Timestamp) -> Vec<String> {
        let optional = self.0.iter().filter(|(place, _)| place.reason().is_none());
        let said = optional.filter_map(|(_, known)| known.said(now));
        said.map(|(_, why)| capitalized(why)).collect()
    }
}

impl Known {
    fn said(&self, now: Timestamp) -> Option<(Truth, &str)> {
        let silent = self.silent.as_ref();
        let tired = |since: Timestamp| self.answer.is_none() || now < since || now >= later(since, PATIENCE);
        if let Some((_, why)) = silent.filter(|(since, _)| tired(*since)) {
            return Some((Truth::Unknown, why));
        }
        match self.answer.as_ref()? {
            Finding::Bad(why) => Some((Truth::False, why)),
            Finding::Hidden(why) => Some((Truth::Unknown, why)),
            Finding::Good | Finding::Silent(_) => None,
        }
    }
}

fn pause(failures: u32) -> SignedDuration {
    match failures {
        0 => AGAIN,
        n => SignedDuration::try_from(RETRY.bound(n)).unwrap_or(AGAIN),
    }
}

fn later(at: Timestamp, by: SignedDuration) -> Timestamp {
    at.checked_add(by).unwrap_or(Timestamp::MAX)
}

/// A text of ours, which begins with a small letter, as a sentence.
pub(super) fn capitalized(text: &str) -> String {
    let mut letters = text.trim().chars();
    let first = letters.next().map(|c| c.to_uppercase().to_string()).unwrap_or_default();
    sentence(&format!("{first}{}", letters.as_str()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_log_group_that_cannot_be_made_and_rows_that_are_refused_are_notes_and_hold_nothing_up() {
        for place in [AwsResource::LogGroup, AwsResource::Rows] {
            let mut reach = Reach::default();
            reach.take(place, "the place", 1, bad(), at(0));
            assert_eq!(reach.unreachable(at(0)), None);
            assert_eq!(reach.notes(at(0)), ["It does not exist; create it."]);
            reach.take(AwsResource::Table, "the table rows", 1, bad(), at(0));
            assert_eq!(reach.unreachable(at(0)).unwrap().reason, reasons::TABLE_UNREACHABLE);
            reach.take(place, "the place", 1, Finding::Good, at(5));
            assert_eq!(reach.notes(at(5)), Vec::<String>::new());
        }
    }

    fn at(second: i64) -> Timestamp {
        Timestamp::from_second(1_800_000_000 + second).unwrap()
    }

    fn bad() -> Finding {
        Finding::Bad("it does not exist; create it".into())
    }

    fn silent() -> Finding {
        Finding::Silent("it does not answer; check the network".into())
    }

    fn said(reach: &Reach, second: i64) -> Option<Truth> {
        reach.unreachable(at(second)).map(|found| found.truth)
    }

    type Case = (&'static str, Vec<(i64, Finding)>, Vec<(i64, Option<Truth>)>);

    /// Looks one after the other, each with its second, and what is shown at other seconds.
    #[test]
    fn an_answer_counts_at_once_and_silence_when_it_lasts() {
        use Truth::{False, Unknown};
        let hidden = || Finding::Hidden("the controller may not look".into());
        let cases: Vec<Case> = vec![
            ("good", vec![(0, Finding::Good)], vec![(0, None), (10_000, None)]),
            ("bad", vec![(0, bad())], vec![(0, Some(False))]),
            ("hidden", vec![(0, hidden())], vec![(0, Some(Unknown))]),
            ("fixed", vec![(0, bad()), (5, Finding::Good)], vec![(5, None)]),
            ("never answered", vec![(0, silent())], vec![(0, Some(Unknown))]),
            (
                "away for a minute",
                vec![
                    (0, Finding::Good),
                    (300, silent()),
                    (305, silent()),
                    (360, Finding::Good),
                ],
                vec![(305, None), (359, None), (360, None)],
            ),
            (
                "away for longer",
                vec![(0, Finding::Good), (300, silent()), (400, silent())],
                vec![(419, None), (420, Some(Unknown))],
            ),
            (
                "away, and back, and away: the time starts anew",
                vec![
                    (0, Finding::Good),
                    (300, silent()),
                    (410, Finding::Good),
                    (415, silent()),
                ],
                vec![(430, None), (534, None), (535, Some(Unknown))],
            ),
            (
                "bad, then silent: it stays bad for as long",
                vec![(0, bad()), (5, silent())],
                vec![(124, Some(False)), (125, Some(Unknown))],
            ),
            (
                "gone after it was good",
                vec![(0, Finding::Good), (300, bad())],
                vec![(300, Some(False))],
            ),
        ];
        for (name, looks, expected) in cases {
            for (second, truth) in expected {
                let mut reach = Reach::default();
                for (look, found) in looks.iter().filter(|(look, _)| *look <= second) {
                    reach.take(AwsResource::Table, "table", 1, found.clone(), at(*look));
                }
                assert_eq!(said(&reach, second), truth, "{name} at {second}");
            }
        }
    }

    #[test]
    fn what_fails_is_asked_sooner_then_ever_later() {
        let mut reach = Reach::default();
        assert!(reach.is_due(AwsResource::Bucket, "bucket", 1, at(0)) && reach.next(at(0)).is_none());
        let mut now = 0;
        for wait in [5, 10, 20, 40, 80, 160, 300, 300] {
            reach.take(AwsResource::Bucket, "bucket", 1, bad(), at(now));
            assert!(
                !reach.is_due(AwsResource::Bucket, "bucket", 1, at(now + wait - 1)),
                "{wait}"
            );
            assert!(reach.is_due(AwsResource::Bucket, "bucket", 1, at(now + wait)), "{wait}");
            assert_eq!(reach.next(at(now)), Some(at(now + wait)));
            now += wait;
        }
        reach.take(AwsResource::Bucket, "bucket", 1, Finding::Good, at(now));
        assert_eq!(reach.next(at(now)), Some(at(now + 300)));
        assert!(
            reach.is_due(AwsResource::Bucket, "bucket", 1, at(now - 1)),
            "a clock that was set back"
        );
    }

    #[test]
    fn an_edit_asks_at_once_and_another_address_has_nothing_of_the_old_one() {
        let mut reach = Reach::default();
        for second in [0, 5, 15] {
            reach.take(AwsResource::Queue, "one", 1, bad(), at(second));
        }
        assert!(reach.is_due(AwsResource::Queue, "one", 2, at(16)));
        reach.take(AwsResource::Queue, "one", 2, silent(), at(16));
        assert_eq!(
            (said(&reach, 16), reach.next(at(16))),
            (Some(Truth::False), Some(at(21)))
        );
        assert!(reach.is_due(AwsResource::Queue, "two", 2, at(17)));
        reach.take(AwsResource::Queue, "two", 2, silent(), at(17));
        assert_eq!(said(&reach, 17), Some(Truth::Unknown));
        reach.retain(&[AwsResource::Bucket]);
        assert_eq!((said(&reach, 17), reach.next(at(17))), (None, None));
    }

    #[test]
    fn the_end_of_patience_is_a_moment_to_look() {
        let mut reach = Reach::default();
        reach.take(AwsResource::Bucket, "bucket", 1, Finding::Good, at(0));
        for second in [300, 305, 315, 335, 375] {
            reach.take(AwsResource::Bucket, "bucket", 1, silent(), at(second));
        }
        assert_eq!(
            reach.next(at(375)),
            Some(at(420)),
            "not only at 455, when it is asked again"
        );
    }

    #[test]
    fn what_is_surely_wrong_comes_first_and_all_is_shown() {
        let mut reach = Reach::default();
        reach.take(AwsResource::Bucket, "bucket", 1, silent(), at(0));
        reach.take(AwsResource::Table, "table", 1, Finding::Good, at(0));
        reach.take(AwsResource::Queue, "queue", 1, bad(), at(0));
        let found = reach.unreachable(at(0)).unwrap();
        assert_eq!((found.truth, found.reason), (Truth::False, reasons::QUEUE_UNREACHABLE));
        assert_eq!(
            found.message,
            "It does not exist; create it. It does not answer; check the network."
        );
    }
}
