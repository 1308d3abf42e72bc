//! Detects a process that a restart would help: its watches stay broken while the API server answers.
//!
//! Kept by the watches themselves, read by the health server. An outage of the API server is no reason to restart, so a
//! stuck watch counts only while other calls are answered. A task that ends needs no probe: it ends the process (`tasks`).

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::Duration;

use tokio::time::Instant;

use leaderboard_base::lock::lock;

/// A watch that is broken for so long does not recover by itself.
const STUCK_AFTER: Duration = Duration::from_mins(10);
/// The API server counts as answering for so long after an answer.
const ANSWERED_LATELY: Duration = Duration::from_mins(1);
/// A watch that has failed to start tries again within this time (back-off, and the longest that one try may hang).
/// Without another failure by then it runs, though it may have no news.
const FAILS_AGAIN_WITHIN: Duration = Duration::from_mins(7);

/// Clones are the same registry.
#[derive(Clone, Debug, Default)]
pub struct Liveness(Arc<Mutex<State>>);

#[derive(Debug, Default)]
struct State {
    answered: Option<Instant>,
    watches: BTreeMap<String, WatchState>,
}

#[derive(Debug, Default)]
struct WatchState {
    /// Since when the watch wants a complete list and has none.
    listing: Option<Instant>,
    /// The first and the last of a row of failures to start.
    failing: Option<(Instant, Instant)>,
}

impl WatchState {
    fn is_stuck(&self, now: Instant) -> bool {
        let lists_too_long = self.listing.is_some_and(|since| now - since > STUCK_AFTER);
        let fails_too_long =
            |(first, last): (Instant, Instant)| now - first > STUCK_AFTER && now - last < FAILS_AGAIN_WITHIN;
        lists_too_long || self.failing.is_some_and(fails_too_long)
    }
}

impl Liveness {
    /// The API server has answered something.
    pub fn answered(&self) {
        self.lock().answered = Some(Instant::now());
    }

    /// Registers a watch, which starts by listing.
    pub fn watch(&self, name: &str) -> WatchProbe {
        let state = WatchState {
            listing: Some(Instant::now()),
            failing: None,
        };
        self.lock().watches.insert(name.to_owned(), state);
        WatchProbe {
            liveness: self.clone(),
            name: name.to_owned(),
        }
    }

    /// The problems that a restart would fix, one sentence each. Empty: alive.
    pub fn problems(&self) -> Vec<String> {
        let (state, now) = (self.lock(), Instant::now());
        if state.answered.is_none_or(|at| now - at >= ANSWERED_LATELY) {
            return Vec::new();
        }
        let stuck = state.watches.iter().filter(|(_, watch)| watch.is_stuck(now));
        stuck
            .map(|(name, _)| {
                format!("the watch of {name} has been broken for 10 minutes while the API server answers other calls")
            })
            .collect()
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        lock(&self.0)
    }
}

/// How a watch reports what happens to it.
#[derive(Debug)]
pub struct WatchProbe {
    liveness: Liveness,
    name: String,
}

impl WatchProbe {
    /// It begins to list: at the start, and after the server forgot where it was.
    pub fn listing(&self) {
        self.change(|state, now| state.listing = state.listing.or(Some(now)));
    }

    /// The list is complete.
    pub fn listed(&self) {
        self.change(|state, _| *state = WatchState::default());
        self.liveness.answered();
    }

    /// An event has come, or a watch that had started broke: either way it had been let in.
    pub fn running(&self) {
        self.change(|state, _| state.failing = None);
        self.liveness.answered();
    }

    /// It could not list or start.
    pub fn failed(&self) {
        self.change(|state, now| {
            let first = state
                .failing
                .filter(|(_, last)| now - *last < FAILS_AGAIN_WITHIN)
                .map_or(now, |(first, _)| first);
            state.failing = Some((first, now));
        });
    }

    /// The API server has refused it: a restart would give it no right, and readiness names the one that is missing.
    pub fn refused(&self) {
        self.change(|state, _| *state = WatchState::default());
        self.liveness.answered();
    }

    fn change(&self, change: impl FnOnce(&mut WatchState, Instant)) {
        let mut state = self.liveness.lock();
        change(state.watches.entry(self.name.clone()).or_default(), Instant::now());
    }
}

impl Drop for WatchProbe {
    fn drop(&mut self) {
        self.liveness.lock().watches.remove(&self.name);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tokio::time::advance;

    const MINUTE: Duration = Duration::from_mins(1);

    #[tokio::test(start_paused = true)]
    async fn a_watch_that_never_lists_is_stuck_only_while_the_api_answers() {
        let liveness = Liveness::default();
        let _watch = liveness.watch("jobs");
        advance(11 * MINUTE).await;
        assert!(liveness.problems().is_empty(), "an outage is no reason to restart");
        liveness.answered();
        let problems = liveness.problems();
        assert!(
            problems.len() == 1 && problems[0].contains("watch of jobs"),
            "{problems:?}"
        );
        advance(2 * MINUTE).await;
        assert!(liveness.problems().is_empty(), "the outage is back");
    }

    #[tokio::test(start_paused = true)]
    async fn failing_to_start_for_ten_minutes_is_stuck_and_an_event_clears_it() {
        let liveness = Liveness::default();
        let watch = liveness.watch("pods");
        watch.listed();
        for _ in 0..12 {
            watch.failed();
            advance(MINUTE).await;
        }
        liveness.answered();
        assert_eq!(liveness.problems().len(), 1);
        watch.running();
        assert!(liveness.problems().is_empty());
    }

    #[tokio::test(start_paused = true)]
    async fn a_watch_that_is_refused_is_no_reason_to_restart() {
        let liveness = Liveness::default();
        let watch = liveness.watch("networkpolicies");
        for _ in 0..12 {
            watch.listing();
            watch.refused();
            advance(MINUTE).await;
        }
        liveness.answered();
        assert_eq!(liveness.problems(), Vec::<String>::new());
    }

    #[tokio::test(start_paused = true)]
    async fn one_failure_and_then_silence_is_a_watch_without_news() {
        let liveness = Liveness::default();
        let watch = liveness.watch("pods");
        watch.listed();
        watch.failed();
        advance(60 * MINUTE).await;
        liveness.answered();
        assert!(liveness.problems().is_empty());
        watch.failed();
        advance(MINUTE / 2).await;
        assert!(
            liveness.problems().is_empty(),
            "an hour later it is another row of failures"
        );
    }

    #[tokio::test(start_paused = true)]
    async fn a_second_list_that_does_not_come_counts_from_its_first_try() {
        let liveness = Liveness::default();
        let watch = liveness.watch("pods");
        watch.listed();
        for _ in 0..3 {
            watch.listing();
            advance(4 * MINUTE).await;
        }
        liveness.answered();
        assert_eq!(liveness.problems().len(), 1);
        drop(watch);
        assert!(
            liveness.problems().is_empty(),
            "a watch that is given up is not asked for"
        );
    }
}
