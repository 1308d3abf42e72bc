//! A question to a service outside the cluster, and what is known of its answer. Pure: time is handed in as lengths.

use std::fmt::{self, Debug};
use std::sync::Arc;
use std::time::Duration;

use leaderboard_api::{Storage, Table};

/// One kind of question. Everything that makes an older answer useless is part of the question: the attempt, a digest, a stage.
pub trait Ask: Clone + Debug + PartialEq + Send + 'static {
    /// What is found.
    type Answer: Debug + Send + Sync + 'static;
    /// Reads under way at once.
    const AT_ONCE: usize;
    /// Reads under way at once of one bucket, table or server: one that hangs leaves the rest to the others.
    const AT_ONCE_OF_A_SERVICE: usize;
    /// Time that one read may take.
    const LONGEST: Duration;

    /// The service that a read may wait for.
    fn service(&self) -> Service;

    /// After which pause the question is asked again, counted from its answer; None: the answer is good as long as anybody wants it.
    /// `failures` counts those in a row.
    fn again(&self, result: &Result<Self::Answer, Failure>, failures: u32) -> Option<Duration>;
}

/// Why a question has no answer yet.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Failure {
    /// Waiting alone does not help: somebody has to do something.
    pub is_refused: bool,
    pub why: String,
}

/// What is known of an object.
#[derive(Clone, Debug)]
pub struct Lookup<Q: Ask> {
    /// How long the present question has waited; None: it is answered, or there is none.
    pub waited: Option<Duration>,
    /// The last answer, which may be one to an older question.
    pub last: Option<Answered<Q>>,
}

/// An answer.
#[derive(Debug)]
pub struct Answered<Q: Ask> {
    pub question: Q,
    /// How long ago the question was sent: the answer shows nothing that has happened since.
    pub sent_ago: Duration,
    pub result: Arc<Result<Q::Answer, Failure>>,
}

impl<Q: Ask> Clone for Answered<Q> {
    fn clone(&self) -> Self {
        Self {
            question: self.question.clone(),
            sent_ago: self.sent_ago,
            result: Arc::clone(&self.result),
        }
    }
}

impl<Q: Ask> Default for Lookup<Q> {
    fn default() -> Self {
        Self {
            waited: None,
            last: None,
        }
    }
}

impl<Q: Ask> Lookup<Q> {
    /// The last answer, if it is one to this very question.
    pub fn answer_to(&self, question: &Q) -> Option<&Answered<Q>> {
        self.last.as_ref().filter(|last| last.question == *question)
    }
}

/// Something that may hang: an endpoint of the host's own hangs with all that it has, a bucket or table of AWS alone.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct Service(String);

impl Service {
    /// The bucket of a run.
    pub fn bucket(storage: &Storage) -> Self {
        Self::of(
            "bucket",
            storage.endpoint.as_deref(),
            storage.region.as_deref(),
            &storage.bucket,
        )
    }

    /// A table of rows.
    pub fn table(table: &Table) -> Self {
        Self::of("table", table.endpoint.as_deref(), table.region.as_deref(), &table.name)
    }

    fn of(kind: &str, endpoint: Option<&str>, region: Option<&str>, name: &str) -> Self {
        Self(match (endpoint, region) {
            (Some(endpoint), _) => endpoint.to_owned(),
            (None, Some(region)) => format!("{kind} {name} in {region}"),
            (None, None) => format!("{kind} {name}"),
        })
    }
}

/// For people.
impl fmt::Display for Service {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}
