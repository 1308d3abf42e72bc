//! Subcommands that need no cluster: `crd` and `results`.

use std::fs::{self, File};
use std::io::{ErrorKind, Read as _, Write as _};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::Args;
use clap::builder::{PossibleValuesParser, TypedValueParser};
use leaderboard_results::{Files, Format, Merged, PairProgress, Plan, Refusal, Slice, Verify, offline};

use crate::crds;
use leaderboard_api::{RouteSlice, effective};

/// Exit code of a refusal: nothing that had been good is overwritten.
const REFUSED: u8 = 2;
/// One byte more than the largest checkpoint, so that a larger one is known as such without being read.
const READ_LIMIT: u64 = (64 << 20) + 1;

/// Prints both definitions as one YAML stream.
pub(super) fn print_crds() -> ExitCode {
    let printed = crds::all().map_err(|error| error.to_string()).and_then(|text| {
        match std::io::stdout().write_all(text.as_bytes()) {
            Err(error) if error.kind() != ErrorKind::BrokenPipe => Err(error.to_string()),
            _ => Ok(()),
        }
    });
    match printed {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("leaderboard-operator: {error}");
            ExitCode::FAILURE
        }
    }
}

/// The formats by their names.
pub(super) fn formats() -> impl TypedValueParser<Value = Format> {
    PossibleValuesParser::new(["v1", "v2"]).map(|name| if name == "v1" { Format::V1 } else { Format::V2 })
}

fn verifications() -> impl TypedValueParser<Value = Verify> {
    PossibleValuesParser::new(["disabled", "warn", "refuse"]).map(|name| match name.as_str() {
        "disabled" => Verify::Disabled,
        "warn" => Verify::Warn,
        _ => Verify::Refuse,
    })
}

/// Exit codes of `results`, for its help.
pub(super) const EXIT_CODES: &str = "Exit code 0: the four files are written. 2: the files or the arguments are refused. 1: \
    something can't be read or written. Unless it is 0, what had been in the folder is still there.";

/// Merges the checkpoint files of the workers of a CARLA run and renders what EvalAI gets.
#[derive(Args, Debug)]
pub(super) struct Results {
    /// Format of the checkpoints.
    #[arg(long, value_parser = formats())]
    format: Format,
    /// Folder for agent_results.json, results.json, stdout.txt and metadata.json.
    #[arg(long)]
    out: PathBuf,
    /// How many workers there were; with --routes, a missing worker is not final.
    #[arg(long, requires = "routes")]
    workers: Option<usize>,
    /// Routes of the whole run, not counting repetitions.
    #[arg(long, requires = "workers")]
    routes: Option<u32>,
    /// The routes of each worker, if they were not shared out as the operator does: 0-10,11-21,22-31,32-41. In place of --workers and
    /// --routes.
    #[arg(long, value_delimiter = ',', conflicts_with_all = ["workers", "routes"])]
    slices: Vec<RouteSlice>,
    /// How often each route was driven; default 5 in V1, 1 in V2.
    #[arg(long)]
    repetitions: Option<u32>,
    /// Decide as the original does, its mistakes included.
    #[arg(long)]
    as_original: bool,
    /// What to do about scores that do not follow from the infractions.
    #[arg(long, value_parser = verifications(), default_value = "warn")]
    verify: Verify,
    /// The workers' files in order; an absent file is a worker without results.
    #[arg(required = true)]
    inputs: Vec<PathBuf>,
}

/// Why there are no new files.
#[derive(thiserror::Error, Debug)]
enum Failure {
    #[error("{0}. {next}", next = .0.next_step())]
    Refused(#[from] Refusal),
    #[error("{0}")]
    Arguments(String),
    #[error("{} can't be {what}: {error}", .path.display())]
    File {
        path: PathBuf,
        what: &'static str,
        error: std::io::Error,
    },
}

impl Failure {
    fn exit_code(&self) -> ExitCode {
        match self {
            Self::Refused(_) | Self::Arguments(_) => ExitCode::from(REFUSED),
            Self::File { .. } => ExitCode::FAILURE,
        }
    }
}

impl Results {
    pub(super) fn run(self) -> ExitCode {
        match self.merge() {
            Ok(summary) => {
                // A closed pipe is ignored.
                let _ = writeln!(std::io::stdout(), "{summary}");
                ExitCode::SUCCESS
            }
            Err(failure) => {
                eprintln!("leaderboard-operator results: {failure}");
                failure.exit_code()
            }
        }
    }

    fn merge(&self) -> Result<String, Failure> {
        let plan = self.plan()?;
        let inputs = self
            .inputs
            .iter()
            .map(|path| read(path))
            .collect::<Result<Vec<_>, _>>()?;
        let (merged, files) = offline(&plan, &inputs)?;
        write_all(&self.out, &merged.text, &files)?;
        for warning in &merged.warnings {
            eprintln!("warning: {warning}");
        }
        if merged.ended_as() != merged.entry_status {
            let (file, run) = (&merged.entry_status, merged.ended_as());
            eprintln!("the merged file says {file}, as the original's; this run counts as {run}");
        }
        for reason in self.why_not_final(&merged) {
            eprintln!("not final: {reason}");
        }
        let state = if merged.is_final { "final" } else { "not final" };
        let (done, total, status) = (merged.done, merged.total, merged.ended_as());
        Ok(format!("{done} of {total} routes, {status}, {state}"))
    }

    /// Each worker that has another number of route runs than it should, in a sentence.
    fn why_not_final(&self, merged: &Merged) -> Vec<String> {
        if merged.is_final {
            return Vec::new();
        }
        let workers = (1..).zip(self.inputs.iter().zip(&merged.pairs));
        let differing = workers.filter(|(_, (_, pair))| pair.done != pair.total);
        let sentence = |(number, (path, pair)): (u32, (&PathBuf, &PairProgress))| {
            let PairProgress { done, total, .. } = *pair;
            let file = path.display();
            if done < total {
                format!("worker {number} ({file}) has {done} of its {total} route runs")
            } else {
                format!(
                    "worker {number} ({file}) has {done} route runs, more than its {total}; --slices gives the routes of each"
                )
            }
        };
        let reasons: Vec<String> = differing.map(sentence).collect();
        if reasons.is_empty() {
            return vec!["the files promise no route".to_owned()];
        }
        reasons
    }

    fn plan(&self) -> Result<Plan, Failure> {
        let plan = Plan {
            as_original: self.as_original,
            verify: self.verify,
            ..Plan::lenient(self.format)
        };
        let pairs: Vec<Slice> = self.slices()?.into_iter().map(of_plan).collect();
        if pairs.is_empty() {
            return match self.repetitions {
                None => Ok(plan),
                Some(_) => Err(Failure::Arguments(
                    "--repetitions needs --workers and --routes, or --slices".to_owned(),
                )),
            };
        }
        let usual = match self.format {
            Format::V1 => 5,
            Format::V2 => 1,
        };
        let plan = Plan {
            routes: pairs.iter().map(|slice| slice.routes()).fold(0, u32::saturating_add),
            pairs,
            repetitions: self.repetitions.unwrap_or(usual),
            ..plan
        };
        plan.check()?;
        Ok(plan)
    }

    /// The routes of each worker; none where the files are to decide.
    fn slices(&self) -> Result<Vec<RouteSlice>, Failure> {
        let files = self.inputs.len();
        let (Some(workers), Some(routes)) = (self.workers, self.routes) else {
            let slices = self.slices.len();
            if slices != 0 && slices != files {
                let words = format!("--slices has {slices}, but {files} files are named; name absent ones too");
                return Err(Failure::Arguments(words));
            }
            return Ok(self.slices.clone());
        };
        if workers != files {
            let words = format!("--workers {workers}, but {files} files are named; name absent ones too");
            return Err(Failure::Arguments(words));
        }
        let routes_in_all = usize::try_from(routes).unwrap_or(usize::MAX);
        if workers > routes_in_all {
            let words = format!("--routes {routes} can't be shared out over {workers} workers: some would have none");
            return Err(Failure::Arguments(words));
        }
        Ok(effective::slices(routes_in_all, workers))
    }
}

fn of_plan(RouteSlice { first, last }: RouteSlice) -> Slice {
    Slice { first, last }
}

fn read(path: &Path) -> Result<Option<Vec<u8>>, Failure> {
    let bytes = File::open(path).and_then(|file| {
        let size = file.metadata()?.len().min(READ_LIMIT);
        let mut bytes = Vec::with_capacity(usize::try_from(size).unwrap_or_default());
        file.take(READ_LIMIT).read_to_end(&mut bytes)?;
        Ok(bytes)
    });
    match bytes {
        Ok(bytes) => Ok(Some(bytes)),
        Err(error) if error.kind() == ErrorKind::NotFound => {
            eprintln!("{} is absent: that worker has no results", path.display());
            Ok(None)
        }
        Err(error) => Err(failed(path, "read", error)),
    }
}

fn failed(path: &Path, what: &'static str, error: std::io::Error) -> Failure {
    Failure::File {
        path: path.to_owned(),
        what,
        error,
    }
}

/// All files or none: each is written under another name, and only when all of them are on the disk do they take their
/// places.
fn write_all(out: &Path, merged: &str, files: &Files) -> Result<(), Failure> {
    fs::create_dir_all(out).map_err(|error| failed(out, "made", error))?;
    let mut texts = vec![
        ("agent_results.json", merged),
        ("results.json", files.results_json.as_str()),
        ("stdout.txt", files.stdout_txt.as_str()),
    ];
    texts.extend(files.metadata_json.as_deref().map(|text| ("metadata.json", text)));
    let staged = |name: &str| out.join(format!(".{name}.{}", std::process::id()));
    let each = |step: &dyn Fn(&Path, &Path, &str) -> std::io::Result<()>| {
        texts.iter().try_for_each(|(name, text)| {
            let target = out.join(name);
            step(&target, &staged(name), text).map_err(|error| failed(&target, "written", error))
        })
    };
    let done = each(&stage).and_then(|()| each(&|target, staged, _| fs::rename(staged, target)));
    if done.is_err() {
        for (name, _) in &texts {
            // The files that this call wrote go; most of them may not be there.
            let _ = fs::remove_file(staged(name));
        }
    }
    done
}

fn stage(target: &Path, staged: &Path, text: &str) -> std::io::Result<()> {
    // The one thing a rename does not replace.
    if target.is_dir() {
        return Err(ErrorKind::IsADirectory.into());
    }
    let mut file = File::create_new(staged)?;
    file.write_all(text.as_bytes())?;
    file.sync_all()
}
