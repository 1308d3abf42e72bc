//! One way to ask a service outside the cluster: a task asks, and an answer wakes the object, so that no reconcile waits.
//!
//! ```text
//! reconcile ── want(question) ──▶ state ── next ──▶ ask: one read, bounded in time
//!     ▲  └──── get: Lookup ◀──────  │  ▲                 │
//!     └──────────── wake ◀──────────┘  └───── done ◀─────┘
//! ```
//!
//! A newer question replaces an older one. One read of an object is under way at a time: a question that comes meanwhile makes a
//! second read. The last answer stays readable until then, with the question that it answers. Only news wakes the object.

pub(crate) mod state;
#[cfg(test)]
mod tests;

use std::sync::{Arc, Mutex};
use std::time::Duration;

use futures::StreamExt;
use futures::stream::FuturesUnordered;
use tokio::sync::Notify;
use tokio::time::Instant;
use tracing::Instrument;

use leaderboard_base::lock::lock;
use leaderboard_base::object_key::ObjectKey;
use leaderboard_base::spans::LogSpan;
use leaderboard_base::tasks::Tasks;
use leaderboard_policy::ask::{Answered, Ask, Failure, Lookup, Service};
use state::{State, Work};

/// A question that is sent now.
#[derive(Clone, Debug)]
pub struct Asked<Q: Ask> {
    pub about: ObjectKey,
    pub question: Q,
    /// Time that the question has waited.
    pub waited: Duration,
    /// The last answer, which may be one to an older question.
    pub last: Option<Answered<Q>>,
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
    /// Starts the task that asks. Each read gets a clone of `uses`.
    pub fn start<U, F>(
        name: &'static str,
        tasks: &Tasks,
        wake: Wake,
        uses: U,
        ask: impl Fn(U, Asked<Q>) -> F + Send + 'static,
    ) -> Self
    where
        U: Clone + Send + 'static,
        F: Future<Output = Result<Q::Answer, Failure>> + Send + 'static,
    {
        let shared = Arc::new(Shared {
            state: Mutex::default(),
            notify: Notify::new(),
        });
        let ask = move |asked| ask(uses.clone(), asked);
        tasks.until_stop(name, answer_all(Arc::clone(&shared), wake, ask));
        Self(shared)
    }

    /// Asks about an object, in place of what was asked about it before. The answer to the same question stays. A question that is
    /// not repeated for a quarter of an hour is asked no more.
    pub fn want(&self, about: &ObjectKey, question: Q, log: LogSpan) {
        let is_new = lock(&self.0.state).want(about, question, log, Instant::now());
        if is_new {
            self.0.notify.notify_one();
        }
    }

    /// All that is known of the object with this UID.
    pub fn get(&self, uid: &str) -> Lookup<Q> {
        lock(&self.0.state).get(uid, Instant::now())
    }

    /// The number of questions to a service that have waited for an answer for longer than this.
    pub fn waiting(&self, service: &Service, time: Duration) -> usize {
        lock(&self.0.state).waiting(service, time, Instant::now())
    }

    /// Drops the question and the answer. A read that is under way keeps its place until it ends, and wakes no object.
    pub fn forget(&self, uid: &str) {
        lock(&self.0.state).forget(uid);
    }
}

async fn answer_all<Q: Ask, F>(shared: Arc<Shared<Q>>, wake: Wake, ask: impl Fn(Asked<Q>) -> F)
where
    F: Future<Output = Result<Q::Answer, Failure>> + Send + 'static,
{
    let mut under_way = FuturesUnordered::new();
    loop {
        while let Some(work) = begin(&shared) {
            let reading = ask(work.asked.clone());
            under_way.push(bounded(work, reading));
        }
        let due = lock(&shared.state).next_due(Instant::now());
        tokio::select! {
            // An answer frees a place, so it goes first.
            biased;
            Some((work, result)) = under_way.next() => {
                let is_news = lock(&shared.state).done(&work, result, Instant::now());
                if is_news {
                    wake(&work.asked.about);
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
        Err(Failure::silent(format!(
            "{} did not answer within {} s",
            work.service,
            Q::LONGEST.as_secs()
        )))
    });
    (work, result)
}

async fn at(due: Option<Instant>) {
    match due {
        Some(due) => tokio::time::sleep_until(due).await,
        None => std::future::pending().await,
    }
}
