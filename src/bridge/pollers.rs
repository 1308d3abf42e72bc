//! The pollers, one for each queue that a Leaderboard names: started, stopped, and what keeps them from reading.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use tokio::sync::watch;
use tokio::task::JoinHandle;

use super::Shared;
use super::poller::Poller;
use super::route;
use crate::lock::lock;
use crate::observability::readiness::Readiness;
use leaderboard_api::Leaderboard;

/// How long messages in hand may take to be finished when the program stops.
const DRAIN: Duration = Duration::from_secs(20);
/// Name of the readiness check.
const CHECK: &str = "queues";

/// How to reach a queue.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Connection {
    region: Option<String>,
    endpoint: Option<String>,
}

/// The queues that Leaderboards name, each reached by the connection of the oldest of them.
pub(super) fn desired(leaderboards: &[Arc<Leaderboard>]) -> BTreeMap<String, Connection> {
    let urls: BTreeSet<&String> = leaderboards
        .iter()
        .filter_map(|lb| route::queue_of(lb))
        .map(|queue| &queue.url)
        .collect();
    let mut desired = BTreeMap::new();
    for url in urls {
        let readers = route::readers(url, leaderboards);
        if let Some(queue) = readers.first().and_then(|lb| route::queue_of(lb)) {
            let (region, endpoint) = (queue.region.clone(), queue.endpoint.clone());
            desired.insert(url.clone(), Connection { region, endpoint });
        }
    }
    desired
}

/// A poller that runs.
struct Running {
    connection: Connection,
    stop: watch::Sender<bool>,
}

pub(super) struct Pollers {
    shared: Arc<Shared>,
    running: BTreeMap<String, Running>,
    /// All that have begun, those whose queue is no longer read until they have finished what is in hand.
    started: Vec<JoinHandle<Option<()>>>,
}

impl Pollers {
    pub fn new(shared: Arc<Shared>) -> Self {
        Self {
            shared,
            running: BTreeMap::new(),
            started: Vec::new(),
        }
    }

    /// Stops what is no longer desired, starts what is missing.
    pub fn adjust(&mut self, desired: &BTreeMap<String, Connection>) {
        let problems = &self.shared.problems;
        self.running.retain(|url, running| {
            let keep = desired.get(url) == Some(&running.connection);
            if !keep {
                tracing::info!(queue = url, "stopped reading the queue with its former settings");
                running.stop.send_replace(true);
                problems.forget(url);
            }
            keep
        });
        for (url, connection) in desired {
            if !self.running.contains_key(url) {
                self.start(url, connection);
            }
        }
        self.started.retain(|task| !task.is_finished());
    }

    fn start(&mut self, url: &str, connection: &Connection) {
        tracing::info!(queue = url, "reading the queue");
        let (stop, stopped) = watch::channel(false);
        let sqs = self
            .shared
            .aws
            .sqs(connection.region.as_deref(), connection.endpoint.as_deref());
        let poller = Poller::new(url.to_owned(), sqs, self.shared.clone(), stopped);
        let running = Running {
            connection: connection.clone(),
            stop,
        };
        // It may end before the process does: its queue may be taken out of the Leaderboards.
        let task = self
            .shared
            .telemetry
            .tasks
            .may_end(format!("queue {url}"), poller.run());
        self.started.push(task);
        self.running.insert(url.to_owned(), running);
    }

    /// Lets each poller finish what it has in hand.
    pub async fn drain(self) {
        for running in self.running.values() {
            running.stop.send_replace(true);
        }
        let all = futures::future::join_all(self.started);
        if tokio::time::timeout(DRAIN, all).await.is_err() {
            tracing::warn!("messages in hand were not finished in time and will come back");
        }
    }
}

/// What keeps each queue from being read. The process is ready while at least one can be read, or there is none.
pub(super) struct Problems {
    queues: Mutex<BTreeMap<String, Option<String>>>,
    readiness: Readiness,
}

impl Problems {
    pub fn new(readiness: Readiness) -> Self {
        readiness.set(CHECK, Ok(()));
        Self {
            queues: Mutex::default(),
            readiness,
        }
    }

    /// What a poller last met; None: its queue can be read.
    pub fn set(&self, url: &str, problem: Option<String>) {
        self.change(|queues| _ = queues.insert(url.to_owned(), problem));
    }

    /// A queue is no longer read.
    pub fn forget(&self, url: &str) {
        self.change(|queues| _ = queues.remove(url));
    }

    fn change(&self, change: impl FnOnce(&mut BTreeMap<String, Option<String>>)) {
        let mut queues = lock(&self.queues);
        change(&mut queues);
        let is_cut_off = !queues.is_empty() && queues.values().all(Option::is_some);
        let problems: Vec<_> = queues.values().flatten().map(String::as_str).collect();
        let state = if is_cut_off { Err(problems.join("; ")) } else { Ok(()) };
        // Under the lock: of two changes the later one is shown.
        self.readiness.set(CHECK, state);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_is_ready_while_at_least_one_queue_answers() {
        let readiness = Readiness::default();
        readiness.registered();
        let problems = Problems::new(readiness.clone());
        assert_eq!(readiness.missing(), Vec::<String>::new());
        problems.set("a", Some("queue a is gone".into()));
        assert_eq!(readiness.missing(), ["queues: queue a is gone"]);
        problems.set("c", Some("queue c is gone".into()));
        assert_eq!(readiness.missing(), ["queues: queue a is gone; queue c is gone"]);
        problems.set("b", None);
        assert_eq!(readiness.missing(), Vec::<String>::new());
        problems.forget("b");
        problems.forget("c");
        assert_eq!(readiness.missing(), ["queues: queue a is gone"]);
        problems.forget("a");
        assert_eq!(readiness.missing(), Vec::<String>::new());
    }
}
