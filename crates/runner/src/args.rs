//! The command line: parsed here once into a [`Job`] that cannot hold nonsense. Called by `main`; reads and changes nothing else.

use std::ffi::{OsStr, OsString};
use std::num::NonZeroU16;
use std::os::unix::ffi::{OsStrExt, OsStringExt};
use std::path::PathBuf;
use std::str::FromStr;
use std::time::Duration;

use thiserror::Error;

use leaderboard_protocol::files::{Host, Member, Pair, RESULT, Side};
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

/// Work of one container.
#[derive(Debug, Clone, PartialEq)]
pub struct Job {
    pub pair: Pair,
    pub status: PathBuf,
    pub ready: Duration,
    pub grace: Duration,
    pub peer: Duration,
    /// Bytes of output that are kept in the log.
    pub log_limit: u64,
    pub termination_log: PathBuf,
    /// True if changed files wake it; else it looks once a second.
    pub inotify: bool,
    /// Where devices and drivers are looked for.
    pub root: PathBuf,
    /// True if an evaluator, or its agent, has no peer beside it.
    pub alone: bool,
    pub role: Role,
    /// The command and its arguments; never empty.
    pub command: Vec<OsString>,
}

/// Settings of one side.
#[derive(Debug, Clone, PartialEq)]
pub enum Role {
    Host {
        server: Server,
        flush: Duration,
        cancel: Duration,
        log: Option<PathBuf>,
        /// Driver that the command draws with, if it is to have a GPU.
        gpu: Option<Needs>,
        /// True if its agent is to see a GPU.
        agent_gpu: bool,
        /// Variables that the command does not get.
        unset: Vec<OsString>,
    },
    Agent {
        program: Program,
        work: PathBuf,
        idle: Duration,
        /// True if it reports that it sees a GPU.
        report_gpu: bool,
    },
}

/// Command of a host's container.
#[derive(Debug, Clone, PartialEq)]
pub enum Server {
    Simulator {
        port: u16,
        /// Time that the server may take to answer when its agent has crashed.
        answer: Duration,
    },
    Evaluator {
        /// Port on which its agent finds it. None: its agent need not find it.
        port: Option<u16>,
        /// Folder of its result.
        results: PathBuf,
        /// Time from its agent's regular end to the complete result.
        answer: Duration,
        /// Folder with the results of the pairs before this one, after which its command begins.
        after: Option<PathBuf>,
    },
}

/// Command of an agent's container.
#[derive(Debug, Clone, PartialEq)]
pub enum Program {
    /// It evaluates itself against a simulator, and keeps a checkpoint.
    Driver {
        checkpoint: PathBuf,
        python_path: Option<OsString>,
        /// How many route runs it is to drive, if that is known.
        route_runs: Option<u32>,
    },
    /// An evaluator evaluates it.
    Plain {
        /// Folder in which it leaves files for its evaluator, if it is alone.
        leaves: Option<PathBuf>,
    },
}

impl Job {
    pub fn member(&self) -> Member {
        let side = match self.role {
            Role::Host { .. } => Side::Host(self.host()),
            Role::Agent { .. } => Side::Agent,
        };
        Member { side, pair: self.pair }
    }

    /// The other container of the pair.
    pub fn peer(&self) -> Member {
        match self.role {
            Role::Host { .. } => self.pair.agent(),
            Role::Agent { .. } => self.pair.host(self.host()),
        }
    }

    /// The file of an evaluator's result.
    pub fn result(&self) -> Option<PathBuf> {
        match &self.role {
            Role::Host {
                server: Server::Evaluator { results, .. },
                ..
            } => Some(results.join(RESULT)),
            _ => None,
        }
    }

    /// Kind of the pair's host.
    pub const fn host(&self) -> Host {
        match &self.role {
            Role::Host {
                server: Server::Simulator { .. },
                ..
            }
            | Role::Agent {
                program: Program::Driver { .. },
                ..
            } => Host::Simulator,
            Role::Host {
                server: Server::Evaluator { .. },
                ..
            }
            | Role::Agent {
                program: Program::Plain { .. },
                ..
            } => Host::Evaluator,
        }
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
    let side = match first.to_str() {
        Some("--version" | "-V") => return Ok(Request::Version),
        Some("--help" | "-h" | "help") => return Ok(Request::Help),
        Some("simulator") => Side::Host(Host::Simulator),
        Some("evaluator") => Side::Host(Host::Evaluator),
        Some("agent") => Side::Agent,
        Some("keep") => return keep(arguments).map(Request::Keep),
        Some("copy") => return copy(arguments).map(Request::Copy),
        _ => return Err(UsageError::Subcommand(first)),
    };
    let mut options = Options::collect(&mut arguments)?;
    let command: Vec<OsString> = arguments.collect();
    let mut job = Job {
        pair: options.required("--pair", "a number from 1 to 999")?,
        status: options.path("--status")?,
        ready: options.seconds("--ready-seconds", 3600)?,
        grace: options.seconds("--grace-seconds", grace_seconds(side))?,
        peer: options.seconds("--peer-seconds", 600)?,
        log_limit: options.log_limit()?,
        termination_log: options.termination_log()?,
        inotify: options.optional("--inotify", "true or false")?.unwrap_or(true),
        root: options.take("--root")?.map_or_else(|| "/".into(), PathBuf::from),
        alone: false,
        role: role(side, &mut options)?,
        command,
    };
    if job.host() == Host::Evaluator {
        job.alone = options.optional(ALONE, "true or false")?.unwrap_or(false);
    }
    if job.alone
        && let Role::Agent {
            program: Program::Plain { leaves },
            ..
        } = &mut job.role
    {
        *leaves = options.take("--leaves")?.map(PathBuf::from);
    }
    options.finish()?;
    if job.command.is_empty() {
        return Err(UsageError::NoCommand);
    }
    Ok(Request::Run(Box::new(job)))
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

/// An evaluator has to write down what it knows so far.
const fn grace_seconds(side: Side) -> u32 {
    match side {
        Side::Host(Host::Evaluator) => 30,
        Side::Host(Host::Simulator) | Side::Agent => 20,
    }
}

fn role(side: Side, options: &mut Options) -> Result<Role, UsageError> {
    Ok(match side {
        Side::Host(host) => Role::Host {
            server: server(host, options)?,
            flush: options.seconds("--flush-seconds", 1800)?,
            cancel: options.seconds("--cancel-seconds", 120)?,
            log: options
                .take("--log")?
                .filter(|path| !path.is_empty())
                .map(PathBuf::from),
            gpu: options.optional("--gpu", "any, vulkan or opengl")?,
            agent_gpu: options.optional("--agent-gpu", "true or false")?.unwrap_or(false),
            unset: options.list("--unset")?,
        },
        Side::Agent => Role::Agent {
            program: program(options)?,
            work: options.take("--work")?.map_or_else(|| WORK.into(), PathBuf::from),
            idle: options.seconds("--idle-seconds", 800)?,
            report_gpu: options.optional("--report-gpu", "true or false")?.unwrap_or(false),
        },
    })
}

fn server(host: Host, options: &mut Options) -> Result<Server, UsageError> {
    let port = options.optional::<NonZeroU16>("--port", "a port from 1 to 65535")?;
    Ok(match host {
        Host::Simulator => Server::Simulator {
            port: port.ok_or(UsageError::Missing("--port"))?.get(),
            answer: options.seconds("--answer-seconds", 10)?,
        },
        Host::Evaluator => Server::Evaluator {
            port: port.map(NonZeroU16::get),
            results: options.path("--results")?,
            answer: options.seconds("--answer-seconds", 600)?,
            after: options.take("--after")?.map(PathBuf::from),
        },
    })
}

fn program(options: &mut Options) -> Result<Program, UsageError> {
    let host = options.take("--host")?;
    match host.as_deref().map(OsStr::as_bytes) {
        None | Some(b"simulator") => Ok(Program::Driver {
            checkpoint: options.path("--checkpoint")?,
            python_path: options.take("--python-path")?.filter(|value| !value.is_empty()),
            route_runs: options.optional("--route-runs", "a number of routes")?,
        }),
        Some(b"evaluator") => Ok(Program::Plain { leaves: None }),
        Some(_) => Err(UsageError::Invalid {
            option: "--host",
            value: host.unwrap_or_default(),
            expected: "simulator or evaluator",
        }),
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
        let path = self.take("--termination-log")?;
        Ok(path.map_or_else(|| TERMINATION_LOG.into(), PathBuf::from))
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
