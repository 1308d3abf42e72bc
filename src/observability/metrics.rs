//! Every metric of the operator, as one typed struct: what is counted, with which labels.
//!
//! Parts call the methods; the health server asks for the text. Labels hold kinds, outcomes and fixed words only, never
//! the name of an object, so that their number stays small.

use std::fmt;
use std::sync::atomic::AtomicU64;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use prometheus_client::encoding::{EncodeLabelSet, text};
use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::metrics::histogram::Histogram;
use prometheus_client::metrics::info::Info;
use prometheus_client::registry::{Metric, Registry};

/// Media type of `Metrics::text`.
pub const CONTENT_TYPE: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";

type FloatGauge = Gauge<f64, AtomicU64>;
type Timings<L> = Family<L, Histogram, fn() -> Histogram>;

#[derive(Clone, Debug, PartialEq, Eq, Hash, EncodeLabelSet)]
struct Kind {
    kind: String,
}

#[derive(Clone, Debug, PartialEq, Eq, Hash, EncodeLabelSet)]
struct KindOutcome {
    kind: &'static str,
    outcome: &'static str,
}

#[derive(Clone, Debug, PartialEq, Eq, Hash, EncodeLabelSet)]
struct KindReason {
    kind: &'static str,
    reason: &'static str,
}

#[derive(Clone, Debug, PartialEq, Eq, Hash, EncodeLabelSet)]
struct Reason {
    reason: &'static str,
}

#[derive(Clone, Debug, PartialEq, Eq, Hash, EncodeLabelSet)]
struct State {
    state: &'static str,
}

#[derive(Clone, Debug, PartialEq, Eq, Hash, EncodeLabelSet)]
struct Op {
    op: &'static str,
    outcome: &'static str,
}

#[derive(Clone, Debug, PartialEq, Eq, Hash, EncodeLabelSet)]
struct Call {
    service: &'static str,
    op: &'static str,
    outcome: &'static str,
}

#[derive(Clone, Debug, PartialEq, Eq, Hash, EncodeLabelSet)]
struct ServiceOp {
    service: &'static str,
    op: &'static str,
}

#[derive(Clone, Debug, PartialEq, Eq, Hash, EncodeLabelSet)]
struct Fate {
    fate: &'static str,
}

#[derive(Clone, Debug, PartialEq, Eq, Hash, EncodeLabelSet)]
struct Build {
    version: &'static str,
}

/// One for a process, shared by all parts.
#[derive(Debug)]
pub struct Metrics {
    registry: Registry,
    reconciles: Family<KindOutcome, Counter>,
    reconcile_seconds: Timings<Kind>,
    reconcile_errors: Family<KindReason, Counter>,
    waiting_passes: Gauge,
    watch_errors: Family<Kind, Counter>,
    watch_malformed: Family<Kind, Counter>,
    watch_last_event: Family<Kind, FloatGauge>,
    is_leader: Gauge,
    leader_term: Gauge,
    lease_errors: Family<Reason, Counter>,
    submissions: Family<State, Gauge>,
    evalai_requests: Family<Op, Counter>,
    evalai_request_seconds: Timings<ServiceOp>,
    evalai_budget_used: Gauge,
    evalai_waiting: Gauge,
    cloud_calls: Family<Call, Counter>,
    cloud_call_seconds: Timings<ServiceOp>,
    sqs_messages: Family<Fate, Counter>,
}

impl Default for Metrics {
    fn default() -> Self {
        Self::new()
    }
}

/// From 1 ms to half a minute: passes and calls.
fn timing() -> Histogram {
    Histogram::new([
        0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0,
    ])
}

/// Registers a metric and hands it back.
fn add<M: Metric + Clone>(registry: &mut Registry, name: &str, help: &str, metric: M) -> M {
    registry.register(name, help, metric.clone());
    metric
}

impl Metrics {
    /// All metrics at their beginning; every name starts with `leaderboard_`.
    pub fn new() -> Self {
        let mut registry = Registry::with_prefix("leaderboard");
        let r = &mut registry;
        let build = Build {
            version: env!("CARGO_PKG_VERSION"),
        };
        r.register("build", "The program that runs", Info::new(build));
        Self {
            reconciles: add(r, "reconciles", "Passes by kind and outcome", Family::default()),
            reconcile_seconds: add(
                r,
                "reconcile_seconds",
                "Duration of a pass",
                Family::new_with_constructor(timing as fn() -> _),
            ),
            reconcile_errors: add(r, "reconcile_errors", "Failed passes by reason", Family::default()),
            waiting_passes: add(r, "waiting_passes", "Objects that wait for a pass", Gauge::default()),
            watch_errors: add(r, "watch_errors", "Errors of a kind's watch", Family::default()),
            watch_malformed: add(
                r,
                "watch_malformed_objects",
                "Objects that could not be read",
                Family::default(),
            ),
            watch_last_event: add(
                r,
                "watch_last_event_seconds",
                "Unix time of a watch's last event",
                Family::default(),
            ),
            is_leader: add(r, "is_leader", "1 while this process leads", Gauge::default()),
            leader_term: add(
                r,
                "leader_term",
                "Term in which this process leads or led last",
                Gauge::default(),
            ),
            lease_errors: add(
                r,
                "lease_errors",
                "Failed calls about the Lease by reason",
                Family::default(),
            ),
            submissions: add(r, "submissions", "Submissions by state", Family::default()),
            evalai_requests: add(
                r,
                "evalai_requests",
                "Requests to EvalAI by operation and outcome",
                Family::default(),
            ),
            evalai_request_seconds: add(
                r,
                "evalai_request_seconds",
                "Duration of requests to EvalAI",
                Family::new_with_constructor(timing as fn() -> _),
            ),
            evalai_budget_used: add(
                r,
                "evalai_budget_used",
                "Requests to EvalAI within the last minute",
                Gauge::default(),
            ),
            evalai_waiting: add(
                r,
                "evalai_waiting",
                "Wishes that wait for a request to EvalAI",
                Gauge::default(),
            ),
            cloud_calls: add(
                r,
                "cloud_calls",
                "Calls to AWS by service, operation and outcome",
                Family::default(),
            ),
            cloud_call_seconds: add(
                r,
                "cloud_call_seconds",
                "Duration of calls to AWS",
                Family::new_with_constructor(timing as fn() -> _),
            ),
            sqs_messages: add(r, "sqs_messages", "Messages by what became of them", Family::default()),
            registry,
        }
    }

    /// All of it as OpenMetrics text.
    ///
    /// # Errors
    /// If a metric cannot be written, which is an error of the program.
    pub fn text(&self) -> Result<String, fmt::Error> {
        let mut text = String::new();
        text::encode(&mut text, &self.registry)?;
        Ok(text)
    }

    /// A pass over an object of a kind is done.
    pub fn reconciled(&self, kind: &'static str, outcome: &'static str, took: Duration) {
        self.reconciles.get_or_create(&KindOutcome { kind, outcome }).inc();
        self.reconcile_seconds
            .get_or_create(&Kind { kind: kind.to_owned() })
            .observe(took.as_secs_f64());
    }

    /// A pass has failed; `reason` is a fixed word.
    pub fn reconcile_failed(&self, kind: &'static str, reason: &'static str) {
        self.reconcile_errors.get_or_create(&KindReason { kind, reason }).inc();
    }

    /// So many objects wait for a pass.
    pub fn set_waiting_passes(&self, count: usize) {
        self.waiting_passes.set(whole(count));
    }

    /// The counters of one kind's watch; they appear at once, at zero.
    pub fn watch(&self, kind: &str) -> WatchMetrics {
        let label = Kind { kind: kind.to_owned() };
        WatchMetrics {
            errors: self.watch_errors.get_or_create_owned(&label),
            malformed: self.watch_malformed.get_or_create_owned(&label),
            last_event: self.watch_last_event.get_or_create_owned(&label),
        }
    }

    /// This process leads in a term, or does not lead.
    pub fn set_leading(&self, term: Option<i32>) {
        self.is_leader.set(i64::from(term.is_some()));
        if let Some(term) = term {
            self.leader_term.set(term.into());
        }
    }

    /// A call about the Lease has failed.
    pub fn lease_failed(&self, reason: &'static str) {
        self.lease_errors.get_or_create(&Reason { reason }).inc();
    }

    /// So many Submissions are in a state. States with none are to be told, too.
    pub fn set_submissions(&self, state: &'static str, count: usize) {
        self.submissions.get_or_create(&State { state }).set(whole(count));
    }

    /// EvalAI was asked something.
    pub fn evalai_request(&self, op: &'static str, outcome: &'static str, took: Duration) {
        let service = "evalai";
        self.evalai_requests.get_or_create(&Op { op, outcome }).inc();
        self.evalai_request_seconds
            .get_or_create(&ServiceOp { service, op })
            .observe(took.as_secs_f64());
    }

    /// Requests within the last minute, over all tokens, and the wishes that wait for one.
    pub fn set_evalai_load(&self, used: usize, waiting: usize) {
        self.evalai_budget_used.set(whole(used));
        self.evalai_waiting.set(whole(waiting));
    }

    /// A call to a service of AWS is over.
    pub fn cloud_call(&self, service: &'static str, op: &'static str, outcome: &'static str, took: Duration) {
        self.cloud_calls.get_or_create(&Call { service, op, outcome }).inc();
        self.cloud_call_seconds
            .get_or_create(&ServiceOp { service, op })
            .observe(took.as_secs_f64());
    }

    /// What became of a message.
    pub fn sqs_message(&self, fate: &'static str) {
        self.sqs_messages.get_or_create(&Fate { fate }).inc();
    }
}

fn whole(count: usize) -> i64 {
    i64::try_from(count).unwrap_or(i64::MAX)
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
        let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        self.last_event.set(now.as_secs_f64());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_metric_is_told_under_its_name_with_its_labels() {
        let metrics = Metrics::new();
        metrics.reconciled("Submission", "ok", Duration::from_millis(20));
        metrics.reconcile_failed("Submission", "conflict");
        metrics.set_waiting_passes(3);
        let watch = metrics.watch("Job");
        watch.failed();
        watch.event();
        metrics.set_leading(Some(7));
        metrics.lease_failed("timeout");
        metrics.set_submissions("Running", 2);
        metrics.evalai_request("put_finished", "ok", Duration::from_millis(20));
        metrics.set_evalai_load(54, 1);
        metrics.cloud_call("s3", "GetObject", "ok", Duration::from_secs(1));
        metrics.sqs_message("created");
        let text = metrics.text().unwrap();
        for line in [
            concat!("leaderboard_build_info{version=\"", env!("CARGO_PKG_VERSION"), "\"} 1"),
            "leaderboard_reconciles_total{kind=\"Submission\",outcome=\"ok\"} 1",
            "leaderboard_reconcile_seconds_bucket{le=\"0.025\",kind=\"Submission\"} 1",
            "leaderboard_reconcile_errors_total{kind=\"Submission\",reason=\"conflict\"} 1",
            "leaderboard_waiting_passes 3",
            "leaderboard_watch_errors_total{kind=\"Job\"} 1",
            "leaderboard_watch_malformed_objects_total{kind=\"Job\"} 0",
            "leaderboard_is_leader 1",
            "leaderboard_leader_term 7",
            "leaderboard_lease_errors_total{reason=\"timeout\"} 1",
            "leaderboard_submissions{state=\"Running\"} 2",
            "leaderboard_evalai_requests_total{op=\"put_finished\",outcome=\"ok\"} 1",
            "leaderboard_evalai_request_seconds_bucket{le=\"0.025\",service=\"evalai\",op=\"put_finished\"} 1",
            "leaderboard_evalai_budget_used 54",
            "leaderboard_evalai_waiting 1",
            "leaderboard_cloud_calls_total{service=\"s3\",op=\"GetObject\",outcome=\"ok\"} 1",
            "leaderboard_sqs_messages_total{fate=\"created\"} 1",
        ] {
            assert!(text.lines().any(|l| l == line), "{line} is missing in\n{text}");
        }
        assert!(
            text.contains("leaderboard_watch_last_event_seconds{kind=\"Job\"} 1"),
            "a time since 1970 in\n{text}"
        );
        assert!(text.ends_with("# EOF\n"));
    }

    #[test]
    fn a_process_that_stops_leading_keeps_its_last_term() {
        let metrics = Metrics::new();
        metrics.set_leading(Some(4));
        metrics.set_leading(None);
        let text = metrics.text().unwrap();
        assert!(
            text.contains("leaderboard_is_leader 0\n") && text.contains("leaderboard_leader_term 4\n"),
            "{text}"
        );
    }
}
