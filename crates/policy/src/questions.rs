//! Questions of `decide` to services outside the cluster.

use std::fmt;
use std::time::Duration;

use crate::ask::{Ask, Failure, Service};
use leaderboard_api::{Attempt, DynamoTable, RunId, S3Bucket, SubmittedFile};

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

/// The file of a submission in EvalAI, which is to be copied into the bucket of its run.
#[derive(Clone, Debug, PartialEq)]
pub struct Input {
    /// An attempt asks anew: EvalAI may have another file since.
    pub attempt: Attempt,
    /// EvalAI's server, in one spelling.
    pub server: String,
    /// Names the prefix of the run.
    pub run_id: RunId,
    pub storage: S3Bucket,
    /// Id of the submission in EvalAI.
    pub submission: i64,
    /// Most bytes that the file may have.
    pub limit: u64,
}

/// Outcome of a copy.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Fetched {
    /// The bucket has it.
    Stored(SubmittedFile),
    /// It has more bytes than it may have.
    TooLarge,
    /// EvalAI has not given it out, so many times in a row.
    Missing { why: Absence, times: u32 },
}

/// Why a file is not to be had.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Absence {
    /// Its address answers with this HTTP status.
    Status(u16),
    /// EvalAI's row names no file.
    NoFile,
    /// The copy took longer than [`INPUT_LIMIT`].
    Late,
}

/// For people.
impl fmt::Display for Absence {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Status(status) => write!(f, "EvalAI's address of it answers {status}"),
            Self::NoFile => f.write_str("EvalAI's row of the submission names no file"),
            Self::Late => write!(f, "it could not be copied within {} min", INPUT_LIMIT.as_secs() / 60),
        }
    }
}

/// For people.
impl fmt::Display for Fetched {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Stored(file) => write!(f, "{} bytes are stored", file.size),
            Self::TooLarge => f.write_str("it is too large"),
            Self::Missing { why, times } => write!(f, "{why}, {times} times in a row"),
        }
    }
}

/// Time that a copy may take.
pub const INPUT_LIMIT: Duration = Duration::from_mins(30);
/// Times that EvalAI is asked for a file which it does not give out.
pub const INPUT_TRIES: u32 = 3;
/// Time between two of them. In it EvalAI is asked for the address anew.
const INPUT_PAUSE: Duration = Duration::from_mins(1);
/// Pauses after a copy that has failed: each is twice as long as the one before.
const FIRST_PAUSE: Duration = Duration::from_secs(10);
const LONGEST_PAUSE: Duration = Duration::from_mins(5);

impl Ask for Input {
    type Answer = Fetched;
    /// Each has a part of a file in memory, of 11 MiB at most. The chart gives the controller 256 MiB.
    const AT_ONCE: usize = 6;
    const AT_ONCE_OF_A_SERVICE: usize = 4;
    /// The copy has a limit of its own, which is shorter: it gives an upload up that it has begun.
    const LONGEST: Duration = Duration::from_mins(50);

    /// EvalAI may be slow for all of a copy's time. A request to the bucket has a limit of its own.
    fn service(&self) -> Service {
        Service::evalai(&self.server)
    }

    fn again(&self, result: &Result<Fetched, Failure>, failures: u32, _waited: Duration) -> Option<Duration> {
        match result {
            Ok(Fetched::Missing { times, .. }) => (*times < INPUT_TRIES).then_some(INPUT_PAUSE),
            Ok(Fetched::Stored(_) | Fetched::TooLarge) => None,
            Err(_) => {
                let doubled = 1_u32 << failures.saturating_sub(1).min(5);
                Some(LONGEST_PAUSE.min(FIRST_PAUSE * doubled))
            }
        }
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

    #[test]
    fn a_file_is_fetched_once_and_what_failed_is_tried_again_later_each_time() {
        let question = Input {
            attempt: Attempt::FIRST,
            server: "https://evalai.example".into(),
            run_id: "77".parse().unwrap(),
            storage: serde_json::from_value(serde_json::json!({"bucket": "results"})).unwrap(),
            submission: 77,
            limit: 1 << 30,
        };
        let stored = Fetched::Stored(SubmittedFile {
            sha256: "0".repeat(64),
            size: 3,
        });
        let missing = |why, times| Ok(Fetched::Missing { why, times });
        let gone = |times| missing(Absence::Status(404), times);
        let silent = || Err(Failure::silent("no"));
        for (result, failures, pause) in [
            (Ok(stored), 0, None),
            (Ok(Fetched::TooLarge), 0, None),
            (gone(1), 0, Some(60)),
            (gone(2), 0, Some(60)),
            (gone(INPUT_TRIES), 0, None),
            (missing(Absence::NoFile, 1), 0, Some(60)),
            (missing(Absence::Late, 2), 0, Some(60)),
            (missing(Absence::Late, INPUT_TRIES), 0, None),
            (silent(), 1, Some(10)),
            (silent(), 2, Some(20)),
            (silent(), 5, Some(160)),
            (silent(), 6, Some(300)),
            (silent(), u32::MAX, Some(300)),
        ] {
            let again = question.again(&result, failures, Duration::ZERO);
            assert_eq!(again.map(|pause| pause.as_secs()), pause, "{result:?} after {failures}");
        }
    }
}
