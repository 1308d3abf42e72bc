//! A Leaderboard's bucket, table, queues and log group: which can be reached, and what is reported of the others.
//!
//! Pure: `places` asks, `decide` makes the condition `Ready` of the answers. An answer counts at once. Silence counts as `Unknown`, once
//! it has lasted for [`PATIENCE`]: its cause is not known. A service that is away for a minute makes nothing flap.

use std::time::Duration;

use leaderboard_api::conditions::Truth;
use leaderboard_api::text::sentence;
use leaderboard_api::{DynamoTable, LogGroup, Reason, S3Bucket, SqsQueue};
use leaderboard_base::backoff::Backoff;
use leaderboard_policy::ask::{Ask, Failure, Lookup, Service};
use leaderboard_policy::leaderboards::view::Unreachable;

/// Time after which a place that was reached is asked again.
const AGAIN: Duration = Duration::from_mins(5);
/// The waits after checks that found something wrong, up to [`AGAIN`].
const RETRY: Backoff = Backoff::new(Duration::from_secs(5), AGAIN);
/// Time for which the last answer is held to be true while the service is silent.
const PATIENCE: Duration = Duration::from_mins(2);

/// Kinds of places in AWS that a Leaderboard names, the gravest first.
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
    /// Each with the name of the task that asks for it.
    pub const ALL: [(Self, &str); 6] = [
        (Self::Bucket, "ask buckets"),
        (Self::Table, "ask tables"),
        (Self::Rows, "ask tables for rows"),
        (Self::Queue, "ask queues"),
        (Self::DeadLetterQueue, "ask dead-letter queues"),
        (Self::LogGroup, "ask log groups"),
    ];

    /// The reason of a Leaderboard that cannot do without it.
    fn reason(self) -> Option<Reason> {
        match self {
            Self::Bucket => Some(Reason::BucketUnreachable),
            Self::Table => Some(Reason::TableUnreachable),
            Self::Queue => Some(Reason::QueueUnreachable),
            Self::DeadLetterQueue => Some(Reason::DeadLetterQueueUnreachable),
            // No result depends on lines in CloudWatch, and rows wait for their table.
            Self::Rows | Self::LogGroup => None,
        }
    }
}

/// One place that a Leaderboard names.
#[derive(Clone, Debug, PartialEq)]
pub struct Place {
    pub resource: AwsResource,
    pub at: At,
    /// Generation of the Leaderboard: an edit asks anew.
    pub generation: Option<i64>,
}

/// Where a place is: elsewhere it is another one.
#[derive(Clone, Debug, PartialEq)]
pub enum At {
    Bucket(S3Bucket),
    Table(DynamoTable),
    /// The queue itself, or the dead-letter queue in its place.
    Queue(SqsQueue),
    LogGroup(LogGroup),
}

/// The answer of a place.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Seen {
    /// Messages of a queue, visible and in flight.
    pub messages: Option<(u64, u64)>,
    /// Why the controller may not look; who uses the place may all the same be allowed to.
    pub hidden: Option<String>,
}

impl Ask for Place {
    type Answer = Seen;
    const AT_ONCE: usize = 16;
    const AT_ONCE_OF_A_SERVICE: usize = 4;
    const LONGEST: Duration = Duration::from_secs(10);

    fn service(&self) -> Service {
        match &self.at {
            At::Bucket(storage) => Service::bucket(storage),
            At::Table(table) => Service::table(table),
            At::Queue(queue) => Service::queue(queue),
            At::LogGroup(group) => Service::log_group(group),
        }
    }

    fn again(&self, result: &Result<Seen, Failure>, failures: u32, _waited: Duration) -> Option<Duration> {
        Some(result.as_ref().map_or_else(|_| RETRY.bound(failures), |_| AGAIN))
    }
}

/// Each place that a Leaderboard names, with what is known of it.
#[derive(Clone, Debug, Default)]
pub struct Reach(pub Vec<(Place, Lookup<Place>)>);

impl Reach {
    /// Time until the first silence counts.
    pub fn patience(&self) -> Option<Duration> {
        let silences = self.0.iter().filter_map(|(_, lookup)| lookup.silence.as_ref());
        let left = silences.filter_map(|silence| PATIENCE.checked_sub(silence.lasts));
        left.filter(|left| !left.is_zero()).min()
    }

    /// The places that cannot be reached, for the condition; None if all is well, or may still be.
    pub fn unreachable(&self) -> Option<Unreachable> {
        let mut said: Vec<_> = self
            .0
            .iter()
            .filter_map(|(place, lookup)| Some((place.resource.reason()?, said(place, lookup)?)))
            .collect();
        // Known failures come before possible ones; among equals the gravest is first already.
        said.sort_by_key(|(_, (truth, _))| *truth != Truth::False);
        let (reason, (truth, _)) = said.first()?;
        Some(Unreachable {
            truth: *truth,
            reason: *reason,
            message: said
                .iter()
                .map(|(_, (_, why))| capitalized(why))
                .collect::<Vec<_>>()
                .join(" "),
        })
    }

    /// Sentences about places that a Leaderboard can do without.
    pub fn notes(&self) -> Vec<String> {
        let optional = self.0.iter().filter(|(place, _)| place.resource.reason().is_none());
        let said = optional.filter_map(|(place, lookup)| said(place, lookup));
        said.map(|(_, why)| capitalized(why)).collect()
    }

    /// Messages of a queue, as SQS reported them last.
    pub fn messages(&self, of: AwsResource) -> Option<(u64, u64)> {
        let (_, lookup) = self.0.iter().find(|(place, _)| place.resource == of)?;
        lookup.known()?.result.as_ref().as_ref().ok()?.messages
    }
}

/// The fault of a place, if it has one.
fn said<'a>(place: &Place, lookup: &'a Lookup<Place>) -> Option<(Truth, &'a str)> {
    let patient = lookup.silence.as_ref().filter(|silence| silence.lasts < PATIENCE);
    let before = patient.and_then(|silence| silence.before.as_ref());
    let mut answers = [before, lookup.last.as_ref()].into_iter().flatten();
    let answer = answers.find(|answer| answer.question.at == place.at)?;
    match answer.result.as_ref() {
        Ok(seen) => Some((Truth::Unknown, seen.hidden.as_ref()?)),
        Err(failure) if failure.is_refused => Some((Truth::False, &failure.why)),
        Err(failure) => Some((Truth::Unknown, &failure.why)),
    }
}

/// A text of ours, which begins with a small letter, as a sentence.
pub(super) fn capitalized(text: &str) -> String {
    let mut letters = text.trim().chars();
    let first = letters.next().map(|c| c.to_uppercase().to_string()).unwrap_or_default();
    sentence(&format!("{first}{}", letters.as_str()))
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use leaderboard_policy::ask::{Answered, Silence};

    type Found = Result<Seen, Failure>;

    fn bad() -> Found {
        Err(Failure {
            is_refused: true,
            why: "it does not exist; create it".into(),
        })
    }

    fn silent() -> Found {
        Err(Failure::silent("it does not answer; check the network"))
    }

    fn place(resource: AwsResource, bucket: &str) -> Place {
        Place {
            resource,
            at: At::Bucket(serde_json::from_value(serde_json::json!({"bucket": bucket})).unwrap()),
            generation: Some(1),
        }
    }

    /// The last answer, or the answer before a silence that has lasted for so many seconds.
    fn found(resource: AwsResource, known: Option<Found>, lasts: Option<u64>) -> (Place, Lookup<Place>) {
        let place = place(resource, "one");
        let answered = |result: Found| Answered {
            question: place.clone(),
            sent_ago: Duration::ZERO,
            result: Arc::new(result),
        };
        let known = known.map(answered);
        let lookup = Lookup {
            last: lasts.map_or_else(|| known.clone(), |_| Some(answered(silent()))),
            silence: lasts.map(|seconds| Silence {
                lasts: Duration::from_secs(seconds),
                before: known.clone(),
            }),
            ..Lookup::default()
        };
        (place, lookup)
    }

    #[test]
    fn a_log_group_that_cannot_be_made_and_rows_that_are_refused_are_notes_and_hold_nothing_up() {
        for resource in [AwsResource::LogGroup, AwsResource::Rows] {
            let mut reach = Reach(vec![found(resource, Some(bad()), None)]);
            assert_eq!(reach.unreachable(), None);
            assert_eq!(reach.notes(), ["It does not exist; create it."]);
            reach.0.push(found(AwsResource::Table, Some(bad()), None));
            assert_eq!(reach.unreachable().unwrap().reason, Reason::TableUnreachable);
            reach.0[0] = found(resource, Some(Ok(Seen::default())), None);
            assert_eq!(reach.notes(), Vec::<String>::new());
        }
    }

    #[test]
    fn an_answer_counts_at_once_and_silence_when_it_lasts() {
        use Truth::{False, Unknown};
        let hidden = || {
            Ok(Seen {
                hidden: Some("the controller may not look".into()),
                ..Seen::default()
            })
        };
        for (name, known, lasts, expected) in [
            ("good", Some(Ok(Seen::default())), None, None),
            ("bad", Some(bad()), None, Some(False)),
            ("hidden", Some(hidden()), None, Some(Unknown)),
            ("not asked yet", None, None, None),
            ("never answered", None, Some(0), Some(Unknown)),
            ("away for a minute", Some(Ok(Seen::default())), Some(60), None),
            ("away for longer", Some(Ok(Seen::default())), Some(120), Some(Unknown)),
            (
                "bad, then silent: it stays bad for as long",
                Some(bad()),
                Some(119),
                Some(False),
            ),
            ("bad, and silent for longer", Some(bad()), Some(120), Some(Unknown)),
        ] {
            let reach = Reach(vec![found(AwsResource::Table, known, lasts)]);
            assert_eq!(reach.unreachable().map(|found| found.truth), expected, "{name}");
        }
    }

    #[test]
    fn what_fails_is_asked_sooner_then_ever_later() {
        let place = place(AwsResource::Bucket, "one");
        let pause = |found, failures| place.again(&found, failures, Duration::ZERO).unwrap().as_secs();
        let failed: Vec<u64> = (1..=8).map(|failures| pause(bad(), failures)).collect();
        assert_eq!(failed, [5, 10, 20, 40, 80, 160, 300, 300]);
        assert_eq!(pause(Ok(Seen::default()), 0), 300);
    }

    #[test]
    fn an_edit_asks_anew_and_another_address_has_nothing_of_the_old_one() {
        let one = place(AwsResource::Queue, "one");
        let mut edited = one.clone();
        edited.generation = Some(2);
        assert_ne!(one, edited);
        let (_, lookup) = found(AwsResource::Queue, Some(bad()), None);
        assert_eq!(said(&edited, &lookup).map(|(truth, _)| truth), Some(Truth::False));
        assert_eq!(said(&place(AwsResource::Queue, "two"), &lookup), None);
    }

    #[test]
    fn the_end_of_patience_is_a_moment_to_look() {
        let reach = |lasts| Reach(vec![found(AwsResource::Bucket, Some(Ok(Seen::default())), lasts)]);
        assert_eq!(reach(Some(75)).patience(), Some(Duration::from_secs(45)));
        assert_eq!((reach(None).patience(), reach(Some(120)).patience()), (None, None));
    }

    #[test]
    fn what_is_surely_wrong_comes_first_and_all_is_shown() {
        let reach = Reach(vec![
            found(AwsResource::Bucket, None, Some(0)),
            found(AwsResource::Table, Some(Ok(Seen::default())), None),
            found(AwsResource::Queue, Some(bad()), None),
        ]);
        let found = reach.unreachable().unwrap();
        assert_eq!((found.truth, found.reason), (Truth::False, Reason::QueueUnreachable));
        assert_eq!(
            found.message,
            "It does not exist; create it. It does not answer; check the network."
        );
    }
}
