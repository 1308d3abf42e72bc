//! Turns EvalAI's messages into Submissions: watches the Leaderboards and reads each queue that they name.
//!
//! Started by `leaderboard-operator bridge` for queues in SQS. Several replicas may run at once: `ingest` is safe twice and SQS hands
//! a message to one of them. `route` holds the policy. The controller has a `source` of its own for EvalAI's queues, and `ingest` for its
//! sweep.

mod dead_letter;
pub mod queue;
mod sqs;

use std::sync::Arc;

use kube::runtime::watcher::Config;

use crate::intake::leaderboards::Scope;
use crate::intake::pollers::follow;
use crate::intake::shared::{Problems, Shared};
use crate::kubernetes::{Clients, recorder, spawn_watch};
use crate::observability::Observability;
use leaderboard_aws::clients::Aws;
use leaderboard_base::tasks::TaskFailed;
use leaderboard_policy::intake::route;
use sqs::{Connection, Pulse, SqsQueue, desired};

fn shared(clients: Clients, scope: Scope, telemetry: Observability) -> Shared {
    let apis = scope.namespaces.apis(&clients.watch);
    Shared {
        leaderboards: spawn_watch(apis, Config::default(), |_| None, &telemetry),
        recorder: recorder(&clients.api, "bridge"),
        client: clients.api,
        scope,
        problems: Problems::new(telemetry.readiness.clone()),
        telemetry,
    }
}

/// Runs the bridge until the stop of `telemetry`; then finishes what is in hand, within 20 s. It serves the Leaderboards of
/// this scope.
///
/// # Errors
/// If one of its tasks has ended before.
pub async fn run(clients: Clients, aws: Aws, scope: Scope, telemetry: Observability) -> Result<(), TaskFailed> {
    let shared = Arc::new(shared(clients, scope, telemetry.clone()));
    telemetry.readiness.registered();
    // Prometheus sees no increase in a sample that begins with 1.
    for outcome in route::OUTCOMES {
        telemetry.metrics.shared.messages.of([outcome]);
    }
    let aws = aws.counted_by(telemetry.metrics.meter());
    let pulse = Arc::new(Pulse::of(Arc::clone(&shared)));
    let open = |url: &str, way: &Connection| SqsQueue {
        url: url.to_owned(),
        sqs: aws.sqs(way.region.as_deref(), way.endpoint.as_deref()),
        meter: aws.meter().clone(),
        pulse: Arc::clone(&pulse),
        reader: None,
    };
    tokio::select! {
        biased;
        failed = telemetry.tasks.failed() => Err(failed),
        () = follow(shared, desired, open) => Ok(()),
    }
}

#[cfg(test)]
mod tests;
