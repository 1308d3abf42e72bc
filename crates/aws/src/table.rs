//! The DynamoDB table of submissions: finds out its keys, writes rows so that an older one never wins.
//!
//! Called through `Tables` by the controller's leader, which alone writes. Knows no Kubernetes objects; what a
//! column holds is the caller's.

mod keys;
mod read;
mod tables;
mod trial;

use std::collections::{BTreeMap, HashMap};

use aws_sdk_dynamodb::Client;
use aws_sdk_dynamodb::config::http::HttpResponse;
use aws_sdk_dynamodb::error::{ProvideErrorMetadata, SdkError};
use aws_sdk_dynamodb::operation::update_item::UpdateItemError;
use aws_sdk_dynamodb::operation::update_item::builders::UpdateItemFluentBuilder;
use aws_sdk_dynamodb::types::{AttributeValue, ReturnValuesOnConditionCheckFailure};
use thiserror::Error;

use keys::Key;
pub use read::ObservedRow;
pub use tables::Tables;

use crate::clients::Aws;
use crate::fault::{self, Fault};
use crate::metered::Metered;
use leaderboard_api as api;
use leaderboard_base::meter::Meter;

/// Column with the attempt, a number.
const ATTEMPT: &str = "attempt";
/// Column with the status, in upper case.
const STATUS: &str = "submission_status";
/// Statuses after which a row of the same attempt is not written again.
const ENDS: [&str; 3] = ["FINISHED", "FAILED", "CANCELLED"];
/// A row is written only over an older attempt, or over the same one before its end.
const CONDITION: &str = "attribute_not_exists(#attempt) OR #attempt < :attempt \
     OR (#attempt = :attempt AND NOT (#status IN (:end0, :end1, :end2)))";
/// Status in a cancelled submission's row.
const CANCELLED: &str = ENDS[2];
/// A cancel that EvalAI shows after it has refused a result is written over the end that the row had. Nothing leads back from it.
const OR_CANCELLED: &str = " OR (#attempt = :attempt AND #status IN (:end0, :end1))";
/// One row, all columns as text. An empty text is unknown: its column stays as it is.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Row {
    /// Partition key: id of the team.
    pub team_id: String,
    /// Sort key: id of the run.
    pub run_id: String,
    /// Attempt, from 1.
    pub attempt: i64,
    /// Name of the team.
    pub team_name: String,
    /// `PENDING`, `RUNNING`, `FINISHED` and so on.
    pub submission_status: String,
    /// Id of the phase.
    pub track_id: String,
    /// Codename of the track.
    pub track_name: String,
    /// The participant's image.
    pub submitted_image_uri: String,
    /// When it was submitted, as `2026-11-20 10:00:00 UTC`.
    pub submitted_time: String,
    /// When the attempt started.
    pub start_time: String,
    /// When the attempt ended.
    pub end_time: String,
    /// Where the results are, `s3://bucket/id`.
    pub results: String,
    /// `12/20`.
    pub progress: String,
    /// GPUs times seconds that it has used.
    pub gpu_seconds: String,
    /// Metric columns and their values; none removes the column: only a finished submission has metrics.
    pub metrics: Vec<(String, Option<String>)>,
}

impl Row {
    /// The columns that are known, but for the keys and the attempt; those without a value are removed.
    fn columns(&self) -> Columns<'_> {
        let fixed = [
            ("team_name", &self.team_name),
            (STATUS, &self.submission_status),
            ("track_id", &self.track_id),
            ("track_name", &self.track_name),
            ("submitted_image_uri", &self.submitted_image_uri),
            ("submitted_time", &self.submitted_time),
            ("start_time", &self.start_time),
            ("end_time", &self.end_time),
            ("results", &self.results),
            ("progress", &self.progress),
            ("gpu_seconds", &self.gpu_seconds),
        ];
        let metrics = self
            .metrics
            .iter()
            .map(|(column, value)| (column.as_str(), value.as_deref()));
        // The phase names its metrics, maybe like a column of ours; our own columns come last and win.
        metrics
            .chain(fixed.iter().map(|(column, value)| (*column, Some(value.as_str()))))
            .filter(|(column, value)| *value != Some("") && *column != ATTEMPT)
            .collect()
    }
}

/// Condition on the row that is there.
fn condition(row: &Row) -> String {
    let is_cancelled = row.submission_status == CANCELLED;
    let or_cancelled = if is_cancelled { OR_CANCELLED } else { "" };
    format!("{CONDITION}{or_cancelled}")
}

/// Columns and their values; those without one are removed.
type Columns<'a> = BTreeMap<&'a str, Option<&'a str>>;

/// Outcome of a write.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Written {
    /// The row is stored, now or by an earlier try.
    Stored,
    /// The table holds the end of this attempt, or a later attempt, with other values.
    Stale {
        /// The attempt of that row.
        kept: i64,
    },
}

/// Why a row is not stored.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum TableError {
    /// The operator may not do this.
    #[error("table {table}: {action} is not allowed: {text}; give the operator's AWS identity dynamodb:{action}")]
    Denied {
        table: String,
        action: &'static str,
        text: String,
    },
    /// There is no such table.
    #[error(
        "table {table} does not exist: {text}; check table.dynamoDB.name, table.dynamoDB.region and table.dynamoDB.endpoint"
    )]
    Missing { table: String, text: String },
    /// DynamoDB may accept it later.
    #[error("table {table}: {action} failed: {text}; it is retried")]
    Passing {
        table: String,
        action: &'static str,
        text: String,
    },
    /// DynamoDB refuses it.
    #[error("table {table}: {action} was refused: {text}")]
    Refused {
        table: String,
        action: &'static str,
        text: String,
    },
    /// The table has one key only: the rows of a team would overwrite each other.
    #[error("table {table} has no sort key; it needs a partition key for the team and a sort key for the submission")]
    NoSortKey { table: String },
    /// The keys that are set are not the table's.
    #[error(
        "table {table} has the keys {found} but table.dynamoDB.partitionKey and table.dynamoDB.sortKey are {set}; leave both out"
    )]
    OtherKeys { table: String, found: String, set: String },
    /// A key's value is not of the type that the table wants.
    #[error("table {table}: key {key} {problem}")]
    Key {
        table: String,
        key: String,
        problem: String,
    },
    /// The table holds a later state of the submission.
    #[error("table {table} already holds attempt {kept} of submission {run_id}; the row is left as it is")]
    Stale { table: String, run_id: String, kept: i64 },
}

impl TableError {
    /// True if other rows of this table would meet the same error, and the same row may be taken later.
    pub fn is_of_the_table(&self) -> bool {
        !matches!(self, Self::Refused { .. } | Self::Key { .. } | Self::Stale { .. })
    }
}

/// A table whose keys are known.
#[derive(Clone, Debug)]
pub struct Table {
    client: Client,
    meter: Meter,
    name: String,
    partition: Key,
    sort: Key,
}

impl Table {
    /// Asks the table for the names and types of its keys. Where that is not allowed, keys that are set are taken
    /// for strings.
    pub async fn describe(aws: &Aws, table: &api::DynamoTable) -> Result<Self, TableError> {
        let client = aws.dynamodb(table.region.as_deref(), table.endpoint.as_deref());
        let name = table.name.clone();
        let set = table.partition_key.clone().zip(table.sort_key.clone());
        let request = client.describe_table().table_name(&name).send();
        let answer = aws.meter().aws("dynamodb", "DescribeTable", request).await;
        let (partition, sort) = match answer.map_err(|error| failed(&name, "DescribeTable", &error)) {
            Ok(output) => keys::read(&name, output.table.as_ref(), set)?,
            Err(TableError::Denied { .. }) if set.is_some() => {
                let (partition, sort) = set.unwrap_or_default();
                (Key::text(partition), Key::text(sort))
            }
            Err(error) => return Err(error),
        };
        Ok(Self {
            client,
            meter: aws.meter().clone(),
            name,
            partition,
            sort,
        })
    }

    /// Writes a row, unless the table holds a later one. Safe twice.
    pub async fn write(&self, row: &Row) -> Result<Written, TableError> {
        let columns = self.columns(row);
        let request = set_columns(self.request(row)?, &columns).send();
        match self.meter.aws("dynamodb", "UpdateItem", request).await {
            Ok(_) => Ok(Written::Stored),
            Err(error) => match error.as_service_error() {
                Some(UpdateItemError::ConditionalCheckFailedException(lost)) => {
                    let old = lost.item();
                    let same = old.is_some_and(|old| is_same(old, row.attempt, &columns));
                    let kept = old.and_then(attempt_of).unwrap_or(row.attempt);
                    Ok(if same { Written::Stored } else { Written::Stale { kept } })
                }
                _ => Err(failed(&self.name, "UpdateItem", &error)),
            },
        }
    }

    /// An update of the row with these keys, which names the column of the attempt, without a condition.
    fn update(&self, row: &Row) -> Result<UpdateItemFluentBuilder, TableError> {
        let team = self.partition.value(&self.name, &row.team_id, "team")?;
        let submission = self.sort.value(&self.name, &row.run_id, "submission")?;
        let update = self.client.update_item().table_name(&self.name);
        Ok(update
            .key(&self.partition.name, team)
            .key(&self.sort.name, submission)
            .expression_attribute_names("#attempt", ATTEMPT)
            .expression_attribute_values(":attempt", AttributeValue::N(row.attempt.to_string())))
    }

    /// The update of a row, under its condition, without columns.
    fn request(&self, row: &Row) -> Result<UpdateItemFluentBuilder, TableError> {
        let mut request = self
            .update(row)?
            .condition_expression(condition(row))
            .expression_attribute_names("#status", STATUS)
            .return_values_on_condition_check_failure(ReturnValuesOnConditionCheckFailure::AllOld);
        for (index, end) in ENDS.into_iter().enumerate() {
            request = request.expression_attribute_values(format!(":end{index}"), AttributeValue::S(end.into()));
        }
        Ok(request)
    }

    /// Keys can't be set; a table may have given one the name of a column.
    fn columns<'a>(&self, row: &'a Row) -> Columns<'a> {
        let mut columns = row.columns();
        columns.retain(|column, _| *column != self.partition.name && *column != self.sort.name);
        columns
    }
}

/// Sets the columns that have a value, and removes the others.
fn set_columns(mut request: UpdateItemFluentBuilder, columns: &Columns<'_>) -> UpdateItemFluentBuilder {
    let (mut set, mut remove) = (vec!["#attempt = :attempt".to_owned()], Vec::new());
    for (index, (column, value)) in columns.iter().enumerate() {
        // A name may have one placeholder only, and the status has one already.
        let name = match *column {
            STATUS => "#status".to_owned(),
            _ => format!("#c{index}"),
        };
        request = request.expression_attribute_names(&name, *column);
        if let Some(value) = value {
            set.push(format!("{name} = :v{index}"));
            request = request.expression_attribute_values(format!(":v{index}"), AttributeValue::S((*value).into()));
        } else {
            remove.push(name);
        }
    }
    let mut update = format!("SET {}", set.join(", "));
    if !remove.is_empty() {
        update = format!("{update} REMOVE {}", remove.join(", "));
    }
    request.update_expression(update)
}

fn attempt_of(item: &HashMap<String, AttributeValue>) -> Option<i64> {
    item.get(ATTEMPT)?.as_n().ok()?.parse().ok()
}

/// True if the stored item holds what we were about to write.
fn is_same(old: &HashMap<String, AttributeValue>, attempt: i64, columns: &Columns<'_>) -> bool {
    attempt_of(old) == Some(attempt)
        && columns.iter().all(|(column, value)| match (old.get(*column), value) {
            (stored, None) => stored.is_none(),
            (stored, Some(value)) => stored.and_then(|v| v.as_s().ok()).is_some_and(|text| text == value),
        })
}

fn failed<E>(table: &str, action: &'static str, error: &SdkError<E, HttpResponse>) -> TableError
where
    E: ProvideErrorMetadata + std::error::Error + 'static,
{
    let (table, text) = (table.to_owned(), fault::sentence(error));
    match fault::of(error) {
        Fault::Denied => TableError::Denied { table, action, text },
        Fault::Missing => TableError::Missing { table, text },
        Fault::Throttled | Fault::Unavailable | Fault::Conflict => TableError::Passing { table, action, text },
        Fault::Refused => TableError::Refused { table, action, text },
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unknown_columns_are_left_alone_and_metrics_hide_none_of_ours() {
        let row = Row {
            team_name: "t".into(),
            submission_status: "RUNNING".into(),
            metrics: vec![
                ("score".into(), Some("1.5".into())),
                ("gone".into(), None),
                ("team_name".into(), None),
                ("attempt".into(), Some("9".into())),
            ],
            ..Row::default()
        };
        let want = BTreeMap::from([
            ("score", Some("1.5")),
            ("gone", None),
            (STATUS, Some("RUNNING")),
            ("team_name", Some("t")),
        ]);
        assert_eq!(row.columns(), want);
    }

    #[test]
    fn what_is_stored_already_is_known_again() {
        let columns = BTreeMap::from([("a", Some("1")), (STATUS, Some("FAILED"))]);
        let text = |text: &str| AttributeValue::S(text.into());
        let old = |attempt: &str, status: &str| {
            HashMap::from([
                (ATTEMPT.to_owned(), AttributeValue::N(attempt.into())),
                (STATUS.to_owned(), text(status)),
                ("a".to_owned(), text("1")),
                ("of an earlier attempt".to_owned(), text("z")),
            ])
        };
        assert!(is_same(&old("2", "FAILED"), 2, &columns));
        assert!(!is_same(&old("2", "FINISHED"), 2, &columns));
        assert!(!is_same(&old("3", "FAILED"), 2, &columns));
        let removed = |column| BTreeMap::from([(STATUS, Some("FAILED")), (column, None)]);
        assert!(is_same(&old("2", "FAILED"), 2, &removed("b")));
        assert!(!is_same(&old("2", "FAILED"), 2, &removed("a")), "it is still there");
    }
}
