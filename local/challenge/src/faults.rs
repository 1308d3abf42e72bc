//! Faults of an agent on purpose: the knobs of `AGENT_KNOBS`, and how the checkpoint gets to disk under them. Called by `evaluator` at
//! fixed moments, so that the evaluator itself reads like an honest one.

use std::{
    fs, io,
    net::{Ipv4Addr, TcpListener},
    os::unix::fs::{FileTypeExt, PermissionsExt, symlink},
    path::{Path, PathBuf},
    thread,
    time::Duration,
};

use nix::{
    sys::signal::{SigSet, Signal},
    sys::stat::Mode,
    unistd::mkfifo,
};
use serde_json::Number;

use crate::{
    checkpoint::{Checkpoint, Record, write_in_pieces},
    flags::Format,
    knobs::{Knobs, Known, Shape},
};

/// The agent's knobs; `README.md` describes what each does.
pub const KNOBS: &[Known] = &[
    ("crash", Shape::At),
    ("hang", Shape::At),
    ("oom", Shape::At),
    ("reject", Shape::At),
    ("no-setup", Shape::At),
    ("no-world", Shape::At),
    ("no-record", Shape::At),
    ("dies-after", Shape::At),
    ("once-more", Shape::Plain),
    ("replay", Shape::Value),
    ("print-routes", Shape::PlainOrAt),
    ("nonsense", Shape::At),
    ("deep", Shape::At),
    ("huge", Shape::At),
    ("nan", Shape::At),
    ("forge", Shape::Plain),
    ("early", Shape::At),
    ("symlink", Shape::Value),
    ("fifo", Shape::Plain),
    ("mode0600", Shape::Plain),
    ("spam", Shape::Value),
    ("print-env", Shape::Plain),
    ("noexit", Shape::Plain),
    ("forge-verdict", Shape::At),
    ("take-port", Shape::Value),
    ("ignore-term", Shape::Plain),
];

/// Where the kubelet reads the last message of a container.
const TERMINATION_LOG: &str = "/dev/termination-log";
/// Between two tries of a port that somebody else has.
const PORT_PAUSE: Duration = Duration::from_millis(1);
/// Between two pieces of a checkpoint.
const BETWEEN_PIECES: Duration = Duration::from_millis(2);
const OOM_STEP: usize = 16 << 20;
/// Where `oom` gives up: a container without a memory limit must not take the machine with it.
const OOM_END: usize = 4 << 30;
const DEPTH: usize = 200_000;
const HUGE: usize = 65 << 20;

/// The faults of this worker.
#[derive(Debug)]
pub struct Faults {
    knobs: Knobs,
    format: Format,
    path: PathBuf,
    /// Where the `once` markers lie: the checkpoint's folder, which outlives the container.
    markers: PathBuf,
}

impl Faults {
    /// `path` is the checkpoint's.
    pub fn new(knobs: Knobs, format: Format, path: &Path) -> Self {
        let markers = path.parent().map(Path::to_path_buf).unwrap_or_default();
        Self {
            knobs,
            format,
            path: path.to_path_buf(),
            markers,
        }
    }

    /// Before anything else.
    pub fn at_start(&self) {
        if self.knobs.has("ignore-term") {
            ignore_term();
        }
        if self.knobs.has("print-env") {
            for (name, value) in std::env::vars_os() {
                println!("{}={}", name.display(), value.display());
            }
        }
        if let Some(port) = self.knobs.value("take-port").and_then(|port| port.parse().ok()) {
            thread::spawn(move || take_port(port));
        }
        let bytes: usize = self
            .knobs
            .value("spam")
            .and_then(|bytes| bytes.parse().ok())
            .unwrap_or(0);
        let line = "spam ".repeat(20);
        for _ in 0..bytes / (line.len() + 1) {
            println!("{line}");
        }
    }

    /// In the middle of a route; `number` counts the worker's routes from 1.
    pub fn in_route(&self, number: usize, routes: &Path) {
        let fires = |name| self.knobs.fires(name, number, &self.markers);
        if fires("print-routes") || (number == 1 && self.knobs.has("print-routes")) {
            println!("{}", fs::read_to_string(routes).unwrap_or_default());
            abort("Segmentation fault (core dumped)");
        }
        if fires("crash") {
            abort("Segmentation fault (core dumped)");
        }
        if fires("forge-verdict") {
            forge_verdict();
        }
        if fires("oom") {
            exhaust_memory();
        }
        if fires("hang") {
            forever();
        }
    }

    /// Are the agent's sensors refused at this route?
    pub fn rejects(&self, number: usize) -> bool {
        self.knobs.fires("reject", number, &self.markers)
    }

    /// Does the agent's set-up fail at this route?
    pub fn keeps_from_setting_up(&self, number: usize) -> bool {
        self.knobs.fires("no-setup", number, &self.markers)
    }

    /// Can the world of this route not be loaded?
    pub fn keeps_from_loading(&self, number: usize) -> bool {
        self.knobs.fires("no-world", number, &self.markers)
    }

    /// Does stopping this route fail, after its simulation has crashed?
    pub fn loses_record(&self, number: usize) -> bool {
        self.knobs.fires("no-record", number, &self.markers)
    }

    /// After the last write of a route.
    pub fn after_route(&self, number: usize) {
        if self.knobs.fires("dies-after", number, &self.markers) {
            abort("Segmentation fault (core dumped)");
        }
    }

    /// Is the evaluator started once more when it has done everything?
    pub fn starts_once_more(&self) -> bool {
        self.knobs.has("once-more")
    }

    /// The file that stands for a whole evaluation, beside the routes file.
    pub fn replays(&self) -> Option<&str> {
        self.knobs.value("replay")
    }

    /// Does the agent leave out what comes after this route?
    pub fn ends_early(&self, number: usize) -> bool {
        self.knobs.fires("early", number, &self.markers)
    }

    /// Changes a finished record.
    pub fn falsify(&self, number: usize, record: &mut Record) {
        if self.knobs.has("forge") {
            record.scores.score_route = Number::from(100);
            record.scores.score_penalty = 1.0;
            record.scores.score_composed = 100.0;
        }
        if self.knobs.fires("nan", number, &self.markers) {
            record.scores.score_composed = f64::NAN;
        }
    }

    /// Writes the checkpoint after the `number`-th route.
    pub fn write(&self, checkpoint: &Checkpoint, number: usize) -> io::Result<()> {
        self.write_text(&checkpoint.text(self.format)?, number)
    }

    /// Writes this text as the checkpoint.
    pub fn write_text(&self, checkpoint: &str, number: usize) -> io::Result<()> {
        if self.knobs.has("fifo") {
            return self.make_fifo();
        }
        let holds = |name| self.knobs.holds(name, number, &self.markers);
        let text = match () {
            () if holds("nonsense") => {
                "{\"_checkpoint\": {\"records\": \"all of them\", \"global_record\": 7}}".to_owned()
            }
            () if holds("deep") => "[".repeat(DEPTH),
            () if holds("huge") => " ".repeat(HUGE),
            () => checkpoint.to_owned(),
        };
        let Some(target) = self.knobs.value("symlink") else {
            write_in_pieces(&self.path, &text, || thread::sleep(BETWEEN_PIECES))?;
            let private = self.knobs.has("mode0600");
            return if private {
                fs::set_permissions(&self.path, fs::Permissions::from_mode(0o600))
            } else {
                Ok(())
            };
        };
        fs::write(self.path.with_extension("hidden"), text)?;
        remove(&self.path)?;
        symlink(target, &self.path)
    }

    /// After the last write.
    pub fn at_end(&self) {
        if self.knobs.has("noexit") {
            forever();
        }
    }

    fn make_fifo(&self) -> io::Result<()> {
        if fs::symlink_metadata(&self.path).is_ok_and(|found| found.file_type().is_fifo()) {
            return Ok(());
        }
        remove(&self.path)?;
        mkfifo(&self.path, Mode::from_bits_truncate(0o666)).map_err(io::Error::from)
    }
}

/// SIGTERM stays pending permanently. Must be called before any thread starts.
pub fn ignore_term() {
    let mut set = SigSet::empty();
    set.add(Signal::SIGTERM);
    if let Err(error) = set.thread_block() {
        eprintln!("SIGTERM can't be blocked, so `ignore-term` has no effect: {error}");
    }
}

fn remove(path: &Path) -> io::Result<()> {
    match fs::remove_file(path) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
        _ => Ok(()),
    }
}

fn abort(last_words: &str) -> ! {
    eprintln!("{last_words}");
    std::process::abort()
}

/// Claims that the simulator was not ready, and keeps the runner from replacing that. Without the capability to pass over
/// permissions even root's runner cannot write to the file then.
fn forge_verdict() -> ! {
    let forged = r#"{"what":"notReady","why":"the simulator was not ready in time"}"#;
    let written = fs::write(TERMINATION_LOG, forged)
        .and_then(|()| fs::set_permissions(TERMINATION_LOG, fs::Permissions::from_mode(0o444)));
    if let Err(error) = written {
        eprintln!("the forged verdict cannot be written: {error}");
    }
    std::process::exit(1);
}

/// Listens on another pair's port as soon as its simulator is down, and never answers.
fn take_port(port: u16) -> ! {
    loop {
        match TcpListener::bind((Ipv4Addr::LOCALHOST, port)) {
            Ok(_listener) => forever(),
            Err(_) => thread::sleep(PORT_PAUSE),
        }
    }
}

fn exhaust_memory() -> ! {
    let mut hoard = Vec::new();
    while hoard.len() * OOM_STEP < OOM_END {
        // Filled with ones: zero pages would cost nothing.
        hoard.push(vec![1_u8; OOM_STEP]);
    }
    abort("MemoryError: the limit of this stand-in was reached before one of the container")
}

fn forever() -> ! {
    loop {
        thread::park();
    }
}
