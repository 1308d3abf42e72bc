//! `kubectl leaderboard`: explains why a submission waits, runs or failed, and cancels or resumes it.
//!
//! `why`, `overview`, `change` and `transitions` are pure and hold what is printed and decided; `cluster` talks to the API
//! server. It shows what the status holds, and contacts neither EvalAI nor AWS.

mod board;
mod change;
mod cluster;
mod error;
mod near;
mod overview;
mod text;
mod transitions;
mod why;

#[cfg(test)]
mod tests;

use std::io::{ErrorKind, Write as _};
use std::pin::pin;
use std::process::ExitCode;

use clap::{Args, Parser, Subcommand};
use futures::StreamExt;
use jiff::Timestamp;
use kube::ResourceExt;

use self::change::Request;
use self::cluster::{Cluster, Target};
use self::error::Error;
use self::transitions::Waiting;
use leaderboard_api::client_errors::watch as watch_error;
use leaderboard_api::{State, Submission};

/// How often a change is tried again after a conflict with somebody else's.
const TRIES: usize = 4;

/// Explain, cancel and resume submissions.
#[derive(Parser, Debug)]
#[command(name = "kubectl-leaderboard", bin_name = "kubectl leaderboard", version, long_about = None)]
struct Cli {
    #[command(subcommand)]
    command: Command,
    #[command(flatten)]
    target: Target,
}

#[derive(Subcommand, Debug)]
enum Command {
    /// Explain a submission's state and the next step. Without NAME, list every submission that is waiting, failed or stuck.
    Why {
        /// Name of the submission.
        name: Option<String>,
    },
    /// Stop a submission. Completed routes are kept.
    #[command(
        after_help = "Exit code 0: the cancellation is requested; with --wait, the submission has ended. 1: it had already ended, or an error."
    )]
    Cancel(Change),
    /// Run a Failed or Cancelled submission again, from its stored results.
    #[command(
        after_help = "Exit code 0: the attempt is requested; with --wait, the submission is Finished. 1: it cannot be resumed, it did not finish, or an error."
    )]
    Resume(Change),
}

#[derive(Args, Debug)]
struct Change {
    /// Name of the submission.
    name: String,
    /// Wait for the end, and print each state until then.
    #[arg(long)]
    wait: bool,
}

/// Runs the command line.
fn main() -> ExitCode {
    let cli = Cli::parse();
    // It fails only where a provider is installed already, which serves as well.
    let _ = rustls::crypto::ring::default_provider().install_default();
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
    let result = runtime
        .map_err(Error::Runtime)
        .and_then(|runtime| runtime.block_on(carry_out(cli)));
    match result {
        Ok(code) => code,
        Err(error) => {
            eprintln!("kubectl leaderboard: {error}");
            ExitCode::FAILURE
        }
    }
}

async fn carry_out(cli: Cli) -> Result<ExitCode, Error> {
    let cluster = Cluster::connect(cli.target).await?;
    match cli.command {
        Command::Why { name: Some(name) } => explain(&cluster, &name).await,
        Command::Why { name: None } => survey(&cluster).await,
        Command::Cancel(target) => change(&cluster, Request::Cancel, &target).await,
        Command::Resume(target) => change(&cluster, Request::Resume, &target).await,
    }
}

async fn explain(cluster: &Cluster, name: &str) -> Result<ExitCode, Error> {
    let submission = cluster.submission(name).await?;
    let leaderboard = cluster.leaderboard(&submission.spec.leaderboard_name).await?;
    print(&why::explain(&submission, leaderboard.observed(), Timestamp::now()));
    Ok(ExitCode::SUCCESS)
}

async fn survey(cluster: &Cluster) -> Result<ExitCode, Error> {
    let submissions = cluster.submissions().await?;
    let leaderboards = cluster.leaderboards().await?;
    let now = Timestamp::now();
    print(&overview::lines(
        &cluster.namespace,
        &submissions,
        leaderboards.as_deref(),
        now,
    ));
    Ok(ExitCode::SUCCESS)
}

async fn change(cluster: &Cluster, request: Request, target: &Change) -> Result<ExitCode, Error> {
    let attempt = send(cluster, request, &target.name).await?;
    if !target.wait {
        return Ok(ExitCode::SUCCESS);
    }
    let end = wait(cluster, &target.name, attempt).await?;
    // A cancel succeeds with any end, a resume only with a result.
    let is_fulfilled = request == Request::Cancel || end == State::Finished;
    Ok(if is_fulfilled {
        ExitCode::SUCCESS
    } else {
        ExitCode::FAILURE
    })
}

/// Sends a request to the API server; returns the attempt whose end fulfils it.
async fn send(cluster: &Cluster, request: Request, name: &str) -> Result<i64, Error> {
    for _ in 0..TRIES {
        let submission = cluster.submission(name).await?;
        let leaderboard = cluster.leaderboard(&submission.spec.leaderboard_name).await?;
        let plan =
            change::plan(request, &submission, leaderboard.observed(), Timestamp::now()).map_err(Error::Unfit)?;
        if let Some(patch) = &plan.patch {
            match cluster.patch(name, patch).await? {
                Ok(_) => {}
                Err(kube::Error::Api(status)) if status.is_conflict() => continue,
                Err(error) => return Err(refusal(request, &submission, error)),
            }
        }
        print(&plan.lines);
        return Ok(plan.attempt);
    }
    Err(Error::Conflict(name.to_owned()))
}

/// The next step after a refusal by the API server's rules, or for lack of a right where EvalAI is another way.
fn refusal(request: Request, submission: &Submission, error: kube::Error) -> Error {
    let kube::Error::Api(status) = &error else {
        return error.into();
    };
    let has_other_way = status.is_forbidden() && submission.spec.evalai.is_some();
    if has_other_way || status.is_invalid() || status.code == 400 {
        return Error::Refused {
            message: error::phrase(&status.message),
            next: change::after_refusal(request, submission),
        };
    }
    if status.is_not_found() {
        return Error::Gone(submission.name_any());
    }
    error.into()
}

/// Waits for the end of an attempt, and prints each state until then.
async fn wait(cluster: &Cluster, name: &str, attempt: i64) -> Result<State, Error> {
    let mut waiting = Waiting::new(attempt);
    let mut changes = pin!(cluster.changes(name));
    let mut printed = String::new();
    while let Some(change) = changes.next().await {
        match change {
            Ok(Some(submission)) => {
                let update = waiting.observe(&submission, Timestamp::now());
                print(&update.lines);
                if let Some(end) = update.end {
                    return Ok(end);
                }
            }
            Ok(None) => return Err(Error::Gone(name.to_owned())),
            Err(error) => {
                let message = error::phrase(&watch_error(&error));
                if let Some(permanent) = error::permanent(error) {
                    return Err(permanent);
                }
                if message != printed {
                    eprintln!("kubectl leaderboard: {message}; retrying.");
                    printed = message;
                }
            }
        }
    }
    Err(Error::Api("the watch has ended".to_owned()))
}

fn print(lines: &[String]) {
    let mut out = std::io::stdout().lock();
    for line in lines {
        if let Err(error) = writeln!(out, "{line}") {
            // Ignore a closed pipe.
            if error.kind() != ErrorKind::BrokenPipe {
                eprintln!("kubectl leaderboard: cannot write the output: {error}. Check where it is redirected to");
            }
            return;
        }
    }
}
