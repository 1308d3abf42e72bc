//! The Leaderboard's evaluator: runs a worker's routes against a simulator, keeps the checkpoint, resumes from it. Called
//! by `challenge-agent`. What happens on a route comes from `scenario`, what goes wrong on purpose from `faults`.

use std::{
    fs,
    io::{self, Write},
    path::{Path, PathBuf},
    thread,
    time::{Duration, Instant},
};

use crate::{
    checkpoint::{self, Checkpoint, Saved},
    faults::Faults,
    flags::{Format, Invocation},
    knobs::Knobs,
    link::{Link, NoSimulator},
    routes::{self, SubsetError},
    scenario::{self, Leg, Outcome, Scenario},
    statistics,
};

/// Packages the Leaderboard imports, each from another of the shared folders.
const MODULES: [&str; 3] = ["leaderboard", "srunner", "agents"];

/// A copy that does not come is not waited for any longer.
const COPY_PATIENCE: Duration = Duration::from_secs(10);

/// What does not come from the command line.
#[derive(Debug)]
pub struct Environment {
    /// How long each route takes.
    pub route_time: Duration,
    /// No route ends before this file holds what the checkpoint holds.
    pub route_copy: Option<PathBuf>,
    pub knobs: Knobs,
    /// `PYTHONPATH`.
    pub python_path: Vec<PathBuf>,
}

/// How an evaluation ended that did not break down.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ending {
    /// All routes have a record, and the file a global one.
    Finished,
    /// The simulator went away or the sensors were refused: no global record. The evaluator exits 255.
    Stopped,
}

/// Why an evaluation could not be done. Python would show a traceback and exit 1.
#[derive(Debug, thiserror::Error)]
pub enum EvaluatorError {
    #[error("ModuleNotFoundError: No module named '{0}'; it is in no folder of PYTHONPATH")]
    NoModule(&'static str),
    #[error("ModuleNotFoundError: No module named '{0}'; --agent names no file")]
    NoAgent(String),
    #[error("{what} {path} can't be read: {source}")]
    Read {
        what: &'static str,
        path: PathBuf,
        source: io::Error,
    },
    #[error("{what} {path} is not what it should be: {source}")]
    Parse {
        what: &'static str,
        path: PathBuf,
        source: serde_json::Error,
    },
    #[error("ValueError: {0}")]
    Subset(#[from] SubsetError),
    #[error("{path} holds nothing of the route '{route}'")]
    UnknownRoute { path: PathBuf, route: String },
    #[error("RuntimeError: {0}")]
    NoSimulator(#[from] NoSimulator),
    #[error("{path} can't be written: {source}")]
    Write { path: PathBuf, source: io::Error },
}

/// Runs the evaluation.
pub fn run(invocation: &Invocation, environment: Environment) -> Result<Ending, EvaluatorError> {
    let faults = Faults::new(environment.knobs, invocation.format, &invocation.checkpoint);
    faults.at_start();
    check_imports(invocation, &environment.python_path)?;
    let Plan { sensors, legs } = plan(invocation)?;
    let link = Link::connect(invocation.port)?;
    let file = Checkpoint::new(invocation.format, legs.len());
    let mut worker = Worker {
        invocation,
        route_time: environment.route_time,
        route_copy: environment.route_copy,
        faults,
        sensors,
        legs,
        link,
        file,
    };
    let ending = worker.evaluate()?;
    worker.faults.at_end();
    Ok(ending)
}

fn check_imports(invocation: &Invocation, python_path: &[PathBuf]) -> Result<(), EvaluatorError> {
    for module in MODULES {
        if !python_path.iter().any(|folder| folder.join(module).is_dir()) {
            return Err(EvaluatorError::NoModule(module));
        }
    }
    if !invocation.agent.is_file() {
        let name = invocation.agent.file_stem().unwrap_or_default();
        return Err(EvaluatorError::NoAgent(name.to_string_lossy().into_owned()));
    }
    Ok(())
}

struct Plan {
    sensors: Vec<String>,
    /// The worker's routes, each with what happens on it; the repetitions of a route lie next to each other, as the
    /// Leaderboard orders them.
    legs: Vec<(Leg, Outcome)>,
}

fn plan(invocation: &Invocation) -> Result<Plan, EvaluatorError> {
    if let Some(path) = &invocation.scenarios {
        json::<serde_json::Value>("the scenarios file", path)?;
    }
    let ids = routes::ids(&read("the routes file", &invocation.routes)?);
    let path = invocation.routes.with_file_name("scenario.json");
    let scenario: Scenario = json("the table of outcomes", &path)?;
    let mut legs = Vec::new();
    for route in routes::select(&ids, &invocation.routes_subset)? {
        let Some(outcome) = scenario.routes.get(&route) else {
            return Err(EvaluatorError::UnknownRoute { path, route });
        };
        for repetition in 0..invocation.repetitions {
            legs.push((
                Leg {
                    index: legs.len(),
                    route: route.clone(),
                    repetition,
                },
                outcome.clone(),
            ));
        }
    }
    Ok(Plan {
        sensors: scenario.sensors,
        legs,
    })
}

fn read(what: &'static str, path: &Path) -> Result<String, EvaluatorError> {
    fs::read_to_string(path).map_err(|source| EvaluatorError::Read {
        what,
        path: path.to_path_buf(),
        source,
    })
}

fn json<T: serde::de::DeserializeOwned>(what: &'static str, path: &Path) -> Result<T, EvaluatorError> {
    serde_json::from_str(&read(what, path)?).map_err(|source| EvaluatorError::Parse {
        what,
        path: path.to_path_buf(),
        source,
    })
}

struct Worker<'a> {
    invocation: &'a Invocation,
    route_time: Duration,
    route_copy: Option<PathBuf>,
    faults: Faults,
    sensors: Vec<String>,
    legs: Vec<(Leg, Outcome)>,
    link: Link,
    file: Checkpoint,
}

impl Worker<'_> {
    fn evaluate(&mut self) -> Result<Ending, EvaluatorError> {
        let start = self.resume()?;
        self.file.routes.progress[0] = start;
        self.write(start)?;
        for (leg, outcome) in self.legs.split_off(start) {
            say(&format!(
                "\n========= Preparing {} (repetition {}) =========",
                leg.id(self.format()),
                leg.repetition
            ));
            let stop = self.route(&leg, &outcome)?;
            if stop.is_none() || self.format() == Format::V2 {
                self.file.routes.progress[0] = leg.index + 1;
            }
            self.write(leg.index + 1)?;
            if stop.is_some() {
                return Ok(Ending::Stopped);
            }
            if self.faults.ends_early(leg.index + 1) {
                break;
            }
        }
        say("> Registering the global statistics");
        self.finish();
        self.write(self.file.routes.records.len())?;
        Ok(Ending::Finished)
    }

    /// Takes up an earlier file, or clears it; the index of the first route to run.
    fn resume(&mut self) -> Result<usize, EvaluatorError> {
        let earlier = if self.invocation.resume {
            checkpoint::saved(&self.invocation.checkpoint)
        } else {
            None
        };
        let Some((start, saved)) = earlier.and_then(|saved| Some((self.first_route(&saved)?, saved))) else {
            let cleared = fs::OpenOptions::new()
                .write(true)
                .truncate(true)
                .open(&self.invocation.checkpoint);
            return match cleared {
                Err(error) if error.kind() != io::ErrorKind::NotFound => Err(self.unwritable(error)),
                _ => Ok(0),
            };
        };
        say(&format!("> Resuming at route {} of {}", start + 1, self.legs.len()));
        self.file.routes.records = saved.routes.records;
        self.file.routes.records.truncate(start);
        self.file.sensors = saved.sensors;
        if start > 0 {
            self.started();
        }
        Ok(start)
    }

    /// V2 repeats the route in which it crashed and compares the ids of those before; V1 trusts its progress.
    fn first_route(&self, saved: &Saved) -> Option<usize> {
        let &[done, total] = saved.routes.progress.as_slice() else {
            return None;
        };
        let records = &saved.routes.records;
        let repeat = usize::from(self.format() == Format::V2 && saved.entry_status == "Crashed");
        let start = done.saturating_sub(repeat).min(records.len());
        let same = records
            .iter()
            .zip(&self.legs)
            .all(|(record, (leg, _))| record.route_id == leg.id(self.format()));
        (total == self.legs.len() && (same || self.format() == Format::V1)).then_some(start)
    }

    /// Runs one route up to its record. Returns with which entry status the evaluation stops, if it does.
    fn route(&mut self, leg: &Leg, outcome: &Outcome) -> Result<Option<&'static str>, EvaluatorError> {
        let (format, number) = (self.format(), leg.index + 1);
        self.started();
        if let Some(path) = &self.invocation.debug_checkpoint {
            fs::write(path, format!("Route id: {}\n", leg.id(format))).map_err(|source| EvaluatorError::Write {
                path: path.clone(),
                source,
            })?;
        }
        say("> Setting up the agent");
        self.file.sensors.clone_from(&self.sensors);
        let (record, stop) = if self.faults.rejects(number) {
            say("The sensor's configuration used is invalid");
            (scenario::rejected(format, leg), Some("Rejected"))
        } else if drive(&mut self.link, &self.faults, self.invocation, self.route_time, leg) {
            let mut record = outcome.record(format, leg);
            self.faults.falsify(number, &mut record);
            (record, None)
        } else {
            say("> The simulation crashed");
            (outcome.broken_off(format, leg), Some("Crashed"))
        };
        self.await_copy();
        say("> Registering the route statistics");
        self.file.routes.records.truncate(leg.index);
        self.file.routes.records.push(record);
        if let Some(status) = stop {
            status.clone_into(&mut self.file.entry_status);
        } else if format == Format::V1 {
            // V1 saves the record first and the progress after it.
            self.write(number)?;
        }
        Ok(stop)
    }

    fn finish(&mut self) {
        let records = &self.file.routes.records;
        let global = statistics::global(self.format(), records);
        let agent_errors = self.format() == Format::V1 && records.iter().any(|record| record.status.contains("Agent"));
        let status = if agent_errors {
            "Finished with agent errors"
        } else {
            "Finished"
        };
        status.clone_into(&mut self.file.entry_status);
        self.file.eligible = true.into();
        self.file.values = statistics::values(self.format(), &global);
        self.file.labels = statistics::labels(self.format());
        self.file.routes.global_record = Some(global);
    }

    /// Routes of real challenges take minutes, those of tests must take at least as long as a copy of the checkpoint.
    fn await_copy(&self) {
        let Some(copy) = &self.route_copy else { return };
        let begin = Instant::now();
        let differ = || fs::read(copy).ok() != fs::read(&self.invocation.checkpoint).ok();
        while differ() && begin.elapsed() < COPY_PATIENCE {
            thread::sleep(Duration::from_millis(1));
        }
    }

    fn started(&mut self) {
        "Started".clone_into(&mut self.file.entry_status);
        self.file.eligible = false.into();
    }

    fn write(&self, number: usize) -> Result<(), EvaluatorError> {
        self.faults
            .write(&self.file, number)
            .map_err(|source| self.unwritable(source))
    }

    fn unwritable(&self, source: io::Error) -> EvaluatorError {
        EvaluatorError::Write {
            path: self.invocation.checkpoint.clone(),
            source,
        }
    }

    fn format(&self) -> Format {
        self.invocation.format
    }
}

/// False if the simulator went away.
fn drive(link: &mut Link, faults: &Faults, invocation: &Invocation, time: Duration, leg: &Leg) -> bool {
    say("> Running the route");
    if link.begin(&leg.route).is_err() {
        return false;
    }
    faults.in_route(leg.index + 1, &invocation.routes);
    link.drive(time, |passed| {
        say(&format!("route {}: {} s", leg.route, passed.as_secs()));
    })
    .is_ok()
}

/// A reader of the log that went away is not the evaluator's end.
fn say(line: &str) {
    let _ = writeln!(io::stdout(), "{line}");
}
