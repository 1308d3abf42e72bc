//! A Pod on a temporary folder: starts real runners as its containers, waits for their files and their ends as events, and
//! kills them as the kernel would.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test that cannot go on fails")]
#![allow(dead_code, reason = "each test program uses its own part of it")]

use std::fs;
use std::net::TcpListener;
use std::os::fd::AsFd;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

use leaderboard_protocol::files::{Host, KEPT_CHECKPOINT, Mark, Member, Pair, RESULT, Side, StatusFile};
use leaderboard_protocol::verdict::Verdict;
use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use nix::sys::inotify::{AddWatchFlags, InitFlags, Inotify};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use tempfile::TempDir;

/// No event of these tests takes so long, however busy the machine is.
pub const LIMIT: Duration = Duration::from_mins(1);

pub const COMPLETE: &str = r#"{"_checkpoint": {"global_record": {"index": -1}, "progress": [1, 1], "records": []}}"#;
pub const PARTIAL: &str = r#"{"_checkpoint": {"global_record": {}, "progress": [1, 5], "records": []}}"#;

const SERVER: &str = "
import socket, sys
server = socket.socket()
server.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
server.bind(('127.0.0.1', int(sys.argv[1])))
server.listen()
while True:
    server.accept()[0].close()
";

pub struct Pod {
    folder: TempDir,
    pub port: u16,
    /// Environment of every container.
    pub environment: Vec<(String, String)>,
    /// Options of every container, before `--`.
    pub options: Vec<String>,
    /// The program that starts the runner, with its arguments; empty: the test itself.
    pub starter: Vec<String>,
}

pub struct Container {
    pub member: Member,
    pid: Pid,
    end: Receiver<ExitStatus>,
    verdict: PathBuf,
    stderr: PathBuf,
    pub stdout: PathBuf,
    ended: Option<ExitStatus>,
}

pub const fn member(side: Side) -> Member {
    Member {
        side,
        pair: Pair::new(1).unwrap(),
    }
}

pub const SIMULATOR: Member = member(Side::Host(Host::Simulator));
pub const EVALUATOR: Member = member(Side::Host(Host::Evaluator));
pub const AGENT: Member = member(Side::Agent);
/// Merges what the evaluator has left.
pub const MERGER: Member = Member {
    side: Side::Host(Host::Evaluator),
    pair: Pair::new(2).unwrap(),
};

/// Below what the kernel gives away by itself: a Pod has its ports to itself, and here other programs connect.
const PORTS: std::ops::Range<u16> = 20_000..32_000;
/// A server has ports behind its own.
const PORT_STEP: u16 = 10;

/// The first of some ports that no other program has, and no other test of this one.
fn free_ports() -> u16 {
    static TAKEN: AtomicU32 = AtomicU32::new(0);
    let all: Vec<u16> = PORTS.step_by(PORT_STEP.into()).collect();
    loop {
        let number = std::process::id().wrapping_add(TAKEN.fetch_add(1, Ordering::Relaxed));
        let first = all[number as usize % all.len()];
        if (first..first + PORT_STEP).all(|port| TcpListener::bind(("127.0.0.1", port)).is_ok()) {
            return first;
        }
    }
}

impl Pod {
    pub fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        for name in ["status", "work", "results"] {
            fs::create_dir(folder.path().join(name)).unwrap();
        }
        fs::write(folder.path().join("server.py"), SERVER).unwrap();
        Self {
            folder,
            port: free_ports(),
            environment: Vec::new(),
            options: vec!["--grace-seconds=2".to_owned()],
            starter: Vec::new(),
        }
    }

    pub fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    pub fn status(&self) -> PathBuf {
        self.path("status")
    }

    pub fn checkpoint(&self) -> PathBuf {
        self.path("work/agent_results.json")
    }

    pub fn log(&self) -> PathBuf {
        self.path("work/leaderboard.log")
    }

    /// A simulator whose server answers.
    pub fn simulator(&self) -> Container {
        let server = self.path("server.py").display().to_string();
        self.simulator_running(&["python3", &server, &self.port.to_string()], &[])
    }

    pub fn simulator_running(&self, command: &[&str], options: &[&str]) -> Container {
        let port = format!("--port={}", self.port);
        self.start(SIMULATOR, &[&[port.as_str()], options].concat(), command, Stdio::null())
    }

    /// An evaluator that runs a shell script, which finds the path of its result in `$RESULT`. Without the option of a port it has none.
    pub fn evaluator(&self, script: &str, options: &[&str]) -> Container {
        let results = format!("--results={}", self.path("results").display());
        let options = [&[results.as_str()], options].concat();
        self.start(EVALUATOR, &options, &["sh", "-c", script], Stdio::null())
    }

    /// Runs a shell script once the evaluator's result, below the folder `parts`, is final. It finds the path of its own in `$RESULT`.
    pub fn merger(&self, script: &str, options: &[&str]) -> Container {
        let results = format!("--results={}", self.path("results").display());
        let after = format!("--after={}", self.path("parts").display());
        let options = [&["--alone", results.as_str(), &after], options].concat();
        self.start(MERGER, &options, &["sh", "-c", script], Stdio::null())
    }

    /// An evaluator's agent that runs a shell script.
    pub fn plain(&self, script: &str, options: &[&str]) -> Container {
        let work = format!("--work={}", self.path("work").display());
        let options = [&["--host=evaluator", work.as_str()], options].concat();
        self.start(AGENT, &options, &["sh", "-c", script], Stdio::null())
    }

    pub fn result(&self) -> PathBuf {
        self.path("results").join(RESULT)
    }

    /// An agent that runs a shell script, which finds the path of its checkpoint in `$CHECKPOINT`.
    pub fn agent(&self, script: &str) -> Container {
        self.agent_running(&["sh", "-c", script], &[])
    }

    pub fn agent_running(&self, command: &[&str], options: &[&str]) -> Container {
        let stdout = fs::File::create(self.path("agent-1.stdout")).unwrap();
        self.agent_printing(command, options, stdout.into())
    }

    pub fn agent_printing(&self, command: &[&str], options: &[&str], stdout: Stdio) -> Container {
        let work = format!("--work={}", self.path("work").display());
        let checkpoint = format!("--checkpoint={}", self.checkpoint().display());
        self.start(
            AGENT,
            &[&[work.as_str(), &checkpoint], options].concat(),
            command,
            stdout,
        )
    }

    fn start(&self, member: Member, options: &[&str], command: &[&str], stdout: Stdio) -> Container {
        let verdict = self.path(&format!("{member}.termination"));
        fs::write(&verdict, "").unwrap();
        let stderr = self.path(&format!("{member}.stderr"));
        let log = fs::OpenOptions::new().append(true).create(true).open(&stderr).unwrap();
        let runner = env!("CARGO_BIN_EXE_leaderboard-runner").to_owned();
        let words = self.starter.iter().chain([&runner]).collect::<Vec<_>>();
        let child = Command::new(words[0])
            .args(&words[1..])
            .arg(member.side.name())
            .arg(format!("--pair={}", member.pair))
            .arg(format!("--status={}", self.status().display()))
            .arg(format!("--termination-log={}", verdict.display()))
            .args(&self.options)
            .args(options)
            .arg("--")
            .args(command)
            .env("CHECKPOINT", self.checkpoint())
            .env("RESULT", self.result())
            .env_remove("RESUME")
            .envs(self.environment.iter().map(|(name, value)| (name, value)))
            .stdin(Stdio::null())
            .stdout(stdout)
            .stderr(log)
            .spawn()
            .unwrap();
        Container::new(member, child, verdict, stderr, self.path(&format!("{member}.stdout")))
    }

    /// Writes a status file as its owner would.
    pub fn write(&self, file: StatusFile) {
        file.create(&self.status()).unwrap();
    }

    pub fn has(&self, member: Member, mark: Mark) -> bool {
        StatusFile::Of(member, mark).exists(&self.status())
    }

    /// Waits until a status file is there.
    pub fn until(&self, member: Member, mark: Mark) {
        let file = StatusFile::Of(member, mark);
        until_exists(&file.path(&self.status()));
    }

    /// The names of all status files a member wrote, sorted; the kept checkpoint is none.
    pub fn files(&self, member: Member) -> Vec<String> {
        let folder = self.status().join(member.to_string());
        let Ok(entries) = fs::read_dir(folder) else {
            return Vec::new();
        };
        let mut names: Vec<_> = entries
            .map(|entry| entry.unwrap().file_name().into_string().unwrap())
            .filter(|name| name != KEPT_CHECKPOINT)
            .collect();
        names.sort();
        names
    }

    /// Prints how long one file came after another.
    pub fn print_reaction(&self, what: &str, first: StatusFile, then: StatusFile) {
        let time = |file: StatusFile| fs::metadata(file.path(&self.status())).unwrap().modified().unwrap();
        println!(
            "{what}: {:?}",
            time(then).duration_since(time(first)).unwrap_or_default()
        );
    }
}

/// Waits until `path` is there, by inotify on the nearest folder that is.
pub fn until_exists(path: &Path) {
    let begin = Instant::now();
    while !path.exists() {
        assert!(begin.elapsed() < LIMIT, "{} did not come", path.display());
        let folder = path.ancestors().skip(1).find(|folder| folder.is_dir()).unwrap();
        let inotify = Inotify::init(InitFlags::IN_NONBLOCK).unwrap();
        inotify
            .add_watch(folder, AddWatchFlags::IN_CREATE | AddWatchFlags::IN_MOVED_TO)
            .unwrap();
        if !path.exists() {
            let mut ready = [PollFd::new(inotify.as_fd(), PollFlags::POLLIN)];
            poll(&mut ready, PollTimeout::from(500_u16)).unwrap();
        }
    }
}

impl Container {
    fn new(member: Member, mut child: Child, verdict: PathBuf, stderr: PathBuf, stdout: PathBuf) -> Self {
        let pid = Pid::from_raw(child.id().try_into().unwrap());
        let (sender, end) = channel();
        std::thread::spawn(move || sender.send(child.wait().unwrap()));
        Self {
            member,
            pid,
            end,
            verdict,
            stderr,
            stdout,
            ended: None,
        }
    }

    /// Waits for its end; the exit code, or 128 + the signal.
    pub fn code(&mut self) -> i32 {
        use std::os::unix::process::ExitStatusExt;
        if self.ended.is_none() {
            let ended = self.end.recv_timeout(LIMIT);
            self.ended = Some(ended.unwrap_or_else(|_| panic!("{} does not end:\n{}", self.member, self.stderr())));
        }
        let status = self.ended.unwrap();
        status.code().unwrap_or_else(|| 128 + status.signal().unwrap())
    }

    /// True if it is still there after `time`.
    pub fn stays(&mut self, time: Duration) -> bool {
        self.ended = self.ended.or_else(|| self.end.recv_timeout(time).ok());
        self.ended.is_none()
    }

    pub fn verdict(&self) -> Verdict {
        Verdict::parse(&fs::read_to_string(&self.verdict).unwrap()).unwrap()
    }

    /// Output of its runners so far, all lives of it.
    pub fn stderr(&self) -> String {
        fs::read_to_string(&self.stderr).unwrap()
    }

    pub fn signal(&self, signal: Signal) {
        kill(self.pid, signal).unwrap();
    }

    /// The processes its runner has started itself.
    pub fn children(&self) -> Vec<Pid> {
        let list = fs::read_to_string(format!("/proc/{0}/task/{0}/children", self.pid)).unwrap_or_default();
        list.split_whitespace()
            .map(|pid| Pid::from_raw(pid.parse().unwrap()))
            .collect()
    }

    /// Kills its runner without a word, and all its processes, as the kernel does when PID 1 of a container dies.
    pub fn kill_without_a_word(&mut self) {
        let children = self.children();
        self.signal(Signal::SIGKILL);
        assert_eq!(self.code(), 137);
        for child in children {
            let _ = nix::sys::signal::killpg(child, Signal::SIGKILL);
        }
    }
}

impl Drop for Container {
    fn drop(&mut self) {
        if self.stays(Duration::ZERO) {
            self.kill_without_a_word();
        }
    }
}

/// True if a process with this id lives (a zombie does not).
pub fn lives(pid: i32) -> bool {
    let stat = fs::read_to_string(format!("/proc/{pid}/stat")).unwrap_or_default();
    stat.rsplit_once(") ")
        .is_some_and(|(_, rest)| !rest.starts_with(['Z', 'X']))
}
