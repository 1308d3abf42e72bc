//! Which controller leads, and the gauges without labels that it alone has.

use std::fmt;
use std::sync::Arc;
use std::sync::atomic::{AtomicI64, Ordering};

use prometheus_client::encoding::{EncodeMetric, MetricEncoder};
use prometheus_client::metrics::MetricType;
use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::registry::Registry;

use super::labels::Reason;
use super::{Metrics, zero};

/// A gauge of the leader: who does not lead has no sample of it, where a 0 would mean that something is so.
#[derive(Clone, Debug)]
pub(super) struct LeaderGauge(Arc<AtomicI64>);

/// No count comes near it.
const NO_SAMPLE: i64 = i64::MIN;

impl Default for LeaderGauge {
    fn default() -> Self {
        Self(Arc::new(AtomicI64::new(NO_SAMPLE)))
    }
}

impl LeaderGauge {
    pub(super) fn set(&self, value: i64) {
        self.0.store(value, Ordering::Relaxed);
    }

    pub(super) fn clear(&self) {
        self.set(NO_SAMPLE);
    }
}

impl EncodeMetric for LeaderGauge {
    fn encode(&self, mut encoder: MetricEncoder) -> fmt::Result {
        match self.0.load(Ordering::Relaxed) {
            NO_SAMPLE => Ok(()),
            value => encoder.encode_gauge(&value),
        }
    }

    fn metric_type(&self) -> MetricType {
        MetricType::Gauge
    }

    fn is_empty(&self) -> bool {
        self.0.load(Ordering::Relaxed) == NO_SAMPLE
    }
}

#[derive(Debug)]
pub(super) struct Leader {
    leads: Gauge,
    term: LeaderGauge,
    errors: Family<Reason, Counter>,
}

impl Leader {
    pub(super) fn new(r: &mut Registry) -> Self {
        Self {
            leads: zero(r, "is_leader", "1 while this process leads"),
            term: zero(r, "leader_term", "Term in which this process leads"),
            errors: zero(r, "lease_errors", "Failed calls about the Lease by reason"),
        }
    }
}

impl Metrics {
    /// This process leads in a term, or does not lead: then it shows nothing of what the leader alone counts at present.
    pub fn set_leading(&self, term: Option<i32>) {
        self.leader.leads.set(i64::from(term.is_some()));
        if let Some(term) = term {
            self.leader.term.set(term.into());
        } else {
            self.leader.term.clear();
            self.submissions.leave_to_the_leader();
            self.boards.leave_to_the_leader();
            self.limits.leave_to_the_leader();
            self.queues.leave_to_the_leader();
            self.evalai.leave_to_the_leader();
            self.reconciles.leave_to_the_leader();
        }
    }

    /// A call about the Lease has failed.
    pub fn lease_failed(&self, reason: &'static str) {
        self.leader.errors.get_or_create(&Reason { reason }).inc();
    }
}
