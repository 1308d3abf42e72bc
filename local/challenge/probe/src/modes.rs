//! The endings, carried out. Called by the program in pair 1; the other pairs are honest.

use std::convert::Infallible;
use std::env;
use std::fs::{self, File, Permissions};
use std::io::{self, Write as _};
use std::net::{Ipv4Addr, SocketAddr, TcpListener, TcpStream};
use std::os::unix::fs::{MetadataExt as _, PermissionsExt as _};
use std::os::unix::process::CommandExt as _;
use std::path::Path;
use std::process::{Command, exit};
use std::thread;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use nix::libc;
use nix::sys::signal::{Signal, kill};
use nix::sys::stat::Mode;
use nix::unistd::{Pid, mkfifo, setsid};

use crate::call::{call, of};
use crate::{exhaust, folders};

/// The honest agent of the image.
const HONEST: &str = "/usr/bin/challenge-agent";
const TERMINATION_LOG: &str = "/dev/termination-log";
const WORK: &str = "/tmp/agent";
const LOG: &str = "/tmp/agent/leaderboard.log";
const CHECKPOINT: &str = "/tmp/agent/agent_results.json";
/// Results that a runner takes for complete, and that no other program does.
const COMPLETE: &str = r#"{"_checkpoint": {"global_record": {"index": -1}}}"#;
/// A file that `workspace` has copied, as the user of `logcopy`.
const RUNNER: &str = "/leaderboard-tools/leaderboard-runner";
/// The user of the challenge's simulator.
const SIMULATOR: u32 = 1000;
/// Outlives the container.
const MARKER: &str = "/tmp/agent/probe-was-here";
const FIRST_PORT: u16 = 2000;
const PORT_STEP: u16 = 100;
/// Where an agent listens that is about to take a port.
const SIGN: u16 = 7777;
/// Longest life of a process that outlives the agent.
const LIFE: Duration = Duration::from_mins(1);
const CRASHES: u32 = 1000;
const CHAINS: usize = 8;
/// Final size of a growing file, in bytes.
const GROWN: usize = 64 << 20;
/// 1 MiB of log.
const LOG_LINES: usize = (1 << 20) / 9;

/// The number of this container's pair, by its port.
pub fn pair() -> u16 {
    let port = env::var("CARLA_PORT").ok().and_then(|port| port.parse().ok());
    let port: u16 = port.unwrap_or(FIRST_PORT);
    port.saturating_sub(FIRST_PORT) / PORT_STEP + 1
}

/// Carries out an ending; returns if the agent is to be an honest one from here on.
pub fn run(id: &str, arguments: &[String]) -> io::Result<()> {
    if (id, pair()) == ("port-behind", 2) {
        return first_life(|| {
            await_squatter();
            Ok(())
        });
    }
    if pair() != 1 {
        return Ok(());
    }
    if let Some(done) = exhaust::run(id) {
        return done;
    }
    match id {
        "named-crash" => name_crash(arguments),
        "port-behind" => squat(),
        "forge-message" => forge("notReady", protect),
        "forge-variable" => forge("notReady", || Ok(())),
        "forge-limit" => forge("notReady", silence),
        "forge-peer" => forge("peerCrashed", protect),
        "forge-stopped" => forge("stopped", protect),
        "stop-runner" => stop_runner(),
        "own-crash" => own_crash(),
        "many-crashes" => (0..CRASHES).try_for_each(|number| mark(&format!("crash{number}"))),
        "own-done" => {
            mark("done")?;
            exit(0)
        }
        "survivors" => {
            (0..CHAINS).try_for_each(|_| background("survive"))?;
            exit(1)
        }
        "status-content" => first_life(|| fs::write(status("start1"), vec![b'x'; 1 << 20])),
        "status-sparse" => first_life(|| sparse(Path::new(&status("start1")))),
        "status-pipe" => first_life(|| Ok(mkfifo(Path::new(&status("start1")), Mode::S_IRWXU)?)),
        "folder-shut" => shut(),
        "folder-listed" => folder_listed(),
        // One that can be deleted would be seen: the honest agent's run ends well.
        "folder-deleted" => match folders::delete(&folders::of_agent(pair())) {
            Ok(()) => Ok(()),
            Err(_) => exit(1),
        },
        "results-shut" => fs::set_permissions(WORK, Permissions::from_mode(0o700)),
        "growing-file" => background("grow"),
        "replaced-log" => background("replace"),
        // The honest agent's own knob.
        "own-score" => honest(arguments, "forge").map(|never| match never {}),
        other => Err(io::Error::other(format!("there is no ending {other}"))),
    }
}

fn stop_runner() -> io::Result<()> {
    kill(Pid::from_raw(1), Signal::SIGTERM)?;
    loop {
        thread::park();
    }
}

fn own_crash() -> io::Result<()> {
    mark("crash0")?;
    // An honest agent that is faster than its simulator's look would end well, and the mark mean nothing.
    await_simulators_end();
    Ok(())
}

fn folder_listed() -> io::Result<()> {
    let logcopy = fs::metadata(RUNNER)?.uid();
    folders::forbid(&folders::of_agent(pair()), &[logcopy, SIMULATOR]).and_then(|()| exit(1))
}

/// Does the work of a background process, which was started as `--background NAME`.
pub fn background_work(name: &str) -> io::Result<()> {
    if let Some(done) = exhaust::background_work(name) {
        return done;
    }
    let begun = Instant::now();
    match name {
        "survive" => survive(),
        "grow" => grow(begun),
        "replace" => replace(begun),
        other => Err(io::Error::other(format!("there is no work {other}"))),
    }
}

/// Becomes the honest agent.
pub fn honest(arguments: &[String], knobs: &str) -> io::Result<Infallible> {
    let mut command = Command::new(HONEST);
    if !knobs.is_empty() {
        command.env("AGENT_KNOBS", knobs);
    }
    Err(command.args(arguments).exec())
}

fn status(mark: &str) -> String {
    let pair = pair();
    format!("{}/agent-{pair}.{mark}", folders::of_agent(pair).display())
}

/// Shuts the folder: while it stays shut, no other container can see the end. Only the mark of the end shows that no results will come.
fn shut() -> io::Result<()> {
    fs::write(CHECKPOINT, COMPLETE)?;
    fs::set_permissions(folders::of_agent(pair()), Permissions::from_mode(0o700))?;
    exit(0)
}

/// Until nothing listens on the port of its simulator any more.
fn await_simulators_end() {
    let address = SocketAddr::from((Ipv4Addr::LOCALHOST, FIRST_PORT + PORT_STEP * (pair() - 1)));
    let begun = Instant::now();
    while TcpStream::connect(address).is_ok() && begun.elapsed() < LIFE {
        thread::sleep(Duration::from_millis(20));
    }
}

/// Drives as an honest agent does, and then writes into its first record that the simulation crashed.
fn name_crash(arguments: &[String]) -> io::Result<()> {
    let driven = Command::new(HONEST).args(arguments).status()?;
    if !driven.success() {
        return Err(io::Error::other(format!("the honest agent ended with {driven}")));
    }
    let changed = with_a_crash(&fs::read_to_string(CHECKPOINT)?);
    fs::write(
        CHECKPOINT,
        changed.ok_or_else(|| io::Error::other("the checkpoint has no record"))?,
    )?;
    exit(0)
}

/// A whole checkpoint whose first record names a crash; its global record stays.
fn with_a_crash(checkpoint: &str) -> Option<String> {
    let records = checkpoint.find("\"records\"")?;
    let changed = with_value(checkpoint, records, "\"status\"", "Failed - Simulation crashed")?;
    let entry = changed.find("\"entry_status\"");
    entry.map_or(Some(changed.clone()), |entry| {
        with_value(&changed, entry, "\"entry_status\"", "Crashed")
    })
}

/// The text with another value of the first such key from there on.
fn with_value(text: &str, from: usize, key: &str, value: &str) -> Option<String> {
    let after = from + text.get(from..)?.find(key)? + key.len();
    let begin = after + text.get(after..)?.find('"')? + 1;
    let end = begin + text.get(begin..)?.find('"')?;
    Some(format!("{}{value}{}", text.get(..begin)?, text.get(end..)?))
}

/// Takes the port behind that of the second pair's simulator once it is free, and keeps it.
fn squat() -> io::Result<()> {
    let _sign = TcpListener::bind((Ipv4Addr::LOCALHOST, SIGN))?;
    let begun = Instant::now();
    let mut taken = None;
    while begun.elapsed() < LIFE {
        // It ends with its container, once the run has come to its end.
        taken = taken.or_else(|| TcpListener::bind((Ipv4Addr::UNSPECIFIED, FIRST_PORT + PORT_STEP + 1)).ok());
        thread::sleep(Duration::from_millis(1));
    }
    Err(io::Error::other(format!("port taken: {}", taken.is_some())))
}

/// Until the first pair's agent is about to take the port.
fn await_squatter() {
    let begun = Instant::now();
    while TcpStream::connect((Ipv4Addr::LOCALHOST, SIGN)).is_err() && begun.elapsed() < LIFE {
        thread::sleep(Duration::from_millis(20));
    }
}

fn mark(name: &str) -> io::Result<()> {
    File::create(status(name)).map(|_| ())
}

fn last_words(what: &str) -> io::Result<()> {
    let verdict = format!(r#"{{"what":"{what}","why":"the simulator was not ready in time"}}"#);
    fs::write(TERMINATION_LOG, verdict)
}

/// Leaves a verdict of its own, keeps the runner from replacing it, and ends.
fn forge(what: &str, keep: impl FnOnce() -> io::Result<()>) -> io::Result<()> {
    last_words(what)?;
    keep()?;
    exit(1)
}

fn protect() -> io::Result<()> {
    fs::set_permissions(TERMINATION_LOG, Permissions::from_mode(0o444))
}

/// The runner can open nothing from now on.
fn silence() -> io::Result<()> {
    let limit = [0_u64; 2];
    let files = usize::try_from(libc::RLIMIT_NOFILE).unwrap_or_default();
    let runner = 1;
    call(
        libc::SYS_prlimit64,
        of([runner, files, limit.as_ptr().expose_provenance(), 0]),
    )?;
    Ok(())
}

/// Does it in the first container, and crashes there; the next one is honest.
fn first_life(attack: impl FnOnce() -> io::Result<()>) -> io::Result<()> {
    match File::create_new(MARKER) {
        Ok(_) => {
            attack()?;
            exit(1)
        }
        Err(error) if error.kind() == io::ErrorKind::AlreadyExists => Ok(()),
        Err(error) => Err(error),
    }
}

/// As large as the file system takes it; it costs no block.
fn sparse(path: &Path) -> io::Result<()> {
    let file = File::create(path)?;
    let mut last = Ok(());
    for power in (34..=43).rev() {
        last = file.set_len(1 << power);
        if last.is_ok() {
            break;
        }
    }
    last
}

/// Starts this program again, for work of its own.
fn background(name: &str) -> io::Result<()> {
    Command::new("/proc/self/exe").args(["--background", name]).spawn()?;
    Ok(())
}

/// Leaves the process group, and is a new process every moment, so that no list of processes shows it for long.
fn survive() -> io::Result<()> {
    // A leader of its session already is as good.
    _ = setsid();
    last_words("notReady")?;
    thread::sleep(Duration::from_millis(1));
    let until = env::var("PROBE_UNTIL").ok().and_then(|until| until.parse().ok());
    let until: u64 = until.unwrap_or_else(|| now() + LIFE.as_secs());
    if now() >= until {
        return Ok(());
    }
    Command::new("/proc/self/exe")
        .args(["--background", "survive"])
        .env("PROBE_UNTIL", until.to_string())
        .spawn()?;
    Ok(())
}

/// Seconds since 1970: the processes of a chain need one clock.
#[allow(clippy::disallowed_methods, reason = "the program of a stranger")]
fn now() -> u64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH);
    since.map_or(0, |since| since.as_secs())
}

/// A file of one byte at first, of 64 MiB in the end, next to many others that are stored before it.
fn grow(begun: Instant) -> io::Result<()> {
    let mut file = File::create("/tmp/agent/zz-growing")?;
    let piece = vec![b'x'; 64 << 10];
    let mut size = 0;
    while size < GROWN && begun.elapsed() < LIFE {
        file.write_all(&piece)?;
        size += piece.len();
        thread::sleep(Duration::from_millis(2));
    }
    Ok(())
}

/// A new log of 1 MiB in the place of the old one, 10 times a second.
fn replace(begun: Instant) -> io::Result<()> {
    let lines = "replaced ".repeat(LOG_LINES);
    while begun.elapsed() < LIFE {
        fs::write("/tmp/agent/next.log", &lines)?;
        fs::rename("/tmp/agent/next.log", LOG)?;
        thread::sleep(Duration::from_millis(100));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_crash_is_written_into_the_first_record_alone() {
        let whole = r#"{"_checkpoint": {"global_record": {"status": "Completed"}, "progress": [2, 2],
            "records": [{"index": 0, "status": "Perfect"}, {"index": 1, "status": "Completed"}]}, "entry_status": "Finished"}"#;
        let changed = with_a_crash(whole).unwrap();
        let expected = whole
            .replace("Perfect", "Failed - Simulation crashed")
            .replace("Finished", "Crashed");
        assert_eq!(changed, expected);
        assert_eq!(with_a_crash("{}"), None);
    }
}
