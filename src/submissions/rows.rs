//! The row that another program may have written of a submission, read before anything is written of it anywhere. While it shows a run,
//! or cannot be read, it is read again every 30 s.

use std::sync::Arc;

use crate::ask::Asked;
use leaderboard_aws::table::{ObservedRow, TableError, Tables};
use leaderboard_policy::ask::Failure;
use leaderboard_policy::questions::{ForeignRun, Row};

/// Words of the old pipeline's row for a run that has not ended.
const UNDER_WAY: [&str; 2] = ["SUBMITTED", "RUNNING"];

/// Reads the row.
pub async fn read(tables: Arc<Tables>, asked: Asked<Row>) -> Result<Option<ForeignRun>, Failure> {
    let row = &asked.question;
    match tables.read(&row.table, &row.team, row.run_id.as_str()).await {
        Ok(found) => Ok(found.and_then(foreign_run)),
        Err(error) => failure(&error).map_or(Ok(None), Err),
    }
}

/// A row without an attempt is not this operator's.
fn foreign_run(row: ObservedRow) -> Option<ForeignRun> {
    let is_under_way = UNDER_WAY.contains(&row.status.as_str());
    (is_under_way && !row.is_ours).then_some(ForeignRun {
        status: row.status,
        since: row.since,
    })
}

/// A table that does not exist, or cannot hold such a row, holds no other program's. The Leaderboard's status shows what is wrong.
fn failure(error: &TableError) -> Option<Failure> {
    let is_refused = match error {
        TableError::Missing { .. }
        | TableError::NoSortKey { .. }
        | TableError::OtherKeys { .. }
        | TableError::Key { .. } => return None,
        TableError::Denied { .. } | TableError::Refused { .. } | TableError::Stale { .. } => true,
        TableError::Passing { .. } => false,
    };
    let why = error.to_string();
    Some(Failure { is_refused, why })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(status: &str, is_ours: bool) -> ObservedRow {
        ObservedRow {
            status: status.into(),
            is_ours,
            since: Some("2026-11-20 10:00:00 UTC".into()),
        }
    }

    #[test]
    fn only_a_row_of_a_run_without_our_attempt_shows_another_program() {
        for (status, is_ours, is_foreign) in [
            ("SUBMITTED", false, true),
            ("RUNNING", false, true),
            ("SUBMITTED", true, false),
            ("RUNNING", true, false),
            ("FINISHED", false, false),
            ("FAILED", false, false),
            ("CANCELLED", false, false),
            ("", false, false),
        ] {
            let found = foreign_run(row(status, is_ours));
            assert_eq!(found.is_some(), is_foreign, "{status} {is_ours}");
        }
    }

    #[test]
    fn only_a_table_that_can_hold_no_row_counts_as_empty() {
        let (table, text, action) = (|| "rows".to_owned(), String::new, "GetItem");
        let is_refused = |error| failure(&error).map(|failure| failure.is_refused);
        assert_eq!(is_refused(TableError::NoSortKey { table: table() }), None);
        let missing = TableError::Missing {
            table: table(),
            text: text(),
        };
        assert_eq!(is_refused(missing), None);
        let denied = TableError::Denied {
            table: table(),
            action,
            text: text(),
        };
        assert_eq!(is_refused(denied), Some(true));
        let passing = TableError::Passing {
            table: table(),
            action,
            text: text(),
        };
        assert_eq!(is_refused(passing), Some(false));
    }
}
