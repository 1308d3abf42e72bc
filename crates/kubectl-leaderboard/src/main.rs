//! `kubectl leaderboard`: why a submission is where it is, and to cancel or resume it.
//!
//! `why`, `overview`, `change` and `transitions` are pure and hold what is
//! said and decided; `cluster` is the way to the API server. Knows no EvalAI and no AWS: it says what the status says.

mod board;
mod change;
mod cluster;
mod error;
mod near;
mod overview;
mod steps;
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

use self::change::Wish;
use self::cluster::{Cluster, Place};
use self::error::Error;
use self::transitions::Waiting;
use leaderboard_api::client_errors::watch as watch_words;
use leaderboard_api::{State, Submission};

/// How often a race for the object is run before it is given up.
const ROUNDS: usize = 4;

/// Why submissions wait or fail, and to cancel or resume them.
#[derive(Parser, Debug)]
#[command(name = "kubectl-leaderboard", bin_name = "kubectl leaderboard", version, long_about = None)]
struct Cli {
    #[command(subcommand)]
    command: Command,
    #[command(flatten)]
    place: Place,
}

#[derive(Subcommand, Debug)]
enum Command {
    /// Says why a submission is in its state and what to do next; without a name, of each that waits or is in trouble.
    Why {
        /// Name of the submission.
        name: Option<String>,
    },
    /// Stops a submission and keeps what it has reached.
    #[command(
        after_help = "Exit code 0: it is to be cancelled; with --wait, it has come to its end. 1: it had ended before."
    )]
    Cancel(Target),
    /// Runs a Failed or Cancelled submission again from what is stored.
    #[command(
        after_help = "Exit code 0: it is to be resumed; with --wait, it is Finished. 1: it can't be, or it did not finish."
    )]
    Resume(Target),
}

#[derive(Args, Debug)]
struct Target {
    /// Name of the submission.
    name: String,
    /// Waits for the end, and prints the states on the way.
    #[arg(long)]
    wait: bool,
}

/// Runs what the command line asks for.
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
    let cluster = Cluster::connect(cli.place).await?;
    match cli.command {
        Command::Why { name: Some(name) } => explain(&cluster, &name).await,
        Command::Why { name: None } => survey(&cluster).await,
        Command::Cancel(target) => change(&cluster, Wish::Cancel, &target).await,
        Command::Resume(target) => change(&cluster, Wish::Resume, &target).await,
    }
}

async fn explain(cluster: &Cluster, name: &str) -> Result<ExitCode, Error> {
    let submission = cluster.submission(name).await?;
    let leaderboard = cluster.leaderboard(&submission.spec.leaderboard_name).await?;
    print(&why::explain(&submission, leaderboard.sight(), Timestamp::now()));
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

async fn change(cluster: &Cluster, wish: Wish, target: &Target) -> Result<ExitCode, Error> {
    let attempt = tell(cluster, wish, &target.name).await?;
    if !target.wait {
        return Ok(ExitCode::SUCCESS);
    }
    let end = wait(cluster, &target.name, attempt).await?;
    // Who cancels wants it ended; who resumes wants a result.
    let is_well = wish == Wish::Cancel || end == State::Finished;
    Ok(if is_well { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

/// Tells the API server what is wished; hands back the attempt whose end fulfils it.
async fn tell(cluster: &Cluster, wish: Wish, name: &str) -> Result<i64, Error> {
    for _ in 0..ROUNDS {
        let submission = cluster.submission(name).await?;
        let leaderboard = cluster.leaderboard(&submission.spec.leaderboard_name).await?;
        let plan = change::plan(wish, &submission, leaderboard.sight(), Timestamp::now()).map_err(Error::Unfit)?;
        if let Some(patch) = &plan.patch {
            match cluster.patch(name, patch).await? {
                Ok(_) => {}
                Err(kube::Error::Api(status)) if status.is_conflict() => continue,
                Err(error) => return Err(refusal(wish, &submission, error)),
            }
        }
        print(&plan.says);
        return Ok(plan.attempt);
    }
    Err(Error::Busy(name.to_owned()))
}

/// A refusal of the API server's rules has a next step, and so has one of a person's rights where EvalAI is another way.
fn refusal(wish: Wish, submission: &Submission, error: kube::Error) -> Error {
    let kube::Error::Api(status) = &error else {
        return error.into();
    };
    let has_other_way = status.is_forbidden() && submission.spec.evalai.is_some();
    if has_other_way || status.is_invalid() || status.code == 400 {
        return Error::Refused {
            words: error::phrase(&status.message),
            next: change::after_refusal(wish, submission),
        };
    }
    if status.is_not_found() {
        return Error::Gone(submission.name_any());
    }
    error.into()
}

/// Waits for the end of an attempt, and prints the states on the way.
async fn wait(cluster: &Cluster, name: &str, attempt: i64) -> Result<State, Error> {
    let mut waiting = Waiting::new(attempt);
    let mut changes = pin!(cluster.changes(name));
    let mut told = String::new();
    while let Some(change) = changes.next().await {
        match change {
            Ok(Some(submission)) => {
                let seen = waiting.see(&submission, Timestamp::now());
                print(&seen.says);
                if let Some(end) = seen.end {
                    return Ok(end);
                }
            }
            Ok(None) => return Err(Error::Gone(name.to_owned())),
            Err(error) => {
                let words = error::phrase(&watch_words(&error));
                if let Some(hopeless) = error::hopeless(error) {
                    return Err(hopeless);
                }
                if words != told {
                    eprintln!("kubectl leaderboard: {words}; it is tried again.");
                    told = words;
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
            // Nobody has to listen.
            if error.kind() != ErrorKind::BrokenPipe {
                eprintln!("kubectl leaderboard: the output can't be written: {error}. See where it goes");
            }
            return;
        }
    }
}
