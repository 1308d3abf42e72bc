//! The rows of the tables: at most one write in 2 s and table, each only while this process leads, and ends before all others.
//!
//! The newest row of an object wins: a later attempt over an earlier one, an end over what comes before it.

use std::sync::Arc;
use std::time::Duration;

use crate::ask::{Asker, Wake};
use leaderboard_api::DynamoTable;
use leaderboard_aws::table::{Row, TableError, Tables, Written};
use leaderboard_base::backoff::Backoff;
use leaderboard_base::object_key::ObjectKey;
use leaderboard_base::spans::LogSpan;
use leaderboard_base::tasks::Tasks;
use leaderboard_policy::ask::{Ask, Failure, Lookup, Rank, Service};
use leaderboard_policy::view::RecordView;

/// Pauses after failures in a row.
const RETRY: Backoff = Backoff::new(Duration::from_secs(4), Duration::from_mins(5));
/// Time before a row that was refused for its own sake is tried again.
const REFUSED: Duration = Duration::from_mins(5);
/// A row that waits for less is on its way.
pub const ON_ITS_WAY: Duration = Duration::from_secs(10);

/// A row that is to be written.
#[derive(Clone, Debug, PartialEq)]
pub struct Record {
    pub table: DynamoTable,
    pub row: Arc<Row>,
    /// It is the last of its attempt.
    pub is_end: bool,
}

impl Ask for Record {
    type Answer = Written;
    const AT_ONCE: usize = 64;
    const AT_ONCE_OF_A_SERVICE: usize = 1;
    const LONGEST: Duration = Duration::from_mins(1);
    // The stock table has one write unit.
    const SPACING: Duration = Duration::from_secs(2);

    fn service(&self) -> Service {
        Service::table(&self.table)
    }

    fn again(&self, result: &Result<Written, Failure>, failures: u32, _waited: Duration) -> Option<Duration> {
        let failure = result.as_ref().err()?;
        Some(if failure.is_refused {
            REFUSED
        } else {
            RETRY.after(failures)
        })
    }

    fn rank(&self) -> Rank {
        (u8::from(!self.is_end), 0)
    }
}

/// Starts the task that writes. `may_write` is asked right before each write.
pub fn start(
    tables: Arc<Tables>,
    may_write: impl Fn() -> bool + Send + Sync + 'static,
    tasks: &Tasks,
    wake: Wake,
) -> Asker<Record> {
    let uses = (tables, Arc::new(may_write));
    Asker::start("records", tasks, wake, uses, |(tables, may_write), asked| async move {
        if !may_write() {
            return Err(Failure::silent("this process does not lead any more"));
        }
        let Record { table, row, .. } = &asked.question;
        let written = tables.write(table, row).await;
        written.map_err(|error| {
            tracing::warn!(%error, "the row is not in the table");
            failure(&error)
        })
    })
}

/// An error of the table passes for this row when it passes for the others.
fn failure(error: &TableError) -> Failure {
    let (is_refused, why) = (!error.is_of_the_table(), error.to_string());
    Failure { is_refused, why }
}

/// Writes the newest row of an object, unless a newer one is known. Safe to call in each reconcile.
pub fn record(records: &Asker<Record>, key: &ObjectKey, record: Record, log: LogSpan) {
    let known = records.get(&key.uid).asked;
    if known.is_none_or(|known| !record.is_older_than(&known)) {
        records.want(key, record, log);
    }
}

impl Record {
    fn is_older_than(&self, known: &Self) -> bool {
        let age = |record: &Self| (record.row.attempt, record.is_end);
        self.table == known.table && age(self) < age(known)
    }
}

/// The row of an attempt, as far as it is known.
pub fn seen(lookup: &Lookup<Record>, attempt: i64) -> RecordView {
    let Some(asked) = lookup.asked.as_ref().filter(|asked| asked.row.attempt == attempt) else {
        return RecordView::default();
    };
    let last = lookup.last.as_ref().filter(|last| last.question.row.attempt == attempt);
    let is_newest = last.is_some_and(|last| last.question == *asked);
    match last.map(|last| last.result.as_ref()) {
        Some(Err(failure)) => RecordView {
            error: Some(failure.why.clone()),
            ..RecordView::default()
        },
        Some(Ok(Written::Stored)) => RecordView {
            end_written: asked.is_end && is_newest,
            ..RecordView::default()
        },
        // A row before the end that comes too late is no error; an end that was not stored is.
        Some(Ok(Written::Stale { kept })) if asked.is_end && is_newest => RecordView {
            superseded_by: Some(*kept),
            error: Some(superseded(asked, *kept)),
            ..RecordView::default()
        },
        Some(Ok(Written::Stale { .. })) | None => RecordView::default(),
    }
}

fn superseded(asked: &Record, kept: i64) -> String {
    let (table, run_id) = (asked.table.name.clone(), asked.row.run_id.clone());
    TableError::Stale { table, run_id, kept }.to_string()
}

#[cfg(test)]
mod tests;
