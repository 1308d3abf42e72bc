//! Asks AWS for a Leaderboard's bucket, table and queues: one cheap request each, all at once, each with a limit of time.
//!
//! Called by `probe`. When to ask, and what follows, is decided by `reach`.

use std::fmt::Display;
use std::time::Duration;

use futures::future::{BoxFuture, FutureExt, join_all};
use jiff::Timestamp;

use super::reach::{AwsResource, Finding, Reach};
use crate::controller::objects::key_of;
use crate::services::archive::{Archive, ArchiveError};
use crate::services::aws::Aws;
use crate::services::fault::Fault;
use crate::services::log_groups::{self, LogGroupError};
use crate::services::queue::{self, QueueError, Reading};
use crate::services::table::{Table, TableError};
use leaderboard_api::{self as api, Leaderboard};

/// Time one answer may take.
const LIMIT: Duration = Duration::from_secs(10);
/// A run that nobody has: the list below it is empty, and costs nothing.
const NO_RUN: &str = "none/";

/// What was read of the queues that were asked.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Readings {
    pub(super) queue: Option<Reading>,
    pub(super) dead_letters: Option<Reading>,
}

/// What has to be asked now, each with its address in words.
pub(super) fn due(leaderboard: &Leaderboard, reach: &Reach, now: Timestamp) -> Vec<(AwsResource, String)> {
    let generation = leaderboard.metadata.generation.unwrap_or_default();
    let is_due = |(place, address): &(AwsResource, String)| reach.is_due(*place, address, generation, now);
    named(leaderboard).into_iter().filter(is_due).collect()
}

/// Asks what is due.
pub(super) async fn look(
    aws: &Aws,
    leaderboard: &Leaderboard,
    reach: &mut Reach,
    due: Vec<(AwsResource, String)>,
    now: Timestamp,
) -> Readings {
    let generation = leaderboard.metadata.generation.unwrap_or_default();
    let places: Vec<AwsResource> = named(leaderboard).iter().map(|(place, _)| *place).collect();
    reach.retain(&places);
    let asked = due.into_iter().map(|(place, address)| {
        let question = ask(aws, leaderboard, place);
        async move {
            let answer = tokio::time::timeout(LIMIT, question).await;
            let silent = || Finding::Silent(format!("{address} did not answer within {} s", LIMIT.as_secs()));
            let (found, read) = answer.unwrap_or_else(|_| (silent(), None));
            (place, address, found, read)
        }
    });
    let mut readings = Readings::default();
    for (place, address, found, read) in join_all(asked).await {
        match place {
            AwsResource::Queue => readings.queue = read,
            AwsResource::DeadLetterQueue => readings.dead_letters = read,
            AwsResource::Bucket | AwsResource::Table | AwsResource::Rows | AwsResource::LogGroup => {}
        }
        if let Finding::Bad(why) | Finding::Hidden(why) | Finding::Silent(why) = &found {
            tracing::warn!(leaderboard = %key_of(leaderboard), place = address, why, "the bucket, table, queue or log group cannot be reached");
        }
        reach.take(place, &address, generation, found, now);
    }
    readings
}

/// What a Leaderboard names, each with its address in words.
fn named(leaderboard: &Leaderboard) -> Vec<(AwsResource, String)> {
    let spec = &leaderboard.spec;
    let at = |region: &Option<String>, endpoint: &Option<String>| {
        let place = endpoint.as_ref().or(region.as_ref());
        place.map(|place| format!(" at {place}")).unwrap_or_default()
    };
    let (region, endpoint) = (&spec.storage.region, &spec.storage.endpoint);
    let bucket = format!("the bucket {}{}", spec.storage.bucket, at(region, endpoint));
    let mut places = vec![(AwsResource::Bucket, bucket)];
    if let Some(table) = &spec.table {
        let keys = table.partition_key.as_deref().zip(table.sort_key.as_deref());
        let keys = keys.map(|(team, submission)| format!(" by {team} and {submission}"));
        let (keys, at) = (keys.unwrap_or_default(), at(&table.region, &table.endpoint));
        places.push((AwsResource::Table, format!("the table {}{keys}{at}", table.name)));
        if !spec.observes() {
            places.push((AwsResource::Rows, format!("the rows of {}{keys}{at}", table.name)));
        }
    }
    if let Some(queue) = &spec.queue {
        let at = at(&queue.region, &queue.endpoint);
        places.push((AwsResource::Queue, format!("the queue {}{at}", queue.url)));
        let dead = queue.dead_letter_url.as_ref();
        places.extend(dead.map(|url| (AwsResource::DeadLetterQueue, format!("the dead-letter queue {url}{at}"))));
    }
    if let Some(group) = spec.log_group.as_ref().filter(|group| group.retention_days.is_some()) {
        let at = at(&group.region, &group.endpoint);
        places.push((AwsResource::LogGroup, format!("the log group {}{at}", group.name)));
    }
    places
}

fn ask<'a>(
    aws: &'a Aws,
    leaderboard: &'a Leaderboard,
    place: AwsResource,
) -> BoxFuture<'a, (Finding, Option<Reading>)> {
    let spec = &leaderboard.spec;
    if let (AwsResource::LogGroup, Some(group)) = (place, &spec.log_group) {
        let days = group.retention_days.unwrap_or_default();
        return async move { (of_log_group(log_groups::keep(aws, group, days).await), None) }.boxed();
    }
    match (place, &spec.table, &spec.queue) {
        (AwsResource::Bucket, ..) => {
            let prefix = format!("{}{NO_RUN}", spec.storage.prefix.as_deref().unwrap_or_default());
            let archive = Archive::of_storage(aws, &spec.storage).at_prefix(prefix);
            async move { (of_bucket(archive.prefix_is_empty().await), None) }.boxed()
        }
        (AwsResource::Table, Some(table), _) => {
            async move { (of_table(Table::describe(aws, table).await), None) }.boxed()
        }
        (AwsResource::Rows, Some(table), _) => async move { (of_table(try_rows(aws, table).await), None) }.boxed(),
        (AwsResource::Queue, _, Some(queue)) => {
            async move { of_queue(queue::check(aws, queue, &queue.url).await) }.boxed()
        }
        (AwsResource::DeadLetterQueue, _, Some(queue)) => {
            let url = queue.dead_letter_url.as_deref().unwrap_or_default();
            async move { of_queue(queue::check(aws, queue, url).await) }.boxed()
        }
        // It is named by nobody.
        _ => async { (Finding::Good, None) }.boxed(),
    }
}

/// Whether the table takes rows. The right to describe it does not include that.
async fn try_rows(aws: &Aws, table: &api::Table) -> Result<(), TableError> {
    Table::describe(aws, table).await?.try_write().await
}

/// What an answer means; a cause that passes is as none.
fn finding<T, E: Display>(answer: Result<T, E>, is_passing: impl Fn(&E) -> bool) -> Finding {
    match answer {
        Ok(_) => Finding::Good,
        Err(error) if is_passing(&error) => Finding::Silent(error.to_string()),
        Err(error) => Finding::Bad(error.to_string()),
    }
}

fn of_bucket<T>(answer: Result<T, ArchiveError>) -> Finding {
    finding(answer, |error| error.cause.is_transient())
}

fn of_table<T>(answer: Result<T, TableError>) -> Finding {
    finding(answer, |error| matches!(error, TableError::Passing { .. }))
}

/// The bridge reads the queue, with rights of its own.
fn of_queue(answer: Result<Reading, QueueError>) -> (Finding, Option<Reading>) {
    match answer {
        Ok(reading) => (Finding::Good, Some(reading)),
        Err(error) if error.fault == Fault::Denied => (Finding::Hidden(error.to_string()), None),
        failed => (finding(failed, |error| error.fault.is_passing()), None),
    }
}

fn of_log_group(answer: Result<(), LogGroupError>) -> Finding {
    finding(answer, |error| error.fault.is_passing())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::services::archive::Cause;
    use serde_json::json;

    #[test]
    fn a_refusal_of_aws_has_its_reason_and_next_step() {
        use std::mem::discriminant;
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
        let (bad, hidden, silent) = (
            discriminant(&Finding::Bad(String::new())),
            discriminant(&Finding::Hidden(String::new())),
            discriminant(&Finding::Silent(String::new())),
        );
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
            (of_queue(Err(queue(Fault::Missing))).0, bad),
            (of_queue(Err(queue(Fault::Denied))).0, hidden),
            (of_queue(Err(queue(Fault::Throttled))).0, silent),
            (of_log_group(Err(group(Fault::Denied))), bad),
            (of_log_group(Err(group(Fault::Throttled))), silent),
        ];
        for (found, kind) in cases {
            assert_eq!(discriminant(&found), kind, "{found:?}");
        }
    }

    #[test]
    fn only_what_is_named_is_asked_for() {
        let mut spec = json!({
            "evalai": {"apiServer": "https://e", "challenge": 1, "token": {"secretKeyRef": {"name": "t", "key": "k"}}},
            "tracks": [{"name": "sensors", "codename": "SENSORS", "phase": 1}],
            "leaderboardVersion": "V2", "contents": {"image": "c"}, "simulator": {"image": "s"},
            "storage": {"bucket": "bucket"},
        });
        let places = |spec: &serde_json::Value| {
            let board = Leaderboard::new("one", serde_json::from_value(spec.clone()).unwrap());
            named(&board)
                .into_iter()
                .map(|(_, address)| address)
                .collect::<Vec<_>>()
        };
        assert_eq!(places(&spec), ["the bucket bucket"]);
        spec["table"] = json!({"name": "rows", "region": "eu-west-1"});
        spec["queue"] = json!({"url": "https://sqs/one", "deadLetterURL": "https://sqs/dead"});
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
        spec["logGroup"] = json!({"name": "logs"});
        assert_eq!(places(&spec), all);
        spec["logGroup"] = json!({"name": "logs", "retentionDays": 30});
        assert_eq!(places(&spec).last().unwrap(), "the log group logs");
    }
}
