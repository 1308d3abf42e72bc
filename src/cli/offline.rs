//! Subcommands that need no cluster: `crd` and `results`.

use std::fs;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::{Args, ValueEnum};
use leaderboard_results::{Files, Format, Plan, offline};

use crate::crds;

/// Exit code of a refusal: nothing that had been good is overwritten.
const REFUSED: u8 = 2;

/// Prints both definitions as one YAML stream.
pub(super) fn print_crds() -> ExitCode {
    match crds::all() {
        Ok(text) => {
            print!("{text}");
            ExitCode::SUCCESS
        }
        Err(error) => {
            eprintln!("leaderboard-operator: {error}");
            ExitCode::FAILURE
        }
    }
}

#[derive(ValueEnum, Clone, Copy, Debug)]
enum FormatName {
    V1,
    V2,
}

/// Merges the checkpoint files of the workers and renders what EvalAI gets.
#[derive(Args, Debug)]
pub(super) struct Results {
    /// Format of the checkpoints.
    #[arg(long, value_enum)]
    format: FormatName,
    /// Folder for agent_results.json, results.json, stdout.txt and metadata.json.
    #[arg(long)]
    out: PathBuf,
    /// How many workers there were; with --routes, a missing worker is not final.
    #[arg(long, requires = "routes")]
    workers: Option<usize>,
    /// Routes of the whole run, not counting repetitions.
    #[arg(long, requires = "workers")]
    routes: Option<u32>,
    /// How often each route was driven; default 5 in V1, 1 in V2.
    #[arg(long)]
    repetitions: Option<u32>,
    /// Decide as the original does, its mistakes included.
    #[arg(long)]
    as_original: bool,
    /// The workers' files in order; an absent file is a worker without results.
    #[arg(required = true)]
    inputs: Vec<PathBuf>,
}

impl Results {
    /// Exit code 0, or 2 with the reason on stderr.
    pub(super) fn run(self) -> ExitCode {
        match self.merge() {
            Ok(()) => ExitCode::SUCCESS,
            Err(message) => {
                eprintln!("leaderboard-operator results: {message}");
                ExitCode::from(REFUSED)
            }
        }
    }

    fn merge(&self) -> Result<(), String> {
        let plan = self.plan()?;
        let inputs = self
            .inputs
            .iter()
            .map(|path| read(path))
            .collect::<Result<Vec<_>, _>>()?;
        let (merged, files) = offline(&plan, &inputs).map_err(|r| format!("{r}. {}", r.next_step()))?;
        write_all(&self.out, &merged.text, &files)?;
        for warning in &merged.warnings {
            eprintln!("warning: {warning}");
        }
        let state = if merged.is_final { "final" } else { "not final" };
        println!(
            "{} of {} routes, {}, {state}",
            merged.done, merged.total, merged.entry_status
        );
        Ok(())
    }

    fn plan(&self) -> Result<Plan, String> {
        let format = match self.format {
            FormatName::V1 => Format::V1,
            FormatName::V2 => Format::V2,
        };
        let mut plan = Plan {
            as_original: self.as_original,
            ..Plan::lenient(format)
        };
        if let (Some(workers), Some(routes)) = (self.workers, self.routes) {
            if workers != self.inputs.len() {
                return Err(format!(
                    "--workers {workers}, but {} files are named; name absent ones too",
                    self.inputs.len()
                ));
            }
            let routes_in_all = usize::try_from(routes).map_err(|e| e.to_string())?;
            plan.pairs = crate::api::effective::slices(routes_in_all, workers)
                .iter()
                .filter_map(|slice| crate::api::effective::slice_bounds(slice))
                .map(|(first, last)| leaderboard_results::Slice { first, last })
                .collect();
            plan.routes = routes;
            plan.repetitions = self.repetitions.unwrap_or(match format {
                Format::V1 => 5,
                Format::V2 => 1,
            });
        }
        Ok(plan)
    }
}

fn read(path: &Path) -> Result<Option<Vec<u8>>, String> {
    match fs::read(path) {
        Ok(bytes) => Ok(Some(bytes)),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => {
            eprintln!("{} is absent: that worker has no results", path.display());
            Ok(None)
        }
        Err(error) => Err(format!("{} cannot be read: {error}", path.display())),
    }
}

fn write_all(out: &Path, merged: &str, files: &Files) -> Result<(), String> {
    fs::create_dir_all(out).map_err(|e| format!("{} cannot be made: {e}", out.display()))?;
    put(out, "agent_results.json", merged)?;
    put(out, "results.json", &files.results_json)?;
    put(out, "stdout.txt", &files.stdout_txt)?;
    files
        .metadata_json
        .as_deref()
        .map_or(Ok(()), |text| put(out, "metadata.json", text))
}

/// Under another name first, so that a full disk leaves the older file whole.
fn put(out: &Path, name: &str, text: &str) -> Result<(), String> {
    let (target, part) = (out.join(name), out.join(format!(".{name}.part")));
    let write = || -> std::io::Result<()> {
        let mut file = fs::File::create(&part)?;
        file.write_all(text.as_bytes())?;
        file.sync_all()?;
        fs::rename(&part, &target)
    };
    write().map_err(|e| format!("{} cannot be written: {e}", target.display()))
}
