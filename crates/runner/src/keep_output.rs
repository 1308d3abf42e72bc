//! A command whose output goes to a file too, and that is all: no peer, no status files, no verdict. Called by `main` for the host's
//! private contents.

use std::time::{Duration, Instant};

use nix::sys::signal::Signal;

use crate::group::{self, Status, spawn_code};
use crate::launch::teed;
use crate::say;
use crate::tee;
use crate::wake::Signals;
use leaderboard_runner::args::Kept;

/// Behind the signal of a child's end.
const SLOW_POLL: Duration = Duration::from_secs(1);
/// For output whose writer outlives the command: then the rest is given up.
const LAST_WAIT: Duration = Duration::from_secs(10);
/// Number that a shell adds to that of a signal.
const BY_SIGNAL: i32 = 128;

/// Runs the command to its end; its exit code, as a shell would give it.
pub(crate) fn run(kept: Kept, mut signals: Signals) -> i32 {
    let started = teed(group::command(&kept.command, &[]), kept.log, kept.log_limit);
    let (mut group, mut tee) = match started {
        Ok((group, Some(tee))) => (group, tee),
        Ok((_, None)) => return BY_SIGNAL,
        Err(error) => {
            say(format_args!("the command cannot be started: {error}"));
            return spawn_code(&error);
        }
    };
    let mut ended: Option<Instant> = None;
    loop {
        group.reap();
        if group.status().is_some() && ended.is_none() {
            ended = Some(Instant::now());
        }
        let is_late = ended.is_some_and(|ended| ended.elapsed() >= LAST_WAIT);
        if let Some(status) = group.status().filter(|_| tee.finished() || is_late) {
            return code(status);
        }
        if tee::wait(signals.fds().into_iter(), Some(&tee), SLOW_POLL) {
            tee.read();
        }
        tee.write();
        if signals.drain() {
            group.signal(Signal::SIGTERM);
        }
    }
}

fn code(status: Status) -> i32 {
    match status {
        Status::Exited(code) => code,
        Status::Killed(signal) => BY_SIGNAL + signal.unwrap_or_default(),
    }
}
