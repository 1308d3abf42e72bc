//! The command line: parsed here once into a [`Job`] that cannot hold nonsense. Called by `main`; reads and changes nothing else.

use std::ffi::{OsStr, OsString};
use std::os::unix::ffi::{OsStrExt, OsStringExt};
use std::path::PathBuf;
use std::str::FromStr;
use std::time::Duration;

use thiserror::Error;

use leaderboard_protocol::files::{Member, Pair, Side};
use leaderboard_protocol::graphics::Needs;

pub const USAGE: &str = "\
usage: leaderboard-runner simulator --pair N --status DIR --port P [options] -- CMD ARGS...
       leaderboard-runner agent --pair N --status DIR --checkpoint FILE [options] -- CMD ARGS...
       leaderboard-runner keep --log FILE [--log-limit BYTES] -- CMD ARGS...
       leaderboard-runner --version | --help

Runs CMD as one container of a simulator-agent pair and speaks the status-file protocol in DIR; `keep` runs CMD and keeps its output.

both:       --ready-seconds 3600   how long a server may take until its port answers
            --grace-seconds 20     between SIGTERM and SIGKILL
            --peer-seconds 600     how long to wait for the other side's end of a round
            --log-limit 2147483648 bytes of output that are kept in the log
            --termination-log /dev/termination-log  where the verdict is written
            --inotify true         false: files are looked for once a second
            --root /               where devices and drivers are looked for
simulator:  --flush-seconds 1800   how long to hold the exit until the results are stored
            --cancel-seconds 120   the same after a cancel
            --answer-seconds 10    how long a server may take to answer when its agent has crashed
            --log FILE             where output is kept, too
            --gpu any|vulkan|opengl  the server needs a GPU, and the driver for what it draws with
            --agent-gpu false      true: the agent is to see one too; the server is not announced before its runner has looked
            --unset A,B            variables that the server does not get
agent:      --work /tmp/agent      where leaderboard.log is written
            --idle-seconds 800     no output for so long ends the command
            --python-path A:B:C    put in front of the image's own PYTHONPATH
            --report-gpu false     true: looks for a GPU before anything else, and reports it to the simulator
            --route-runs N         the pair's routes times repetitions: CMD is not started on a checkpoint that has all of them
";

/// Where agents keep their results, as everywhere in the CARLA Leaderboard's cloud.
const WORK: &str = "/tmp/agent";

/// Where the kubelet reads a container's last message. A flag and no variable: the environment is the image's.
const TERMINATION_LOG: &str = "/dev/termination-log";

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
    pub role: Role,
    /// The command and its arguments; never empty.
    pub command: Vec<OsString>,
}

/// Settings of one side.
#[derive(Debug, Clone, PartialEq)]
pub enum Role {
    Simulator {
        port: u16,
        flush: Duration,
        cancel: Duration,
        answer: Duration,
        log: Option<PathBuf>,
        /// Driver that the server draws with, if it is to have a GPU.
        gpu: Option<Needs>,
        /// True if its agent is to see a GPU.
        agent_gpu: bool,
        /// Variables that the server does not get.
        unset: Vec<OsString>,
    },
    Agent {
        work: PathBuf,
        checkpoint: PathBuf,
        idle: Duration,
        python_path: Option<OsString>,
        /// True if it reports that it sees a GPU.
        report_gpu: bool,
        /// How many route runs its evaluator is to drive, if that is known.
        route_runs: Option<u32>,
    },
}

impl Job {
    pub fn member(&self) -> Member {
        let side = match self.role {
            Role::Simulator { .. } => Side::Host,
            Role::Agent { .. } => Side::Agent,
        };
        Member { side, pair: self.pair }
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

/// Request of the command line.
#[derive(Debug, PartialEq)]
pub enum Request {
    Run(Box<Job>),
    Keep(Kept),
    Version,
    Help,
}

/// A command line that asks for nothing we can do.
#[derive(Debug, PartialEq, Error)]
pub enum UsageError {
    #[error("no arguments")]
    Nothing,
    #[error("unknown subcommand {0:?}: simulator, agent or keep")]
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
        Some("simulator") => Side::Host,
        Some("agent") => Side::Agent,
        Some("keep") => return keep(arguments).map(Request::Keep),
        _ => return Err(UsageError::Subcommand(first)),
    };
    let mut options = Options::collect(&mut arguments)?;
    let command: Vec<OsString> = arguments.collect();
    let job = Job {
        pair: options.required("--pair", "a number from 1 to 999")?,
        status: options.path("--status")?,
        ready: options.seconds("--ready-seconds", 3600)?,
        grace: options.seconds("--grace-seconds", 20)?,
        peer: options.seconds("--peer-seconds", 600)?,
        log_limit: options.log_limit()?,
        termination_log: options
            .take("--termination-log")?
            .map_or_else(|| TERMINATION_LOG.into(), PathBuf::from),
        inotify: options.optional("--inotify", "true or false")?.unwrap_or(true),
        root: options.take("--root")?.map_or_else(|| "/".into(), PathBuf::from),
        role: role(side, &mut options)?,
        command,
    };
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

fn role(side: Side, options: &mut Options) -> Result<Role, UsageError> {
    Ok(match side {
        Side::Host => Role::Simulator {
            port: options
                .required::<std::num::NonZeroU16>("--port", "a port from 1 to 65535")?
                .get(),
            flush: options.seconds("--flush-seconds", 1800)?,
            cancel: options.seconds("--cancel-seconds", 120)?,
            answer: options.seconds("--answer-seconds", 10)?,
            log: options
                .take("--log")?
                .filter(|path| !path.is_empty())
                .map(PathBuf::from),
            gpu: options.optional("--gpu", "any, vulkan or opengl")?,
            agent_gpu: options.optional("--agent-gpu", "true or false")?.unwrap_or(false),
            unset: options.list("--unset")?,
        },
        Side::Agent => Role::Agent {
            work: options.take("--work")?.map_or_else(|| WORK.into(), PathBuf::from),
            checkpoint: options.path("--checkpoint")?,
            idle: options.seconds("--idle-seconds", 800)?,
            python_path: options.take("--python-path")?.filter(|value| !value.is_empty()),
            report_gpu: options.optional("--report-gpu", "true or false")?.unwrap_or(false),
            route_runs: options.optional("--route-runs", "a number of routes")?,
        },
    })
}

struct Options(Vec<(String, OsString)>);

impl Options {
    /// Collects up to and including `--`.
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
                .or_else(|| arguments.next())
                .ok_or_else(|| UsageError::NoValue(name.clone()))?;
            options.push((name, value));
        }
        Err(UsageError::NoCommand)
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
mod tests {
    use super::*;

    fn parse_line(line: &str) -> Result<Request, UsageError> {
        parse(line.split_whitespace().map(OsString::from))
    }

    fn job(line: &str) -> Job {
        match parse_line(line).unwrap() {
            Request::Run(job) => *job,
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn a_simulator_has_its_defaults() {
        let job = job("simulator --pair 2 --status /s --port=2100 -- ./server --pair 9 -- x");
        assert_eq!(job.member().to_string(), "simulator-2");
        let flush = Duration::from_mins(30);
        assert_eq!(
            job.role,
            Role::Simulator {
                port: 2100,
                flush,
                cancel: Duration::from_mins(2),
                answer: Duration::from_secs(10),
                log: None,
                gpu: None,
                agent_gpu: false,
                unset: Vec::new(),
            }
        );
        assert_eq!(job.termination_log, PathBuf::from("/dev/termination-log"));
        assert_eq!((job.log_limit, job.inotify), (2 << 30, true));
        assert_eq!(
            [job.ready, job.grace, job.peer].map(|time| time.as_secs()),
            [3600, 20, 600]
        );
        assert_eq!(job.command, ["./server", "--pair", "9", "--", "x"]);
    }

    #[test]
    fn a_simulator_has_a_gpu_and_loses_variables() {
        let line = "simulator --pair 1 --status /s --port 1 --gpu=vulkan --agent-gpu=true --unset=DISPLAY,XAUTHORITY --root /r -- a";
        let job = job(line);
        let Role::Simulator {
            gpu, agent_gpu, unset, ..
        } = job.role
        else {
            panic!("a simulator's line");
        };
        assert_eq!((gpu, agent_gpu, job.root), (Some(Needs::Vulkan), true, "/r".into()));
        assert_eq!(unset, ["DISPLAY", "XAUTHORITY"]);
    }

    #[test]
    fn an_agent_has_its_defaults_and_options() {
        let line = "agent --pair 1 --status /s --checkpoint /w/c.json";
        let role = |job: Job| match job.role {
            Role::Agent {
                work,
                idle,
                python_path,
                report_gpu,
                route_runs,
                ..
            } => (
                (work, idle.as_secs(), job.log_limit),
                python_path,
                (report_gpu, route_runs),
            ),
            Role::Simulator { .. } => panic!("an agent's line"),
        };
        assert_eq!(
            role(job(&format!("{line} -- a"))),
            ((WORK.into(), 800, 2 << 30), None, (false, None))
        );
        let more = job(&format!(
            "{line} --work /w --idle-seconds 3 --log-limit 9 --python-path=/a:/b --report-gpu=true --route-runs 5 -- a"
        ));
        assert_eq!(role(more), (("/w".into(), 3, 9), Some("/a:/b".into()), (true, Some(5))));
    }

    #[test]
    fn each_mistake_is_named() {
        let cases = [
            ("", "no arguments"),
            ("monitor", "unknown subcommand \"monitor\": simulator, agent or keep"),
            ("simulator --status /s --port 1 -- a", "--pair is missing"),
            (
                "simulator --pair 0 --status /s --port 1 -- a",
                "--pair: \"0\" is not a number from 1 to 999",
            ),
            (
                "simulator --pair 1 --status /s --port 0 -- a",
                "--port: \"0\" is not a port from 1 to 65535",
            ),
            (
                "simulator --pair 1 --pair 2 --status /s --port 1 -- a",
                "--pair is given twice",
            ),
            (
                "simulator --pair 1 --status /s --port 1 --idle-seconds 3 -- a",
                "unknown option --idle-seconds",
            ),
            (
                "simulator --pair 1 --status /s --port 1 --grace-seconds -1 -- a",
                "--grace-seconds: \"-1\" is not a number of seconds",
            ),
            (
                "simulator --pair 1 --status= --port 1 -- a",
                "--status: \"\" is not a path",
            ),
            ("simulator --pair 1 --status /s --port", "--port needs a value"),
            (
                "simulator --pair 1 --status /s --port 1 --inotify off -- a",
                "--inotify: \"off\" is not true or false",
            ),
            (
                "simulator --pair 1 --status /s --port 1 --gpu directx -- a",
                "--gpu: \"directx\" is not any, vulkan or opengl",
            ),
            (
                "simulator --pair 1 --status /s --port 1",
                "the command after -- is missing",
            ),
            (
                "simulator --pair 1 --status /s --port 1 --",
                "the command after -- is missing",
            ),
            ("simulator run --pair 1", "unknown option run"),
            ("agent --pair 1 --status /s --work /w -- a", "--checkpoint is missing"),
        ];
        for (line, message) in cases {
            assert_eq!(parse_line(line).unwrap_err().to_string(), message, "{line}");
        }
    }

    #[test]
    fn a_command_may_be_kept_alone() {
        let parsed = |line: &str| parse(line.split_whitespace().map(OsString::from));
        let kept = |log_limit| Kept {
            log: "/l/c.log".into(),
            log_limit,
            command: ["/bin/bash", "-c", "x"].map(OsString::from).to_vec(),
        };
        assert_eq!(
            parsed("keep --log=/l/c.log -- /bin/bash -c x"),
            Ok(Request::Keep(kept(2 << 30)))
        );
        assert_eq!(
            parsed("keep --log /l/c.log --log-limit 9 -- /bin/bash -c x"),
            Ok(Request::Keep(kept(9)))
        );
        assert_eq!(parsed("keep -- a"), Err(UsageError::Missing("--log")));
        assert_eq!(parsed("keep --log=/l --"), Err(UsageError::NoCommand));
        assert_eq!(
            parsed("keep --log=/l --pair=1 -- a"),
            Err(UsageError::Unknown("--pair".into()))
        );
    }

    #[test]
    fn version_and_help_are_asked_for() {
        assert_eq!(parse_line("--version").unwrap(), Request::Version);
        assert_eq!(parse_line("--help").unwrap(), Request::Help);
    }
}
