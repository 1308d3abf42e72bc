//! What the watches of Kubernetes bring, and how they fail.

use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use prometheus_client::registry::Registry;

use super::labels::Kind;
use super::{FloatGauge, Metrics, unix_time, zero};

#[derive(Debug)]
pub(super) struct Watches {
    errors: Family<Kind, Counter>,
    malformed: Family<Kind, Counter>,
    last_event: Family<Kind, FloatGauge>,
}

impl Watches {
    pub(super) fn new(r: &mut Registry) -> Self {
        Self {
            errors: zero(r, "watch_errors", "Errors of a kind's watch"),
            malformed: zero(r, "watch_malformed_objects", "Objects that could not be read"),
            last_event: zero(
                r,
                "watch_last_event_timestamp_seconds",
                "Unix time of a watch's last event",
            ),
        }
    }
}

impl Metrics {
    /// The counters of one kind's watch; they appear at once, at zero.
    pub fn watch(&self, kind: &str) -> WatchMetrics {
        let label = Kind { kind: kind.to_owned() };
        WatchMetrics {
            errors: self.watches.errors.get_or_create_owned(&label),
            malformed: self.watches.malformed.get_or_create_owned(&label),
            last_event: self.watches.last_event.get_or_create_owned(&label),
        }
    }
}

/// Of one kind's watch.
#[derive(Clone, Debug)]
pub struct WatchMetrics {
    errors: Counter,
    malformed: Counter,
    last_event: FloatGauge,
}

impl WatchMetrics {
    /// The watch met an error.
    pub fn failed(&self) {
        self.errors.inc();
    }

    /// An object could not be read.
    pub fn malformed(&self) {
        self.malformed.inc();
    }

    /// The watch brought something.
    pub fn event(&self) {
        self.last_event.set(unix_time());
    }
}
