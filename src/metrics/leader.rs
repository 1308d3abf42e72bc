//! The gauges that the leader alone shows: a set of samples that each walk over the caches replaces.

use std::collections::BTreeMap;
use std::fmt;
use std::sync::Mutex;

use prometheus_client::collector::Collector;
use prometheus_client::encoding::DescriptorEncoder;
use prometheus_client::metrics::MetricType;

use leaderboard_base::lock::lock;

/// A gauge with `N` labels: its name after `leaderboard_`, its labels and its meaning.
#[derive(Debug)]
pub struct Gauge<const N: usize>(&'static str, [&'static str; N], &'static str);

const IS_LEADER: Gauge<0> = Gauge("is_leader", [], "1 while this process leads");
const LEADER_TERM: Gauge<0> = Gauge("leader_term", [], "Term in which this process leads");
pub const SUBMISSIONS: Gauge<1> = Gauge("submissions", ["state"], "Submissions by state");
pub const SUBMISSIONS_BY_REASON: Gauge<3> = Gauge(
    "submissions_by_reason",
    ["state", "reason", "class"],
    "Submissions by the reason of their state; `class` is that of the failure, or empty",
);
pub const GPU_SECONDS: Gauge<2> = Gauge(
    "submission_gpu_seconds",
    ["leaderboard", "submission"],
    "GPUs times seconds that a submission has used so far, over all its Jobs, while it holds GPUs; of a Leaderboard the first 500, all others together as `other`",
);
pub const READY: Gauge<1> = Gauge(
    "ready",
    ["leaderboard"],
    "1 while the condition `Ready` of the Leaderboard is True",
);
pub const OLDEST_PENDING: Gauge<1> = Gauge(
    "oldest_pending_seconds",
    ["leaderboard"],
    "How long the oldest submission that is Pending has waited; 0 without one",
);
pub const OLDEST_UNPUBLISHED: Gauge<1> = Gauge(
    "oldest_unpublished_seconds",
    ["leaderboard"],
    "How long ago the oldest submission ended whose end EvalAI does not have yet; 0 without one",
);
pub const SLOTS_IN_USE: Gauge<1> = Gauge(
    "slots_in_use",
    ["leaderboard"],
    "Submissions that have a Job, or are about to get one",
);
pub const SLOTS_LIMIT: Gauge<1> = Gauge(
    "slots_limit",
    ["leaderboard"],
    "Submissions that may have a Job at once; absent without `concurrency.total`",
);
pub const TOKEN_EXPIRY: Gauge<1> = Gauge(
    "evalai_token_expiry_timestamp_seconds",
    ["leaderboard"],
    "Unix time at which EvalAI's token ends; absent where the token does not say",
);
pub const VISIBLE_MESSAGES: Gauge<1> = Gauge(
    "queue_visible_messages",
    ["leaderboard"],
    "Messages that wait in the SQS queue, as SQS reported last",
);
pub const IN_FLIGHT_MESSAGES: Gauge<1> = Gauge(
    "queue_in_flight_messages",
    ["leaderboard"],
    "Messages of the SQS queue that somebody has received and not deleted, as SQS reported last",
);
pub const DEAD_LETTERS: Gauge<1> = Gauge(
    "dead_letter_queue_messages",
    ["leaderboard"],
    "Messages that lie in the dead-letter queue, as SQS reported last",
);
pub const ROWS_WAITING: Gauge<1> = Gauge(
    "table_rows_waiting",
    ["leaderboard"],
    "Rows that have waited for the table for more than 10 s, of all Leaderboards that write to it",
);
pub const EVALAI_BUDGET_USED: Gauge<0> = Gauge("evalai_budget_used", [], "Requests to EvalAI within the last minute");
pub const EVALAI_BUDGET_LIMIT: Gauge<0> = Gauge(
    "evalai_budget_limit",
    [],
    "Requests to EvalAI that the operator allows itself within a minute, over all tokens",
);
pub const EVALAI_WAITING: Gauge<0> = Gauge(
    "evalai_waiting",
    [],
    "Updates and questions that wait for a request to EvalAI",
);
pub const RECONCILES_WAITING: Gauge<2> = Gauge(
    "reconciles_waiting",
    ["kind", "class"],
    "Objects that are ready to be reconciled, by class",
);

type Labels = Vec<(&'static str, String)>;

/// Samples of these gauges.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Samples(BTreeMap<&'static str, (&'static str, BTreeMap<Labels, i64>)>);

impl Samples {
    /// A value that no `i64` holds is shown as the largest one.
    pub fn set<const N: usize>(
        &mut self,
        Gauge(name, labels, help): &Gauge<N>,
        values: [&str; N],
        value: impl TryInto<i64>,
    ) {
        let labels = labels.iter().copied().zip(values.map(str::to_owned));
        let (_, samples) = self.0.entry(name).or_insert((help, BTreeMap::new()));
        samples.insert(labels.collect(), value.try_into().unwrap_or(i64::MAX));
    }

    fn encode(&self, encoder: &mut DescriptorEncoder<'_>) -> fmt::Result {
        for (name, (help, samples)) in &self.0 {
            let mut gauge = encoder.encode_descriptor(name, help, None, MetricType::Gauge)?;
            for (labels, value) in samples {
                match labels.as_slice() {
                    [] => gauge.encode_gauge(value)?,
                    _ => gauge.encode_family(labels)?.encode_gauge(value)?,
                }
            }
        }
        Ok(())
    }
}

/// The samples that this process shows while it leads.
#[derive(Debug, Default)]
pub(super) struct Leader(Mutex<(Option<i32>, Samples)>);

impl Leader {
    /// Begins a term without samples, or ends it with None.
    pub(super) fn leads(&self, term: Option<i32>) {
        *lock(&self.0) = (term, Samples::default());
    }

    /// Shows the samples of a walk, if this process leads.
    pub(super) fn show(&self, samples: Samples) {
        let mut shown = lock(&self.0);
        if shown.0.is_some() {
            shown.1 = samples;
        }
    }
}

impl Collector for Leader {
    fn encode(&self, mut encoder: DescriptorEncoder<'_>) -> fmt::Result {
        let (term, samples) = &*lock(&self.0);
        let mut own = Samples::default();
        own.set(&IS_LEADER, [], i64::from(term.is_some()));
        if let Some(term) = term {
            own.set(&LEADER_TERM, [], *term);
        }
        own.encode(&mut encoder)?;
        samples.encode(&mut encoder)
    }
}
