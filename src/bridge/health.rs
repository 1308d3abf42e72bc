//! Whether the bridge can do its work, and what is missing if not.
//!
//! Written by the watch and the pollers, read by the health server. Knows neither of them.

use std::collections::BTreeMap;
use std::sync::{Mutex, MutexGuard, PoisonError};

/// The answer to a readiness probe.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Readiness {
    /// True if messages can be taken from at least one queue, or none is wished for.
    pub ready: bool,
    /// What is missing, one line for each; empty if nothing is.
    pub text: String,
}

/// What the parts of the bridge last said of themselves.
#[derive(Debug, Default)]
pub struct Health {
    state: Mutex<State>,
}

#[derive(Debug, Default)]
struct State {
    synced: bool,
    watch: Option<String>,
    queues: BTreeMap<String, Option<String>>,
}

impl Health {
    /// What a probe is told.
    pub fn readiness(&self) -> Readiness {
        let state = self.lock();
        let mut lines = Vec::new();
        if !state.synced {
            lines.push("Leaderboards are not synced yet".to_owned());
        }
        lines.extend(
            state
                .watch
                .iter()
                .map(|text| format!("Leaderboards can't be watched: {text}")),
        );
        lines.extend(state.queues.values().flatten().cloned());
        let is_cut_off = !state.queues.is_empty() && state.queues.values().all(Option::is_some);
        Readiness {
            ready: state.synced && !is_cut_off,
            text: lines.join("\n"),
        }
    }

    /// All Leaderboards are known.
    pub(super) fn synced(&self) {
        let mut state = self.lock();
        state.synced = true;
        state.watch = None;
    }

    /// What the watch of Leaderboards last met; None: it goes on.
    pub(super) fn watch(&self, problem: Option<String>) {
        self.lock().watch = problem;
    }

    /// What a poller last met; None: its queue can be read.
    pub(super) fn queue(&self, url: &str, problem: Option<String>) {
        self.lock().queues.insert(url.to_owned(), problem);
    }

    /// A queue is no longer read.
    pub(super) fn forget(&self, url: &str) {
        self.lock().queues.remove(url);
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_is_ready_when_synced_and_at_least_one_queue_answers() {
        let health = Health::default();
        let told = |ready, text: &str| Readiness {
            ready,
            text: text.into(),
        };
        assert_eq!(health.readiness(), told(false, "Leaderboards are not synced yet"));
        health.watch(Some("forbidden".into()));
        let both = "Leaderboards are not synced yet\nLeaderboards can't be watched: forbidden";
        assert_eq!(health.readiness(), told(false, both));
        health.synced();
        assert_eq!(health.readiness(), told(true, ""));
        health.queue("a", Some("queue a is gone".into()));
        assert_eq!(health.readiness(), told(false, "queue a is gone"));
        health.queue("b", None);
        assert_eq!(health.readiness(), told(true, "queue a is gone"));
        health.forget("a");
        assert_eq!(health.readiness(), told(true, ""));
    }
}
