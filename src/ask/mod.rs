//! One way to ask a service outside the cluster: a task asks, and an answer wakes the object, so that no reconcile waits.
//!
//! ```text
//! reconcile ── want(question) ──▶ state ── next ──▶ ask: one read, bounded in time
//!     ▲  └──── get: Lookup ◀──────  │  ▲                 │
//!     └──────────── wake ◀──────────┘  └───── done ◀─────┘
//! ```
//!
//! A newer question replaces an older one. One read of an object is under way at a time: a question that comes meanwhile makes a
//! second read. The last answer stays readable until then, with the question that it answers. A write is no question: nothing may
//! replace one that is under way.

mod service;
mod state;
#[cfg(test)]
mod tests;

use std::fmt::Debug;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use futures::StreamExt;
use futures::stream::FuturesUnordered;
use tokio::sync::Notify;
use tokio::time::Instant;
use tracing::Instrument;

use crate::lock::lock;
use crate::observability::about::LogSpan;
use crate::observability::tasks::Tasks;
use crate::services::ObjectKey;
pub use service::Service;
use state::{State, Work};

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

/// Called with the object that has an answer.
pub type Wake = Box<dyn Fn(&ObjectKey) + Send + Sync>;

/// Asks one kind of question. Clones are the same.
#[derive(Clone)]
pub struct Asker<Q: Ask>(Arc<Shared<Q>>);

struct Shared<Q: Ask> {
    state: Mutex<State<Q>>,
    notify: Notify,
}

impl<Q: Ask> Asker<Q> {
    /// Starts the task that asks. `ask` gets a question and the object that it is about.
    pub fn start<F>(
        name: &'static str,
        tasks: &Tasks,
        wake: Wake,
        ask: impl Fn(Q, ObjectKey) -> F + Send + 'static,
    ) -> Self
    where
        F: Future<Output = Result<Q::Answer, Failure>> + Send + 'static,
    {
        let shared = Arc::new(Shared {
            state: Mutex::default(),
            notify: Notify::new(),
        });
        tasks.until_stop(name, answer_all(Arc::clone(&shared), wake, ask));
        Self(shared)
    }

    /// Asks about an object, in place of what was asked about it before. The answer to the same question stays. An object that
    /// stops asking is forgotten after ten minutes.
    pub fn want(&self, about: &ObjectKey, question: Q, log: LogSpan) {
        let is_new = lock(&self.0.state).want(about, question, log, Instant::now());
        if is_new {
            self.0.notify.notify_one();
        }
    }

    /// What is known of the object with this UID.
    pub fn get(&self, uid: &str) -> Lookup<Q> {
        lock(&self.0.state).get(uid, Instant::now())
    }

    /// Drops the question and the answer. A read that is under way keeps its place until it ends, and wakes nobody.
    pub fn forget(&self, uid: &str) {
        lock(&self.0.state).forget(uid);
    }
}

async fn answer_all<Q: Ask, F>(shared: Arc<Shared<Q>>, wake: Wake, ask: impl Fn(Q, ObjectKey) -> F)
where
    F: Future<Output = Result<Q::Answer, Failure>> + Send + 'static,
{
    let mut under_way = FuturesUnordered::new();
    loop {
        while let Some(work) = begin(&shared) {
            let reading = ask(work.question.clone(), work.about.clone());
            under_way.push(bounded(work, reading));
        }
        let due = lock(&shared.state).next_due(Instant::now());
        tokio::select! {
            // An answer frees a place, so it goes first.
            biased;
            Some((work, result)) = under_way.next() => {
                let is_news = lock(&shared.state).done(&work, result, Instant::now());
                if is_news {
                    wake(&work.about);
                }
            }
            () = shared.notify.notified() => {}
            () = at(due) => {}
        }
    }
}

/// The next read; the lock is free before it begins.
fn begin<Q: Ask>(shared: &Shared<Q>) -> Option<Work<Q>> {
    lock(&shared.state).next(Instant::now())
}

async fn bounded<Q: Ask>(
    work: Work<Q>,
    reading: impl Future<Output = Result<Q::Answer, Failure>>,
) -> (Work<Q>, Result<Q::Answer, Failure>) {
    let reading = reading.instrument(work.log.span());
    let result = tokio::time::timeout(Q::LONGEST, reading).await;
    let result = result.unwrap_or_else(|_| {
        Err(Failure {
            is_refused: false,
            why: format!("{} did not answer within {} s", work.service, Q::LONGEST.as_secs()),
        })
    });
    (work, result)
}

async fn at(due: Option<Instant>) {
    match due {
        Some(due) => tokio::time::sleep_until(due).await,
        None => std::future::pending().await,
    }
}
