//! A question to a service outside the cluster, and what is known of its answer. Pure: time is handed in as lengths.

use std::fmt::{self, Debug};
use std::sync::Arc;
use std::time::Duration;

use leaderboard_api::{DynamoTable, LogGroup, S3Bucket, SecretsManagerKey, SqsQueue};

/// One kind of question. Everything that makes an older answer useless is part of the question: the attempt, a digest, a stage.
pub trait Ask: Clone + Debug + PartialEq + Send + 'static {
    /// The finding. An answer equal to the one before is no news.
    type Answer: Debug + PartialEq + Send + Sync + 'static;
    /// Reads under way at once.
    const AT_ONCE: usize;
    /// Reads under way at once of one bucket, table or server: one that hangs leaves the rest to the others.
    const AT_ONCE_OF_A_SERVICE: usize;
    /// Time that one read may take.
    const LONGEST: Duration;
    /// Time between the starts of two reads of one bucket, table or server.
    const SPACING: Duration = Duration::ZERO;

    /// The service that a read may wait for.
    fn service(&self) -> Service;

    /// The pause before the question is asked again, counted from its answer; None: the answer is good as long as anybody wants it.
    /// `failures` counts those in a row. `waited` is the time without an answer since the question was first asked.
    fn again(&self, result: &Result<Self::Answer, Failure>, failures: u32, waited: Duration) -> Option<Duration>;

    /// The lowest of the questions that are due goes first.
    fn rank(&self) -> Rank {
        Rank::default()
    }

    /// True if what was asked by an older question is no answer any more, not even when that is asked again.
    fn outdates(&self, _older: &Self) -> bool {
        false
    }
}

/// The place of a question among those that are due: its class, and then a time in seconds.
pub type Rank = (u8, i64);

/// Why there is no answer of the kind that was asked for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Failure {
    /// The service has answered, and waiting alone does not help. Else it is silent.
    pub is_refused: bool,
    pub why: String,
}

impl Failure {
    /// The service has not answered, or its answer may pass.
    pub fn silent(why: impl Into<String>) -> Self {
        Self {
            is_refused: false,
            why: why.into(),
        }
    }
}

/// The question about an object, and its last answer.
#[derive(Clone, Debug)]
pub struct Lookup<Q: Ask> {
    /// The present question.
    pub asked: Option<Q>,
    /// Time that the present question has waited; None: it is answered, or there is none.
    pub waited: Option<Duration>,
    /// The outcome of the last read, which may answer an older question.
    pub last: Option<Answered<Q>>,
    /// Present while the service does not answer.
    pub silence: Option<Silence<Q>>,
}

/// A service that does not answer.
#[derive(Clone, Debug)]
pub struct Silence<Q: Ask> {
    pub lasts: Duration,
    /// The last answer before it.
    pub before: Option<Answered<Q>>,
}

/// An answer.
#[derive(Debug)]
pub struct Answered<Q: Ask> {
    pub question: Q,
    /// Time since the question was sent: the answer shows nothing that has happened since.
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
            asked: None,
            waited: None,
            last: None,
            silence: None,
        }
    }
}

impl<Q: Ask> Lookup<Q> {
    /// The last answer, if it is one to this very question.
    pub fn answer_to(&self, question: &Q) -> Option<&Answered<Q>> {
        self.last.as_ref().filter(|last| last.question == *question)
    }

    /// The last answer before the service fell silent, or the last one.
    pub fn known(&self) -> Option<&Answered<Q>> {
        match &self.silence {
            Some(silence) => silence.before.as_ref(),
            None => self.last.as_ref(),
        }
    }
}

/// Something that may hang: an endpoint of the host's own hangs with all that it has, a bucket or table of AWS alone.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct Service(String);

impl Service {
    /// The bucket of a run.
    pub fn bucket(storage: &S3Bucket) -> Self {
        Self::of(
            "bucket",
            storage.endpoint.as_deref(),
            storage.region.as_deref(),
            &storage.bucket,
        )
    }

    /// A table of rows.
    pub fn table(table: &DynamoTable) -> Self {
        Self::of("table", table.endpoint.as_deref(), table.region.as_deref(), &table.name)
    }

    /// A queue, with its dead-letter queue.
    pub fn queue(queue: &SqsQueue) -> Self {
        Self::of("queue", queue.endpoint.as_deref(), queue.region.as_deref(), &queue.url)
    }

    /// A log group.
    pub fn log_group(group: &LogGroup) -> Self {
        Self::of(
            "log group",
            group.endpoint.as_deref(),
            group.region.as_deref(),
            &group.name,
        )
    }

    /// An entry of Secrets Manager.
    pub fn secret(entry: &SecretsManagerKey) -> Self {
        Self::of(
            "the entry",
            entry.endpoint.as_deref(),
            entry.region.as_deref(),
            &entry.id,
        )
    }

    /// EvalAI's server of this address.
    pub fn evalai(server: &str) -> Self {
        Self(format!("EvalAI at {server}"))
    }

    /// The cluster's own.
    pub fn api_server() -> Self {
        Self("the API server".to_owned())
    }

    fn of(kind: &str, endpoint: Option<&str>, region: Option<&str>, name: &str) -> Self {
        Self(match (endpoint, region) {
            (Some(endpoint), _) => format!("the server {endpoint}"),
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
