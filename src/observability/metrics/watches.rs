//! What the watches of Kubernetes bring, and how they fail.

use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::registry::Registry;

use super::labels::Kind;
use super::{FloatGauge, Metrics, unix_time, whole, zero};

#[derive(Debug)]
pub(super) struct Watches {
    errors: Family<Kind, Counter>,
    unreadable: Family<Kind, Gauge>,
    last_event: Family<Kind, FloatGauge>,
}

impl Watches {
    pub(super) fn new(r: &mut Registry) -> Self {
        Self {
            errors: zero(r, "watch_errors", "Errors of a kind's watch"),
            unreadable: zero(r, "watch_unreadable_objects", "Objects that cannot be read now"),
            last_event: zero(
                r,
                "watch_last_event_timestamp_seconds",
                "Unix time of a watch's last event",
            ),
        }
    }
}

impl Metrics {
    /// What is counted of one kind's watch; it appears at once, at zero.
    pub fn watch(&self, kind: &str) -> WatchMetrics {
        let label = Kind { kind: kind.to_owned() };
        WatchMetrics {
            errors: self.watches.errors.get_or_create_owned(&label),
            unreadable: self.watches.unreadable.get_or_create_owned(&label),
            last_event: self.watches.last_event.get_or_create_owned(&label),
        }
    }
}

/// Of one kind's watch.
#[derive(Clone, Debug)]
pub struct WatchMetrics {
    errors: Counter,
    unreadable: Gauge,
    last_event: FloatGauge,
}

impl WatchMetrics {
    /// The watch met an error.
    pub fn failed(&self) {
        self.errors.inc();
    }

    /// So many objects cannot be read now.
    pub fn unreadable(&self, objects: usize) {
        self.unreadable.set(whole(objects));
    }

    /// The watch brought something.
    pub fn event(&self) {
        self.last_event.set(unix_time());
    }
}
