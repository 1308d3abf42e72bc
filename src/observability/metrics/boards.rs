//! Each Leaderboard that the leader drives: whether it is ready, and how long its submissions have waited.

use std::time::Duration;

use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::registry::Registry;

use super::labels::OfLeaderboard;
use super::{FloatGauge, Metrics, zero};

#[derive(Debug)]
pub(super) struct Boards {
    ready: Family<OfLeaderboard, Gauge>,
    pending: Family<OfLeaderboard, FloatGauge>,
    unpublished: Family<OfLeaderboard, FloatGauge>,
}

impl Boards {
    pub(super) fn new(r: &mut Registry) -> Self {
        Self {
            ready: zero(r, "ready", "1 while the condition `Ready` of the Leaderboard is True"),
            pending: zero(
                r,
                "oldest_pending_seconds",
                "How long the oldest submission that is Pending has waited; 0 without one",
            ),
            unpublished: zero(
                r,
                "oldest_unpublished_seconds",
                "How long ago the oldest submission ended whose end EvalAI does not have yet; 0 without one",
            ),
        }
    }

    pub(super) fn leave_to_the_leader(&self) {
        self.ready.clear();
        self.pending.clear();
        self.unpublished.clear();
    }
}

/// One Leaderboard at present.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct BoardState {
    pub is_ready: bool,
    pub oldest_pending: Duration,
    pub oldest_unpublished: Duration,
}

impl Metrics {
    /// What `leaderboard`, named with its namespace before it, shows at present.
    pub fn set_leaderboard(&self, leaderboard: &str, state: BoardState) {
        let of = OfLeaderboard {
            leaderboard: leaderboard.to_owned(),
        };
        self.boards.ready.get_or_create(&of).set(state.is_ready.into());
        let pending = state.oldest_pending.as_secs_f64();
        self.boards.pending.get_or_create(&of).set(pending);
        let unpublished = state.oldest_unpublished.as_secs_f64();
        self.boards.unpublished.get_or_create(&of).set(unpublished);
    }

    /// A Leaderboard is gone, or another installation's.
    pub fn forget_leaderboard(&self, leaderboard: &str) {
        let of = OfLeaderboard {
            leaderboard: leaderboard.to_owned(),
        };
        self.boards.ready.remove(&of);
        self.boards.pending.remove(&of);
        self.boards.unpublished.remove(&of);
        self.limits.forget(&of);
    }
}
