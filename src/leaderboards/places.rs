//! Asks AWS for a Leaderboard's bucket, table and queues, by one cheap request each.
//!
//! When to ask, and what follows, is decided by `reach`.

use std::fmt::Display;
use std::sync::Arc;

use super::reach::{AwsResource, Place, Seen};
use crate::ask::Asked;
use crate::runtime::objects::key_of;
use leaderboard_api as api;
use leaderboard_api::Leaderboard;
use leaderboard_aws::archive::{Archive, ArchiveError};
use leaderboard_aws::clients::Aws;
use leaderboard_aws::fault::Fault;
use leaderboard_aws::log_groups::{self, LogGroupError};
use leaderboard_aws::queue::{self, QueueError, Reading};
use leaderboard_aws::table::{Table, TableError};
use leaderboard_policy::ask::Failure;

/// Prefix of a run that does not exist: the list below it is empty, and costs little.
const NO_RUN: &str = "none/";

/// The places that a Leaderboard names.
pub(super) fn named(leaderboard: &Arc<Leaderboard>) -> Vec<Place> {
    let spec = &leaderboard.spec;
    let at = |region: &Option<String>, endpoint: &Option<String>| {
        let place = endpoint.as_ref().or(region.as_ref());
        place.map(|place| format!(" at {place}")).unwrap_or_default()
    };
    let (region, endpoint) = (&spec.storage.s3.region, &spec.storage.s3.endpoint);
    let bucket = format!("the bucket {}{}", spec.storage.s3.bucket, at(region, endpoint));
    let mut places = vec![(AwsResource::Bucket, bucket)];
    if let Some(table) = spec.dynamo_table() {
        let keys = table.partition_key.as_deref().zip(table.sort_key.as_deref());
        let keys = keys.map(|(team, submission)| format!(" by {team} and {submission}"));
        let (keys, at) = (keys.unwrap_or_default(), at(&table.region, &table.endpoint));
        places.push((AwsResource::Table, format!("the table {}{keys}{at}", table.name)));
        if !spec.observes() {
            places.push((AwsResource::Rows, format!("the rows of {}{keys}{at}", table.name)));
        }
    }
    if let Some(queue) = spec.sqs() {
        let at = at(&queue.region, &queue.endpoint);
        places.push((AwsResource::Queue, format!("the queue {}{at}", queue.url)));
        let dead = queue.dead_letter_url.as_ref();
        places.extend(dead.map(|url| (AwsResource::DeadLetterQueue, format!("the dead-letter queue {url}{at}"))));
    }
    if let Some(group) = spec.log_group().filter(|group| group.retention_days.is_some()) {
        let at = at(&group.region, &group.endpoint);
        places.push((AwsResource::LogGroup, format!("the log group {}{at}", group.name)));
    }
    let place = |(resource, address)| Place {
        resource,
        address,
        leaderboard: Arc::clone(leaderboard),
    };
    places.into_iter().map(place).collect()
}

/// Asks for one place.
pub(super) async fn ask(aws: Aws, asked: Asked<Place>) -> Result<Seen, Failure> {
    let (aws, place) = (&aws, &asked.question);
    let spec = &place.leaderboard.spec;
    let answer = match (place.resource, spec.dynamo_table(), spec.sqs(), spec.log_group()) {
        (AwsResource::Table, Some(table), ..) => of_table(Table::describe(aws, table).await),
        (AwsResource::Rows, Some(table), ..) => of_table(try_rows(aws, table).await),
        (AwsResource::Queue, _, Some(queue), _) => of_queue(queue::check(aws, queue, &queue.url).await),
        (AwsResource::DeadLetterQueue, _, Some(queue), _) => {
            let url = queue.dead_letter_url.as_deref().unwrap_or_default();
            of_queue(queue::check(aws, queue, url).await)
        }
        (AwsResource::LogGroup, .., Some(group)) => {
            let days = group.retention_days.unwrap_or_default();
            of_log_group(log_groups::keep(aws, group, days).await)
        }
        _ => {
            let prefix = format!("{}{NO_RUN}", spec.storage.s3.prefix.as_deref().unwrap_or_default());
            let archive = Archive::of_storage(aws, &spec.storage.s3).at_prefix(prefix);
            of_bucket(archive.prefix_is_empty().await)
        }
    };
    if let Ok(Seen { hidden: Some(why), .. }) | Err(Failure { why, .. }) = &answer {
        let leaderboard = key_of(place.leaderboard.as_ref());
        tracing::warn!(%leaderboard, place = place.address, why, "the bucket, table, queue or log group cannot be reached");
    }
    answer
}

/// Writes to the table, because the right to describe it does not include the right to write rows.
async fn try_rows(aws: &Aws, table: &api::DynamoTable) -> Result<(), TableError> {
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
    use super::*;
    use leaderboard_aws::archive::Cause;
    use serde_json::json;

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
            let named = named(&Arc::new(board)).into_iter();
            named.map(|place| place.address).collect::<Vec<_>>()
        };
        assert_eq!(places(&spec), ["the bucket bucket"]);
        spec["table"] = json!({"dynamoDB": {"name": "rows", "region": "eu-west-1"}});
        spec["queue"] = json!({"sqs": {"url": "https://sqs/one", "deadLetterURL": "https://sqs/dead"}});
        let all = [
            "the bucket bucket",
            "the table rows at eu-west-1",
            "the rows of rows at eu-west-1",
            "the queue https://sqs/one",
            "the dead-letter queue https://sqs/dead",
        ];
        assert_eq!(places(&spec), all);
        let mut observing = spec.clone();
        observing["evalai"]["mode"] = json!("Observe");
        assert!(!places(&observing).contains(&all[2].to_owned()), "none is written");
        // A group that is the host's own is left alone.
        spec["logs"] = json!({"cloudWatch": {"name": "logs"}});
        assert_eq!(places(&spec), all);
        spec["logs"] = json!({"cloudWatch": {"name": "logs", "retentionDays": 30}});
        assert_eq!(places(&spec).last().unwrap(), "the log group logs");
    }
}
