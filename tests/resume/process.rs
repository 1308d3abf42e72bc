//! Processes by their ids: who lives, whose child somebody is, and killing a container as the kernel does when its PID 1 dies.

use std::fs;
use std::io::Write;
use std::time::Duration;

use nix::sys::signal::{Signal, kill, killpg};
use nix::unistd::Pid;

/// One line that is seen although the test passes.
pub fn say(line: &str) {
    // Without stderr the line has no reader.
    let _ = writeln!(std::io::stderr(), "{line}");
}

/// The children of a process, each the leader of a group of its own.
pub fn children(of: Pid) -> Vec<Pid> {
    let list = fs::read_to_string(format!("/proc/{of}/task/{of}/children")).unwrap_or_default();
    let pids = list.split_whitespace().filter_map(|pid| pid.parse().ok());
    pids.map(Pid::from_raw).collect()
}

/// The state's letter; none for what is gone or a zombie.
fn state(pid: Pid) -> Option<char> {
    let stat = fs::read_to_string(format!("/proc/{pid}/stat")).ok()?;
    let letter = stat.rsplit_once(") ")?.1.chars().next()?;
    (!matches!(letter, 'Z' | 'X')).then_some(letter)
}

/// Kills a runner and its children, so that none of them can react to the death of another. Returns the children, whose end no parent
/// reports.
pub async fn kill_container(runner: Pid) -> Vec<Pid> {
    // It must not start anything between the look at its children and its end.
    let _ = kill(runner, Signal::SIGSTOP);
    while state(runner).is_some_and(|letter| !matches!(letter, 'T' | 't')) {
        tokio::task::yield_now().await;
    }
    let orphans = children(runner);
    let _ = kill(runner, Signal::SIGKILL);
    for orphan in &orphans {
        let _ = killpg(*orphan, Signal::SIGKILL);
    }
    orphans
}

/// Waits until they are gone: the kernel notifies only their parent, who is dead.
pub async fn gone(pids: &[Pid]) {
    for pid in pids {
        while state(*pid).is_some() {
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
    }
}

/// Sends SIGTERM once the process handles it. The first process of a container would drop an earlier one, and use up the kubelet's
/// patience.
pub async fn terminate(pid: Pid) {
    while state(pid).is_some() && !handles_sigterm(pid) {
        tokio::time::sleep(Duration::from_millis(1)).await;
    }
    let _ = kill(pid, Signal::SIGTERM);
}

fn handles_sigterm(pid: Pid) -> bool {
    let status = fs::read_to_string(format!("/proc/{pid}/status")).unwrap_or_default();
    let caught = status.lines().find_map(|line| line.strip_prefix("SigCgt:"));
    let caught = caught.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok());
    caught.is_some_and(|mask| mask & (1 << (Signal::SIGTERM as u64 - 1)) != 0)
}
