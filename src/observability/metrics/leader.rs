//! Which controller leads.

use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::registry::Registry;

use super::labels::Reason;
use super::{Metrics, zero};

#[derive(Debug)]
pub(super) struct Leader {
    leads: Gauge,
    term: Gauge,
    errors: Family<Reason, Counter>,
}

impl Leader {
    pub(super) fn new(r: &mut Registry) -> Self {
        Self {
            leads: zero(r, "is_leader", "1 while this process leads"),
            term: zero(r, "leader_term", "Term in which this process leads or led last"),
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
            self.submissions.leave_to_the_leader();
            self.boards.leave_to_the_leader();
            self.limits.leave_to_the_leader();
            self.queues.leave_to_the_leader();
            self.set_evalai_load(0, 0, 0);
        }
    }

    /// A call about the Lease has failed.
    pub fn lease_failed(&self, reason: &'static str) {
        self.leader.errors.get_or_create(&Reason { reason }).inc();
    }
}
