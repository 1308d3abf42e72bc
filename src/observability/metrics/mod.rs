//! Every metric of the operator, as one typed struct: what is counted, with which labels.
//!
//! Parts call the methods; the health server asks for the text. Labels hold kinds, outcomes and other fixed values, the names of
//! Leaderboards and queues, which are few, those of the first teams of each Leaderboard, and those of submissions as long as they hold
//! GPUs: never those of an image, nor of what has ended.

mod boards;
mod labels;
mod leader;
mod limits;
mod phases;
mod process;
mod queues;
mod reconciles;
mod runtime;
mod services;
mod submissions;
mod watches;

use std::fmt;
use std::sync::atomic::AtomicU64;
use std::time::{SystemTime, UNIX_EPOCH};

use prometheus_client::encoding::text;
use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::metrics::histogram::Histogram;
use prometheus_client::metrics::info::Info;
use prometheus_client::registry::{Metric, Registry};

pub use boards::BoardState;
pub use labels::{OfSubmission, Standing};
pub use limits::LimitsState;
pub use reconciles::QueueMetrics;
pub use submissions::{FailedAttempt, OTHERS};
pub use watches::WatchMetrics;

use super::REVISION;
use boards::Boards;
use labels::Build;
use leader::Leader;
use limits::Limits;
use phases::Phases;
use process::Process;
use queues::Queues;
use reconciles::Reconciles;
use runtime::Runtime;
use services::{Cloud, Evalai, Messages};
use submissions::Submissions;
use watches::Watches;

/// Media type of `Metrics::text`.
pub const CONTENT_TYPE: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";

type FloatGauge = Gauge<f64, AtomicU64>;
type FloatCounter = Counter<f64, AtomicU64>;
type Timings<L> = Family<L, Histogram, fn() -> Histogram>;

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
    process: Process,
    runtime: Runtime,
    queues: Queues,
    reconciles: Reconciles,
    watches: Watches,
    leader: Leader,
    submissions: Submissions,
    phases: Phases,
    boards: Boards,
    limits: Limits,
    evalai: Evalai,
    cloud: Cloud,
    messages: Messages,
}

/// From 1 ms to two minutes: a reconcile may take 90 s, a request to EvalAI about 65 s.
fn timings<L: Clone + std::hash::Hash + Eq>() -> Timings<L> {
    Family::new_with_constructor(|| {
        Histogram::new([
            0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 60.0, 120.0,
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

fn whole(count: usize) -> i64 {
    i64::try_from(count).unwrap_or(i64::MAX)
}

fn unix_time() -> f64 {
    let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    now.as_secs_f64()
}

impl Default for Metrics {
    fn default() -> Self {
        Self::new(Program::Controller)
    }
}

impl Metrics {
    /// All metrics at their beginning; the names of the operator's own start with `leaderboard_`.
    pub fn new(program: Program) -> Self {
        let mut registry = Registry::default();
        let mut unexported = Registry::default();
        let process = Process::new(registry.sub_registry_with_prefix("process"));
        let both = registry.sub_registry_with_prefix("leaderboard");
        let build = Build {
            version: env!("CARGO_PKG_VERSION"),
            revision: REVISION,
        };
        both.register("build", "The running program", Info::new(build));
        let (watches, cloud) = (Watches::new(both), Cloud::new(both));
        let (runtime, queues) = (Runtime::new(both), Queues::new(both));
        let (controller, bridge) = match program {
            Program::Controller => (both, &mut unexported),
            Program::Bridge => (&mut unexported, both),
        };
        Self {
            process,
            runtime,
            queues,
            reconciles: Reconciles::new(controller),
            watches,
            leader: Leader::new(controller),
            submissions: Submissions::new(controller),
            phases: Phases::new(controller),
            boards: Boards::new(controller),
            limits: Limits::new(controller),
            evalai: Evalai::new(controller),
            cloud,
            messages: Messages::new(bridge),
            registry,
        }
    }

    /// All of it as OpenMetrics text.
    ///
    /// # Errors
    /// If a metric cannot be written, which is an error of the program.
    pub fn text(&self) -> Result<String, fmt::Error> {
        self.process.read();
        self.runtime.read();
        let mut text = String::new();
        text::encode(&mut text, &self.registry)?;
        Ok(text)
    }
}

#[cfg(test)]
mod tests;
