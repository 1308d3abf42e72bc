//! Calls to the services around the cluster, and the messages of the queues.

use std::time::Duration;

use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::histogram::Histogram;
use prometheus_client::registry::Registry;

use super::labels::{Call, MessageOutcome, Op, OpOutcome, ServiceOp};
use super::leader::LeaderGauge;
use super::{Metrics, Timings, add, timings, whole, zero};

#[derive(Debug)]
pub(super) struct Evalai {
    requests: Family<OpOutcome, Counter>,
    duration: Timings<Op>,
    budget_used: LeaderGauge,
    budget_limit: LeaderGauge,
    waiting: LeaderGauge,
}

impl Evalai {
    pub(super) fn new(r: &mut Registry) -> Self {
        Self {
            requests: zero(r, "evalai_requests", "Requests to EvalAI by operation and outcome"),
            duration: add(
                r,
                "evalai_request_duration_seconds",
                "Duration of requests to EvalAI",
                timings(),
            ),
            budget_used: zero(r, "evalai_budget_used", "Requests to EvalAI within the last minute"),
            budget_limit: zero(
                r,
                "evalai_budget_limit",
                "Requests to EvalAI that the operator allows itself within a minute, over all tokens",
            ),
            waiting: zero(
                r,
                "evalai_waiting",
                "Updates and questions that wait for a request to EvalAI",
            ),
        }
    }

    pub(super) fn leave_to_the_leader(&self) {
        self.budget_used.clear();
        self.budget_limit.clear();
        self.waiting.clear();
    }
}

#[derive(Debug)]
pub(super) struct Cloud {
    calls: Family<Call, Counter>,
    duration: Timings<ServiceOp>,
}

impl Cloud {
    pub(super) fn new(r: &mut Registry) -> Self {
        Self {
            calls: zero(r, "cloud_calls", "Calls to AWS by service, operation and outcome"),
            duration: add(r, "cloud_call_duration_seconds", "Duration of calls to AWS", timings()),
        }
    }
}

#[derive(Debug)]
pub(super) struct Messages {
    total: Family<MessageOutcome, Counter>,
    wait: Histogram,
}

impl Messages {
    pub(super) fn new(r: &mut Registry) -> Self {
        Self {
            total: zero(r, "sqs_messages", "Messages by outcome"),
            wait: add(
                r,
                "sqs_message_wait_duration_seconds",
                "Time from sending a message to the Submission that it made or resumed",
                Histogram::new([0.1, 0.5, 1.0, 5.0, 15.0, 60.0, 300.0, 900.0, 3600.0, 14400.0, 86400.0]),
            ),
        }
    }
}

impl Metrics {
    /// A request to EvalAI is over.
    pub fn evalai_request(&self, op: &'static str, outcome: &'static str, took: Duration) {
        self.evalai.requests.get_or_create(&OpOutcome { op, outcome }).inc();
        let duration = self.evalai.duration.get_or_create(&Op { op });
        duration.observe(took.as_secs_f64());
    }

    /// Requests within the last minute, those allowed, and the updates that wait for one, each over all tokens.
    pub fn set_evalai_load(&self, used: usize, limit: usize, waiting: usize) {
        self.evalai.budget_used.set(whole(used));
        self.evalai.budget_limit.set(whole(limit));
        self.evalai.waiting.set(whole(waiting));
    }

    /// A call to a service of AWS is over.
    pub fn cloud_call(&self, service: &'static str, op: &'static str, outcome: &'static str, took: Duration) {
        self.cloud.calls.get_or_create(&Call { service, op, outcome }).inc();
        let duration = self.cloud.duration.get_or_create(&ServiceOp { service, op });
        duration.observe(took.as_secs_f64());
    }

    /// What became of a message.
    pub fn sqs_message(&self, outcome: &'static str) {
        self.messages.total.get_or_create(&MessageOutcome { outcome }).inc();
    }

    /// These outcomes begin at zero: Prometheus sees no increase in a sample that begins with 1.
    pub fn expect_messages(&self, outcomes: &[&'static str]) {
        for outcome in outcomes {
            let _ = self.messages.total.get_or_create(&MessageOutcome { outcome });
        }
    }

    /// A message has made or resumed a Submission, so long after it was sent.
    pub fn sqs_message_waited(&self, wait: Duration) {
        self.messages.wait.observe(wait.as_secs_f64());
    }
}
