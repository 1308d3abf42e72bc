//! The whole controller inside a test: against the real API server, in a namespace and with a Lease of its own.

use std::time::Duration;

use kube::{Client, Config};
use tokio::sync::watch;
use tokio::task::JoinHandle;

use crate::support::apiserver::server;
use leaderboard_aws::clients::Aws;
use leaderboard_base::shutdown::Stop;
use leaderboard_operator::kubernetes::{Namespaces, watch_client};
use leaderboard_operator::observability::Observability;
use leaderboard_operator::runtime as run;
use leaderboard_operator::runtime::leader::{self, Identity, Timing};
use leaderboard_operator::runtime::settings::Settings;
use leaderboard_operator::runtime::{Clients, RunError};
use leaderboard_pod_spec::job::OwnImage;
use leaderboard_policy::allowed::Allowed;

/// Longer than it takes to end, with a write to EvalAI under way.
const END_LIMIT: Duration = Duration::from_mins(3);

/// Name of the Lease, in the operator's own namespace.
pub const LEASE_NAME: &str = "operator";

/// No other process wants its Lease.
const LEASE: Duration = Duration::from_mins(4);

/// A controller that leads, or will.
pub struct Operator {
    pub telemetry: Observability,
    stop: watch::Sender<bool>,
    task: JoinHandle<Result<(), RunError>>,
}

impl Operator {
    /// Starts one for a namespace.
    pub async fn start(namespace: &str, aws: Aws) -> Self {
        Self::start_as(namespace, aws, server().await.config())
    }

    /// Starts one with the rights that this configuration gives.
    pub fn start_as(namespace: &str, aws: Aws, config: Config) -> Self {
        let (stop, signal) = Stop::new();
        let telemetry = Observability::new(signal);
        Self {
            task: tokio::spawn(Box::pin(run(namespace, aws, config, telemetry.clone()))),
            telemetry,
            stop,
        }
    }

    /// Starts one with these settings, and with its Lease in this namespace.
    pub fn start_with(settings: Settings, lease_namespace: &str, aws: Aws, config: Config) -> Self {
        let (stop, signal) = Stop::new();
        let telemetry = Observability::new(signal);
        let lease = lease(lease_namespace);
        Self {
            task: tokio::spawn(Box::pin(run_with(settings, lease, aws, config, telemetry.clone()))),
            telemetry,
            stop,
        }
    }

    /// True while it runs. A test fails if it has ended by itself.
    pub fn is_running(&self) -> bool {
        !self.task.is_finished()
    }

    /// The metrics, as Prometheus gets them.
    pub fn metrics(&self) -> String {
        self.telemetry.metrics.text().unwrap()
    }

    /// Tells it to end, and waits for that.
    pub async fn end(self) {
        self.stop.send_replace(true);
        let ended = tokio::time::timeout(END_LIMIT, self.task).await;
        ended.expect("it ends when told").unwrap().unwrap();
    }
}

/// A controller that runs until its stop signal; started as a task by [`Operator`].
pub fn run(
    namespace: &str,
    aws: Aws,
    config: Config,
    telemetry: Observability,
) -> impl Future<Output = Result<(), RunError>> + Send + use<> {
    run_with(settings(namespace), lease(namespace), aws, config, telemetry)
}

fn run_with(
    settings: Settings,
    lease: leader::Settings,
    aws: Aws,
    config: Config,
    telemetry: Observability,
) -> impl Future<Output = Result<(), RunError>> + Send + use<> {
    let clients = Clients {
        api: Client::try_from(config.clone()).unwrap(),
        watch: watch_client(config.clone()).unwrap(),
        lease: leader::lease_client(config).unwrap(),
    };
    run::run(clients, lease, settings, aws, None, telemetry)
}

fn lease(namespace: &str) -> leader::Settings {
    // A machine that compiles something else at the same time may leave an API server silent for ten seconds.
    let timing = Timing {
        lease: LEASE,
        renew_deadline: LEASE / 2,
        call: LEASE / 4,
        ..Timing::default()
    };
    leader::Settings {
        timing,
        ..leader::Settings::new(namespace, LEASE_NAME, Identity::random("test"))
    }
}

/// The settings that the command line makes for an operator that serves one namespace.
pub fn settings(namespace: &str) -> Settings {
    Settings {
        own: OwnImage {
            image: "operator:1".into(),
            region: Some("us-east-1".into()),
            ..OwnImage::default()
        },
        operator: format!("{namespace}/{LEASE_NAME}"),
        namespaces: Namespaces::of([namespace.to_owned()]),
        has_cluster_rights: false,
        allowed: Allowed::default(),
        concurrency: 16,
    }
}
