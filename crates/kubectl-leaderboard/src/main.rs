//! `kubectl leaderboard`: explains why a submission waits, runs or failed, and cancels or resumes it.
//!
//! `why`, `overview`, `change` and `transitions` are pure and hold what is printed and decided; `cluster` talks to the API
//! server. It shows what the status holds, and contacts neither EvalAI nor AWS.

mod board;
mod bucket;
mod change;
mod check;
mod checking;
mod cluster;
mod complete;
mod dashboard;
mod error;
mod logs;
mod near;
mod output;
mod overview;
mod report;
mod rerun;
mod status;
mod submit;
mod table;
mod text;
mod top;
mod transitions;
mod why;

#[cfg(test)]
mod tests;

use std::pin::pin;
use std::process::ExitCode;
use std::time::Duration;

use clap::{Args, CommandFactory, Parser, Subcommand};
use futures::StreamExt;
use jiff::Timestamp;
use kube::ResourceExt;
use serde_json::Value;

use self::change::Request;
use self::cluster::{Cluster, Scope, Target};
use self::complete::Offer;
use self::error::Error;
use self::output::{Colour, Format, Output, print};
use self::transitions::Waiting;
use leaderboard_api::client_errors::watch as watch_error;
use leaderboard_api::{State, Submission};

/// How often a change is tried again after a conflict with somebody else's.
const TRIES: usize = 4;
/// How long a shell waits for names.
const COMPLETION: Duration = Duration::from_secs(3);

/// Check Leaderboards; show, explain, cancel and resume submissions.
#[derive(Parser, Debug)]
#[command(name = "kubectl-leaderboard", bin_name = "kubectl leaderboard", version, long_about = None)]
struct Cli {
    #[command(subcommand)]
    command: Command,
    #[command(flatten)]
    target: Target,
    /// When to colour lines.
    #[arg(long, global = true, value_enum, default_value_t, value_name = "WHEN")]
    color: Colour,
    /// The same as --color never.
    #[arg(long, global = true, conflicts_with = "color")]
    no_color: bool,
}

#[derive(Subcommand, Debug)]
enum Command {
    /// Explain a submission's state and the next step. Without NAME, list every submission that is waiting, failed or stuck.
    Why(Show),
    /// Show one submission on one screen. Without NAME, list all.
    Status(Watched),
    /// Show who uses the slots and who waits, by Leaderboard and team.
    Top {
        #[command(flatten)]
        scope: Scope,
        #[command(flatten)]
        output: Output,
    },
    /// Submit an image to a track, without EvalAI.
    Submit(submit::Submit),
    /// Open the operator's page for a browser on this machine, until Ctrl-C.
    Dashboard(dashboard::Dashboard),
    /// Print what the agents of a submission print.
    Logs(logs::Logs),
    /// Drive one route with one pair, and show which parts of a Leaderboard work.
    #[command(
        after_help = "Exit code 0: the check passed; 1: a part is broken, or an error. docs/check.md explains the table."
    )]
    Check(checking::Check),
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
    /// Resume all submissions that failed because of the infrastructure.
    #[command(after_help = "Exit code 0: all are requested; 1: one was refused, or an error.")]
    Rerun(rerun::Rerun),
    /// Write what a person who helps needs into one archive, without secrets, routes and names of teams.
    Report(report::Report),
    /// Print the program with which kubectl completes these commands in a shell.
    #[command(
        after_help = "Example: kubectl leaderboard completion > ~/bin/kubectl_complete-leaderboard; chmod +x ~/bin/kubectl_complete-leaderboard"
    )]
    Completion,
    /// What fits in place of the last word.
    #[command(hide = true)]
    Complete {
        #[arg(last = true)]
        words: Vec<String>,
    },
}

#[derive(Args, Debug)]
struct Show {
    /// Name of the submission.
    name: Option<String>,
    #[command(flatten)]
    scope: Scope,
    #[command(flatten)]
    output: Output,
}

#[derive(Args, Debug)]
struct Watched {
    #[command(flatten)]
    show: Show,
    /// Print it again each time it changes, until it has ended.
    #[arg(short, long, requires = "name")]
    watch: bool,
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
    if cli.no_color { Colour::Never } else { cli.color }.settle();
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
    match cli.command {
        Command::Completion => {
            print(&[complete::SCRIPT.trim_end().to_owned()]);
            Ok(ExitCode::SUCCESS)
        }
        Command::Complete { words } => {
            Box::pin(complete(&words)).await;
            Ok(ExitCode::SUCCESS)
        }
        command => carry_out_there(command, &Cluster::connect(cli.target).await?).await,
    }
}

/// Carries out what needs a cluster.
async fn carry_out_there(command: Command, cluster: &Cluster) -> Result<ExitCode, Error> {
    match command {
        Command::Completion | Command::Complete { .. } => Ok(ExitCode::SUCCESS),
        Command::Why(Show {
            name: Some(name),
            output,
            ..
        }) => explain(cluster, &name, output.format).await,
        Command::Why(Show {
            name: None,
            scope,
            output,
        }) => survey(cluster, &scope, output.format).await,
        Command::Status(Watched { show, watch }) => Box::pin(show_status(cluster, &show, watch)).await,
        Command::Top { scope, output } => top(cluster, &scope, output.format).await,
        Command::Submit(wanted) => submit(cluster, &wanted).await,
        Command::Dashboard(wanted) => Box::pin(dashboard::dashboard(cluster, &wanted))
            .await
            .map(|()| ExitCode::SUCCESS),
        Command::Logs(wanted) => Box::pin(logs::logs(cluster, &wanted)).await.map(|()| ExitCode::SUCCESS),
        Command::Report(wanted) => report::report(cluster, &wanted).await.map(|()| ExitCode::SUCCESS),
        Command::Rerun(wanted) => rerun(cluster, &wanted).await,
        Command::Check(wanted) => Box::pin(checking::check(cluster, &wanted)).await,
        Command::Cancel(target) => change(cluster, Request::Cancel, &target).await,
        Command::Resume(target) => change(cluster, Request::Resume, &target).await,
    }
}

/// Prints what fits. A cluster that does not answer has no names.
async fn complete(words: &[String]) {
    let offered = complete::offer(&Cli::command(), words);
    let last = words.last().map(String::as_str).unwrap_or_default();
    // The flags that name the cluster may be among the words; the last one may be half of anything.
    let before = words.split_last().map_or(&[][..], |(_, before)| before);
    let target = Cli::try_parse_from(std::iter::once("kubectl-leaderboard").chain(before.iter().map(String::as_str)));
    let target = target.map(|cli| cli.target).unwrap_or_default();
    let names = match offered {
        Offer::Words(words) => words,
        of_cluster => {
            let found = tokio::time::timeout(COMPLETION, names_of(target, &of_cluster)).await;
            found.ok().and_then(Result::ok).unwrap_or_default()
        }
    };
    if let Offer::Words(words) = complete::fitting(names, last) {
        print(&words);
    }
    print(&[complete::NO_FILES.to_owned()]);
}

async fn names_of(target: Target, offered: &Offer) -> Result<Vec<String>, Error> {
    let cluster = Cluster::connect(target).await?;
    let scope = Scope::default();
    Ok(if *offered == Offer::Leaderboards {
        let boards = cluster.leaderboards(&scope).await?.unwrap_or_default();
        boards.iter().map(ResourceExt::name_any).collect()
    } else {
        cluster
            .submissions(&scope)
            .await?
            .iter()
            .map(ResourceExt::name_any)
            .collect()
    })
}

async fn explain(cluster: &Cluster, name: &str, format: Format) -> Result<ExitCode, Error> {
    let submission = cluster.submission(name).await?;
    let leaderboard = cluster.leaderboard(&submission.spec.leaderboard_name).await?;
    let value = why::value(&submission, leaderboard.observed());
    let lines = output::document(format, &value);
    print(&lines.unwrap_or_else(|| why::explain(&submission, leaderboard.observed(), Timestamp::now())));
    Ok(ExitCode::SUCCESS)
}

async fn survey(cluster: &Cluster, scope: &Scope, format: Format) -> Result<ExitCode, Error> {
    let submissions = cluster.submissions(scope).await?;
    let leaderboards = cluster.leaderboards(scope).await?;
    let value = Value::Array(submissions.iter().map(status::value).collect());
    if let Some(lines) = output::document(format, &value) {
        print(&lines);
        return Ok(ExitCode::SUCCESS);
    }
    if submissions.is_empty() {
        print(&nothing(cluster, scope).await);
    } else {
        let place = overview::Place {
            namespace: &cluster.namespace,
            is_all: scope.all_namespaces,
        };
        print(&overview::lines(
            place,
            &submissions,
            leaderboards.as_deref(),
            Timestamp::now(),
        ));
    }
    Ok(ExitCode::SUCCESS)
}

/// The message where no submission is found: most often the namespace is another one.
async fn nothing(cluster: &Cluster, scope: &Scope) -> Vec<String> {
    let elsewhere = if scope.all_namespaces {
        Vec::new()
    } else {
        cluster.elsewhere().await
    };
    overview::nothing(&cluster.namespace, scope.selector.as_deref(), &elsewhere)
}

async fn show_status(cluster: &Cluster, show: &Show, watch: bool) -> Result<ExitCode, Error> {
    let format = show.output.format;
    let Some(name) = &show.name else {
        let submissions = cluster.submissions(&show.scope).await?;
        let value = Value::Array(submissions.iter().map(status::value).collect());
        let lines = match output::document(format, &value) {
            Some(lines) => lines,
            None if submissions.is_empty() => nothing(cluster, &show.scope).await,
            None => status::lines(
                &submissions,
                show.scope.all_namespaces,
                format == Format::Wide,
                Timestamp::now(),
            ),
        };
        print(&lines);
        return Ok(ExitCode::SUCCESS);
    };
    let submission = cluster.submission(name).await?;
    if !watch {
        return screen(cluster, &submission, format).await;
    }
    let mut changes = pin!(cluster.changes(name));
    while let Some(change) = changes.next().await {
        match change {
            Ok(Some(submission)) => {
                output::begin_screen();
                screen(cluster, &submission, format).await?;
                if why::has_ended(&submission) {
                    return Ok(ExitCode::SUCCESS);
                }
            }
            Ok(None) => return Err(Error::Gone(name.clone())),
            Err(error) => {
                if let Some(permanent) = error::permanent(error) {
                    return Err(permanent);
                }
            }
        }
    }
    Ok(ExitCode::SUCCESS)
}

async fn screen(cluster: &Cluster, submission: &Submission, format: Format) -> Result<ExitCode, Error> {
    let leaderboard = cluster.leaderboard(&submission.spec.leaderboard_name).await?;
    let lines = output::document(format, &status::value(submission));
    print(&lines.unwrap_or_else(|| status::screen(submission, leaderboard.observed(), Timestamp::now())));
    Ok(ExitCode::SUCCESS)
}

async fn top(cluster: &Cluster, scope: &Scope, format: Format) -> Result<ExitCode, Error> {
    let submissions = cluster.submissions(scope).await?;
    let leaderboards = cluster.leaderboards(scope).await?.unwrap_or_default();
    let lines = output::document(format, &top::value(&submissions));
    print(&lines.unwrap_or_else(|| top::lines(&submissions, &leaderboards)));
    Ok(ExitCode::SUCCESS)
}

async fn submit(cluster: &Cluster, wanted: &submit::Submit) -> Result<ExitCode, Error> {
    let created = cluster.create(&submit::object(wanted)).await?;
    let name = created.name_any();
    print(&[format!(
        "Submitted {name}. `kubectl leaderboard status {name} -n {} -w` follows it.",
        cluster.namespace
    )]);
    if !wanted.wait {
        return Ok(ExitCode::SUCCESS);
    }
    let end = wait(cluster, &name, 1).await?;
    Ok(if end == State::Finished {
        ExitCode::SUCCESS
    } else {
        ExitCode::FAILURE
    })
}

async fn rerun(cluster: &Cluster, wanted: &rerun::Rerun) -> Result<ExitCode, Error> {
    let scope = Scope {
        selector: wanted.selector.clone(),
        ..Scope::default()
    };
    let names = rerun::chosen(&cluster.submissions(&scope).await?, wanted.reason.as_deref());
    if names.is_empty() {
        print(&["No submission has failed so because of the infrastructure.".to_owned()]);
    }
    let mut is_refused = false;
    for name in names {
        if wanted.dry_run {
            print(&[format!("Would resume {name}.")]);
        } else if let Err(error) = send(cluster, Request::Resume, &name).await {
            eprintln!("kubectl leaderboard: {error}");
            is_refused = true;
        }
    }
    Ok(if is_refused {
        ExitCode::FAILURE
    } else {
        ExitCode::SUCCESS
    })
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
