//! `kubectl leaderboard`: shows and explains submissions, changes them, and checks Leaderboards and manifests.
//!
//! `why`, `status`, `overview`, `top`, `change`, `resume` and `facts` are pure: they decide, and make the lines to print.
//! `cluster` talks to the API server; `commands` and `changes` bring both together. `import` and `lint` make text of text.
//! The plugin shows the status and contacts neither EvalAI nor AWS; where files or logs help, it starts the person's own `aws` program.

mod aws;
mod board;
mod bucket;
mod change;
mod changes;
mod check;
mod cluster;
mod commands;
mod complete;
mod csv;
mod dashboard;
mod error;
mod facts;
mod foreign;
mod get;
mod help;
mod import;
mod lines;
mod lint;
mod logs;
mod manual;
mod near;
mod output;
mod overview;
mod pause;
mod report;
mod resume;
mod scores;
mod status;
mod submit;
mod table;
mod text;
mod top;
mod upload;
mod version;
mod why;

#[cfg(test)]
mod tests;

use std::ffi::OsString;
use std::process::ExitCode;
use std::time::Duration;

use clap::{Args, ColorChoice, CommandFactory, FromArgMatches, Parser, Subcommand};
use kube::ResourceExt;

use self::cluster::{Cluster, Scope, Target};
use self::complete::Offer;
use self::error::Error;
use self::help::GLOBAL;
use self::output::{Format, Output, formats, note, print, set_colours};

/// How long a shell waits for names.
const COMPLETION: Duration = Duration::from_secs(3);

/// Show and explain submissions, submit, stop and resume them, and check Leaderboards.
#[derive(Parser, Debug)]
#[command(name = "kubectl-leaderboard", bin_name = "kubectl leaderboard", version, long_about = None)]
struct Cli {
    #[command(subcommand)]
    command: Command,
    #[command(flatten)]
    target: Target,
    /// When to color lines; auto: on a terminal, unless NO_COLOR is set.
    #[arg(long, global = true, value_enum, default_value_t, value_name = "WHEN", help_heading = GLOBAL)]
    color: ColorChoice,
    /// The same as --color never.
    #[arg(long, global = true, conflicts_with = "color", help_heading = GLOBAL)]
    no_color: bool,
}

#[derive(Subcommand, Debug)]
enum Command {
    /// Explain a submission's state and the next step; without NAME, list each that waits, has failed or is stuck.
    Why(Show),
    /// Show one submission on one screen; without NAME, list all.
    Status(Watched),
    /// Show who uses the slots and who waits, by Leaderboard and team.
    Top {
        #[command(flatten)]
        scope: Scope,
        #[command(flatten)]
        output: Output,
    },
    /// Show who leads each track: the best result of each team.
    Scores(scores::Scores),
    /// List what a submission has stored, or copy it into a folder.
    Get(get::Get),
    /// Submit an image or a file to a track, without EvalAI.
    #[command(
        override_usage = "kubectl leaderboard submit [OPTIONS] --leaderboard <LEADERBOARD>\n       --track <TRACK> <--image <IMAGE>|--file <FILE>>",
        after_help = "Exit code 0: it is submitted; with --wait, it is Finished. 1: it did not finish, or an error."
    )]
    Submit(submit::Submit),
    /// Open the operator's page for a browser on this machine, until Ctrl-C.
    Dashboard(dashboard::Dashboard),
    /// Print the logs of a submission, by default those of its agents.
    Logs(logs::Logs),
    /// Run an agent of your own once, and show whether the Leaderboard works.
    #[command(
        after_help = "Exit code 0: its run is Finished and the Leaderboard Ready; 1: one of them is not, or an error.\n\nMore: docs/check.md"
    )]
    Check(check::Check),
    /// Stop a submission. Completed work is kept.
    #[command(
        after_help = "Exit code 0: the cancellation is requested; with --wait, the submission has ended. 1: it had already ended, or an error."
    )]
    Cancel(Cancel),
    /// Run submissions again, from their stored results.
    #[command(
        after_help = "A submission that is named is Failed or Cancelled; with --restart, it runs. With -l or --all, a terminal shows which ones \
                      fit, and asks.\n\nExit code 0: all are requested, or none matched; with --wait, all are Finished. 1: one was refused or did \
                      not finish, or an error."
    )]
    Resume(resume::Resume),
    /// Let nothing new of a Leaderboard start. What runs goes on.
    Pause(pause::Pause),
    /// Let submissions of a paused Leaderboard start again.
    Unpause(pause::Pause),
    /// Check manifests by schema and rules, without a cluster.
    #[command(after_help = "Exit code 0: no fault. 1: a fault, or a file that cannot be read.")]
    Lint(lint::Lint),
    /// Collect a support bundle in one file, without Secrets, logs and names of teams.
    Report(report::Report),
    /// Print manifests for a pipeline of Step Functions that this operator takes over. It asks neither AWS nor a cluster.
    #[command(
        override_usage = "kubectl leaderboard import [OPTIONS] --challenge <ID> --queue <URL>\n       <FILE>...",
        after_help = "Without --namespace the objects are in `leaderboard`.\n\nExit code 0: the manifests are printed. 1: an entry or a file is \
                      refused, and nothing is printed.\n\nMore: docs/import.md"
    )]
    Import(import::Import),
    /// Print the program with which kubectl completes these commands in a shell.
    Completion,
    /// Print the version of this program, and of the operator here.
    Version(version::Version),
    /// Write a manual page of each command.
    Man(manual::Man),
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
    /// Name of the submission.
    name: Option<String>,
    #[command(flatten)]
    scope: Scope,
    /// Output format; wide: more columns.
    #[arg(short = 'o', long = "output", value_name = "FORMAT", default_value = "text", value_parser = formats(["text", "wide", "json", "yaml"]))]
    format: Format,
    /// Print it again each time it changes, until it has ended.
    #[arg(short, long, requires = "name")]
    watch: bool,
}

#[derive(Args, Debug)]
struct Cancel {
    /// Name of the submission.
    name: String,
    /// Wait for the end, and print each state until then.
    #[arg(long)]
    wait: bool,
}

/// Columns of the help on a wide terminal.
const HELP_WIDTH: usize = 120;

/// Runs the command line.
fn main() -> ExitCode {
    let words: Vec<OsString> = std::env::args_os().collect();
    let matches = command_line(&words).get_matches_from(&words);
    let cli = Cli::from_arg_matches(&matches).unwrap_or_else(|error| error.exit());
    set_colours(if cli.no_color { ColorChoice::Never } else { cli.color });
    // It fails only where a provider is installed already, which serves as well.
    let _ = rustls::crypto::ring::default_provider().install_default();
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
    let result = runtime
        .map_err(Error::Runtime)
        .and_then(|runtime| runtime.block_on(carry_out(cli)));
    match result {
        Ok(code) => code,
        Err(error) => {
            note(&error.to_string());
            ExitCode::FAILURE
        }
    }
}

/// The command line. Its help is printed before the flags are known, and they count for it all the same.
fn command_line(words: &[OsString]) -> clap::Command {
    let is_plain = words.iter().any(|word| word == "--no-color" || word == "--color=never");
    let colors = if is_plain || words.windows(2).any(|pair| pair == ["--color", "never"]) {
        ColorChoice::Never
    } else {
        ColorChoice::Auto
    };
    help::dressed(Cli::command().color(colors).max_term_width(HELP_WIDTH))
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
        Command::Man(wanted) => manual::write(help::dressed(Cli::command()), &wanted),
        Command::Lint(wanted) => lint::lint(&wanted),
        Command::Version(wanted) => version::version(cli.target, &wanted).await,
        Command::Import(wanted) => import::import(&wanted, cli.target.namespace.as_deref()),
        command => {
            let cluster = Cluster::connect(cli.target).await?;
            let done = carry_out_there(command, &cluster).await;
            done.map_err(|error| error.naming(&cluster.server))
        }
    }
}

/// Carries out what needs a cluster.
async fn carry_out_there(command: Command, cluster: &Cluster) -> Result<ExitCode, Error> {
    match command {
        Command::Completion
        | Command::Complete { .. }
        | Command::Man(_)
        | Command::Import(_)
        | Command::Lint(_)
        | Command::Version(_) => Ok(ExitCode::SUCCESS),
        Command::Why(wanted) => commands::why(cluster, &wanted).await,
        Command::Status(wanted) => Box::pin(commands::show_status(cluster, &wanted)).await,
        Command::Get(wanted) => Box::pin(get::get(cluster, &wanted)).await,
        Command::Pause(wanted) => pause::pause(cluster, &wanted, true).await,
        Command::Unpause(wanted) => pause::pause(cluster, &wanted, false).await,
        Command::Top { scope, output } => commands::top(cluster, &scope, output.format).await,
        Command::Scores(wanted) => scores::scores(cluster, &wanted).await,
        Command::Submit(wanted) => Box::pin(changes::submit(cluster, &wanted)).await,
        Command::Dashboard(wanted) => Box::pin(dashboard::dashboard(cluster, &wanted)).await,
        Command::Logs(wanted) => Box::pin(logs::logs(cluster, &wanted)).await,
        Command::Report(wanted) => report::report(cluster, &wanted).await,
        Command::Check(wanted) => Box::pin(check::check(cluster, &wanted)).await,
        Command::Cancel(target) => changes::cancel(cluster, &target).await,
        Command::Resume(wanted) => changes::resume(cluster, &wanted).await,
    }
}

/// Prints what fits. A cluster that does not answer has no names.
async fn complete(words: &[String]) {
    let offered = complete::offer(&Cli::command(), words);
    let last = words.last().map(String::as_str).unwrap_or_default();
    // The flags that name the cluster may be among the words.
    let line = complete::parsed(&Cli::command(), words);
    let target = line.and_then(|line| Target::from_arg_matches(&line).ok());
    let target = target.unwrap_or_default();
    let (names, directive) = match offered {
        Offer::Files => (Vec::new(), complete::FILES),
        Offer::Words(words) => (words, complete::NO_FILES),
        of_cluster => {
            let found = tokio::time::timeout(COMPLETION, names_of(target, &of_cluster)).await;
            let names = found.ok().and_then(Result::ok).unwrap_or_default();
            (complete::fitting(names, last), complete::NO_FILES)
        }
    };
    print(&names);
    print(&[directive.to_owned()]);
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
