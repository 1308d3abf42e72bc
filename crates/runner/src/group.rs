//! The command's processes: starting them in a process group of their own, reaping every child that ends, and finding what
//! has left the group. Called by `run`; decides nothing.

use std::ffi::OsString;
use std::fs;
use std::io::{self, ErrorKind};
use std::os::unix::process::{CommandExt, ExitStatusExt};
use std::process::{Child, Command, ExitStatus};

use nix::errno::Errno;
use nix::sys::signal::{Signal, kill, killpg};
use nix::sys::wait::{WaitPidFlag, WaitStatus, waitpid};
use nix::unistd::Pid;

/// How the command ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Status {
    Exited(i32),
    Killed(Option<i32>),
}

/// The command is not there, as a shell reports it.
const CODE_NOT_FOUND: i32 = 127;
/// The command is there and cannot be started, as a shell reports it.
const CODE_NOT_STARTED: i32 = 126;

/// The exit code of a shell for a command it could not start.
pub(crate) fn spawn_code(error: &io::Error) -> i32 {
    if error.kind() == ErrorKind::NotFound {
        CODE_NOT_FOUND
    } else {
        CODE_NOT_STARTED
    }
}

/// The command and all its descendants.
#[derive(Debug)]
pub(crate) struct Group {
    child: Child,
    leader: Pid,
    status: Option<Status>,
}

impl Group {
    /// Starts `command` as the leader of a new process group.
    pub(crate) fn spawn(command: &mut Command) -> io::Result<Self> {
        let child = command.process_group(0).spawn()?;
        let leader = i32::try_from(child.id()).map(Pid::from_raw).map_err(io::Error::other)?;
        Ok(Self {
            child,
            leader,
            status: None,
        })
    }

    /// How the command itself ended, if it has.
    pub(crate) const fn status(&self) -> Option<Status> {
        self.status
    }

    /// Reaps whatever has ended: the command, its group, and orphans, which all come to this process.
    pub(crate) fn reap(&mut self) {
        // The standard library's wait comes first because it alone understands death by a real-time signal.
        if self.status.is_none() {
            self.status = match self.child.try_wait() {
                Ok(None) => None,
                Ok(Some(status)) => Some(Status::from(status)),
                Err(_) => Some(Status::Killed(None)),
            };
        }
        loop {
            match waitpid(None, Some(WaitPidFlag::WNOHANG)) {
                Ok(WaitStatus::Exited(pid, code)) if pid == self.leader => self.status = Some(Status::Exited(code)),
                Ok(WaitStatus::Signaled(pid, signal, _)) if pid == self.leader => {
                    self.status = Some(Status::Killed(Some(signal as i32)));
                }
                Ok(WaitStatus::StillAlive) | Err(Errno::ECHILD) => return,
                // EINVAL is a child that died of a real-time signal: it is reaped all the same.
                Ok(_) | Err(_) => {}
            }
        }
    }

    /// True if a process of the group is left.
    pub(crate) fn lives(&self) -> bool {
        self.status.is_none() || killpg(self.leader, None) != Err(Errno::ESRCH)
    }

    /// Sends `signal` to the group.
    pub(crate) fn signal(&self, signal: Signal) {
        if self.lives() {
            // Nothing is left to signal, or it is not ours to signal: the caller looks at what lives, not at this.
            let _ = killpg(self.leader, signal);
        }
    }

    /// Sends SIGKILL to every direct child of this process: what had left the group comes back to us as an orphan. Returns
    /// how many there were.
    pub(crate) fn kill_children() -> usize {
        let children = children();
        for child in &children {
            let _ = kill(*child, Signal::SIGKILL);
        }
        children.len()
    }
}

/// As the first process of a PID namespace, which is a container's, sends SIGKILL to all others in it. The kernel does that in one
/// step, which no chain of forks outruns. As any other process it does nothing: the others are not its own.
pub(crate) fn kill_all_others() {
    const ALL: Pid = Pid::from_raw(-1);
    if Pid::this() == Pid::from_raw(1) {
        // An error means that no process is left, or that one is not ours to end: the caller looks at what lives, not at this.
        let _ = kill(ALL, Signal::SIGKILL);
    }
}

impl From<ExitStatus> for Status {
    fn from(status: ExitStatus) -> Self {
        status
            .code()
            .map_or_else(|| Self::Killed(status.signal()), Self::Exited)
    }
}

fn children() -> Vec<Pid> {
    // This program has one thread, so its list holds all children.
    let list = fs::read_to_string(format!("/proc/self/task/{}/children", std::process::id())).unwrap_or_default();
    list.split_whitespace()
        .filter_map(|pid| pid.parse().ok())
        .map(Pid::from_raw)
        .collect()
}

/// The command from its words (never empty), with `environment` on top of this process's own.
pub(crate) fn command(words: &[OsString], environment: &[(&str, OsString)]) -> Command {
    let mut words = words.iter();
    let mut command = Command::new(words.next().cloned().unwrap_or_default());
    command
        .args(words)
        .envs(environment.iter().map(|(name, value)| (name, value)));
    command
}
