//! Questions of `decide` to services outside the cluster.

use std::time::Duration;

use crate::ask::{Ask, Failure, Service};
use leaderboard_api::{Attempt, DynamoTable, RunId};

/// A run of another program, as its row shows it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ForeignRun {
    pub status: String,
    /// Since when, as it is stored.
    pub since: Option<String>,
}

/// Where the row of a submission would be.
#[derive(Clone, Debug, PartialEq)]
pub struct Row {
    /// An attempt asks anew: another program may have begun since.
    pub attempt: Attempt,
    pub table: DynamoTable,
    /// Id of the team, the table's partition key.
    pub team: String,
    pub run_id: RunId,
}

/// How long after an answer the row is read again.
pub const AGAIN: Duration = Duration::from_secs(30);

impl Ask for Row {
    /// None: no other program runs the submission.
    type Answer = Option<ForeignRun>;
    const AT_ONCE: usize = 16;
    const AT_ONCE_OF_A_SERVICE: usize = 4;
    const LONGEST: Duration = Duration::from_secs(10);

    fn service(&self) -> Service {
        Service::table(&self.table)
    }

    fn again(&self, result: &Result<Self::Answer, Failure>, _failures: u32, _waited: Duration) -> Option<Duration> {
        let is_free = matches!(result, Ok(None));
        (!is_free).then_some(AGAIN)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_row_is_read_once_unless_it_shows_a_run_or_cannot_be_read() {
        let question = Row {
            attempt: Attempt::FIRST,
            table: serde_json::from_value(serde_json::json!({"name": "rows"})).unwrap(),
            team: "42".into(),
            run_id: "77".parse().unwrap(),
        };
        let run = ForeignRun {
            status: "RUNNING".into(),
            since: None,
        };
        let unread = Failure {
            is_refused: true,
            why: "no".into(),
        };
        assert_eq!(question.again(&Ok(None), 0, Duration::ZERO), None);
        assert_eq!(question.again(&Ok(Some(run)), 0, Duration::ZERO), Some(AGAIN));
        assert_eq!(question.again(&Err(unread), 9, Duration::ZERO), Some(AGAIN));
    }
}
