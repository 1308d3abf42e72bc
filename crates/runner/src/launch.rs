//! How each side's command is prepared: its environment, its words, where its output goes. Called by `run`.

use std::env;
use std::ffi::{OsStr, OsString};
use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use leaderboard_protocol::graphics::ADAPTER;
use thiserror::Error;

use crate::checkpoint;
use crate::decide::Cause;
use crate::group::{self, Group};
use crate::kernel;
use crate::tee::Tee;
use leaderboard_runner::args::Job;
use leaderboard_runner::expand::expand;
use leaderboard_runner::graphics::{self, NoGraphics};

/// Why no command runs.
#[derive(Debug, Error)]
pub(crate) enum CannotLaunch {
    /// The kernel refuses it.
    #[error("{program} cannot be started: {source}", program = program.to_string_lossy())]
    Spawn { program: OsString, source: io::Error },
    /// A server that has nothing to draw with.
    #[error(transparent)]
    NoGraphics(#[from] NoGraphics),
}

impl CannotLaunch {
    /// The end that follows.
    pub(crate) fn cause(&self) -> Cause {
        match self {
            Self::Spawn { source, .. } => kernel::of_spawn(source),
            Self::NoGraphics(NoGraphics::NoGpu) => Cause::NoGpu,
            Self::NoGraphics(NoGraphics::DriverMissing) => Cause::GraphicsDriverMissing,
        }
    }
}

/// Starts the command, with the tee of its output if that is kept. `round`: crashes so far.
pub(crate) fn launch(job: &Job, round: u32) -> Result<(Group, Option<Tee>), CannotLaunch> {
    let mut command = if job.part.is_host() {
        of_host(job)?
    } else if job.alone && job.agent_gpu && graphics::devices(&job.root) == 0 {
        // No host reads its report.
        return Err(NoGraphics::NoGpu.into());
    } else {
        let environment = of_agent(job, round);
        group::command(&expand_all(&job.command, &environment), &environment)
    };
    let started = match &job.log {
        None => Group::spawn(command.stdin(no_input())).map(|group| (group, None)),
        Some(log) => teed(command, log.clone(), job.log_limit),
    };
    started.map_err(|source| CannotLaunch::Spawn {
        program: program(job).to_owned(),
        source,
    })
}

/// The command of a host, on its own GPU and without the variables that it is not to have, such as the screen of its image. The words of
/// a simulator stay as they are.
fn of_host(job: &Job) -> Result<Command, NoGraphics> {
    let (mut words, mut environment) = (job.command.clone(), Vec::new());
    if let Some(needs) = job.gpu {
        let adapter = graphics::adapter(&job.root, needs, |name| env::var_os(name))?;
        words = words.iter().map(|word| graphics::with_adapter(word, adapter)).collect();
        environment.push((ADAPTER, adapter.to_string().into()));
    }
    if let Some(results) = &job.results {
        // A later attempt may begin without files: those of an evaluator go when its agent runs anew.
        let has_files = results.read_dir().is_ok_and(|mut files| files.next().is_some());
        environment.push(("RESUME", one_or_empty(has_files)));
        words = expand_all(&words, &environment);
    }
    let mut command = group::command(&words, &environment);
    for name in &job.unset {
        command.env_remove(name);
    }
    Ok(command)
}

/// What the runner adds to the environment of an agent.
fn of_agent(job: &Job, round: u32) -> Vec<(&'static str, OsString)> {
    let Some(checkpoint) = &job.checkpoint else {
        return Vec::new();
    };
    let partial = checkpoint::read(checkpoint).is_ok_and(|found| found.partial);
    let mut environment = vec![("RESUME", resume(env::var_os("RESUME"), round, partial))];
    if let Some(front) = &job.python_path {
        environment.push(("PYTHONPATH", in_front(front, env::var_os("PYTHONPATH"))));
    }
    environment
}

/// Starts the command with its output in a log, too.
pub(crate) fn teed(mut command: Command, log: PathBuf, limit: u64) -> io::Result<(Group, Option<Tee>)> {
    let (tee, writer) = Tee::open(log, limit)?;
    command.stdin(no_input()).stdout(writer.try_clone()?).stderr(writer);
    Ok((Group::spawn(&mut command)?, Some(tee)))
}

/// Nothing to read. A container's own stdin is that already, so one without /dev/null goes on with it.
fn no_input() -> Stdio {
    File::open("/dev/null").map_or_else(|_| Stdio::inherit(), Stdio::from)
}

/// `RESUME` of an agent: yes from outside, after a crash, or with some of its routes in the checkpoint.
fn resume(outside: Option<OsString>, round: u32, partial: bool) -> OsString {
    one_or_empty(outside.is_some_and(|value| value == "1") || round > 0 || partial)
}

/// For the evaluator any text means yes.
fn one_or_empty(yes: bool) -> OsString {
    if yes { "1".into() } else { OsString::new() }
}

fn in_front(front: &OsStr, image: Option<OsString>) -> OsString {
    let mut path = front.to_owned();
    if let Some(image) = image.filter(|image| !image.is_empty()) {
        path.push(":");
        path.push(image);
    }
    path
}

fn expand_all(words: &[OsString], environment: &[(&str, OsString)]) -> Vec<OsString> {
    let lookup = |name: &OsStr| {
        let made = environment
            .iter()
            .find(|(made, _)| *made == name)
            .map(|(_, value)| value.clone());
        made.or_else(|| env::var_os(name))
    };
    words.iter().map(|word| expand(word, lookup)).collect()
}

/// The program's name, for messages.
fn program(job: &Job) -> &OsStr {
    job.command
        .first()
        .map_or(OsStr::new(""), |program| Path::new(program).as_os_str())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn resume_is_1_or_empty() {
        let cases = [
            (None, 0, false, ""),
            (Some("1"), 0, false, "1"),
            (Some("no"), 0, false, ""),
            (Some(""), 1, false, "1"),
            (None, 0, true, "1"),
        ];
        for (outside, round, partial, expected) in cases {
            assert_eq!(
                resume(outside.map(OsString::from), round, partial),
                expected,
                "{outside:?} {round} {partial}"
            );
        }
    }

    #[test]
    fn the_images_python_path_comes_last() {
        assert_eq!(in_front(OsStr::new("/a:/b"), Some("/c".into())), "/a:/b:/c");
        assert_eq!(in_front(OsStr::new("/a"), Some(OsString::new())), "/a");
        assert_eq!(in_front(OsStr::new("/a"), None), "/a");
    }

    #[test]
    fn words_see_the_made_environment_first() {
        let made = [("PATH", OsString::from("made")), ("RESUME", OsString::new())];
        let words = ["$(PATH)", "--resume=$(RESUME)", "$(NOBODY_HAS_THIS)"].map(OsString::from);
        assert_eq!(expand_all(&words, &made), ["made", "--resume=", "$(NOBODY_HAS_THIS)"]);
    }
}
