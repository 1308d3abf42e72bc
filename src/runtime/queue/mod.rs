//! The queue of one kind: which object is reconciled next, and the tasks that do so.
//!
//! Any task adds to it. `run` starts each reconcile as a task of its own, so that one which waits for the API server holds up no other.
//! `state` and `lanes`, which are pure, decide which object is next, and when; `urgency` decides how urgent an event is.

mod lanes;
mod state;
pub mod urgency;

use std::fmt;
use std::pin::pin;
use std::sync::{Arc, Mutex};

use kube::Resource;
use kube::runtime::reflector::ObjectRef;
use tokio::sync::Notify;
use tokio::task::JoinSet;
use tokio::time::{Instant, sleep_until};

use crate::metrics::Histogram;
pub use lanes::Class;
use leaderboard_base::lock::lock;
use leaderboard_base::shutdown::Stop;
pub use state::{After, Limits};
use state::{Begun, State};

/// Namespace and name of an object.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct Key {
    pub namespace: Arc<str>,
    pub name: Arc<str>,
}

impl<K: Resource<DynamicType = ()>> From<&ObjectRef<K>> for Key {
    fn from(object: &ObjectRef<K>) -> Self {
        Self {
            namespace: object.namespace.as_deref().unwrap_or_default().into(),
            name: object.name.as_str().into(),
        }
    }
}

impl<K: Resource<DynamicType = ()>> From<&Key> for ObjectRef<K> {
    fn from(key: &Key) -> Self {
        Self::new(&key.name).within(&key.namespace)
    }
}

impl fmt::Display for Key {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}", self.namespace, self.name)
    }
}

/// All objects of one kind that have to be reconciled.
#[derive(Debug)]
pub struct Queue {
    state: Mutex<State>,
    /// There may be something to begin.
    changed: Notify,
    /// How long events of each class waited for their reconcile.
    waits: [Histogram; 3],
}

impl Queue {
    pub fn new(limits: Limits, waits: [Histogram; 3]) -> Arc<Self> {
        Arc::new(Self {
            state: Mutex::new(State::new(limits)),
            changed: Notify::new(),
            waits,
        })
    }

    /// Something has happened to an object.
    pub fn add(&self, key: impl Into<Key>, class: Class) {
        lock(&self.state).add(key.into(), class, Instant::now());
        self.changed.notify_one();
    }

    /// An object was deleted.
    pub fn forget(&self, key: &Key) {
        lock(&self.state).forget(key);
    }

    /// Reconciles until the stop, and returns once those are done that have begun. Dropped, it ends them.
    ///
    /// `reconcile` must not panic: a panic of it takes its place in the queue with it.
    pub async fn run<R>(self: &Arc<Self>, stop: &Stop, reconcile: impl Fn(Turn) -> R)
    where
        R: Future<Output = After> + Send + 'static,
    {
        let (mut running, mut stopped) = (JoinSet::new(), pin!(stop.wait()));
        while !stop.is_set() {
            while let Some(key) = self.begin() {
                let queue = Arc::clone(self);
                let reconcile = reconcile(Turn {
                    queue,
                    key: key.clone(),
                });
                running.spawn(async move { (key, reconcile.await) });
            }
            let next = lock(&self.state).next_time();
            let due = async {
                match next {
                    Some(at) => sleep_until(at).await,
                    None => std::future::pending().await,
                }
            };
            tokio::select! {
                biased;
                () = &mut stopped => {}
                Some(ended) = running.join_next() => self.finish(ended.ok()),
                () = self.changed.notified() => {}
                () = due => {}
            }
            while let Some(ended) = running.try_join_next() {
                self.finish(ended.ok());
            }
        }
        while let Some(ended) = running.join_next().await {
            self.finish(ended.ok());
        }
    }

    /// How many are ready in each class.
    pub fn depth(&self) -> [usize; 3] {
        lock(&self.state).depth()
    }

    fn begin(&self) -> Option<Key> {
        let Begun { key, class, waited } = lock(&self.state).begin(Instant::now())?;
        self.waits[class as usize].observe(waited.as_secs_f64());
        Some(key)
    }

    fn finish(&self, ended: Option<(Key, After)>) {
        if let Some((key, after)) = ended {
            lock(&self.state).finish(&key, after, Instant::now());
        }
    }
}

/// One reconcile of an object.
#[derive(Debug)]
pub struct Turn {
    queue: Arc<Queue>,
    pub key: Key,
}

impl Turn {
    /// True if it may continue, once it knows whether it creates a Job. If not, it changes nothing and ends with
    /// `After::WithPermit`.
    pub fn may_continue(&self, creates_job: bool) -> bool {
        let may_continue = lock(&self.queue.state).may_continue(&self.key, creates_job);
        if !creates_job {
            self.queue.changed.notify_one();
        }
        may_continue
    }
}

#[cfg(test)]
mod model_tests;
#[cfg(test)]
mod tests;
