//! Reconciles and the queues that they come from.

use std::time::Duration;

use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::metrics::histogram::Histogram;
use prometheus_client::registry::Registry;

use super::labels::{Kind, KindClass, KindOutcome, KindReason};
use super::{Metrics, Timings, add, timings, whole, zero};

#[derive(Debug)]
pub(super) struct Reconciles {
    total: Family<KindOutcome, Counter>,
    duration: Timings<Kind>,
    waiting: Family<KindClass, Gauge>,
    wait: Timings<KindClass>,
    errors: Family<KindReason, Counter>,
}

impl Reconciles {
    pub(super) fn new(r: &mut Registry) -> Self {
        Self {
            total: zero(r, "reconciles", "Reconciliations by kind and outcome"),
            duration: add(
                r,
                "reconcile_duration_seconds",
                "Duration of a reconciliation",
                timings(),
            ),
            waiting: zero(
                r,
                "reconciles_waiting",
                "Objects that are ready to be reconciled, by class",
            ),
            wait: add(
                r,
                "reconcile_wait_duration_seconds",
                "Time from an event to its reconciliation, by class",
                timings(),
            ),
            errors: zero(r, "reconcile_errors", "Failed reconciliations by kind and reason"),
        }
    }

    pub(super) fn leave_to_the_leader(&self) {
        self.waiting.clear();
    }
}

impl Metrics {
    /// A reconciliation of an object of a kind is done.
    pub fn reconciled(&self, kind: &'static str, outcome: &'static str, took: Duration) {
        self.reconciles
            .total
            .get_or_create(&KindOutcome { kind, outcome })
            .inc();
        self.reconciles
            .duration
            .get_or_create(&Kind { kind: kind.to_owned() })
            .observe(took.as_secs_f64());
    }

    /// A reconciliation has failed; `reason` is one of a fixed set.
    pub fn reconcile_failed(&self, kind: &'static str, reason: &'static str) {
        self.reconciles.errors.get_or_create(&KindReason { kind, reason }).inc();
    }

    /// The queue of a kind, with its classes; they appear at once, at zero.
    pub fn queue<const N: usize>(&self, kind: &'static str, classes: [&'static str; N]) -> QueueMetrics<N> {
        let of_class = |class| {
            let label = KindClass { kind, class };
            let waited = self.reconciles.wait.get_or_create_owned(&label);
            (self.reconciles.waiting.get_or_create_owned(&label), waited)
        };
        QueueMetrics(classes.map(of_class))
    }
}

/// Of one kind's queue, by class.
#[derive(Clone, Debug)]
pub struct QueueMetrics<const N: usize>([(Gauge, Histogram); N]);

impl<const N: usize> QueueMetrics<N> {
    /// So many are ready.
    pub fn waiting(&self, depth: [usize; N]) {
        for ((gauge, _), count) in self.0.iter().zip(depth) {
            gauge.set(whole(count));
        }
    }

    /// The reconciliation of one begins, so long after its event.
    pub fn began(&self, class: usize, waited: Duration) {
        if let Some((_, histogram)) = self.0.get(class) {
            histogram.observe(waited.as_secs_f64());
        }
    }
}
