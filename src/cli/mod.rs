//! The command line of `leaderboard-operator`: flags, environment, and which module each subcommand runs.
//!
//! Called by the binary alone. Every flag of a server can be given as an environment variable, as the chart does.

mod labels;
mod offline;
#[cfg(test)]
mod pages_tests;
mod preflight;
pub mod rights;
mod serve;

use std::process::ExitCode;
use std::sync::LazyLock;

use clap::{Args, Parser, Subcommand};

use crate::observability::logging::Format;
use crate::revision::REVISION;
use leaderboard_aws::clients as aws;
use leaderboard_policy::allowed::Allowed;

/// The port that `--dashboard` alone stands for.
const PAGE_PORT: &str = "8081";
static VERSION: LazyLock<String> = LazyLock::new(|| version_of(REVISION));

/// Runs the submissions of an AI challenge on Kubernetes.
#[derive(Parser, Debug)]
#[command(name = "leaderboard-operator", version = VERSION.as_str(), about, long_about = None)]
pub struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand, Debug)]
enum Command {
    /// Run the controller (only the elected leader reconciles).
    #[command(after_help = serve::EXIT_CODES)]
    Controller(Controller),
    /// Create a Submission for each message of the Leaderboards' queues.
    #[command(after_help = serve::EXIT_CODES)]
    Bridge(Server),
    /// Show what an installed operator lacks: kinds, rights, ready programs.
    #[command(after_help = preflight::EXIT_CODES)]
    Preflight(preflight::Preflight),
    /// Prepare the volumes of a submission's Pod (an init container).
    #[command(after_help = serve::POD_EXIT_CODES)]
    Workspace(InPod),
    /// Merge, upload and report the results of a submission's Pod (a sidecar).
    #[command(after_help = serve::POD_EXIT_CODES)]
    Logcopy(InPod),
    /// Copy what the agent has left for the evaluators of a submission's Pod (an init container).
    #[command(after_help = serve::POD_EXIT_CODES)]
    Collect(InPod),
    /// Print the custom resource definitions.
    Crd,
    /// Merge and render the checkpoint files of a CARLA run without a cluster; no other kind of evaluation has such files.
    #[command(after_help = offline::EXIT_CODES)]
    Results(offline::Results),
    /// Print the schema of a phase's leaderboard in EvalAI for CARLA's metrics; those of another evaluation are its host's.
    Labels(labels::Labels),
}

impl Command {
    fn asks_aws(&self) -> bool {
        match self {
            Self::Controller(_) | Self::Bridge(_) | Self::Workspace(_) | Self::Logcopy(_) => true,
            Self::Collect(_) | Self::Preflight(_) | Self::Crd | Self::Results(_) | Self::Labels(_) => false,
        }
    }
}

/// Arguments that controller and bridge share.
#[derive(Args, Debug)]
struct Server {
    /// A namespace to serve; may be given several times, or with commas. All namespaces if there is none.
    #[arg(long = "namespace", env = "LEADERBOARD_NAMESPACES", value_delimiter = ',')]
    namespaces: Vec<String>,
    /// What Leaderboards may name, as JSON by namespace; everything if empty.
    #[arg(long, env = "LEADERBOARD_ALLOWED", default_value = "")]
    allowed: Allowed,
    /// Address of /livez, /readyz and /metrics.
    #[arg(long, env = "LEADERBOARD_HTTP", default_value = "0.0.0.0:8080")]
    http: std::net::SocketAddr,
    /// Log format.
    #[arg(long, env = "LEADERBOARD_LOG_FORMAT", value_enum, default_value = "auto")]
    log_format: Format,
}

#[derive(Args, Debug)]
struct Controller {
    #[command(flatten)]
    server: Server,
    /// The operator's own image, used in Pods for workspace, logcopy and collect.
    #[arg(long, env = "LEADERBOARD_IMAGE")]
    image: String,
    /// Pull policy of that image in Pods.
    #[arg(long, env = "LEADERBOARD_IMAGE_PULL_POLICY")]
    image_pull_policy: Option<String>,
    /// Maximum concurrent reconciles.
    #[arg(long, env = "LEADERBOARD_CONCURRENCY", default_value_t = 16, value_parser = clap::value_parser!(u16).range(1..=256))]
    concurrency: u16,
    /// Serve the page of `kubectl leaderboard dashboard` on this port of 127.0.0.1: read-only, from the caches. Without it there is none.
    #[arg(long, env = "LEADERBOARD_DASHBOARD", value_name = "PORT", num_args = 0..=1, require_equals = true, default_missing_value = PAGE_PORT)]
    dashboard: Option<u16>,
    /// Title of the page, such as the cluster's name. It stands in the page's header and in the browser's tab.
    #[arg(long, env = "LEADERBOARD_PAGE_TITLE", default_value = "")]
    page_title: String,
    /// Whether the operator may read nodes. Without it a lost node is noticed later.
    #[arg(long, env = "LEADERBOARD_CLUSTER_RIGHTS", default_value_t = true, action = clap::ArgAction::Set)]
    cluster_rights: bool,
    /// Namespace of the Lease: the operator's own.
    #[arg(long, env = "POD_NAMESPACE", default_value = "default")]
    lease_namespace: String,
    /// Name of the Lease.
    #[arg(long, env = "LEADERBOARD_LEASE", default_value = "leaderboard-operator")]
    lease: String,
    /// Name of this replica.
    #[arg(long, env = "POD_NAME", default_value = "leaderboard-operator")]
    pod_name: String,
    /// UID of this replica.
    #[arg(long, env = "POD_UID", default_value = "")]
    pod_uid: String,
}

/// How to run a Pod's program outside of a Pod. Within a Pod the defaults are right.
#[derive(Args, Debug)]
struct InPod {
    /// Folder with the Pod's mounts.
    #[arg(long, default_value = "/", hide = true)]
    root: std::path::PathBuf,
    /// Divides the times it waits for what cannot be observed.
    #[arg(long, default_value_t = 1, hide = true)]
    faster: u32,
}

/// The version, with the commit where the build was given one.
fn version_of(revision: &str) -> String {
    let version = env!("CARGO_PKG_VERSION");
    if revision.is_empty() {
        version.to_owned()
    } else {
        format!("{version} ({revision})")
    }
}

/// Runs what the command line asks for.
pub fn run() -> ExitCode {
    let cli = Cli::parse();
    if cli.command.asks_aws()
        && let Err(fault) = aws::check_endpoints(std::env::vars_os())
    {
        eprintln!("leaderboard-operator: {fault}");
        return ExitCode::FAILURE;
    }
    match cli.command {
        Command::Crd => offline::print_crds(),
        Command::Results(results) => results.run(),
        Command::Labels(labels) => labels.run(),
        Command::Controller(options) => serve::controller(options),
        Command::Bridge(options) => serve::bridge(options),
        Command::Preflight(options) => options.run(),
        Command::Workspace(options) => serve::workspace(&options),
        Command::Logcopy(options) => serve::logcopy(&options),
        Command::Collect(options) => serve::collect(&options),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_version_names_the_commit_of_a_build_that_was_given_one() {
        assert_eq!(version_of(""), env!("CARGO_PKG_VERSION"));
        assert_eq!(
            version_of("0123abc"),
            format!("{} (0123abc)", env!("CARGO_PKG_VERSION"))
        );
    }
}
