//! Measures the operator next to the limit of its API server. Each case runs the limit, a client that only writes, and the operator, in
//! turn, on fresh servers of its own. `make bench`; docs/performance.md has the method.
#![allow(clippy::cast_precision_loss, reason = "no count comes near 2^52")]
#![allow(clippy::disallowed_methods, reason = "it measures with its own clock")]

mod api;
mod audit;
mod bench;
mod cases;
mod machine;
mod names;
mod observed;
mod operator;
#[allow(
    dead_code,
    clippy::unwrap_used,
    reason = "it is shared with the tests, and has their part too"
)]
#[path = "../../tests/support/played.rs"]
mod played;
mod player;
mod raw;
mod record;
mod report;
mod sample;
mod scale;
mod servers;
mod stats;
mod storage;
mod world;

use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Instant;

use clap::{Args, Parser, Subcommand};
use jiff::Timestamp;
use tokio::signal::unix::{SignalKind, signal};

use bench::{Bench, Outcome};
use cases::Case;
use machine::Machine;
use raw::Bodies;
use record::{Figures, Line};

/// Measures leaderboard-operator.
#[derive(Parser)]
#[command(name = "leaderboard-bench")]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Measure, and append one line of JSON for each case to a file.
    Run(Run),
    /// Write the tables and plots of the documentation from such a file.
    Report {
        /// The file.
        file: PathBuf,
        /// Folder of the documentation.
        #[arg(long, default_value = "docs")]
        docs: PathBuf,
    },
}

#[derive(Args)]
struct Run {
    /// Folder with etcd, kube-apiserver and kube-controller-manager.
    #[arg(long)]
    tools: PathBuf,
    /// The operator's binary.
    #[arg(long)]
    operator: PathBuf,
    /// Cargo profile of that binary; it is only noted.
    #[arg(long, default_value = "release")]
    profile: String,
    /// File that gets the lines.
    #[arg(long, default_value = "target/bench/lines.jsonl")]
    out: PathBuf,
    /// One run of each side and smaller numbers.
    #[arg(long)]
    quick: bool,
    /// Part of the submissions; less than 1 only shows that the cases work.
    #[arg(long, default_value_t = 1.0)]
    scale: f64,
    /// How often each case is measured; its line has the runs of all.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=100))]
    repeat: u32,
    /// Only these cases.
    #[arg(long = "case", value_enum)]
    cases: Vec<Case>,
}

#[tokio::main]
async fn main() -> ExitCode {
    let _ = rustls::crypto::ring::default_provider().install_default();
    let done = match Cli::parse().command {
        Command::Report { file, docs } => report::write(&file, &docs),
        Command::Run(run) => interruptible(&run).await,
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("bench: {error}");
            ExitCode::FAILURE
        }
    }
}

/// Both signals drop what runs, and with it every server.
async fn interruptible(run: &Run) -> Outcome<()> {
    let mut terminate = signal(SignalKind::terminate())?;
    tokio::select! {
        done = measure(run) => done,
        _ = tokio::signal::ctrl_c() => Err("interrupted".into()),
        _ = terminate.recv() => Err("terminated".into()),
    }
}

/// Prints and stores the line of a case that began then.
fn keep(run: &Run, machine: &Machine, (time, began): (String, Instant), line: Line) -> Outcome<()> {
    let line = Line {
        profile: run.profile.clone(),
        quick: run.quick,
        scale: run.scale,
        time,
        took_seconds: began.elapsed().as_secs_f64(),
        machine: machine.clone(),
        ..line
    };
    line.print();
    line.append(&run.out)?;
    Ok(())
}

async fn measure(run: &Run) -> Outcome<()> {
    for file in ["etcd", "kube-apiserver", "kube-controller-manager"].map(|name| run.tools.join(name)) {
        if !file.is_file() {
            return Err(format!("{} is missing: `local/lab tools` builds it", file.display()).into());
        }
    }
    let machine = Machine::read();
    let bench = Bench {
        tools: run.tools.clone(),
        operator: run
            .operator
            .canonicalize()
            .map_err(|error| format!("{}: {error}", run.operator.display()))?,
        quick: run.quick,
        scale: run.scale,
        cores: machine.cores,
    };
    println!(
        "{} cores, {} GiB, {}; operator built with --profile {}",
        machine.cores, machine.memory_gib, machine.processor, run.profile
    );
    let bodies = sample::take(&bench).await?;
    println!(
        "a Job has {:.1} KiB as the operator sends it",
        bodies.job_bytes() as f64 / 1024.0
    );
    let mut failed = Vec::new();
    for case in cases::chosen(&run.cases) {
        let began = (Timestamp::now().to_string(), Instant::now());
        match Box::pin(repeated(case, &bench, &bodies, run.repeat)).await {
            Ok(figures) => keep(run, &machine, began, figures.into_line(case.name()))?,
            Err(error) => {
                eprintln!("bench: {}: {error}", case.name());
                failed.push(case.name());
            }
        }
    }
    println!("the lines are in {}", run.out.display());
    if failed.is_empty() {
        Ok(())
    } else {
        Err(format!("not measured: {}", failed.join(", ")).into())
    }
}

async fn repeated(case: Case, bench: &Bench, bodies: &Bodies, times: u32) -> Outcome<Figures> {
    let mut figures = case.measure(bench, bodies).await?;
    for _ in 1..times {
        figures.extend(case.measure(bench, bodies).await?);
    }
    Ok(figures)
}
