//! What another program has left of a submission in table and bucket, or this operator before the object lost its status. It is looked
//! for once for each attempt, before its first Job, and again while the submission waits for the other program.

use std::collections::HashMap;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use jiff::Timestamp;

use super::questions::{self, Observed, Questions};
use crate::ask::Service;
use crate::controller::objects::Wake;
use crate::controller::submissions::report_digest::StoredReport;
use crate::lock::lock;
use crate::observability::tasks::Tasks;
use crate::pod::report::{MAX_BYTES, OWNER_KEY, REPORT_KEY};
use crate::services::archive::{Archive, ArchiveError, Cause, Listed};
use crate::services::aws::Aws;
use crate::services::table::{ObservedRow, Table, TableError, TableId};
use leaderboard_api::names::FAILURE_LOG_KEY;
use leaderboard_api::{self as api, Attempt, RunId, Storage, Submission, effective};

/// Time one look may take.
const LIMIT: Duration = Duration::from_secs(20);
/// An answer is good for so long; a submission that still waits is looked for again.
pub const AGAIN: Duration = Duration::from_secs(30);
/// Most objects of one prefix that are looked at: the old pipeline stores its logs anew in each round, and they come first.
const MOST_OBJECTS: usize = 2000;
/// What the old pipeline stores when a run of it has ended. It removes both before it begins another one.
const ENDS: [&str; 2] = ["containers-status/logcopy.done", "containers-status/simulation.cancel"];
/// Where the marks of both pipelines lie, and how many objects of each are looked at: the own ones come before what was refused.
const MARKED: [&str; 2] = ["containers-status/", "logcopy/"];
const MOST_MARKS: usize = 1000;

/// Where to look for a submission.
#[derive(Clone, Debug, PartialEq)]
pub struct Question {
    /// An attempt asks anew: another program may have begun since.
    pub attempt: Attempt,
    pub table: Option<api::Table>,
    pub storage: Storage,
    pub run_id: RunId,
    /// Id of the team, the table's partition key.
    pub team: String,
}

/// What was found of a submission.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Traces {
    /// Its row; none without a table, too.
    pub row: Option<ObservedRow>,
    pub stored: StoredRun,
    /// The last report of a run of ours.
    pub report: Option<Box<StoredReport>>,
}

/// What lies below the prefix of a run.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct StoredRun {
    /// When the newest object was stored; none: there is none.
    pub newest: Option<Timestamp>,
    /// A Pod of this operator has stored its mark there.
    pub is_ours: bool,
    /// The old pipeline has stored that its run has ended.
    pub has_ended: bool,
}

/// Why it is not known what there is, and what to do.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Unread {
    /// Waiting alone does not help.
    pub is_refused: bool,
    pub why: String,
}

/// An answer.
#[derive(Clone, Debug, PartialEq)]
pub struct Looked {
    /// When it was asked for: what has happened since is not in it.
    pub at: Timestamp,
    pub found: Result<Traces, Unread>,
}

impl questions::Question for Question {
    type Answer = Looked;
    const AT_ONCE: usize = 8;
    // Of a bucket or a table that hangs, each look takes all its time, and each submission is looked for again.
    const AT_ONCE_OF_A_SERVICE: usize = 2;
    const GOOD_FOR: Duration = AGAIN;

    fn attempt(&self) -> Attempt {
        self.attempt
    }

    fn shares_a_service(&self, other: &Self) -> bool {
        let tables = self.table.as_ref().zip(other.table.as_ref());
        Service::bucket(&self.storage) == Service::bucket(&other.storage)
            || tables.is_some_and(|(one, other)| Service::table(one) == Service::table(other))
    }
}

/// The questions and their answers.
pub type ForeignRuns = Questions<Question>;

/// What is known of a submission's present attempt.
pub type ObservedTraces = Observed<Looked>;

impl ForeignRuns {
    /// Starts the task that looks.
    pub fn start(aws: &Aws, tasks: &Tasks, wake: Wake<Submission>) -> Self {
        let places = Arc::new(Places {
            aws: aws.clone(),
            tables: Mutex::default(),
        });
        let look = move |question, _namespace| {
            let places = Arc::clone(&places);
            async move { look(&places, &question).await }
        };
        Self::answered_by(look, "foreign runs", tasks, wake)
    }
}

async fn look(places: &Places, question: &Question) -> Looked {
    let at = Timestamp::now();
    let answer = tokio::time::timeout(LIMIT, places.traces(question)).await;
    let slow = || {
        let why = format!("table and bucket did not answer within {} s", LIMIT.as_secs());
        Err(Unread { is_refused: false, why })
    };
    let found = answer.unwrap_or_else(|_| slow());
    Looked { at, found }
}

/// The tables and buckets.
struct Places {
    aws: Aws,
    /// Tables whose keys are known.
    tables: Mutex<HashMap<TableId, Table>>,
}

impl Places {
    async fn traces(&self, question: &Question) -> Result<Traces, Unread> {
        let (row, stored) = tokio::join!(self.row(question), self.stored(question));
        let stored = stored?;
        let report = if stored.is_ours {
            self.report(question).await?
        } else {
            None
        };
        Ok(Traces {
            row: row?,
            stored,
            report,
        })
    }

    /// A report that is none of ours shows nothing: the run goes on from the other objects.
    async fn report(&self, question: &Question) -> Result<Option<Box<StoredReport>>, Unread> {
        let archive = Archive::of_run(&self.aws, &question.storage, &question.run_id);
        let object = archive
            .get(REPORT_KEY, MAX_BYTES as u64)
            .await
            .map_err(|error| Unread {
                is_refused: !error.cause.is_transient(),
                why: error.to_string(),
            })?;
        Ok(object.and_then(|object| StoredReport::read(&object.bytes).ok().map(Box::new)))
    }

    async fn row(&self, question: &Question) -> Result<Option<ObservedRow>, Unread> {
        let Some(table) = question.table.as_ref().filter(|_| !question.team.is_empty()) else {
            return Ok(None);
        };
        let id = TableId::from(table);
        let known = lock(&self.tables).get(&id).cloned();
        let read = async {
            let described = match known {
                Some(described) => described,
                None => Table::describe(&self.aws, table).await?,
            };
            lock(&self.tables).insert(id.clone(), described.clone());
            described.read(&question.team, question.run_id.as_str()).await
        };
        let read = read.await;
        if read.is_err() {
            // It may have been made again with other keys.
            lock(&self.tables).remove(&id);
        }
        read.or_else(|error| of_table(&error))
    }

    async fn stored(&self, question: &Question) -> Result<StoredRun, Unread> {
        let archive = Archive::of_run(&self.aws, &question.storage, &question.run_id);
        let listed = async {
            let mut listing = archive.list("", MOST_OBJECTS).await?;
            for folder in unlisted(listing.complete) {
                listing.objects.extend(archive.list(folder, MOST_MARKS).await?.objects);
            }
            Ok(listing.objects)
        };
        listed
            .await
            .map_or_else(|error| of_bucket(&error), |objects| Ok(stored(&objects)))
    }
}

/// A table that does not exist, or cannot hold such a row, holds no other program's. The Leaderboard's status shows what is wrong.
fn of_table(error: &TableError) -> Result<Option<ObservedRow>, Unread> {
    let is_refused = match error {
        TableError::Missing { .. }
        | TableError::NoSortKey { .. }
        | TableError::OtherKeys { .. }
        | TableError::Key { .. } => return Ok(None),
        TableError::Denied { .. } | TableError::Refused { .. } | TableError::Stale { .. } => true,
        TableError::Passing { .. } => false,
    };
    let why = error.to_string();
    Err(Unread { is_refused, why })
}

fn of_bucket(error: &ArchiveError) -> Result<StoredRun, Unread> {
    let is_refused = match &error.cause {
        Cause::NoBucket => return Ok(StoredRun::default()),
        cause => !cause.is_transient(),
    };
    let why = error.to_string();
    Err(Unread { is_refused, why })
}

/// The folders of marks that a list was cut short of: what an agent stores comes before them, and may be more than is listed.
fn unlisted(is_complete: bool) -> &'static [&'static str] {
    if is_complete { &[] } else { &MARKED }
}

fn stored(objects: &[Listed]) -> StoredRun {
    let has = |keys: &[&str]| objects.iter().any(|object| keys.contains(&object.key.as_str()));
    // The log of a failure is the controller's: it may be there although no Pod has ever begun.
    let of_runs = objects.iter().filter(|object| object.key != FAILURE_LOG_KEY);
    StoredRun {
        newest: of_runs.filter_map(|object| object.stored).max(),
        is_ours: has(&[OWNER_KEY, REPORT_KEY]),
        has_ended: has(&ENDS),
    }
}

/// What a submission's run would store, and where its row would be.
pub fn question(
    submission: &Submission,
    leaderboard: &api::LeaderboardSpec,
    attempt: Attempt,
    team: String,
) -> Question {
    Question {
        attempt,
        table: leaderboard.table.clone(),
        storage: leaderboard.storage.clone(),
        run_id: submission.run_id(),
        team,
    }
}

impl Question {
    /// The prefix of the run, for people.
    pub fn prefix(&self) -> String {
        let prefix = effective::key_prefix(&self.storage, &self.run_id);
        format!("s3://{}/{prefix}", self.storage.bucket)
    }
}

#[cfg(test)]
mod tests {
    use kube::runtime::reflector::ObjectRef;
    use serde_json::{Value, json};

    use super::super::questions::{Question as _, Shared};
    use super::*;
    use crate::observability::about::LogSpan;

    fn ask(attempt: i64) -> Question {
        Question {
            attempt: Attempt(attempt),
            table: None,
            storage: serde_json::from_value(json!({"bucket": "results"})).unwrap(),
            run_id: "77".parse().unwrap(),
            team: "42".into(),
        }
    }

    fn nothing() -> Looked {
        Looked {
            at: Timestamp::UNIX_EPOCH,
            found: Ok(Traces::default()),
        }
    }

    fn by(name: &str) -> ObjectRef<Submission> {
        ObjectRef::new(name).within("one")
    }

    #[tokio::test(start_paused = true)]
    async fn it_is_looked_once_for_an_attempt_and_again_only_for_one_that_still_waits() {
        let shared = Shared::default();
        shared.want("u".into(), by("s"), ask(1), LogSpan::default());
        assert_eq!(shared.next(), Some(("u".into(), ask(1), "one".into())));
        shared.want("u".into(), by("s"), ask(1), LogSpan::default());
        assert_eq!(shared.next(), None, "it is under way");
        tokio::time::advance(Duration::from_secs(3)).await;
        assert_eq!(
            shared.observe("u", Attempt(1)),
            ObservedTraces::Asked(Duration::from_secs(3))
        );
        assert_eq!(shared.done("u", &ask(1), nothing()), Some(by("s")));
        let answered = ObservedTraces::Answered(Arc::new(nothing()));
        assert_eq!(shared.observe("u", Attempt(1)), answered);
        shared.want("u".into(), by("s"), ask(1), LogSpan::default());
        assert_eq!(shared.next(), None, "the answer is young");
        tokio::time::advance(AGAIN).await;
        assert_eq!(shared.next(), None, "nobody asks");
        shared.want("u".into(), by("s"), ask(1), LogSpan::default());
        assert_eq!(
            shared.observe("u", Attempt(1)),
            answered,
            "the old answer stays until there is another"
        );
        assert_eq!(shared.next(), Some(("u".into(), ask(1), "one".into())));
        assert_eq!(shared.observe("u", Attempt(2)), ObservedTraces::NotAsked);
        shared.want("u".into(), by("s"), ask(2), LogSpan::default());
        assert_eq!(
            shared.done("u", &ask(1), nothing()),
            None,
            "it is of the attempt before"
        );
        assert_eq!(shared.next(), Some(("u".into(), ask(2), "one".into())));
    }

    fn ask_of(run: usize, storage: Value, table: Value) -> Question {
        Question {
            run_id: run.to_string().parse().unwrap(),
            storage: serde_json::from_value(storage).unwrap(),
            table: Some(serde_json::from_value(table).unwrap()),
            ..ask(1)
        }
    }

    #[tokio::test(start_paused = true)]
    async fn a_bucket_that_hangs_keeps_no_submission_of_another_waiting() {
        let shared = Shared::default();
        let of = |name: &str, run| ask_of(run, json!({"bucket": name}), json!({"name": name}));
        for run in 1..=20 {
            shared.want(format!("hangs-{run}"), by("a"), of("hangs", run), LogSpan::default());
        }
        tokio::time::advance(Duration::from_secs(1)).await;
        shared.want("answers".into(), by("b"), of("answers", 21), LogSpan::default());
        let begun: Vec<_> = (0..Question::AT_ONCE).filter_map(|_| shared.next()).collect();
        let (others, of_hanging): (Vec<_>, Vec<_>) = begun.iter().partition(|(uid, ..)| uid == "answers");
        assert_eq!((others.len(), of_hanging.len()), (1, Question::AT_ONCE_OF_A_SERVICE));
        let (uid, question, _) = of_hanging[0];
        assert_eq!(shared.done(uid, question, nothing()), Some(by("a")));
        let (uid, ..) = shared.next().unwrap();
        assert!(uid.starts_with("hangs"), "{uid}");
        assert_eq!(shared.next(), None, "its share is under way again");
    }

    #[test]
    fn what_hangs_together_has_one_share() {
        let (bucket, table, others) = (
            json!({"bucket": "results"}),
            json!({"name": "rows"}),
            json!({"name": "others"}),
        );
        let elsewhere = json!({"bucket": "results", "region": "eu-west-1"});
        let of = |storage: &Value, table: &Value| ask_of(1, storage.clone(), table.clone());
        let first = of(&bucket, &table);
        assert!(first.shares_a_service(&of(&bucket, &others)), "the bucket");
        assert!(first.shares_a_service(&of(&elsewhere, &table)), "the table");
        assert!(!first.shares_a_service(&of(&elsewhere, &others)));
        let at = |bucket: &str| Question {
            storage: serde_json::from_value(json!({"bucket": bucket, "endpoint": "http://minio:9000"})).unwrap(),
            ..ask(1)
        };
        assert!(at("one").shares_a_service(&at("two")), "the endpoint");
        assert!(!first.shares_a_service(&at("results")));
    }

    #[test]
    fn what_lies_below_a_prefix() {
        let at = |second| Timestamp::from_second(second).unwrap();
        let object = |key: &str, second| Listed {
            key: key.to_owned(),
            size: 1,
            etag: None,
            stored: Some(at(second)),
        };
        let (newest, ours, ended) = (Some(at(20)), true, true);
        let run = |newest, is_ours, has_ended| StoredRun {
            newest,
            is_ours,
            has_ended,
        };
        let old = || {
            vec![
                object("agent/agent1/leaderboard.log", 20),
                object("simulator/a.log", 10),
            ]
        };
        let with = |key| [old(), vec![object(key, 15)]].concat();
        let cases = [
            (vec![], run(None, false, false)),
            (old(), run(newest, false, false)),
            (with("containers-status/agent-1.done"), run(newest, false, false)),
            (with("containers-status/logcopy.done"), run(newest, false, ended)),
            (with("containers-status/simulation.cancel"), run(newest, false, ended)),
            (with("logcopy/logcopy.log"), run(newest, false, false)),
            (with(OWNER_KEY), run(newest, ours, false)),
            (with(REPORT_KEY), run(newest, ours, false)),
            // What the controller stores of a Job whose Pod has never come so far.
            (vec![object(FAILURE_LOG_KEY, 30)], run(None, false, false)),
        ];
        for (objects, expected) in cases {
            assert_eq!(stored(&objects), expected, "{objects:?}");
        }
    }

    #[test]
    fn the_marks_are_looked_for_by_themselves_behind_more_objects_than_are_listed() {
        assert!(unlisted(true).is_empty(), "a complete list has them");
        let folders = unlisted(false);
        for mark in [OWNER_KEY, REPORT_KEY].into_iter().chain(ENDS) {
            assert!(folders.iter().any(|folder| mark.starts_with(folder)), "{mark}");
            assert!("agent/agent1/0" < mark, "what an agent stores comes first: {mark}");
        }
    }

    #[test]
    fn only_a_place_that_can_hold_nothing_is_taken_for_empty() {
        let table = || "rows".to_owned();
        let (action, text) = ("GetItem", String::new);
        let of = |error| of_table(&error).map_err(|unread| unread.is_refused);
        assert_eq!(of(TableError::NoSortKey { table: table() }), Ok(None));
        let missing = TableError::Missing {
            table: table(),
            text: text(),
        };
        assert_eq!(of(missing), Ok(None));
        let denied = TableError::Denied {
            table: table(),
            action,
            text: text(),
        };
        assert_eq!(of(denied), Err(true));
        let passing = TableError::Passing {
            table: table(),
            action,
            text: text(),
        };
        assert_eq!(of(passing), Err(false));
        let of = |cause| {
            let (op, object) = ("listing", "results/77/".to_owned());
            of_bucket(&ArchiveError { op, object, cause }).map_err(|unread| unread.is_refused)
        };
        assert_eq!(of(Cause::NoBucket), Ok(StoredRun::default()));
        assert_eq!(of(Cause::Denied(text())), Err(true));
        assert_eq!(of(Cause::Away(text())), Err(false));
    }
}
