//! The status files: their names, who writes which, and reading them without trusting anybody's folder.
//!
//! Called by the runner (writes its own sub-folder) and by `logcopy` (writes `logcopy/`, reads all). Every reader asks for
//! exact names and never lists a folder, so what else a container puts into its own folder costs and means nothing.
//! Knows the file system and nothing else.

use std::fmt;
use std::fs::{self, OpenOptions};
use std::io::{self, ErrorKind};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use thiserror::Error;

/// The sub-folder that only `logcopy` writes.
const LOGCOPY_FOLDER: &str = "logcopy";

/// In an agent's sub-folder: the last whole checkpoint, kept by the agent's runner. No message; it is the one file there that
/// is not empty.
pub const KEPT_CHECKPOINT: &str = "checkpoint.json";

/// In an evaluator's folder of results, which is no status folder: its result, written under another name and renamed.
pub const RESULT: &str = "result.json";

/// Rounds a pair may count. Far above any `retries.perWorker`; it bounds what a reader looks up for a folder full of forgeries.
pub const MAX_ROUNDS: u32 = 1000;

/// The number of a worker, which is a pair of the host's container and the agent's: 1 to 999.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Pair(u16);

/// A text or number that names no pair.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[error("a pair is a number from 1 to 999 without leading zeros")]
pub struct NotAPair;

impl Pair {
    /// The highest number.
    pub const MAX: u16 = 999;

    /// The pair with this number, if there may be one.
    pub const fn new(number: u16) -> Option<Self> {
        if number >= 1 && number <= Self::MAX {
            Some(Self(number))
        } else {
            None
        }
    }

    /// The first so many.
    pub fn first(many: usize) -> impl Iterator<Item = Self> + Clone {
        (1..=Self::MAX).take(many).map(Self)
    }

    /// Its number, from 1.
    pub const fn get(self) -> u16 {
        self.0
    }

    /// Its place in a list of all pairs, from 0.
    pub fn index(self) -> usize {
        usize::from(self.0).saturating_sub(1)
    }

    /// The container with the host's image.
    pub const fn host(self, host: Host) -> Member {
        let side = Side::Host(host);
        Member { side, pair: self }
    }

    /// The container with the participant's image.
    pub const fn agent(self) -> Member {
        let side = Side::Agent;
        Member { side, pair: self }
    }
}

impl fmt::Display for Pair {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

impl FromStr for Pair {
    type Err = NotAPair;

    fn from_str(text: &str) -> Result<Self, NotAPair> {
        exact_number(text)
            .and_then(|number| u16::try_from(number).ok())
            .and_then(Self::new)
            .ok_or(NotAPair)
    }
}

/// Kind of the host's container of a pair. All pairs of a run have the same.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Host {
    /// A simulator's server, for an agent that evaluates itself against it. The agent has the last word.
    Simulator,
    /// A program that evaluates the agent and writes the result. It has the last word.
    Evaluator,
}

impl Host {
    /// `simulator` or `evaluator`, as in container and file names.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Simulator => "simulator",
            Self::Evaluator => "evaluator",
        }
    }
}

/// The two containers of a pair.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Side {
    /// Runs the host's image.
    Host(Host),
    /// Runs the participant's image.
    Agent,
}

impl Side {
    /// `simulator`, `evaluator` or `agent`, as in container and file names.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Host(host) => host.name(),
            Self::Agent => "agent",
        }
    }
}

impl fmt::Display for Side {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// One container that speaks the protocol. Its text (`agent-2`) is its container's name and its folder's.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Member {
    /// Which side of the pair.
    pub side: Side,
    /// Which pair.
    pub pair: Pair,
}

impl Member {
    /// Parses `simulator-<n>`, `evaluator-<n>` or `agent-<n>`.
    pub fn parse(text: &str) -> Option<Self> {
        let (side, pair) = text.split_once('-')?;
        let side = [Side::Host(Host::Simulator), Side::Host(Host::Evaluator), Side::Agent]
            .into_iter()
            .find(|known| known.name() == side)?;
        Some(Self {
            side,
            pair: pair.parse().ok()?,
        })
    }
}

impl fmt::Display for Member {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}-{}", self.side, self.pair)
    }
}

/// Meaning of a member's file. The number is the round: the crashes of that side before it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Mark {
    /// Simulator: the server answers. Evaluator: it can be reached. Agent: the command is about to start.
    Start(u32),
    /// This round ended without complete results.
    Crash(u32),
    /// Simulator, evaluator, and an agent that evaluates itself: the pair's results are complete. An evaluator's agent: its program
    /// has ended with exit code 0, which says nothing of the results.
    Done,
}

/// One status file. All are empty: the name is the message.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum StatusFile {
    /// `<member>/<member>.start<c>`, `.crash<c>` or `.done`, written by that member.
    Of(Member, Mark),
    /// `<agent>/<agent>.gpu` or `.nogpu`, written by an agent's runner before it begins anything, and read by its host's runner
    /// alone: whether the agent's container sees a GPU.
    Gpu(Member, bool),
    /// `logcopy/simulation.cancel`, written by `logcopy`: everybody stops.
    Cancel,
    /// `logcopy/logcopy.done`, written by `logcopy`: the final results are stored.
    Stored,
}

impl StatusFile {
    /// The sub-folder it lies in, which is also the only one its writer can write.
    pub fn folder(&self) -> String {
        match self {
            Self::Of(member, _) | Self::Gpu(member, _) => member.to_string(),
            Self::Cancel | Self::Stored => LOGCOPY_FOLDER.to_owned(),
        }
    }

    /// Its name. Names are unique over all folders, so that they can also be stored flat.
    pub fn name(&self) -> String {
        match self {
            Self::Of(member, Mark::Start(round)) => format!("{member}.start{round}"),
            Self::Of(member, Mark::Crash(round)) => format!("{member}.crash{round}"),
            Self::Of(member, Mark::Done) => format!("{member}.done"),
            Self::Gpu(member, true) => format!("{member}.gpu"),
            Self::Gpu(member, false) => format!("{member}.nogpu"),
            Self::Cancel => "simulation.cancel".to_owned(),
            Self::Stored => "logcopy.done".to_owned(),
        }
    }

    /// Where it lies under the status folder `root`.
    pub fn path(&self, root: &Path) -> PathBuf {
        root.join(self.folder()).join(self.name())
    }

    /// The file `name` in the sub-folder `folder`. `None` for every other name, and for a name in a foreign folder. The GPU files of a
    /// pair give `None` too: its simulator alone reads them, by their paths.
    pub fn parse(folder: &str, name: &str) -> Option<Self> {
        if folder == LOGCOPY_FOLDER {
            return [Self::Cancel, Self::Stored]
                .into_iter()
                .find(|file| file.name() == name);
        }
        let member = Member::parse(folder)?;
        let mark = name.strip_prefix(folder)?.strip_prefix('.')?;
        let mark = if mark == "done" {
            Mark::Done
        } else if let Some(round) = mark.strip_prefix("start") {
            Mark::Start(exact_round(round)?)
        } else {
            Mark::Crash(exact_round(mark.strip_prefix("crash")?)?)
        };
        Some(Self::Of(member, mark))
    }

    /// True if the file is there, as a file of any kind.
    pub fn exists(&self, root: &Path) -> bool {
        fs::symlink_metadata(self.path(root)).is_ok()
    }

    /// Creates it (and its sub-folder, where no mount made it). One that is there already is fine.
    pub fn create(&self, root: &Path) -> io::Result<()> {
        let already = |result: io::Result<()>| match result {
            Err(error) if error.kind() == ErrorKind::AlreadyExists => Ok(()),
            other => other,
        };
        let folder = root.join(self.folder());
        if !folder.is_dir() {
            already(fs::create_dir(&folder))?;
        }
        let new = OpenOptions::new()
            .write(true)
            .create_new(true)
            .mode(0o644)
            .open(folder.join(self.name()));
        already(new.map(drop))
    }
}

/// How far a member has come, read from its own folder.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Progress {
    /// Its crashes so far, which is also the number of its present round.
    pub crashes: u32,
    /// It has started in the present round.
    pub started: bool,
    /// It is done.
    pub done: bool,
}

impl Progress {
    /// Reads it. An unreadable or missing folder reads as a member that has not begun.
    pub fn read(root: &Path, member: Member) -> Self {
        let exists = |mark| StatusFile::Of(member, mark).exists(root);
        let crashes = (0..MAX_ROUNDS).take_while(|round| exists(Mark::Crash(*round))).count();
        let crashes = u32::try_from(crashes).unwrap_or(MAX_ROUNDS);
        Self {
            crashes,
            started: exists(Mark::Start(crashes)),
            done: exists(Mark::Done),
        }
    }
}

/// All status files that are there for the pairs 1 to `pairs` of this host, for a reader that reports or stores them. A member's
/// files beyond the first round it has not crashed in are left out.
pub fn present(root: &Path, pairs: u16, host: Host) -> Vec<StatusFile> {
    let members = Pair::first(pairs.into()).flat_map(|pair| [pair.host(host), pair.agent()]);
    let mut files = Vec::new();
    for member in members {
        let crashes = Progress::read(root, member).crashes;
        let rounds = (0..=crashes).flat_map(|round| [Mark::Start(round), Mark::Crash(round)]);
        files.extend(rounds.chain([Mark::Done]).map(|mark| StatusFile::Of(member, mark)));
    }
    files.extend([StatusFile::Cancel, StatusFile::Stored]);
    files.retain(|file| file.exists(root));
    files
}

fn exact_round(text: &str) -> Option<u32> {
    exact_number(text).filter(|round| *round <= MAX_ROUNDS)
}

fn exact_number(text: &str) -> Option<u32> {
    let digits = !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_digit());
    if !digits || (text.len() > 1 && text.starts_with('0')) {
        return None;
    }
    text.parse().ok()
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::symlink;
    use std::process::Command;

    use super::*;

    fn member(side: Side, pair: u16) -> Member {
        Member {
            side,
            pair: Pair::new(pair).unwrap(),
        }
    }

    #[test]
    fn every_file_is_read_back_from_its_folder_and_name() {
        let agent = member(Side::Agent, 12);
        let simulator = member(Side::Host(Host::Simulator), 1);
        let evaluator = member(Side::Host(Host::Evaluator), 999);
        let cases = [
            (
                StatusFile::Of(simulator, Mark::Start(0)),
                "simulator-1",
                "simulator-1.start0",
            ),
            (
                StatusFile::Of(simulator, Mark::Crash(10)),
                "simulator-1",
                "simulator-1.crash10",
            ),
            (
                StatusFile::Of(evaluator, Mark::Done),
                "evaluator-999",
                "evaluator-999.done",
            ),
            (StatusFile::Of(agent, Mark::Done), "agent-12", "agent-12.done"),
            (StatusFile::Cancel, "logcopy", "simulation.cancel"),
            (StatusFile::Stored, "logcopy", "logcopy.done"),
        ];
        for (file, folder, name) in cases {
            assert_eq!((file.folder().as_str(), file.name().as_str()), (folder, name));
            assert_eq!(StatusFile::parse(folder, name), Some(file));
        }
    }

    #[test]
    fn other_names_and_foreign_folders_mean_nothing() {
        let cases = [
            ("agent-1", "simulator-1.done"),
            ("agent-1", "evaluator-1.done"),
            ("simulator-1", "evaluator-1.done"),
            ("evaluators-1", "evaluators-1.done"),
            ("agent-1", "agent-2.done"),
            ("agent-1", "simulation.cancel"),
            ("agent-1", "logcopy.done"),
            ("logcopy", "agent-1.done"),
            ("agent-1", "agent-1.done2"),
            ("agent-1", "agent-1.crash"),
            ("agent-1", "agent-1.crash01"),
            ("agent-1", "agent-1.crash+1"),
            ("agent-1", "agent-1.crash1001"),
            ("agent-1", "agent-1.crash99999999999"),
            ("agent-1", "agent-1.done.tmp"),
            ("agent-01", "agent-01.done"),
            ("agent-0", "agent-0.done"),
            ("agent-1000", "agent-1000.done"),
            ("", ""),
            (".", "agent-1.done"),
        ];
        for (folder, name) in cases {
            assert_eq!(StatusFile::parse(folder, name), None, "{folder}/{name}");
        }
    }

    #[test]
    fn progress_counts_crashes_without_gaps() {
        let root = tempfile::tempdir().unwrap();
        let agent = member(Side::Agent, 1);
        assert_eq!(Progress::read(root.path(), agent), Progress::default());
        for mark in [Mark::Start(0), Mark::Crash(0), Mark::Start(1), Mark::Crash(5)] {
            StatusFile::Of(agent, mark).create(root.path()).unwrap();
        }
        assert_eq!(
            Progress::read(root.path(), agent),
            Progress {
                crashes: 1,
                started: true,
                done: false
            }
        );
        StatusFile::Of(agent, Mark::Crash(1)).create(root.path()).unwrap();
        StatusFile::Of(agent, Mark::Done).create(root.path()).unwrap();
        assert_eq!(
            Progress::read(root.path(), agent),
            Progress {
                crashes: 2,
                started: false,
                done: true
            }
        );
    }

    #[test]
    fn creating_twice_is_fine_and_present_lists_what_is_valid() {
        let root = tempfile::tempdir().unwrap();
        let files = [
            StatusFile::Of(member(Side::Host(Host::Simulator), 1), Mark::Start(0)),
            StatusFile::Of(member(Side::Agent, 1), Mark::Crash(0)),
            StatusFile::Of(member(Side::Agent, 1), Mark::Start(1)),
            StatusFile::Of(member(Side::Agent, 2), Mark::Done),
            StatusFile::Stored,
        ];
        for file in files.iter().chain(&files) {
            file.create(root.path()).unwrap();
        }
        fs::write(root.path().join("agent-1/simulator-1.done"), "").unwrap();
        fs::write(root.path().join("agent-1/agent-1.crash7"), "").unwrap();
        assert_eq!(present(root.path(), 2, Host::Simulator), files);
        assert_eq!(present(root.path(), 1, Host::Simulator).len(), 4);
    }

    #[test]
    fn the_files_of_the_other_kind_of_host_are_not_present() {
        let root = tempfile::tempdir().unwrap();
        let evaluator = StatusFile::Of(member(Side::Host(Host::Evaluator), 1), Mark::Start(0));
        let simulator = StatusFile::Of(member(Side::Host(Host::Simulator), 1), Mark::Done);
        let agent = StatusFile::Of(member(Side::Agent, 1), Mark::Start(0));
        for file in [evaluator, simulator, agent] {
            file.create(root.path()).unwrap();
        }
        assert_eq!(present(root.path(), 1, Host::Evaluator), [evaluator, agent]);
        assert_eq!(present(root.path(), 1, Host::Simulator), [simulator, agent]);
    }

    /// A pipe that was opened would wait for its other end, and the test with it.
    #[test]
    fn a_name_counts_whatever_kind_of_file_it_is_and_none_is_opened() {
        let root = tempfile::tempdir().unwrap();
        let agent = member(Side::Agent, 1);
        let at = |mark| StatusFile::Of(agent, mark).path(root.path());
        fs::create_dir(root.path().join("agent-1")).unwrap();
        let outside = root.path().join("outside");
        let pipe = at(Mark::Start(0));
        assert!(Command::new("mkfifo").arg(&pipe).status().unwrap().success());
        fs::create_dir(at(Mark::Crash(0))).unwrap();
        symlink(&outside, at(Mark::Start(1))).unwrap();
        symlink(at(Mark::Done), at(Mark::Done)).unwrap();
        let files =
            [Mark::Start(0), Mark::Crash(0), Mark::Start(1), Mark::Done].map(|mark| StatusFile::Of(agent, mark));
        for file in files {
            assert!(file.exists(root.path()), "{}", file.name());
            file.create(root.path()).unwrap();
        }
        assert!(!outside.exists(), "no link is followed");
        assert_eq!(present(root.path(), 1, Host::Simulator), files);
        assert_eq!(
            Progress::read(root.path(), agent),
            Progress {
                crashes: 1,
                started: true,
                done: true
            }
        );
    }

    #[test]
    fn a_status_folder_that_cannot_be_written_is_an_error() {
        let root = tempfile::tempdir().unwrap();
        fs::write(root.path().join("logcopy"), "").unwrap();
        assert!(StatusFile::Cancel.create(root.path()).is_err());
    }
}
