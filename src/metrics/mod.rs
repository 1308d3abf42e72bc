//! Every metric of the operator, with its labels.
//!
//! Parts count in these families; the health server asks for the text. Labels hold kinds, outcomes and other fixed values. They also
//! hold names: of Leaderboards and queues, which are few, of the first teams of each Leaderboard, and of submissions that hold GPUs.
//! No label names an image, or an object that has ended.

mod families;
pub mod leader;
mod process;

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use prometheus_client::encoding::text;
use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::gauge::Gauge;

use leaderboard_api::text::{LONGEST_NAME, one_line};
pub use prometheus_client::metrics::histogram::Histogram;
use prometheus_client::metrics::info::Info;
use prometheus_client::registry::Registry;

use crate::revision::REVISION;
use families::{Counters, Families, Gauges, Timings};
use leader::{Leader, Samples};
use leaderboard_base::clock::Clock;
use leaderboard_base::lock::lock;
use leaderboard_base::meter::Meter;
use process::Process;

/// Media type of `Metrics::text`.
pub const CONTENT_TYPE: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";
/// Teams of a Leaderboard that have a sample of their own: a series for each of thousands would burden Prometheus.
const MAX_TEAMS: usize = 50;
/// The team of all others, and the submission of all others.
pub const OTHERS: &str = "other";

/// Which program a process is: each exports what it counts, and nothing else.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Program {
    Controller,
    Bridge,
}

/// One for a process, shared by all parts.
#[derive(Debug)]
pub struct Metrics {
    registry: Registry,
    leader: Arc<Leader>,
    pub shared: Shared,
    pub work: Work,
    pub submissions: Submissions,
}

/// Counted by controller and bridge.
#[derive(Debug)]
pub struct Shared {
    watch_errors: Counters<1>,
    watch_unreadable: Gauges<1>,
    watch_last_event: Gauges<1>,
    pub cloud_calls: Counters<3>,
    pub cloud_call_duration: Timings<2>,
    oldest_message: Gauges<1>,
    pub messages: Counters<1>,
    pub message_wait: Histogram,
}

impl Shared {
    fn new(r: &mut Families<'_>) -> Self {
        Self {
            watch_errors: r.counters("watch_errors", ["kind"], "Errors of a kind's watch"),
            watch_unreadable: r.gauges("watch_unreadable_objects", ["kind"], "Objects that cannot be read now"),
            watch_last_event: r.gauges(
                "watch_last_event_timestamp_seconds",
                ["kind"],
                "Unix time of a watch's last event",
            ),
            cloud_calls: r.counters(
                "cloud_calls",
                ["service", "op", "outcome"],
                "Calls to AWS by service, operation and outcome",
            ),
            cloud_call_duration: r.timings(
                "cloud_call_duration_seconds",
                ["service", "op"],
                "Duration of calls to AWS",
            ),
            oldest_message: r.gauges(
                "queue_oldest_message_timestamp_seconds",
                ["queue"],
                "Unix time of the oldest message that was received and is not deleted; absent without one. `queue` is an SQS URL, or server and name in EvalAI, where a row's last request to run counts",
            ),
            messages: r.counters(
                "queue_messages",
                ["outcome"],
                "Messages by outcome, those of EvalAI's own queues in the controller that leads",
            ),
            message_wait: r.days(
                "queue_message_wait_duration_seconds",
                "Time from sending a message to the Submission that it made or resumed",
            ),
        }
    }
}

/// Counts of a controller's work.
#[derive(Debug)]
pub struct Work {
    reconciles: Counters<2>,
    reconcile_duration: Timings<1>,
    pub reconcile_wait: Timings<2>,
    pub reconcile_errors: Counters<2>,
    pub lease_errors: Counters<1>,
    pub spans: Counters<1>,
    pub evalai_requests: Counters<2>,
    pub evalai_duration: Timings<1>,
}

impl Work {
    fn new(r: &mut Families<'_>) -> Self {
        Self {
            reconciles: r.counters("reconciles", ["kind", "outcome"], "Reconciliations by kind and outcome"),
            reconcile_duration: r.timings("reconcile_duration_seconds", ["kind"], "Duration of a reconciliation"),
            reconcile_wait: r.timings(
                "reconcile_wait_duration_seconds",
                ["kind", "class"],
                "Time from an event to its reconciliation, by class",
            ),
            reconcile_errors: r.counters(
                "reconcile_errors",
                ["kind", "reason"],
                "Failed reconciliations by kind and reason",
            ),
            lease_errors: r.counters("lease_errors", ["reason"], "Failed calls about the Lease by reason"),
            spans: r.counters(
                "trace_spans",
                ["outcome"],
                "Spans by outcome: `sent`, `failed` where the collector did not take them, `dropped` where too many waited",
            ),
            evalai_requests: r.counters(
                "evalai_requests",
                ["op", "outcome"],
                "Requests to EvalAI by operation and outcome",
            ),
            evalai_duration: r.timings(
                "evalai_request_duration_seconds",
                ["op"],
                "Duration of requests to EvalAI",
            ),
        }
    }
}

/// Counts of submissions since this process began to lead.
#[derive(Debug)]
pub struct Submissions {
    pub failures: Counters<3>,
    gpu: Counters<2>,
    team_gpu: Counters<2>,
    pub phases: Timings<1>,
    /// The teams with a sample of their own, by Leaderboard.
    teams: Mutex<BTreeMap<String, BTreeSet<String>>>,
}

impl Submissions {
    fn new(r: &mut Families<'_>) -> Self {
        Self {
            failures: r.counters(
                "submission_failures",
                ["leaderboard", "class", "reason"],
                "Attempts that have failed while this process led; those of class `Participant` count as attempts",
            ),
            gpu: r.counters(
                "gpu_seconds",
                ["leaderboard", "track"],
                "GPUs times seconds of the Jobs that have ended while this process led, by Leaderboard and track",
            ),
            team_gpu: r.counters(
                "team_gpu_seconds",
                ["leaderboard", "team"],
                "GPUs times seconds as in `leaderboard_gpu_seconds_total`, by Leaderboard and team, as `status.gpuUse` names it: the first 50 teams of a Leaderboard, all others as `other`",
            ),
            phases: r.hours(
                "submission_phase_duration_seconds",
                ["phase"],
                "Time that submissions spent in each phase that ended while this process led",
            ),
            teams: Mutex::default(),
        }
    }

    /// A Job that has ended had so many GPUs for so long. `leaderboard` has its namespace before it; a local submission may have no team.
    pub fn gpus_used(&self, leaderboard: String, track: String, team: Option<&str>, seconds: u64) {
        if let Some(team) = team {
            let team = self.label_of(&leaderboard, team);
            self.team_gpu.of([leaderboard.clone(), team]).inc_by(seconds);
        }
        self.gpu.of([leaderboard, track]).inc_by(seconds);
    }

    /// How a team is called in a label.
    fn label_of(&self, leaderboard: &str, team: &str) -> String {
        let team = one_line(team, LONGEST_NAME);
        let mut teams = lock(&self.teams);
        let known = teams.entry(leaderboard.to_owned()).or_default();
        if known.len() >= MAX_TEAMS && !known.contains(&team) {
            return OTHERS.to_owned();
        }
        known.insert(team.clone());
        team
    }
}

impl Metrics {
    /// The meter that counts the calls of this process's clients.
    pub fn meter(self: &Arc<Self>) -> Meter {
        let metrics = Arc::clone(self);
        Meter::new(move |call| {
            let (service, op, outcome) = (call.service, call.op, call.outcome);
            let took = call.began.elapsed().as_secs_f64();
            if service == "evalai" {
                metrics.work.evalai_requests.of([op, outcome]).inc();
                metrics.work.evalai_duration.of([op]).observe(took);
            } else {
                metrics.shared.cloud_calls.of([service, op, outcome]).inc();
                metrics.shared.cloud_call_duration.of([service, op]).observe(took);
            }
        })
    }

    /// All metrics at their beginning; the names of the operator's own start with `leaderboard_`.
    pub fn new(program: Program) -> Self {
        let (mut registry, mut unexported) = (Registry::default(), Registry::default());
        registry.register_collector(Box::new(Process::begins()));
        let both = registry.sub_registry_with_prefix("leaderboard");
        let build = Info::new([("version", env!("CARGO_PKG_VERSION")), ("revision", REVISION)]);
        both.register("build", "The running program", build);
        let shared = Shared::new(&mut Families(both));
        let controller = match program {
            Program::Controller => both,
            Program::Bridge => &mut unexported,
        };
        let leader = Arc::new(Leader::default());
        controller.register_collector(Box::new(Arc::clone(&leader)));
        let mut controller = Families(controller);
        Self {
            leader,
            shared,
            work: Work::new(&mut controller),
            submissions: Submissions::new(&mut controller),
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

    /// This process leads in a term, or does not lead: then it shows nothing of what the leader alone counts at present.
    pub fn set_leading(&self, term: Option<i32>) {
        self.leader.leads(term);
        self.shared.oldest_message.clear();
    }

    /// Sets the leader's samples, which hold until the next walk.
    pub fn show(&self, samples: Samples) {
        self.leader.show(samples);
    }

    /// A reconciliation of an object of a kind is done.
    pub fn reconciled(&self, kind: &'static str, outcome: &'static str, took: Duration) {
        self.work.reconciles.of([kind, outcome]).inc();
        self.work.reconcile_duration.of([kind]).observe(took.as_secs_f64());
    }

    /// When the oldest message of a queue was sent that was received and not deleted, in milliseconds since 1970; None without one.
    pub fn set_oldest_message(&self, queue: &str, sent_ms: Option<i64>) {
        let (oldest, queue) = (&self.shared.oldest_message, [queue.to_owned()]);
        match sent_ms {
            Some(sent_ms) => _ = oldest.of(queue).set(sent_ms / 1000),
            None => oldest.remove(queue),
        }
    }

    /// The metrics of one kind's watch; they appear at once, at zero.
    pub fn watch(&self, kind: &str, clock: &Clock) -> WatchMetrics {
        let kind = || [kind.to_owned()];
        WatchMetrics {
            errors: self.shared.watch_errors.of(kind()),
            unreadable: self.shared.watch_unreadable.of(kind()),
            last_event: self.shared.watch_last_event.of(kind()),
            clock: clock.clone(),
        }
    }
}

/// The metrics of one kind's watch.
#[derive(Clone, Debug)]
pub struct WatchMetrics {
    pub errors: Counter,
    /// Objects that cannot be read now.
    pub unreadable: Gauge,
    last_event: Gauge,
    clock: Clock,
}

impl WatchMetrics {
    /// The watch brought something.
    pub fn event(&self) {
        self.last_event.set(self.clock.now().as_second());
    }
}

#[cfg(test)]
mod tests;
