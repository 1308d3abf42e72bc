//! How long submissions stay in each phase of their life, and what became of the spans that show it.

use std::time::Duration;

use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::histogram::Histogram;
use prometheus_client::registry::Registry;

use super::labels::{OfPhase, SpanOutcome};
use super::{Metrics, Timings, add, zero};

#[derive(Debug)]
pub(super) struct Phases {
    duration: Timings<OfPhase>,
    spans: Family<SpanOutcome, Counter>,
}

/// From a second to two days: a full leaderboard runs for many hours.
fn hours() -> Timings<OfPhase> {
    Family::new_with_constructor(|| {
        Histogram::new([
            1.0, 5.0, 15.0, 60.0, 300.0, 900.0, 1800.0, 3600.0, 7200.0, 14400.0, 28800.0, 57600.0, 86400.0, 172_800.0,
        ])
    })
}

impl Phases {
    pub(super) fn new(r: &mut Registry) -> Self {
        Self {
            duration: add(
                r,
                "submission_phase_duration_seconds",
                "Time that submissions spent in each phase that ended while this process led",
                hours(),
            ),
            spans: zero(
                r,
                "trace_spans",
                "Spans by outcome: `sent`, `failed` where the collector did not take them, `dropped` where too many waited",
            ),
        }
    }
}

impl Metrics {
    /// These phases begin at zero: Prometheus sees no increase in a sample that begins with 1.
    pub fn expect_phases(&self, phases: &[&'static str]) {
        for phase in phases {
            let _ = self.phases.duration.get_or_create(&OfPhase { phase });
        }
    }

    /// A phase of a submission is over.
    pub fn phase_ended(&self, phase: &'static str, took: Duration) {
        let duration = self.phases.duration.get_or_create(&OfPhase { phase });
        duration.observe(took.as_secs_f64());
    }

    /// What became of spans.
    pub fn spans(&self, outcome: &'static str, count: usize) {
        let spans = self.phases.spans.get_or_create(&SpanOutcome { outcome });
        spans.inc_by(u64::try_from(count).unwrap_or(u64::MAX));
    }
}
