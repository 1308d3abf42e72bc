//! The Leaderboard's evaluator: runs a worker's routes against a simulator, keeps the checkpoint, resumes from it, and writes it
//! at the moments of the original. Called by `challenge-agent`. `scenario` decides how a route ends, and `faults` has the faults on
//! purpose.

use std::{
    fs,
    io::{self, Write},
    path::{Path, PathBuf},
    thread,
    time::{Duration, Instant},
};

use crate::{
    checkpoint::{self, CRASHED, Checkpoint, Record},
    faults::Faults,
    flags::{Format, Invocation},
    knobs::Knobs,
    link::{Link, NoSimulator},
    resume,
    routes::{self, SubsetError},
    scenario::{Leg, NOT_LOADED, Outcome, Scenario},
    statistics,
};

/// Packages the Leaderboard imports, each from another of the shared folders.
const MODULES: [&str; 3] = ["leaderboard", "srunner", "agents"];

const STARTED: &str = "Started";
/// A copy that does not come is not waited for any longer.
const COPY_PATIENCE: Duration = Duration::from_secs(10);

/// Settings that do not come from the command line.
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
    #[error("AttributeError: 'NoneType' object has no attribute 'get_actors'")]
    NoWorld,
    #[error("{path} can't be written: {source}")]
    Write { path: PathBuf, source: io::Error },
}

impl EvaluatorError {
    /// It comes once the evaluator is set up.
    pub fn is_of_the_run(&self) -> bool {
        !matches!(self, Self::NoModule(_) | Self::NoAgent(_) | Self::NoSimulator(_))
    }
}

/// Runs the evaluation.
pub fn run(invocation: &Invocation, environment: Environment) -> Result<Ending, EvaluatorError> {
    let faults = Faults::new(environment.knobs, invocation.format, &invocation.checkpoint);
    faults.at_start();
    check_imports(invocation, &environment.python_path)?;
    let link = Link::connect(invocation.port)?;
    let Plan { sensors, legs } = plan(invocation)?;
    let mut worker = Worker {
        invocation,
        route_time: environment.route_time,
        route_copy: environment.route_copy,
        file: Checkpoint::new(invocation.format, legs.len()),
        faults,
        sensors,
        legs,
        link,
        resumes: invocation.resume,
        is_set_up: false,
        has_world: false,
    };
    let ending = match worker.replayed()? {
        Some(ending) => ending,
        None => worker.evaluate()?,
    };
    if ending == Ending::Finished && worker.faults.starts_once_more() {
        worker.start_once_more()?;
    }
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
    resumes: bool,
    /// The sensors of this process are known.
    is_set_up: bool,
    /// This process has loaded a world.
    has_world: bool,
}

/// The end of a route.
struct Driven {
    record: Record,
    /// The entry status: all but `Started` stop the evaluation.
    entry: &'static str,
}

impl Worker<'_> {
    fn evaluate(&mut self) -> Result<Ending, EvaluatorError> {
        let start = match self.format() {
            Format::V1 => self.begin_v1()?,
            Format::V2 => self.begin_v2()?,
        };
        for (leg, outcome) in self.legs.get(start..).unwrap_or_default().to_vec() {
            let number = leg.index + 1;
            say(&format!(
                "\n========= Preparing {} (repetition {}) =========",
                leg.id(self.format()),
                leg.repetition
            ));
            let driven = self.route(&leg, &outcome)?;
            let stops = driven.entry != STARTED;
            if !(stops && self.faults.loses_record(number)) {
                self.register(&leg, driven)?;
            }
            if !stops || self.format() == Format::V2 {
                self.file.routes.progress = vec![number, self.legs.len()];
                self.write(number)?;
            }
            if stops {
                return Ok(Ending::Stopped);
            }
            self.faults.after_route(number);
            if self.faults.ends_early(number) {
                break;
            }
        }
        say("> Registering the global statistics");
        self.finish();
        self.write(self.file.routes.records.len())?;
        Ok(Ending::Finished)
    }

    /// V1 takes up an earlier file without a look at its routes, and edits it from then on; it writes nothing before its first
    /// set-up. The index of the first route to run.
    fn begin_v1(&mut self) -> Result<usize, EvaluatorError> {
        if !self.resumes {
            self.clear()?;
            self.write(0)?;
            return Ok(0);
        }
        if let Some(saved) = checkpoint::saved(&self.invocation.checkpoint) {
            self.file = saved;
        } else {
            self.file.routes.progress.clear();
        }
        let done = self.file.routes.progress.first().copied().unwrap_or(0);
        let start = if done <= self.legs.len() { done } else { 0 };
        self.say_resuming(start);
        Ok(start)
    }

    /// V2 takes of an earlier file its records and nothing else, and writes that at once.
    fn begin_v2(&mut self) -> Result<usize, EvaluatorError> {
        self.file = Checkpoint::new(Format::V2, self.legs.len());
        let earlier = if self.resumes {
            checkpoint::saved(&self.invocation.checkpoint)
        } else {
            None
        };
        let resumed = earlier.and_then(|saved| Some((resume::first_route(&saved, &self.ids())?, saved)));
        let start = if let Some((start, saved)) = resumed {
            self.say_resuming(start);
            self.file.routes.records = saved.routes.records;
            start
        } else {
            self.clear()?;
            0
        };
        self.file.routes.progress = vec![start, self.legs.len()];
        self.write(start)?;
        Ok(start)
    }

    fn ids(&self) -> Vec<String> {
        self.legs.iter().map(|(leg, _)| leg.id(self.format())).collect()
    }

    fn say_resuming(&self, start: usize) {
        say(&format!("> Resuming at route {} of {}", start + 1, self.legs.len()));
    }

    fn clear(&self) -> Result<(), EvaluatorError> {
        let cleared = fs::OpenOptions::new()
            .write(true)
            .truncate(true)
            .open(&self.invocation.checkpoint);
        match cleared {
            Err(error) if error.kind() != io::ErrorKind::NotFound => Err(self.unwritable(error)),
            _ => Ok(()),
        }
    }

    /// Runs one route up to its record.
    fn route(&mut self, leg: &Leg, outcome: &Outcome) -> Result<Driven, EvaluatorError> {
        let format = self.format();
        if format == Format::V2 && leg.index < self.file.routes.records.len() {
            // A route under way is not in the file, and what an earlier process has of it is no longer.
            self.file.routes.records.remove(leg.index);
        }
        if let Some(path) = &self.invocation.debug_checkpoint {
            fs::write(path, format!("Route id: {}\n", leg.id(format))).map_err(|source| EvaluatorError::Write {
                path: path.clone(),
                source,
            })?;
        }
        let not_loaded = || Driven {
            record: outcome.not_begun(format, leg, NOT_LOADED),
            entry: CRASHED,
        };
        if format == Format::V2 && !self.load_world(leg)? {
            return Ok(not_loaded());
        }
        if let Some(failed) = self.set_up(leg, outcome)? {
            return Ok(failed);
        }
        if format == Format::V1 && !self.load_world(leg)? {
            return Ok(not_loaded());
        }
        let driven = if drive(&mut self.link, &self.faults, self.invocation, self.route_time, leg) {
            let mut record = outcome.record(format, leg);
            self.faults.falsify(leg.index + 1, &mut record);
            let entry = STARTED;
            Driven { record, entry }
        } else {
            say("> The simulation crashed");
            let (record, entry) = (outcome.broken_off(format, leg), CRASHED);
            Driven { record, entry }
        };
        self.await_copy();
        Ok(driven)
    }

    /// Without a world of its own V2 falls over its own clearing up, before it has written anything.
    fn load_world(&mut self, leg: &Leg) -> Result<bool, EvaluatorError> {
        say("> Loading the world");
        let is_loaded = !self.faults.keeps_from_loading(leg.index + 1) && self.link.load(&leg.route).is_ok();
        if !is_loaded {
            say("The scenario could not be loaded");
            if self.format() == Format::V2 && !self.has_world {
                return Err(EvaluatorError::NoWorld);
            }
        }
        self.has_world |= is_loaded;
        Ok(is_loaded)
    }

    /// Sets up the agent. The first set-up of a process stores the sensors, V1's only if the file has none.
    fn set_up(&mut self, leg: &Leg, outcome: &Outcome) -> Result<Option<Driven>, EvaluatorError> {
        let (format, number) = (self.format(), leg.index + 1);
        say("> Setting up the agent");
        let failed = if self.faults.rejects(number) {
            Some(("Agent's sensors were invalid", "Rejected"))
        } else if self.faults.keeps_from_setting_up(number) {
            Some(("Agent couldn't be set up", STARTED))
        } else {
            None
        };
        if let Some((why, entry)) = failed {
            say(&format!("The set-up failed: {why}"));
            let record = outcome.not_begun(format, leg, why);
            return Ok(Some(Driven { record, entry }));
        }
        let is_first = !std::mem::replace(&mut self.is_set_up, true);
        if is_first && (format == Format::V2 || self.file.sensors.is_empty()) {
            self.file.sensors.clone_from(&self.sensors);
            self.write(leg.index)?;
        }
        Ok(None)
    }

    /// V1 writes after each step, V2 once at the end of the route.
    fn register(&mut self, leg: &Leg, driven: Driven) -> Result<(), EvaluatorError> {
        say("> Registering the route statistics");
        let (records, number) = (&mut self.file.routes.records, leg.index + 1);
        if self.invocation.format == Format::V2 {
            records.insert(leg.index.min(records.len()), driven.record);
        } else {
            match records.get_mut(leg.index) {
                Some(record) => *record = driven.record,
                None => records.push(driven.record),
            }
            self.write(number)?;
        }
        driven.entry.clone_into(&mut self.file.entry_status);
        self.file.eligible = false.into();
        match self.format() {
            Format::V1 => self.write(number),
            Format::V2 => Ok(()),
        }
    }

    fn finish(&mut self) {
        let records = &self.file.routes.records;
        let global = statistics::global(self.format(), records);
        let status = statistics::entry_status(self.format(), records);
        status.clone_into(&mut self.file.entry_status);
        self.file.eligible = status.starts_with("Finished").into();
        self.file.values = statistics::values(self.format(), &global);
        self.file.labels = statistics::labels(self.format());
        self.file.routes.global_record = Some(global);
    }

    /// With the knob `replay` a file of a real evaluator takes the place of an evaluation that begins.
    fn replayed(&self) -> Result<Option<Ending>, EvaluatorError> {
        let path = &self.invocation.checkpoint;
        let Some(file) = self.faults.replays() else {
            return Ok(None);
        };
        if self.resumes && checkpoint::saved(path).is_some() {
            return Ok(None);
        }
        let text = read("the file to replay", &self.invocation.routes.with_file_name(file))?;
        let written = self.faults.write_text(&text, 0);
        written.map_err(|source| self.unwritable(source))?;
        say(&format!("> Replaying {file}"));
        match checkpoint::saved(path) {
            Some(saved) if saved.routes.global_record.is_some() => Ok(Some(Ending::Finished)),
            Some(saved) if saved.entry_status != STARTED => Ok(Some(Ending::Stopped)),
            _ => Err(EvaluatorError::NoWorld),
        }
    }

    /// Does what another process would do to the complete file.
    fn start_once_more(&mut self) -> Result<Ending, EvaluatorError> {
        (self.resumes, self.is_set_up, self.has_world) = (true, false, false);
        self.evaluate()
    }

    /// Routes of real challenges take minutes, those of tests must take at least as long as a copy of the checkpoint.
    fn await_copy(&self) {
        let Some(copy) = self
            .route_copy
            .as_ref()
            .filter(|_| !self.file.routes.progress.is_empty())
        else {
            return;
        };
        let begin = Instant::now();
        let differ = || fs::read(copy).ok() != fs::read(&self.invocation.checkpoint).ok();
        while differ() && begin.elapsed() < COPY_PATIENCE {
            thread::sleep(Duration::from_millis(1));
        }
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
