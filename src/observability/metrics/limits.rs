//! What a Leaderboard has left: slots, days of its token, and what lies in its queues. The leader alone shows it.

use jiff::Timestamp;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::registry::Registry;

use super::labels::OfLeaderboard;
use super::{FloatGauge, Metrics, whole, zero};

#[derive(Debug)]
pub(super) struct Limits {
    used: Family<OfLeaderboard, Gauge>,
    slots: Family<OfLeaderboard, Gauge>,
    token: Family<OfLeaderboard, FloatGauge>,
    visible: Family<OfLeaderboard, Gauge>,
    in_flight: Family<OfLeaderboard, Gauge>,
    dead: Family<OfLeaderboard, Gauge>,
    rows: Family<OfLeaderboard, Gauge>,
}

impl Limits {
    pub(super) fn new(r: &mut Registry) -> Self {
        Self {
            used: zero(
                r,
                "slots_in_use",
                "Submissions that have a Job, or are about to get one",
            ),
            slots: zero(
                r,
                "slots_limit",
                "Submissions that may have a Job at once; absent without `concurrency.total`",
            ),
            token: zero(
                r,
                "evalai_token_expiry_timestamp_seconds",
                "Unix time at which EvalAI's token ends; absent where the token does not say",
            ),
            visible: zero(
                r,
                "queue_visible_messages",
                "Messages that wait in the SQS queue, as SQS reported last",
            ),
            in_flight: zero(
                r,
                "queue_in_flight_messages",
                "Messages of the SQS queue that somebody has received and not deleted, as SQS reported last",
            ),
            dead: zero(
                r,
                "dead_letter_queue_messages",
                "Messages that lie in the dead-letter queue, as SQS reported last",
            ),
            rows: zero(
                r,
                "table_rows_waiting",
                "Rows that have waited for the table for more than 10 s, of all Leaderboards that write to it",
            ),
        }
    }

    pub(super) fn leave_to_the_leader(&self) {
        self.used.clear();
        self.slots.clear();
        self.token.clear();
        self.visible.clear();
        self.in_flight.clear();
        self.dead.clear();
        self.rows.clear();
    }

    pub(super) fn forget(&self, of: &OfLeaderboard) {
        self.used.remove(of);
        self.slots.remove(of);
        self.token.remove(of);
        self.visible.remove(of);
        self.in_flight.remove(of);
        self.dead.remove(of);
        self.rows.remove(of);
    }
}

/// What is known of one Leaderboard.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LimitsState {
    pub slots_in_use: usize,
    pub slots: Option<usize>,
    pub token_ends: Option<Timestamp>,
    /// Visible, and in flight.
    pub queue: Option<(u64, u64)>,
    pub dead_letters: Option<u64>,
    /// None without a table.
    pub rows_waiting: Option<usize>,
}

impl Metrics {
    /// What `leaderboard`, named with its namespace before it, has at present.
    pub fn set_limits(&self, leaderboard: &str, state: LimitsState) {
        let of = OfLeaderboard {
            leaderboard: leaderboard.to_owned(),
        };
        let limits = &self.limits;
        let number = |count: u64| i64::try_from(count).unwrap_or(i64::MAX);
        show(&limits.used, &of, Some(whole(state.slots_in_use)));
        show(&limits.slots, &of, state.slots.map(whole));
        show(&limits.visible, &of, state.queue.map(|(visible, _)| number(visible)));
        show(
            &limits.in_flight,
            &of,
            state.queue.map(|(_, in_flight)| number(in_flight)),
        );
        show(&limits.dead, &of, state.dead_letters.map(number));
        show(&limits.rows, &of, state.rows_waiting.map(whole));
        match state.token_ends {
            Some(at) => {
                let seconds = at.duration_since(Timestamp::UNIX_EPOCH).as_secs_f64();
                limits.token.get_or_create(&of).set(seconds);
            }
            None => {
                limits.token.remove(&of);
            }
        }
    }
}

/// Nothing is shown of what nobody knows.
fn show(family: &Family<OfLeaderboard, Gauge>, of: &OfLeaderboard, value: Option<i64>) {
    match value {
        Some(value) => {
            family.get_or_create(of).set(value);
        }
        None => {
            family.remove(of);
        }
    }
}
