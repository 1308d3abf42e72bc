//! Asks AWS for a Leaderboard's bucket, table and queues, by one cheap request each.
//!
//! When to ask, and what follows, is decided by `reach`.

use std::fmt::Display;

use super::reach::{At, AwsResource, Place, Seen};
use crate::ask::Asked;
use leaderboard_api::{DynamoTable, Leaderboard, SqsQueue};
use leaderboard_aws::archive::{Archive, ArchiveError};
use leaderboard_aws::clients::Aws;
use leaderboard_aws::fault::Fault;
use leaderboard_aws::log_groups::{self, LogGroupError};
use leaderboard_aws::queue::{self, QueueError, Reading};
use leaderboard_aws::table::{Table, TableError};
use leaderboard_policy::ask::{Ask, Failure};

/// Prefix of a run that does not exist: the list below it is empty, and costs little.
const NO_RUN: &str = "none/";

/// The places that a Leaderboard names.
pub(super) fn named(leaderboard: &Leaderboard) -> Vec<Place> {
    let spec = &leaderboard.spec;
    let mut places = vec![(AwsResource::Bucket, At::Bucket(spec.storage.s3.clone()))];
    if let Some(table) = spec.dynamo_table() {
        places.push((AwsResource::Table, At::Table(table.clone())));
        if !spec.observes() {
            places.push((AwsResource::Rows, At::Table(table.clone())));
        }
    }
    if let Some(queue) = spec.sqs() {
        places.push((AwsResource::Queue, At::Queue(queue.clone())));
        let dead = queue.dead_letter_url.clone();
        let dead = dead.map(|url| At::Queue(SqsQueue { url, ..queue.clone() }));
        places.extend(dead.map(|queue| (AwsResource::DeadLetterQueue, queue)));
    }
    if let Some(group) = spec.log_group().filter(|group| group.retention_days.is_some()) {
        places.push((AwsResource::LogGroup, At::LogGroup(group.clone())));
    }
    let generation = leaderboard.metadata.generation;
    let place = |(resource, at)| Place {
        resource,
        at,
        generation,
    };
    places.into_iter().map(place).collect()
}

/// Asks for one place.
pub(super) async fn ask(aws: Aws, asked: Asked<Place>) -> Result<Seen, Failure> {
    let (aws, place) = (&aws, &asked.question);
    let answer = match &place.at {
        At::Bucket(storage) => {
            let prefix = format!("{}{NO_RUN}", storage.prefix.as_deref().unwrap_or_default());
            let archive = Archive::of_storage(aws, storage).at_prefix(prefix);
            of_bucket(archive.prefix_is_empty().await)
        }
        At::Table(table) if place.resource == AwsResource::Rows => of_table(try_rows(aws, table).await),
        At::Table(table) => of_table(Table::describe(aws, table).await),
        At::Queue(queue) => of_queue(queue::check(aws, queue, &queue.url).await),
        At::LogGroup(group) => {
            let days = group.retention_days.unwrap_or_default();
            of_log_group(log_groups::keep(aws, group, days).await)
        }
    };
    if let Ok(Seen { hidden: Some(why), .. }) | Err(Failure { why, .. }) = &answer {
        let (leaderboard, place) = (&asked.about, place.service());
        tracing::warn!(%leaderboard, %place, why, "the bucket, table, queue or log group cannot be reached");
    }
    answer
}

/// Writes to the table, because the right to describe it does not include the right to write rows.
async fn try_rows(aws: &Aws, table: &DynamoTable) -> Result<(), TableError> {
    Table::describe(aws, table).await?.try_write().await
}

/// The meaning of an answer. A cause that passes is silence.
fn seen<T, E: Display>(answer: Result<T, E>, passes: impl Fn(&E) -> bool) -> Result<Seen, Failure> {
    answer.map(|_| Seen::default()).map_err(|error| Failure {
        is_refused: !passes(&error),
        why: error.to_string(),
    })
}

fn of_bucket<T>(answer: Result<T, ArchiveError>) -> Result<Seen, Failure> {
    seen(answer, |error| error.cause.is_transient())
}

fn of_table<T>(answer: Result<T, TableError>) -> Result<Seen, Failure> {
    seen(answer, |error| matches!(error, TableError::Passing { .. }))
}

/// The bridge reads the queue, with rights of its own.
fn of_queue(answer: Result<Reading, QueueError>) -> Result<Seen, Failure> {
    match answer {
        Ok(reading) => Ok(Seen {
            messages: Some((reading.visible, reading.in_flight)),
            hidden: None,
        }),
        Err(error) if error.fault == Fault::Denied => Ok(Seen {
            messages: None,
            hidden: Some(error.to_string()),
        }),
        failed => seen(failed, |error| error.fault.is_passing()),
    }
}

fn of_log_group(answer: Result<(), LogGroupError>) -> Result<Seen, Failure> {
    seen(answer, |error| error.fault.is_passing())
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;
    use crate::fixtures;
    use crate::observability::logging::tests::Lines;
    use crate::runtime::objects::key_of;
    use leaderboard_aws::archive::Cause;
    use serde_json::json;

    #[tokio::test(start_paused = true)]
    async fn the_log_names_where_a_place_is_that_cannot_be_reached() {
        let endpoint = "http://127.0.0.1:1";
        let board = fixtures::leaderboard("carla", endpoint);
        let aws = Box::pin(fixtures::aws(endpoint)).await;
        let lines = Lines::default();
        let _guard = lines.collect();
        let asked = Asked {
            about: key_of(&board),
            question: named(&board).remove(0),
            waited: Duration::ZERO,
            last: None,
        };
        assert!(Box::pin(ask(aws, asked)).await.is_err());
        let logged = lines.take_json();
        let places: Vec<_> = logged.iter().filter_map(|line| line["place"].as_str()).collect();
        assert_eq!(places, ["the server http://127.0.0.1:1"], "{logged:?}");
    }

    #[test]
    fn a_refusal_of_aws_has_its_reason_and_next_step() {
        let archive = |cause| ArchiveError {
            op: "listing",
            object: "bucket/none/".into(),
            cause,
        };
        let table = || "table".to_owned();
        let queue = |fault| QueueError {
            url: "https://sqs/one".into(),
            fault,
            text: "words".into(),
        };
        let group = |fault| LogGroupError {
            name: "group".to_owned(),
            action: "CreateLogGroup",
            fault,
            text: "words".into(),
        };
        let (bad, silent) = (Err(true), Err(false));
        let cases = [
            (of_bucket::<()>(Err(archive(Cause::NoBucket))), bad),
            (of_bucket::<()>(Err(archive(Cause::Denied("403".into())))), bad),
            (of_bucket::<()>(Err(archive(Cause::Away("503".into())))), silent),
            (
                of_table::<()>(Err(TableError::Missing {
                    table: table(),
                    text: "gone".into(),
                })),
                bad,
            ),
            (of_table::<()>(Err(TableError::NoSortKey { table: table() })), bad),
            (
                of_table::<()>(Err(TableError::Passing {
                    table: table(),
                    action: "DescribeTable",
                    text: "503".into(),
                })),
                silent,
            ),
            (of_queue(Err(queue(Fault::Missing))), bad),
            (of_queue(Err(queue(Fault::Denied))), Ok(true)),
            (of_queue(Err(queue(Fault::Throttled))), silent),
            (of_log_group(Err(group(Fault::Denied))), bad),
            (of_log_group(Err(group(Fault::Throttled))), silent),
        ];
        for (found, expected) in cases {
            let kind = found.as_ref().map(|seen| seen.hidden.is_some());
            assert_eq!(kind.map_err(|failure| failure.is_refused), expected, "{found:?}");
        }
    }

    #[test]
    fn only_what_is_named_is_asked_for() {
        let mut spec = json!({
            "evalai": {"apiServer": "https://e", "challenge": 1, "token": {"secretKeyRef": {"name": "t", "key": "k"}}},
            "tracks": [{"name": "sensors", "phase": 1}],
            "evaluation": {"carla": {
                "version": "V2", "contents": {"image": "c"}, "simulator": {"image": "s"},
            }},
            "storage": {"s3": {"bucket": "bucket"}},
        });
        let places = |spec: &serde_json::Value| {
            let board = Leaderboard::new("one", serde_json::from_value(spec.clone()).unwrap());
            let named = named(&board).into_iter().map(|place| {
                let name = match place.at {
                    At::Bucket(storage) => storage.bucket,
                    At::Table(table) => table.name,
                    At::Queue(queue) => queue.url,
                    At::LogGroup(group) => group.name,
                };
                (place.resource, name)
            });
            named.collect::<Vec<_>>()
        };
        let of = |resource, name: &str| (resource, name.to_owned());
        assert_eq!(places(&spec), [of(AwsResource::Bucket, "bucket")]);
        spec["table"] = json!({"dynamoDB": {"name": "rows", "region": "eu-west-1"}});
        spec["queue"] = json!({"sqs": {"url": "https://sqs/one", "deadLetterURL": "https://sqs/dead"}});
        let all = [
            of(AwsResource::Bucket, "bucket"),
            of(AwsResource::Table, "rows"),
            of(AwsResource::Rows, "rows"),
            of(AwsResource::Queue, "https://sqs/one"),
            of(AwsResource::DeadLetterQueue, "https://sqs/dead"),
        ];
        assert_eq!(places(&spec), all);
        let mut observing = spec.clone();
        observing["evalai"]["mode"] = json!("Observe");
        assert!(!places(&observing).contains(&all[2]), "none is written");
        // A group that is the host's own is left alone.
        spec["logs"] = json!({"cloudWatch": {"name": "logs"}});
        assert_eq!(places(&spec), all);
        spec["logs"] = json!({"cloudWatch": {"name": "logs", "retentionDays": 30}});
        assert_eq!(places(&spec).last(), Some(&of(AwsResource::LogGroup, "logs")));
    }
}
