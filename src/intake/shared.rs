//! State that the readers of all queues share, and the problems that keep them from reading.

use std::collections::BTreeMap;
use std::sync::Mutex;

use kube::Client;
use kube::runtime::events::Recorder;

use super::leaderboards::Scope;
use crate::kubernetes::Watch;
use crate::observability::Observability;
use crate::observability::readiness::Readiness;
use leaderboard_api::Leaderboard;
use leaderboard_base::lock::lock;

/// Name of the readiness check.
const CHECK: &str = "queues";

/// State that all pollers share.
pub struct Shared {
    pub client: Client,
    pub scope: Scope,
    pub leaderboards: Watch<Leaderboard>,
    pub recorder: Recorder,
    pub telemetry: Observability,
    pub problems: Problems,
}

/// The problem of each queue that cannot be read. The process is ready if it reads at least one queue, or has none to read.
pub struct Problems {
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

    /// Sets the last problem of a queue; None if the queue can be read.
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
