//! The pollers, one for each queue that a Leaderboard names: started, stopped, and what keeps them from reading.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use futures::{FutureExt, StreamExt};
use tokio::sync::watch;
use tokio::task::JoinHandle;

use super::leaderboards::Leaderboards;
use super::poller::Poller;
use super::shared::Shared;
use super::source::Source;
use leaderboard_api::Leaderboard;
use leaderboard_base::shutdown::Stop;

/// How long messages in hand may take to be finished when the program stops.
const DRAIN: Duration = Duration::from_secs(20);

/// Reads the queues that Leaderboards name until the stop; then finishes what is in hand. `desired` has the queues, each with the way to it,
/// and `open` makes a source of one.
pub async fn follow<W: Clone + PartialEq, S: Source>(
    shared: Arc<Shared>,
    desired: impl Fn(&[Arc<Leaderboard>]) -> BTreeMap<String, W>,
    open: impl Fn(&str, &W) -> S,
) {
    let stop = shared.telemetry.stop.clone();
    let mut events = shared.leaderboards.subscribe();
    let mut pollers = Pollers {
        shared: Arc::clone(&shared),
        running: BTreeMap::new(),
        started: Vec::new(),
    };
    loop {
        tokio::select! {
            biased;
            () = stop.wait() => break,
            Some(_) = events.next() => {}
        }
        // A list brings many at once.
        while events.next().now_or_never().flatten().is_some() {}
        let all = Leaderboards::cached(&shared.leaderboards, &shared.scope.allowed).all;
        pollers.adjust(&desired(&all), &open);
    }
    pollers.drain().await;
}

/// A poller that runs.
struct Running<W> {
    way: W,
    stop: watch::Sender<bool>,
}

struct Pollers<W> {
    shared: Arc<Shared>,
    running: BTreeMap<String, Running<W>>,
    /// All that have begun, those whose queue is no longer read until they have finished what is in hand.
    started: Vec<JoinHandle<Option<()>>>,
}

impl<W: Clone + PartialEq> Pollers<W> {
    /// Stops what is no longer desired, starts what is missing.
    fn adjust<S: Source>(&mut self, desired: &BTreeMap<String, W>, open: impl Fn(&str, &W) -> S) {
        let problems = &self.shared.problems;
        self.running.retain(|queue, running| {
            let keep = desired.get(queue) == Some(&running.way);
            if !keep {
                tracing::info!(queue, "stopped reading the queue with its former settings");
                running.stop.send_replace(true);
                problems.forget(queue);
            }
            keep
        });
        for (queue, way) in desired {
            if !self.running.contains_key(queue) {
                self.start(queue, way, open(queue, way));
            }
        }
        self.started.retain(|task| !task.is_finished());
    }

    fn start(&mut self, queue: &str, way: &W, source: impl Source) {
        tracing::info!(queue, "reading the queue");
        let (stop, stopped) = Stop::new();
        let poller = Poller::new(queue.to_owned(), source, self.shared.clone(), stopped);
        // It may end before the process does: its queue may be taken out of the Leaderboards.
        let tasks = &self.shared.telemetry.tasks;
        let task = tasks.may_end(format!("queue {queue}"), poller.run());
        self.started.push(task);
        let way = way.clone();
        self.running.insert(queue.to_owned(), Running { way, stop });
    }

    /// Lets each poller finish what it has in hand.
    async fn drain(self) {
        for running in self.running.values() {
            running.stop.send_replace(true);
        }
        let all = futures::future::join_all(self.started);
        if tokio::time::timeout(DRAIN, all).await.is_err() {
            tracing::warn!("messages in hand were not finished in time and will come back");
        }
    }
}
