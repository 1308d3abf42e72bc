//! Turns EvalAI's messages into Submissions: watches the Leaderboards and reads each queue that they name.
//!
//! Started by `leaderboard-operator bridge`. Several replicas may run at once: `ingest` is safe twice and SQS hands
//! a message to one of them. `route` holds the policy, `ingest` is also the controller's, for its sweep.

pub mod ages;
mod dead_letter;
pub mod ingest;
mod leaderboards;
pub mod message;
mod poller;
mod pollers;
pub mod queue;
pub mod route;

use std::sync::{Arc, Mutex};
use std::time::Duration;

use futures::{FutureExt, StreamExt};
use kube::Client;
use kube::api::ListParams;
use kube::runtime::events::{Recorder, Reporter};
use kube::runtime::watcher::Config;
use tokio::time::Instant;

use crate::allowed::Allowed;
use crate::kubernetes::{Clients, Namespaces, Shape, Watch, call_within, spawn_watch};
use crate::lock::lock;
use crate::observability::Observability;
use crate::observability::tasks::TaskFailed;
use crate::services::aws::Aws;
use crate::services::meter::Meter;
use leaderboard_api::Leaderboard;
use leaderboards::Leaderboards;
use pollers::{Pollers, Problems, desired};

/// An answer of the API server that is younger than this is taken for granted.
const PULSE_AGE: Duration = Duration::from_secs(5);
/// How soon the API server must answer before messages are received.
const PULSE_LIMIT: Duration = Duration::from_secs(5);

/// Which Leaderboards are served, and which queues they may name.
#[derive(Clone, Debug)]
pub struct Scope {
    pub namespaces: Namespaces,
    pub allowed: Allowed,
}

/// What all pollers share.
struct Shared {
    client: Client,
    scope: Scope,
    leaderboards: Watch<Leaderboard>,
    aws: Aws,
    telemetry: Observability,
    problems: Problems,
    recorder: Recorder,
    last_pulse: Mutex<Option<Instant>>,
}

impl Shared {
    fn new(clients: Clients, aws: Aws, scope: Scope, telemetry: Observability) -> Self {
        let apis = scope.namespaces.apis(&clients.watch);
        // The status changes often and means nothing here.
        let shape = Shape {
            trim: |leaderboard: &mut Leaderboard| leaderboard.status = None,
            ..Shape::default()
        };
        let reporter = Reporter {
            controller: "leaderboard.carla.org/bridge".to_owned(),
            instance: std::env::var("POD_NAME").ok(),
        };
        Self {
            leaderboards: spawn_watch(apis, Config::default(), shape, &telemetry),
            recorder: Recorder::new(clients.api.clone(), reporter),
            client: clients.api,
            scope,
            aws: aws.counted_by(Meter::for_metrics(&telemetry.metrics)),
            problems: Problems::new(telemetry.readiness.clone()),
            telemetry,
            last_pulse: Mutex::default(),
        }
    }

    /// Makes sure that the API server answers: a message received in vain is a step towards its dead letter.
    async fn check_pulse(&self) -> Result<(), String> {
        let last = *lock(&self.last_pulse);
        if last.is_some_and(|at| at.elapsed() < PULSE_AGE) {
            return Ok(());
        }
        let apis = self.scope.namespaces.apis::<Leaderboard>(&self.client);
        let first = ListParams::default().limit(1);
        let asked = apis
            .iter()
            .map(|api| call_within(PULSE_LIMIT, "a list", "one Leaderboard", api.list_metadata(&first)));
        let listed = futures::future::try_join_all(asked).await;
        listed.map_err(|error| error.cause())?;
        *lock(&self.last_pulse) = Some(Instant::now());
        // A watch that stays broken meanwhile is a reason to restart.
        self.telemetry.liveness.answered();
        Ok(())
    }
}

/// Runs the bridge until the stop of `telemetry`; then finishes what is in hand, within 20 s. It serves the Leaderboards of
/// this scope.
///
/// # Errors
/// If one of its tasks has ended before.
pub async fn run(clients: Clients, aws: Aws, scope: Scope, telemetry: Observability) -> Result<(), TaskFailed> {
    let shared = Arc::new(Shared::new(clients, aws, scope, telemetry.clone()));
    telemetry.readiness.registered();
    // Prometheus sees no increase in a sample that begins with 1.
    for outcome in route::OUTCOMES {
        telemetry.metrics.messages.total.of([outcome]);
    }
    let mut events = shared.leaderboards.subscribe();
    let mut pollers = Pollers::new(shared.clone());
    loop {
        tokio::select! {
            biased;
            failed = telemetry.tasks.failed() => return Err(failed),
            () = telemetry.stop.wait() => break,
            Some(_) = events.next() => {}
        }
        // A list brings many at once.
        while events.next().now_or_never().flatten().is_some() {}
        let all = Leaderboards::cached(&shared.leaderboards, &shared.scope.allowed).all;
        pollers.adjust(&desired(&all));
    }
    pollers.drain().await;
    Ok(())
}

#[cfg(test)]
mod tests;
