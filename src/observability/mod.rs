//! The outside of a running process: metrics, health, logs, the stop signal.
//!
//! Called by every program that stays: `controller` and `bridge`. Knows no Kubernetes object and no policy; parts report
//! what they do and what they miss.

pub mod health;
mod json_lines;
pub mod liveness;
pub mod logging;
pub mod readiness;
pub mod traces;

use std::sync::Arc;

use crate::metrics::{Metrics, Program};
use leaderboard_base::clock::Clock;
use leaderboard_base::shutdown::Stop;
use leaderboard_base::tasks::Tasks;
use liveness::Liveness;
use readiness::Readiness;
use traces::Traces;

/// The parts that every task of a process gets: the time, its metrics, the checks of its health, and the signal to end.
#[derive(Clone, Debug)]
pub struct Observability {
    pub clock: Clock,
    pub metrics: Arc<Metrics>,
    pub liveness: Liveness,
    pub readiness: Readiness,
    pub stop: Stop,
    pub tasks: Tasks,
    pub traces: Traces,
}

impl Observability {
    /// Empty registries of a controller, around the process's stop signal, and the system's clock.
    pub fn new(stop: Stop) -> Self {
        Self::of(Program::Controller, stop)
    }

    /// Empty registries of any program, around the process's stop signal.
    pub fn of(program: Program, stop: Stop) -> Self {
        Self {
            clock: Clock::system(),
            metrics: Arc::new(Metrics::new(program)),
            liveness: Liveness::default(),
            readiness: Readiness::default(),
            tasks: Tasks::new(stop.clone()),
            traces: Traces::default(),
            stop,
        }
    }
}
