//! Joins the bridge's own words to the process's metrics and readiness.

use std::sync::Arc;
use std::time::Duration;

use crate::bridge::{Health, Observer};
use crate::observability::Observability;
use crate::observability::metrics::{Metrics, WatchMetrics};

/// How often the bridge's readiness is taken over.
const EVERY: Duration = Duration::from_millis(500);

/// Counts what the bridge does.
pub(super) struct BridgeCounters {
    metrics: Arc<Metrics>,
    watch: WatchMetrics,
}

impl BridgeCounters {
    pub(super) fn new(seen: &Observability) -> Self {
        Self {
            metrics: Arc::clone(&seen.metrics),
            watch: seen.metrics.watch("leaderboards"),
        }
    }
}

impl Observer for BridgeCounters {
    fn messages(&self, fate: &'static str, count: u64) {
        for _ in 0..count {
            self.metrics.sqs_message(fate);
        }
    }

    fn call(&self, service: &'static str, operation: &'static str, outcome: &'static str) {
        self.metrics.cloud_call(service, operation, outcome, Duration::ZERO);
    }

    fn watch_failed(&self) {
        self.watch.failed();
    }

    fn watch_moved(&self) {
        self.watch.event();
    }
}

/// Shows in /readyz what the bridge misses.
pub(super) async fn report_readiness(health: Arc<Health>, seen: Observability) {
    let mut tick = tokio::time::interval(EVERY);
    loop {
        tick.tick().await;
        let now = health.readiness();
        seen.readiness
            .set("queues", if now.ready { Ok(()) } else { Err(now.text) });
        seen.readiness.registered();
    }
}
