//! What is known of another installation that drives a Leaderboard. Pure.

use std::time::Duration;

use k8s_openapi::api::coordination::v1::Lease;
use tokio::time::Instant;

/// A Lease that has not changed for so long, and for twice its own duration, is held by nobody.
const UNCHANGED: Duration = Duration::from_secs(30);

/// The Lease of another installation, as it was last read.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Foreign {
    pub(super) operator: String,
    version: Option<String>,
    duration: Duration,
    /// Since when it has not changed.
    since: Instant,
}

impl Foreign {
    pub(super) fn of(operator: &str, lease: &Lease, now: Instant) -> Self {
        let seconds = lease.spec.as_ref().and_then(|spec| spec.lease_duration_seconds);
        Self {
            operator: operator.to_owned(),
            version: lease.metadata.resource_version.clone(),
            duration: Duration::from_secs(seconds.and_then(|s| u64::try_from(s).ok()).unwrap_or(0)),
            since: now,
        }
    }

    /// The same, unchanged since what was known.
    pub(super) fn after(self, known: Option<&Self>) -> Self {
        let same = known.filter(|known| known.operator == self.operator && known.version == self.version);
        Self {
            since: same.map_or(self.since, |known| known.since),
            ..self
        }
    }

    pub(super) fn is_given_up(&self, now: Instant) -> bool {
        now.duration_since(self.since) >= UNCHANGED.max(self.duration * 2)
    }
}
