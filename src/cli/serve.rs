//! Subcommands that stay: `controller`, `bridge`, and the programs of a Pod. Sets up logging, TLS, clients and the
//! stop signal, then runs the program's module.

use std::error::Error;
use std::future::Future;
use std::process::ExitCode;

use http::HeaderValue;
use http::header::USER_AGENT;
use kube::{Client, Config};

use super::{Controller, InPod, Server};
use crate::bridge;
use crate::intake::leaderboards::Scope;
use crate::kubernetes::{Clients, Namespaces, watch_client};
use crate::metrics::Program;
use crate::observability::Observability;
use crate::observability::health::HealthServer;
use crate::observability::logging::{self, Format};
#[cfg(feature = "otel")]
use crate::observability::traces::otlp;
use crate::page::Page;
use crate::revision::REVISION;
use crate::runtime as run;
use crate::runtime::leader::{self, Identity};
use crate::runtime::settings::Settings;
use leaderboard_api::client_errors;
use leaderboard_api::names::OPERATOR;
use leaderboard_aws::clients::Aws;
use leaderboard_base::shutdown::on_signals;
use leaderboard_contract::run::ENV_CHECKSUMS;
use leaderboard_evaluation::judge::Pace;
use leaderboard_pod::places::{self, Places, Setting, SettingError};
use leaderboard_pod::{collect as collect_program, logcopy as logcopy_program, ownlog, workspace as workspace_program};
use leaderboard_pod_spec::job::OwnImage;

/// Exit codes of controller and bridge, for their help.
pub(super) const EXIT_CODES: &str = "Exit code 0: it was stopped. 1: an error, which is the last line of its log. 2: arguments or \
    RUST_LOG are refused. 130: a second Ctrl-C.";
/// Exit codes of a Pod's programs, for their help.
pub(super) const POD_EXIT_CODES: &str =
    "Exit code 0: its work is done. 1: an error, which is the last line of its log. 2: the arguments are refused.";
/// Threads that run the tasks of controller and bridge. All that a burst needs is a part of one core, and each thread more is woken by
/// events that another one serves (docs/performance.md).
const THREADS: usize = 1;
/// Threads that run the tasks of a Pod's programs: while one waits for a disk, the other goes on.
const THREADS_IN_POD: usize = 2;
/// Environment variable with the log filter.
const ENV_LOG: &str = "RUST_LOG";

/// How a program ends. An error is the last line of its log.
pub(super) type End = Result<(), Box<dyn Error>>;

pub(super) fn controller(options: Controller) -> ExitCode {
    start("controller", options.server.log_format, || lead(options))
}

pub(super) fn bridge(options: Server) -> ExitCode {
    start("bridge", options.log_format, || serve_bridge(options))
}

pub(super) fn workspace(options: &InPod) -> ExitCode {
    ownlog::start(
        &Places::below(&options.root).logs,
        leaderboard_contract::keys::WORKSPACE_LOG,
    );
    start_logged("workspace", THREADS_IN_POD, || async {
        Ok(workspace_program::main(setting(options)?).await?)
    })
}

pub(super) fn logcopy(options: &InPod) -> ExitCode {
    // Its log is one of the results as well.
    ownlog::start(&Places::below(&options.root).logs, leaderboard_contract::keys::OWN_LOG);
    start_logged("logcopy", THREADS_IN_POD, || async {
        let setting = setting(options)?;
        let stop = on_signals()?;
        Ok(Box::pin(logcopy_program::main(setting, async move { stop.wait().await })).await?)
    })
}

pub(super) fn collect(options: &InPod) -> ExitCode {
    let places = Places::below(&options.root);
    ownlog::start(&places.logs, leaderboard_contract::keys::COLLECT_LOG);
    start_logged("collect", THREADS_IN_POD, || async {
        let run = places::run()?;
        let stop = on_signals()?;
        tokio::select! {
            biased;
            copied = collect_program::main(run, places) => Ok(copied?),
            // The first process of a container ignores a signal that it does not ask for.
            () = stop.wait() => Err("it was asked to end before all files were copied".into()),
        }
    })
}

fn setting(options: &InPod) -> Result<Setting, SettingError> {
    let pace = Pace::default().faster(options.faster);
    Setting::read(Places::below(&options.root), pace)
}

/// Sets up the log, then works until the end; an error is the last line of the log and the exit code.
pub(super) fn start<W>(program: &'static str, format: Format, work: impl FnOnce() -> W) -> ExitCode
where
    W: Future<Output = End>,
{
    if let Err(error) = logging::init(format, std::env::var(ENV_LOG).ok().as_deref()) {
        eprintln!("leaderboard-operator: {error}");
        return ExitCode::from(2);
    }
    start_logged(program, THREADS, work)
}

fn start_logged<W>(program: &'static str, threads: usize, work: impl FnOnce() -> W) -> ExitCode
where
    W: Future<Output = End>,
{
    let version = env!("CARGO_PKG_VERSION");
    let revision = Some(REVISION).filter(|revision| !revision.is_empty());
    tracing::info!(program, version, revision, "starting");
    // It fails only where a provider is installed already, which serves as well.
    let _ = rustls::crypto::ring::default_provider().install_default();
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(threads)
        .enable_all()
        .build();
    let runtime = match runtime {
        Ok(runtime) => runtime,
        Err(error) => {
            eprintln!("leaderboard-operator: no threads can be started: {error}");
            return ExitCode::FAILURE;
        }
    };
    let result = runtime.block_on(async { work().await });
    // The remaining tasks have no purpose any more, and a thread that hangs on a disk must not keep the process.
    runtime.shutdown_background();
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            tracing::error!("{error}");
            ExitCode::FAILURE
        }
    }
}

async fn lead(options: Controller) -> End {
    let telemetry = Observability::new(on_signals()?);
    #[cfg(feature = "otel")]
    let (telemetry, sending) = otlp::begin(telemetry)?;
    #[cfg(not(feature = "otel"))]
    if std::env::var_os("OTEL_EXPORTER_OTLP_ENDPOINT").is_some() {
        tracing::warn!("OTEL_EXPORTER_OTLP_ENDPOINT is set, but this program was built without traces (feature otel)");
    }
    let health = HealthServer::start(options.server.http, telemetry.clone()).await?;
    let config = cluster("controller").await?;
    let clients = run::Clients {
        api: Client::try_from(config.clone()).map_err(|e| client_errors::kube(&e))?,
        watch: watch_client(config.clone()).map_err(|e| client_errors::kube(&e))?,
        lease: leader::lease_client(config).map_err(|e| client_errors::kube(&e))?,
    };
    let identity = Identity::of_pod(&options.pod_name, &options.pod_uid);
    let lease = leader::Settings::new(&options.lease_namespace, &options.lease, identity);
    let aws = Aws::load("controller").await;
    let settings = Settings {
        own: OwnImage {
            image: options.image,
            pull_policy: options.image_pull_policy,
            region: aws.region(),
            checksums: std::env::var(ENV_CHECKSUMS).ok(),
        },
        operator: lease.installation(),
        namespaces: Namespaces::of(options.server.namespaces),
        has_cluster_rights: options.cluster_rights,
        allowed: options.server.allowed,
        concurrency: options.concurrency,
    };
    let page = match options.dashboard {
        Some(port) => {
            let page = Page::bind(port, &options.pod_name).await?;
            Some(page.titled(&options.page_title))
        }
        None => None,
    };
    let result = run::run(clients, lease, settings, aws, page, telemetry).await;
    #[cfg(feature = "otel")]
    if let Some(sending) = sending {
        sending.finish().await;
    }
    health.close().await;
    Ok(result?)
}

async fn serve_bridge(options: Server) -> End {
    let telemetry = Observability::of(Program::Bridge, on_signals()?);
    let server = HealthServer::start(options.http, telemetry.clone()).await?;
    let clients = Clients::new(cluster("bridge").await?).map_err(|e| client_errors::kube(&e))?;
    let scope = Scope {
        namespaces: Namespaces::of(options.namespaces),
        allowed: options.allowed,
    };
    let result = bridge::run(clients, Aws::load("bridge").await, scope, telemetry).await;
    server.close().await;
    Ok(result?)
}

/// How the cluster is reached. Its audit log then names the program.
pub(super) async fn cluster(program: &str) -> Result<Config, String> {
    let mut config = Config::infer().await.map_err(|e| {
        format!("no cluster is configured: {e}; set KUBECONFIG, or run inside a Pod with a service account")
    })?;
    let agent = format!("{OPERATOR}-{program}/{}", env!("CARGO_PKG_VERSION"));
    let agent = HeaderValue::try_from(agent).map_err(|e| format!("the program's name is no header: {e}"))?;
    config.headers.push((USER_AGENT, agent));
    Ok(config)
}
