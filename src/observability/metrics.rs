//! Every metric of the operator, as one typed struct: what is counted, with which labels.
//!
//! Parts call the methods; the health server asks for the text. Labels hold kinds, outcomes and other fixed values only, never
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
struct KindClass {
    kind: &'static str,
    class: &'static str,
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
struct MessageOutcome {
    outcome: &'static str,
}

#[derive(Clone, Debug, PartialEq, Eq, Hash, EncodeLabelSet)]
struct Build {
    version: &'static str,
}

/// One for a process, shared by all parts.
#[derive(Debug)]
pub struct Metrics {
    registry: Registry,
    reconciles: Reconciles,
    watches: Watches,
    leader: Leader,
    submissions: Family<State, Gauge>,
    repeating_teams: Gauge,
    evalai: Evalai,
    cloud: Cloud,
}

#[derive(Debug)]
struct Reconciles {
    total: Family<KindOutcome, Counter>,
    seconds: Timings<Kind>,
    waiting: Family<KindClass, Gauge>,
    wait_seconds: Timings<KindClass>,
    errors: Family<KindReason, Counter>,
}

#[derive(Debug)]
struct Watches {
    errors: Family<Kind, Counter>,
    malformed: Family<Kind, Counter>,
    last_event: Family<Kind, FloatGauge>,
}

#[derive(Debug)]
struct Leader {
    leads: Gauge,
    term: Gauge,
    errors: Family<Reason, Counter>,
}

#[derive(Debug)]
struct Evalai {
    requests: Family<Op, Counter>,
    seconds: Timings<ServiceOp>,
    budget_used: Gauge,
    waiting: Gauge,
}

#[derive(Debug)]
struct Cloud {
    calls: Family<Call, Counter>,
    seconds: Timings<ServiceOp>,
    messages: Family<MessageOutcome, Counter>,
}

impl Default for Metrics {
    fn default() -> Self {
        Self::new()
    }
}

/// From 1 ms to half a minute: reconciles and calls.
fn timings<L: Clone + std::hash::Hash + Eq>() -> Timings<L> {
    Family::new_with_constructor(|| {
        Histogram::new([
            0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0,
        ])
    })
}

/// Registers a metric and hands it back.
fn add<M: Metric + Clone>(registry: &mut Registry, name: &str, help: &str, metric: M) -> M {
    registry.register(name, help, metric.clone());
    metric
}

/// Registers a metric that begins at zero.
fn zero<M: Metric + Clone + Default>(registry: &mut Registry, name: &str, help: &str) -> M {
    add(registry, name, help, M::default())
}

impl Reconciles {
    fn new(r: &mut Registry) -> Self {
        Self {
            total: zero(r, "reconciles", "Reconciliations by kind and outcome"),
            seconds: add(r, "reconcile_seconds", "Duration of a reconciliation", timings()),
            waiting: zero(
                r,
                "reconciles_waiting",
                "Objects that are ready to be reconciled, by class",
            ),
            wait_seconds: add(
                r,
                "reconcile_wait_seconds",
                "Time from an event to its reconciliation, by class",
                timings(),
            ),
            errors: zero(r, "reconcile_errors", "Failed reconciliations by kind and reason"),
        }
    }
}

impl Watches {
    fn new(r: &mut Registry) -> Self {
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

impl Leader {
    fn new(r: &mut Registry) -> Self {
        Self {
            leads: zero(r, "is_leader", "1 while this process leads"),
            term: zero(r, "leader_term", "Term in which this process leads or led last"),
            errors: zero(r, "lease_errors", "Failed calls about the Lease by reason"),
        }
    }
}

impl Evalai {
    fn new(r: &mut Registry) -> Self {
        Self {
            requests: zero(r, "evalai_requests", "Requests to EvalAI by operation and outcome"),
            seconds: add(r, "evalai_request_seconds", "Duration of requests to EvalAI", timings()),
            budget_used: zero(r, "evalai_budget_used", "Requests to EvalAI within the last minute"),
            waiting: zero(
                r,
                "evalai_waiting",
                "Updates and questions that wait for a request to EvalAI",
            ),
        }
    }
}

impl Cloud {
    fn new(r: &mut Registry) -> Self {
        Self {
            calls: zero(r, "cloud_calls", "Calls to AWS by service, operation and outcome"),
            seconds: add(r, "cloud_call_seconds", "Duration of calls to AWS", timings()),
            messages: zero(r, "sqs_messages", "Messages by outcome"),
        }
    }
}

impl Metrics {
    /// All metrics at their beginning; every name starts with `leaderboard_`.
    pub fn new() -> Self {
        let mut registry = Registry::with_prefix("leaderboard");
        let r = &mut registry;
        let build = Build {
            version: env!("CARGO_PKG_VERSION"),
        };
        r.register("build", "The running program", Info::new(build));
        Self {
            reconciles: Reconciles::new(r),
            watches: Watches::new(r),
            leader: Leader::new(r),
            submissions: zero(r, "submissions", "Submissions by state"),
            repeating_teams: zero(
                r,
                "teams_with_repeated_infrastructure_failures",
                "Teams with 3 attempts in a row or more that ended because of the infrastructure in ways that an agent can cause",
            ),
            evalai: Evalai::new(r),
            cloud: Cloud::new(r),
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

    /// A reconciliation of an object of a kind is done.
    pub fn reconciled(&self, kind: &'static str, outcome: &'static str, took: Duration) {
        self.reconciles
            .total
            .get_or_create(&KindOutcome { kind, outcome })
            .inc();
        self.reconciles
            .seconds
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
            let waited = self.reconciles.wait_seconds.get_or_create_owned(&label);
            (self.reconciles.waiting.get_or_create_owned(&label), waited)
        };
        QueueMetrics(classes.map(of_class))
    }

    /// The counters of one kind's watch; they appear at once, at zero.
    pub fn watch(&self, kind: &str) -> WatchMetrics {
        let label = Kind { kind: kind.to_owned() };
        WatchMetrics {
            errors: self.watches.errors.get_or_create_owned(&label),
            malformed: self.watches.malformed.get_or_create_owned(&label),
            last_event: self.watches.last_event.get_or_create_owned(&label),
        }
    }

    /// This process leads in a term, or does not lead.
    pub fn set_leading(&self, term: Option<i32>) {
        self.leader.leads.set(i64::from(term.is_some()));
        if let Some(term) = term {
            self.leader.term.set(term.into());
        }
    }

    /// A call about the Lease has failed.
    pub fn lease_failed(&self, reason: &'static str) {
        self.leader.errors.get_or_create(&Reason { reason }).inc();
    }

    /// So many Submissions are in a state. States with none are to be set, too.
    pub fn set_submissions(&self, state: &'static str, count: usize) {
        self.submissions.get_or_create(&State { state }).set(whole(count));
    }

    /// So many teams have repeated failures that an agent can cause.
    pub fn set_repeating_teams(&self, count: usize) {
        self.repeating_teams.set(whole(count));
    }

    /// A request to EvalAI is over.
    pub fn evalai_request(&self, op: &'static str, outcome: &'static str, took: Duration) {
        let service = "evalai";
        self.evalai.requests.get_or_create(&Op { op, outcome }).inc();
        self.evalai
            .seconds
            .get_or_create(&ServiceOp { service, op })
            .observe(took.as_secs_f64());
    }

    /// Requests within the last minute, over all tokens, and the updates that wait for one.
    pub fn set_evalai_load(&self, used: usize, waiting: usize) {
        self.evalai.budget_used.set(whole(used));
        self.evalai.waiting.set(whole(waiting));
    }

    /// A call to a service of AWS is over.
    pub fn cloud_call(&self, service: &'static str, op: &'static str, outcome: &'static str, took: Duration) {
        self.cloud.calls.get_or_create(&Call { service, op, outcome }).inc();
        self.cloud
            .seconds
            .get_or_create(&ServiceOp { service, op })
            .observe(took.as_secs_f64());
    }

    /// What became of a message.
    pub fn sqs_message(&self, outcome: &'static str) {
        self.cloud.messages.get_or_create(&MessageOutcome { outcome }).inc();
    }
}

fn whole(count: usize) -> i64 {
    i64::try_from(count).unwrap_or(i64::MAX)
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
    fn every_metric_has_its_name_and_its_labels() {
        let metrics = Metrics::new();
        metrics.reconciled("Submission", "ok", Duration::from_millis(20));
        metrics.reconcile_failed("Submission", "conflict");
        let queue = metrics.queue("Submission", ["urgent", "new"]);
        queue.waiting([0, 3]);
        queue.began(1, Duration::from_millis(20));
        let watch = metrics.watch("Job");
        watch.failed();
        watch.event();
        metrics.set_leading(Some(7));
        metrics.lease_failed("timeout");
        metrics.set_submissions("Running", 2);
        metrics.set_repeating_teams(1);
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
            "leaderboard_reconciles_waiting{kind=\"Submission\",class=\"new\"} 3",
            "leaderboard_reconcile_wait_seconds_bucket{le=\"0.025\",kind=\"Submission\",class=\"new\"} 1",
            "leaderboard_reconcile_wait_seconds_count{kind=\"Submission\",class=\"urgent\"} 0",
            "leaderboard_watch_errors_total{kind=\"Job\"} 1",
            "leaderboard_watch_malformed_objects_total{kind=\"Job\"} 0",
            "leaderboard_is_leader 1",
            "leaderboard_leader_term 7",
            "leaderboard_lease_errors_total{reason=\"timeout\"} 1",
            "leaderboard_submissions{state=\"Running\"} 2",
            "leaderboard_teams_with_repeated_infrastructure_failures 1",
            "leaderboard_evalai_requests_total{op=\"put_finished\",outcome=\"ok\"} 1",
            "leaderboard_evalai_request_seconds_bucket{le=\"0.025\",service=\"evalai\",op=\"put_finished\"} 1",
            "leaderboard_evalai_budget_used 54",
            "leaderboard_evalai_waiting 1",
            "leaderboard_cloud_calls_total{service=\"s3\",op=\"GetObject\",outcome=\"ok\"} 1",
            "leaderboard_sqs_messages_total{outcome=\"created\"} 1",
        ] {
            assert!(text.lines().any(|l| l == line), "{line} is missing in\n{text}");
        }
        assert!(
            text.contains("leaderboard_watch_last_event_timestamp_seconds{kind=\"Job\"} 1"),
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
