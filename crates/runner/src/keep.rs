//! Keeps the last whole checkpoint, and gives it back before the command starts again.
//!
//! The evaluator truncates its file before it writes it anew. An evaluator that is killed in between leaves half of a file, from which
//! the next evaluator would start at the first route. So each time the file was written, a copy of it is made in the agent's
//! sub-folder of the status files, where nothing but this container writes.
//!
//! Called by `run`. Both files are the agent's to change, so nothing is followed, and what is copied is bounded. It is no
//! judgement: an agent that keeps a wrong copy harms its own results.

use std::fs::{self, File, Permissions};
use std::io::{self, Read, Seek};
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use crate::checkpoint::{self, MAX_BYTES, Unreadable};
use crate::kernel;
use thiserror::Error;

/// Behind inotify, for whatever it misses.
const SLOW_LOOK: Duration = Duration::from_secs(1);
/// Pause after each copy, for each byte: a second for the largest file, so that one that is written all the time leaves the
/// runner most of its own. By size and not by time taken: on a busy node an honest file must not wait for the next route.
const PAUSE_NANOS: u64 = 15;
/// Bits without which `logcopy`, which runs as another user, reads nothing.
const READABLE: u32 = 0o444;

/// Size, time of change and inode: by which one content of a file differs from the next.
pub(crate) type Stamp = (u64, i64, i64, u64);

/// The keeper of one agent's checkpoint.
#[derive(Debug)]
pub(crate) struct Keeper {
    checkpoint: PathBuf,
    kept: PathBuf,
    /// Stamp of the last copy.
    copied: Option<Stamp>,
    /// The file was written, and was not looked at since.
    due: bool,
    looked: Instant,
    not_before: Instant,
    complained: bool,
}

/// Why the command would start at the first route, although there is a whole checkpoint.
#[derive(Debug, Error)]
#[error("the checkpoint {torn}, and the last whole one cannot be put back: {why}")]
pub(crate) struct NotPutBack {
    torn: &'static str,
    why: Failure,
}

impl NotPutBack {
    /// True if its node is the cause, and not what lies in the folder.
    pub(crate) fn is_nodes(&self) -> bool {
        matches!(&self.why, Failure::Io(error) if kernel::is_nodes(error))
    }
}

impl Keeper {
    pub(crate) fn new(checkpoint: PathBuf, kept: PathBuf) -> Self {
        let now = Instant::now();
        Self {
            checkpoint,
            kept,
            copied: None,
            due: false,
            looked: now,
            not_before: now,
            complained: false,
        }
    }

    /// Before the command starts: what is whole is kept, and what is torn or gone is replaced by what was kept. An error shows why
    /// that cannot be: the command would start at the first route.
    pub(crate) fn prepare(&mut self) -> Result<(), NotPutBack> {
        let torn = match checkpoint::read(&self.checkpoint) {
            Err(Unreadable::Missing) => "is gone",
            Err(Unreadable::Malformed { .. }) => "was left half written",
            _ => {
                self.keep();
                return Ok(());
            }
        };
        let Ok(kept) = checkpoint::open(&self.kept).and_then(whole) else {
            return Ok(());
        };
        // Half of a file is of no use, and on a full disk its room is.
        let _ = fs::remove_file(&self.checkpoint);
        match replace(&self.checkpoint, kept) {
            Ok(()) => {
                crate::say(format_args!(
                    "the checkpoint {torn}; the last whole one is back in its place"
                ));
                Ok(())
            }
            Err(why) => Err(NotPutBack { torn, why }),
        }
    }

    /// While the command runs. `written`: its file was just closed by a writer.
    pub(crate) fn follow(&mut self, written: bool) {
        self.due |= written || self.looked.elapsed() >= SLOW_LOOK;
        if self.due && Instant::now() >= self.not_before {
            self.keep();
        }
    }

    /// How long the next look has to wait, if one is due.
    pub(crate) fn pause(&self) -> Option<Duration> {
        self.due
            .then(|| self.not_before.saturating_duration_since(Instant::now()))
    }

    fn keep(&mut self) {
        self.due = false;
        self.looked = Instant::now();
        let stamp = stamp(&self.checkpoint);
        let size = stamp.map_or(0, |(size, ..)| size.min(MAX_BYTES));
        if stamp.is_some() && stamp != self.copied {
            match self.copy() {
                Ok(()) => self.copied = stamp,
                // Another writer is at it, or it is none of ours to copy.
                Err(Failure::NotWhole) => {}
                Err(Failure::Io(error)) => self.complain(&error),
            }
        }
        self.not_before = Instant::now() + Duration::from_nanos(size * PAUSE_NANOS);
    }

    fn copy(&self) -> Result<(), Failure> {
        let source = checkpoint::open(&self.checkpoint)?;
        let metadata = source.metadata()?;
        if metadata.len() > MAX_BYTES {
            return Err(Failure::NotWhole);
        }
        let mode = metadata.mode();
        if mode & READABLE != READABLE {
            source.set_permissions(Permissions::from_mode(mode & 0o777 | READABLE))?;
        }
        // The copy is looked at, since the file may be written anew meanwhile.
        replace(&self.kept, source)
    }

    fn complain(&mut self, error: &io::Error) {
        if !std::mem::replace(&mut self.complained, true) {
            crate::say(format_args!(
                "no copy of the checkpoint is kept ({error}): a kill while it is written can cost finished routes"
            ));
        }
    }
}

#[derive(Debug)]
enum Failure {
    NotWhole,
    Io(io::Error),
}

impl From<io::Error> for Failure {
    fn from(error: io::Error) -> Self {
        Self::Io(error)
    }
}

impl From<Unreadable> for Failure {
    fn from(error: Unreadable) -> Self {
        match error {
            Unreadable::Io(error) => Self::Io(error),
            _ => Self::NotWhole,
        }
    }
}

/// A checkpoint from which a run can be resumed, read from its beginning.
fn whole(mut file: File) -> Result<File, Unreadable> {
    let found = checkpoint::parse(file.try_clone().map_err(Unreadable::Io)?)?;
    file.rewind().map_err(Unreadable::Io)?;
    if found.partial || found.complete {
        Ok(file)
    } else {
        Err(Unreadable::Missing)
    }
}

/// Puts a copy of `source` in the place of `target`, if it is a whole checkpoint.
fn replace(target: &Path, source: File) -> Result<(), Failure> {
    let name = target.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let temporary = target.with_file_name(format!(".{name}.tmp"));
    let mut copy = checkpoint::create(&temporary)?;
    let copied = io::copy(&mut source.take(MAX_BYTES), &mut copy)
        .and_then(|_| copy.rewind())
        .map_err(Failure::from)
        .and_then(|()| Ok(whole(copy)?))
        .and_then(|_| Ok(fs::rename(&temporary, target)?));
    if copied.is_err() {
        // It stays out of the way by its name; the next copy replaces it.
        let _ = fs::remove_file(&temporary);
    }
    copied
}

/// The stamp of a regular file.
pub(crate) fn stamp(path: &Path) -> Option<Stamp> {
    let metadata = fs::symlink_metadata(path).ok()?;
    let stamp = (metadata.len(), metadata.mtime(), metadata.mtime_nsec(), metadata.ino());
    metadata.is_file().then_some(stamp)
}

impl std::fmt::Display for Failure {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::NotWhole => f.write_str("the copy is no whole checkpoint"),
            Self::Io(error) => error.fmt(f),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::symlink;
    use std::process::Command;

    use super::*;

    const FIRST: &str = r#"{"_checkpoint": {"global_record": {}, "progress": [1, 5]}}"#;
    const SECOND: &str = r#"{"_checkpoint": {"global_record": {}, "progress": [2, 5]}}"#;

    struct Folder {
        folder: tempfile::TempDir,
        keeper: Keeper,
    }

    impl Folder {
        fn new() -> Self {
            let folder = tempfile::tempdir().unwrap();
            let keeper = Keeper::new(
                folder.path().join("agent_results.json"),
                folder.path().join("checkpoint.json"),
            );
            Self { folder, keeper }
        }

        fn write(&self, text: &str) {
            fs::write(&self.keeper.checkpoint, text).unwrap();
        }

        /// Starts this container again after its runner has died.
        fn restart(&mut self) -> String {
            self.keeper = Keeper::new(self.keeper.checkpoint.clone(), self.keeper.kept.clone());
            self.keeper.prepare().unwrap();
            fs::read_to_string(&self.keeper.checkpoint).unwrap_or_default()
        }

        fn written(&mut self, text: &str) {
            self.write(text);
            self.keeper.not_before = Instant::now();
            self.keeper.follow(true);
        }

        fn kept(&self) -> String {
            fs::read_to_string(&self.keeper.kept).unwrap_or_default()
        }
    }

    #[test]
    fn what_was_torn_or_lost_is_replaced_by_the_last_whole_one() {
        let mut folder = Folder::new();
        assert_eq!(folder.restart(), "", "there is nothing to give back");
        folder.written(FIRST);
        folder.written(SECOND);
        for torn in ["", &SECOND[..20]] {
            folder.written(torn);
            assert_eq!(
                (folder.kept(), folder.restart()),
                (SECOND.to_owned(), SECOND.to_owned())
            );
        }
        fs::remove_file(&folder.keeper.checkpoint).unwrap();
        assert_eq!(folder.restart(), SECOND);
        let mode = fs::metadata(&folder.keeper.checkpoint).unwrap().permissions().mode();
        assert_eq!(mode & 0o777, 0o644);
    }

    #[test]
    fn what_cannot_be_put_back_keeps_the_command_from_starting_over() {
        let mut folder = Folder::new();
        folder.written(FIRST);
        fs::remove_file(&folder.keeper.checkpoint).unwrap();
        // A folder in the way, as good as a full disk.
        fs::create_dir(folder.folder.path().join(".agent_results.json.tmp")).unwrap();
        let why = folder.keeper.prepare().unwrap_err().to_string();
        assert!(
            why.starts_with("the checkpoint is gone, and the last whole one cannot be put back: "),
            "{why}"
        );
        assert_eq!(folder.kept(), FIRST);
    }

    #[test]
    fn a_whole_one_that_was_never_copied_stays_and_is_kept() {
        let mut folder = Folder::new();
        folder.written(FIRST);
        folder.write(SECOND);
        assert_eq!(
            (folder.restart(), folder.kept()),
            (SECOND.to_owned(), SECOND.to_owned())
        );
    }

    #[test]
    fn a_route_without_a_number_is_not_taken_back() {
        let without =
            r#"{"_checkpoint": {"global_record": {}, "progress": [2, 5], "records": [{"meta": {"mean": NaN}}]}}"#;
        let mut folder = Folder::new();
        folder.written(FIRST);
        folder.written(without);
        assert_eq!(
            (folder.kept(), folder.restart()),
            (without.to_owned(), without.to_owned())
        );
    }

    #[test]
    fn a_file_without_results_replaces_nothing() {
        let mut folder = Folder::new();
        folder.written(FIRST);
        folder.written(r#"{"_checkpoint": {"global_record": {}, "progress": []}}"#);
        assert_eq!(folder.kept(), FIRST);
    }

    #[test]
    fn nothing_is_followed_and_nothing_large_is_copied() {
        let mut folder = Folder::new();
        let outside = folder.folder.path().join("outside");
        fs::write(&outside, FIRST).unwrap();
        symlink(&outside, &folder.keeper.checkpoint).unwrap();
        folder.keeper.follow(true);
        assert_eq!(folder.kept(), "");
        fs::remove_file(&folder.keeper.checkpoint).unwrap();
        File::create(&folder.keeper.checkpoint)
            .unwrap()
            .set_len(10 << 30)
            .unwrap();
        folder.keeper.follow(true);
        assert_eq!(folder.kept(), "");
        fs::remove_file(&folder.keeper.checkpoint).unwrap();
        // The place of the copy is the agent's as well.
        let temporary = folder.folder.path().join(".checkpoint.json.tmp");
        symlink(&outside, &temporary).unwrap();
        symlink(&outside, &folder.keeper.kept).unwrap();
        folder.written(SECOND);
        assert_eq!(
            (folder.kept(), fs::read_to_string(&outside).unwrap()),
            (SECOND.to_owned(), FIRST.to_owned())
        );
    }

    #[test]
    fn a_pipe_or_a_folder_in_the_place_of_the_copy_holds_nothing_up() {
        let mut folder = Folder::new();
        let at = |folder: &Folder, name: &str| folder.folder.path().join(name);
        let pipe = |path: &Path| assert!(Command::new("mkfifo").arg(path).status().unwrap().success());
        pipe(&folder.keeper.kept);
        assert_eq!(folder.restart(), "", "there is nothing to give back");
        pipe(&at(&folder, ".checkpoint.json.tmp"));
        folder.written(FIRST);
        assert_eq!(folder.kept(), FIRST, "the copy takes the place of both pipes");
        fs::create_dir(at(&folder, ".checkpoint.json.tmp")).unwrap();
        folder.written(SECOND);
        assert_eq!((folder.kept().as_str(), folder.keeper.complained), (FIRST, true));
        fs::remove_dir(at(&folder, ".checkpoint.json.tmp")).unwrap();
        fs::remove_file(&folder.keeper.kept).unwrap();
        fs::create_dir(&folder.keeper.kept).unwrap();
        folder.written(SECOND);
        assert_eq!(folder.restart(), SECOND, "the command goes on without a copy");
        fs::remove_file(&folder.keeper.checkpoint).unwrap();
        assert_eq!(folder.restart(), "");
    }

    #[test]
    fn a_checkpoint_of_mode_0600_becomes_readable_while_the_agent_runs() {
        let mut folder = Folder::new();
        folder.write(FIRST);
        fs::set_permissions(&folder.keeper.checkpoint, Permissions::from_mode(0o600)).unwrap();
        folder.keeper.follow(true);
        let mode = fs::metadata(&folder.keeper.checkpoint).unwrap().permissions().mode();
        assert_eq!((mode & 0o777, folder.kept()), (0o644, FIRST.to_owned()));
    }

    #[test]
    fn a_file_that_is_written_all_the_time_costs_a_share_of_the_time() {
        let mut folder = Folder::new();
        folder.written(FIRST);
        folder.keeper.not_before = Instant::now() + Duration::from_mins(1);
        folder.write(SECOND);
        folder.keeper.follow(true);
        assert_eq!(folder.kept(), FIRST);
        assert!(folder.keeper.pause().unwrap() > Duration::from_secs(10));
        folder.keeper.not_before = Instant::now();
        folder.keeper.follow(false);
        assert_eq!((folder.kept().as_str(), folder.keeper.pause()), (SECOND, None));
    }
}
