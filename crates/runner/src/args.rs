//! The command line: parsed here once into a [`Job`] that cannot hold nonsense. Called by `main`; reads and changes nothing else.

use std::ffi::{OsStr, OsString};
use std::num::NonZeroU16;
use std::os::unix::ffi::{OsStrExt, OsStringExt};
use std::path::PathBuf;
use std::str::FromStr;
use std::time::Duration;

use thiserror::Error;

use leaderboard_protocol::files::{Host, Member, Pair, RESULT};
use leaderboard_protocol::graphics::Needs;

pub const USAGE: &str = "\
usage: leaderboard-runner simulator --pair N --status DIR --port P [options] -- CMD ARGS...
       leaderboard-runner evaluator --pair N --status DIR --results DIR [options] -- CMD ARGS...
       leaderboard-runner agent --pair N --status DIR --checkpoint FILE [options] -- CMD ARGS...
       leaderboard-runner agent --pair N --status DIR --host evaluator [options] -- CMD ARGS...
       leaderboard-runner keep --log FILE [--log-limit BYTES] -- CMD ARGS...
       leaderboard-runner copy --from DIR --to DIR [--termination-log FILE]
       leaderboard-runner --version | --help

Runs CMD as one container of a pair, which is a simulator or an evaluator and its agent, and speaks the status-file protocol in DIR; `keep`
runs CMD and keeps its output; `copy` copies a folder's files, folders and links.

all:        --ready-seconds 3600   how long a simulator or an evaluator may take until it listens on its port
            --grace-seconds 20     between SIGTERM and SIGKILL; 30 for an evaluator
            --peer-seconds 600     how long to wait for the other side's end of a round
            --log-limit 2147483648 bytes of output that are kept in the log
            --termination-log /dev/termination-log  where the verdict is written
            --inotify true         false: files are looked for once a second
            --root /               where devices and drivers are looked for
simulator   --flush-seconds 1800   how long to hold the exit until the results are stored
and         --cancel-seconds 120   the same after a cancel
evaluator:  --log FILE             where output is kept, too
            --gpu any|vulkan|opengl  CMD needs a GPU, and the driver for what it draws with
            --agent-gpu false      true: the agent is to see one too; it is not let begin before its runner has looked
            --unset A,B            variables that CMD does not get
simulator:  --answer-seconds 10    how long a server may take to answer when its agent has crashed
evaluator:  --port P               it is ready when it listens there; without one, as soon as it is started
            --answer-seconds 600   how long it may take, after its agent's exit with code 0, until its result is complete; alone, from its start
            --alone                there is no agent beside it, and none is waited for or followed
            --after DIR            CMD begins once all pairs before this one are done, with final results at DIR/<pair>/result.json
agent:      --work /tmp/agent      where leaderboard.log is written
            --idle-seconds 800     no output for so long ends the command
            --report-gpu false     true: looks for a GPU before anything else, and reports it to its host
            --alone                with --host evaluator: there is none beside it, and none is waited for or followed
            --leaves DIR           with --alone: after exit code 0 of CMD all users can read the files below it
            --host simulator       evaluator: CMD is a plain program, without the options below
            --python-path A:B:C    put in front of the image's own PYTHONPATH
            --route-runs N         the pair's routes times repetitions: CMD is not started on a checkpoint that has all of them
";

/// Where agents keep their results, as everywhere in the CARLA Leaderboard's cloud.
const WORK: &str = "/tmp/agent";

/// Where the kubelet reads a container's last message. A flag and no variable: the environment is the image's.
const TERMINATION_LOG: &str = "/dev/termination-log";

/// The one option that needs no value.
const ALONE: &str = "--alone";

/// Part of a container in its pair.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Part {
    Simulator,
    /// A simulator's agent, which evaluates itself, and keeps a checkpoint.
    Driver,
    Evaluator,
    /// An evaluator's agent.
    Plain,
}

impl Part {
    pub const fn is_host(self) -> bool {
        matches!(self, Self::Simulator | Self::Evaluator)
    }

    /// True if its results are the pair's, and its peer follows it.
    pub const fn has_last_word(self) -> bool {
        matches!(self, Self::Driver | Self::Evaluator)
    }

    /// Kind of the pair's host.
    pub const fn host(self) -> Host {
        match self {
            Self::Simulator | Self::Driver => Host::Simulator,
            Self::Evaluator | Self::Plain => Host::Evaluator,
        }
    }
}

/// Work of one container. What other parts have is empty.
#[derive(Debug, Clone, PartialEq)]
pub struct Job {
    pub part: Part,
    pub pair: Pair,
    pub status: PathBuf,
    pub ready: Duration,
    pub grace: Duration,
    pub peer: Duration,
    /// Where output is kept. An agent always has one.
    pub log: Option<PathBuf>,
    /// Bytes of output that are kept in the log.
    pub log_limit: u64,
    pub termination_log: PathBuf,
    /// True if changed files wake it; else it looks once a second.
    pub inotify: bool,
    /// Where devices and drivers are looked for.
    pub root: PathBuf,
    /// True if an evaluator, or its agent, has no peer beside it.
    pub alone: bool,
    /// True if the pair's agent is to see a GPU: its runner reports whether it does, and its host's waits for that.
    pub agent_gpu: bool,
    /// A host's time to hold its exit, until the results are stored, and after a cancel.
    pub flush: Duration,
    pub cancel: Duration,
    /// Port on which a host's agent finds it. An evaluator's need not.
    pub port: Option<u16>,
    /// Time that a simulator's server may take to answer when its agent has crashed, or an evaluator from its agent's regular end to the
    /// complete result.
    pub answer: Duration,
    /// Driver that a host's command draws with, if it is to have a GPU.
    pub gpu: Option<Needs>,
    /// Variables that a host's command does not get.
    pub unset: Vec<OsString>,
    /// Folder of an evaluator's result.
    pub results: Option<PathBuf>,
    /// Folder with the results of the pairs before this one, after which an evaluator's command begins.
    pub after: Option<PathBuf>,
    /// How long an agent may print nothing.
    pub idle: Option<Duration>,
    /// A driver's.
    pub checkpoint: Option<PathBuf>,
    pub python_path: Option<OsString>,
    /// How many route runs a driver is to drive, if that is known.
    pub route_runs: Option<u32>,
    /// Folder in which an agent leaves files for its evaluator, if it is alone.
    pub leaves: Option<PathBuf>,
    /// The command and its arguments; never empty.
    pub command: Vec<OsString>,
}

impl Job {
    pub const fn member(&self) -> Member {
        if self.part.is_host() {
            self.pair.host(self.part.host())
        } else {
            self.pair.agent()
        }
    }

    /// The other container of the pair.
    pub const fn peer(&self) -> Member {
        if self.part.is_host() {
            self.pair.agent()
        } else {
            self.pair.host(self.part.host())
        }
    }

    /// The file of an evaluator's result.
    pub fn result(&self) -> Option<PathBuf> {
        self.results.as_ref().map(|folder| folder.join(RESULT))
    }
}

/// A command whose output is kept, and nothing else.
#[derive(Debug, Clone, PartialEq)]
pub struct Kept {
    /// Where its output is kept, too.
    pub log: PathBuf,
    /// Bytes of it that are kept.
    pub log_limit: u64,
    /// The command and its arguments; never empty.
    pub command: Vec<OsString>,
}

/// A folder that is copied, and nothing else.
#[derive(Debug, Clone, PartialEq)]
pub struct Copied {
    pub from: PathBuf,
    pub to: PathBuf,
    pub termination_log: PathBuf,
}

/// Request of the command line.
#[derive(Debug, PartialEq)]
pub enum Request {
    Run(Box<Job>),
    Keep(Kept),
    Copy(Copied),
    Version,
    Help,
}

/// A command line that asks for nothing we can do.
#[derive(Debug, PartialEq, Error)]
pub enum UsageError {
    #[error("no arguments")]
    Nothing,
    #[error("unknown subcommand {0:?}: simulator, evaluator, agent, keep or copy")]
    Subcommand(OsString),
    #[error("{0} is missing")]
    Missing(&'static str),
    #[error("{0} needs a value")]
    NoValue(String),
    #[error("unknown option {0}")]
    Unknown(String),
    #[error("{0} is given twice")]
    Twice(&'static str),
    #[error("{option}: {value:?} is not {expected}")]
    Invalid {
        option: &'static str,
        value: OsString,
        expected: &'static str,
    },
    #[error("the command after -- is missing")]
    NoCommand,
}

/// Parses the arguments after the program's name.
pub fn parse(arguments: impl IntoIterator<Item = OsString>) -> Result<Request, UsageError> {
    let mut arguments = arguments.into_iter();
    let first = arguments.next().ok_or(UsageError::Nothing)?;
    let of_host = match first.to_str() {
        Some("--version" | "-V") => return Ok(Request::Version),
        Some("--help" | "-h" | "help") => return Ok(Request::Help),
        Some("simulator") => Some(Part::Simulator),
        Some("evaluator") => Some(Part::Evaluator),
        Some("agent") => None,
        Some("keep") => return keep(arguments).map(Request::Keep),
        Some("copy") => return copy(arguments).map(Request::Copy),
        _ => return Err(UsageError::Subcommand(first)),
    };
    let mut options = Options::collect(&mut arguments)?;
    let part = match of_host {
        Some(part) => part,
        None => agent(&mut options)?,
    };
    let job = job(part, &mut options, arguments.collect())?;
    options.finish()?;
    if job.command.is_empty() {
        return Err(UsageError::NoCommand);
    }
    Ok(Request::Run(Box::new(job)))
}

/// The part of an agent, by its host.
fn agent(options: &mut Options) -> Result<Part, UsageError> {
    let host = options.take("--host")?;
    match host.as_deref().map(OsStr::as_bytes) {
        None | Some(b"simulator") => Ok(Part::Driver),
        Some(b"evaluator") => Ok(Part::Plain),
        Some(_) => Err(UsageError::Invalid {
            option: "--host",
            value: host.unwrap_or_default(),
            expected: "simulator or evaluator",
        }),
    }
}

fn job(part: Part, options: &mut Options, command: Vec<OsString>) -> Result<Job, UsageError> {
    // An evaluator has to write down what it knows so far.
    let grace = if part == Part::Evaluator { 30 } else { 20 };
    let mut job = Job {
        part,
        pair: options.required("--pair", "a number from 1 to 999")?,
        status: options.path("--status")?,
        ready: options.seconds("--ready-seconds", 3600)?,
        grace: options.seconds("--grace-seconds", grace)?,
        peer: options.seconds("--peer-seconds", 600)?,
        log: None,
        log_limit: options.log_limit()?,
        termination_log: options.termination_log()?,
        inotify: options.optional("--inotify", "true or false")?.unwrap_or(true),
        root: options.place("--root")?.unwrap_or_else(|| "/".into()),
        alone: false,
        agent_gpu: false,
        flush: Duration::ZERO,
        cancel: Duration::ZERO,
        port: None,
        answer: Duration::ZERO,
        gpu: None,
        unset: Vec::new(),
        results: None,
        after: None,
        idle: None,
        checkpoint: None,
        python_path: None,
        route_runs: None,
        leaves: None,
        command,
    };
    if part.is_host() {
        fill_host(&mut job, options)?;
    } else {
        fill_agent(&mut job, options)?;
    }
    Ok(job)
}

fn fill_host(job: &mut Job, options: &mut Options) -> Result<(), UsageError> {
    job.flush = options.seconds("--flush-seconds", 1800)?;
    job.cancel = options.seconds("--cancel-seconds", 120)?;
    job.log = options.place("--log")?.filter(|path| !path.as_os_str().is_empty());
    job.gpu = options.optional("--gpu", "any, vulkan or opengl")?;
    job.agent_gpu = options.flag("--agent-gpu")?;
    job.unset = options.list("--unset")?;
    let port = options.optional::<NonZeroU16>("--port", "a port from 1 to 65535")?;
    job.port = port.map(NonZeroU16::get);
    if job.part == Part::Evaluator {
        job.results = Some(options.path("--results")?);
        job.answer = options.seconds("--answer-seconds", 600)?;
        job.after = options.place("--after")?;
        job.alone = options.flag(ALONE)?;
        return Ok(());
    }
    job.answer = options.seconds("--answer-seconds", 10)?;
    match job.port {
        Some(_) => Ok(()),
        None => Err(UsageError::Missing("--port")),
    }
}

fn fill_agent(job: &mut Job, options: &mut Options) -> Result<(), UsageError> {
    let work = options.place("--work")?.unwrap_or_else(|| WORK.into());
    job.log = Some(work.join("leaderboard.log"));
    job.idle = Some(options.seconds("--idle-seconds", 800)?);
    job.agent_gpu = options.flag("--report-gpu")?;
    if job.part == Part::Driver {
        job.checkpoint = Some(options.path("--checkpoint")?);
        job.python_path = options.take("--python-path")?.filter(|value| !value.is_empty());
        job.route_runs = options.optional("--route-runs", "a number of routes")?;
        return Ok(());
    }
    job.alone = options.flag(ALONE)?;
    if job.alone {
        job.leaves = options.place("--leaves")?;
    }
    Ok(())
}

fn keep(mut arguments: impl Iterator<Item = OsString>) -> Result<Kept, UsageError> {
    let mut options = Options::collect(&mut arguments)?;
    let kept = Kept {
        log: options.path("--log")?,
        log_limit: options.log_limit()?,
        command: arguments.collect(),
    };
    options.finish()?;
    if kept.command.is_empty() {
        return Err(UsageError::NoCommand);
    }
    Ok(kept)
}

fn copy(mut arguments: impl Iterator<Item = OsString>) -> Result<Copied, UsageError> {
    let mut options = Options::collect(&mut arguments)?;
    let copied = Copied {
        from: options.path("--from")?,
        to: options.path("--to")?,
        termination_log: options.termination_log()?,
    };
    options.finish()?;
    match arguments.next() {
        None => Ok(copied),
        Some(word) => Err(UsageError::Unknown(word.to_string_lossy().into_owned())),
    }
}

struct Options(Vec<(String, OsString)>);

impl Options {
    /// Collects up to and including `--`, or all.
    fn collect(arguments: &mut impl Iterator<Item = OsString>) -> Result<Self, UsageError> {
        let mut options = Vec::new();
        while let Some(argument) = arguments.next() {
            if argument == "--" {
                return Ok(Self(options));
            }
            let bytes = argument.as_bytes();
            let (name, value) = match bytes.iter().position(|byte| *byte == b'=') {
                Some(at) => (&bytes[..at], Some(OsString::from_vec(bytes[at + 1..].to_vec()))),
                None => (bytes, None),
            };
            let name = OsStr::from_bytes(name).to_string_lossy().into_owned();
            if !name.starts_with("--") {
                return Err(UsageError::Unknown(name));
            }
            let value = value
                .or_else(|| (name == ALONE).then(|| "true".into()))
                .or_else(|| arguments.next())
                .ok_or_else(|| UsageError::NoValue(name.clone()))?;
            options.push((name, value));
        }
        Ok(Self(options))
    }

    fn termination_log(&mut self) -> Result<PathBuf, UsageError> {
        let path = self.place("--termination-log")?;
        Ok(path.unwrap_or_else(|| TERMINATION_LOG.into()))
    }

    fn log_limit(&mut self) -> Result<u64, UsageError> {
        Ok(self.optional("--log-limit", "a number of bytes")?.unwrap_or(2 << 30))
    }

    fn take(&mut self, option: &'static str) -> Result<Option<OsString>, UsageError> {
        let Some(at) = self.0.iter().position(|(name, _)| name == option) else {
            return Ok(None);
        };
        let (_, value) = self.0.remove(at);
        if self.0.iter().any(|(name, _)| name == option) {
            return Err(UsageError::Twice(option));
        }
        Ok(Some(value))
    }

    fn optional<T: FromStr>(&mut self, option: &'static str, expected: &'static str) -> Result<Option<T>, UsageError> {
        let Some(value) = self.take(option)? else {
            return Ok(None);
        };
        match value.to_str().and_then(|text| text.parse().ok()) {
            Some(parsed) => Ok(Some(parsed)),
            None => Err(UsageError::Invalid {
                option,
                value,
                expected,
            }),
        }
    }

    fn required<T: FromStr>(&mut self, option: &'static str, expected: &'static str) -> Result<T, UsageError> {
        self.optional(option, expected)?.ok_or(UsageError::Missing(option))
    }

    fn path(&mut self, option: &'static str) -> Result<PathBuf, UsageError> {
        let value = self.take(option)?.ok_or(UsageError::Missing(option))?;
        if value.is_empty() {
            return Err(UsageError::Invalid {
                option,
                value,
                expected: "a path",
            });
        }
        Ok(value.into())
    }

    fn place(&mut self, option: &'static str) -> Result<Option<PathBuf>, UsageError> {
        Ok(self.take(option)?.map(PathBuf::from))
    }

    fn flag(&mut self, option: &'static str) -> Result<bool, UsageError> {
        Ok(self.optional(option, "true or false")?.unwrap_or(false))
    }

    /// The parts of a value between commas.
    fn list(&mut self, option: &'static str) -> Result<Vec<OsString>, UsageError> {
        let value = self.take(option)?.unwrap_or_default();
        let parts = value
            .as_bytes()
            .split(|byte| *byte == b',')
            .filter(|part| !part.is_empty());
        Ok(parts.map(|part| OsStr::from_bytes(part).to_owned()).collect())
    }

    fn seconds(&mut self, option: &'static str, default: u32) -> Result<Duration, UsageError> {
        let seconds = self.optional::<u32>(option, "a number of seconds")?.unwrap_or(default);
        Ok(Duration::from_secs(seconds.into()))
    }

    fn finish(self) -> Result<(), UsageError> {
        self.0
            .into_iter()
            .next()
            .map_or(Ok(()), |(name, _)| Err(UsageError::Unknown(name)))
    }
}

#[cfg(test)]
mod tests;
