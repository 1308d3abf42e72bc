//! Counts what is asked of the services around the cluster: which service, what, with which outcome, how long it took.
//!
//! Every client here reports its calls to one. All labels are fixed, so that neither a secret nor the name of an object can get into a
//! metric.

use std::fmt;
use std::sync::Arc;
use std::time::Instant;

type Count = Arc<dyn Fn(&Call) + Send + Sync>;

/// Counts calls. Clones count in the same place; the default counts nowhere.
#[derive(Clone, Default)]
pub struct Meter(Option<Count>);

impl Meter {
    /// Hands every call to `count` once it is over.
    pub fn new(count: impl Fn(&Call) + Send + Sync + 'static) -> Self {
        Self(Some(Arc::new(count)))
    }

    /// A call begins. One that is dropped without an end, by a limit of time or a stop, was abandoned.
    pub fn begin(&self, service: &'static str, op: &'static str) -> Call {
        Call {
            meter: self.clone(),
            service,
            op,
            outcome: "abandoned",
            began: Instant::now(),
        }
    }
}

impl fmt::Debug for Meter {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Meter")
    }
}

/// A call under way.
#[must_use]
pub struct Call {
    meter: Meter,
    pub service: &'static str,
    pub op: &'static str,
    pub outcome: &'static str,
    pub began: Instant,
}

impl Call {
    /// It is over.
    pub fn end(mut self, outcome: &'static str) {
        self.outcome = outcome;
    }
}

impl Drop for Call {
    fn drop(&mut self) {
        if let Some(count) = &self.meter.0 {
            count(self);
        }
    }
}
