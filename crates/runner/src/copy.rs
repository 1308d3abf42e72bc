//! A folder that is copied from an image into a volume: the data of a challenge, for containers of other images. Called by `main`.
//!
//! The image is the host's and needs no shell. Its users may be others than those that read the copy, so that all may read it. What would
//! be something else in another container is refused: a device, or a link out of the folder.

use std::fs::{self, File, OpenOptions};
use std::io::{self, ErrorKind, Read};
use std::os::unix::fs::{MetadataExt, OpenOptionsExt, symlink};
use std::path::{Component, Path, PathBuf};

use thiserror::Error;

use crate::decide::{CODE_CRASHED, CODE_OVER};
use crate::wake::Signals;
use crate::{report, say};
use leaderboard_runner::args::Copied;

/// Bytes between two looks at signals.
const CHUNK: u64 = 8 << 20;

#[derive(Debug, Error)]
enum CopyError {
    /// The kernel refuses it.
    #[error("{path} cannot be {what}: {source}", path = path.display())]
    Io {
        what: &'static str,
        path: PathBuf,
        source: io::Error,
    },
    /// It would be copied into itself.
    #[error("{} is where the copy goes, so it cannot hold the data; keep the data in another folder of the image", .0.display())]
    Inside(PathBuf),
    #[error("{} is neither a file, a folder nor a link; remove it from the image", .0.display())]
    Kind(PathBuf),
    #[error(
        "the link {link} has the target {target}; make it a relative path inside the copied folder, with each .. at its front",
        link = link.display(),
        target = target.display()
    )]
    Link { link: PathBuf, target: PathBuf },
    /// The container was ended from outside.
    #[error("the copy was stopped")]
    Stopped,
}

/// Copies the folder; the exit code.
pub(crate) fn run(copied: &Copied, mut signals: Signals) -> i32 {
    let error = match copy(&copied.from, &copied.to, || signals.drain()) {
        Ok(()) => return CODE_OVER,
        Err(error) => error.to_string(),
    };
    say(format_args!("{error}"));
    report::write(&copied.termination_log, &error);
    CODE_CRASHED
}

/// Copies all that is in the folder over what is there already. The modes of the copies are those that the umask leaves.
fn copy(from: &Path, to: &Path, mut is_stopped: impl FnMut() -> bool) -> Result<(), CopyError> {
    let from = from.canonicalize().map_err(cannot_be("read", from))?;
    if to.canonicalize().map_err(cannot_be("opened", to))?.starts_with(&from) {
        return Err(CopyError::Inside(from));
    }
    let mut folders = vec![(from, to.to_owned(), 0)];
    while let Some((source, copied, depth)) = folders.pop() {
        for entry in source.read_dir().map_err(cannot_be("read", &source))? {
            let entry = entry.map_err(cannot_be("read", &source))?;
            let (path, target) = (entry.path(), copied.join(entry.file_name()));
            let kind = entry.file_type().map_err(cannot_be("read", &path))?;
            if kind.is_dir() {
                unless(fs::create_dir(&target), ErrorKind::AlreadyExists).map_err(cannot_be("created", &target))?;
                folders.push((path, target, depth + 1));
            } else if kind.is_symlink() {
                copy_link(&path, &target, depth)?;
            } else if kind.is_file() {
                copy_file(&path, &target, &mut is_stopped)?;
            } else {
                return Err(CopyError::Kind(path));
            }
        }
    }
    Ok(())
}

fn copy_link(path: &Path, to: &Path, depth: usize) -> Result<(), CopyError> {
    let target = path.read_link().map_err(cannot_be("read", path))?;
    if !stays_inside(&target, depth) {
        let link = path.to_owned();
        return Err(CopyError::Link { link, target });
    }
    remove(to)?;
    symlink(target, to).map_err(cannot_be("created", to))
}

fn copy_file(path: &Path, to: &Path, is_stopped: &mut impl FnMut() -> bool) -> Result<(), CopyError> {
    let mut source = File::open(path).map_err(cannot_be("read", path))?;
    let rights = source.metadata().map_err(cannot_be("read", path))?.mode();
    let mode = if rights & 0o111 == 0 { 0o644 } else { 0o755 };
    remove(to)?;
    let mut options = OpenOptions::new();
    let opened = options.write(true).create_new(true).mode(mode).open(to);
    let mut target = opened.map_err(cannot_be("created", to))?;
    while io::copy(&mut source.by_ref().take(CHUNK), &mut target).map_err(cannot_be("copied", path))? > 0 {
        if is_stopped() {
            return Err(CopyError::Stopped);
        }
    }
    Ok(())
}

/// True if a link in a folder so deep below the top leads to nothing above it, in the copy too. A `..` behind a name may lead anywhere,
/// since the name can be that of a link.
fn stays_inside(target: &Path, depth: usize) -> bool {
    let is_front = |part: &Component<'_>| matches!(part, Component::ParentDir | Component::CurDir);
    let front = target.components().take_while(is_front);
    let parents = front.filter(|part| *part == Component::ParentDir).count();
    let mut names = target.components().skip_while(is_front);
    parents <= depth && names.all(|part| matches!(part, Component::Normal(_)))
}

fn remove(path: &Path) -> Result<(), CopyError> {
    unless(fs::remove_file(path), ErrorKind::NotFound).map_err(cannot_be("replaced", path))
}

/// The result, in which an error of this kind is none.
fn unless(result: io::Result<()>, fine: ErrorKind) -> io::Result<()> {
    match result {
        Err(error) if error.kind() == fine => Ok(()),
        other => other,
    }
}

fn cannot_be(what: &'static str, path: &Path) -> impl FnOnce(io::Error) -> CopyError {
    move |source| CopyError::Io {
        what,
        path: path.to_owned(),
        source,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_link_stays_inside_if_its_parents_come_first_and_are_no_more_than_its_own() {
        for (target, depth, expected) in [
            ("a", 0, true),
            ("./a/b", 0, true),
            ("..", 1, true),
            (".././../a", 2, true),
            ("..", 0, false),
            ("../../a", 1, false),
            ("a/../b", 1, false),
            ("/a", 1, false),
            ("/", 1, false),
        ] {
            assert_eq!(stays_inside(Path::new(target), depth), expected, "{target} at {depth}");
        }
    }

    #[test]
    fn a_copy_ends_where_it_is_stopped() {
        let folder = tempfile::tempdir().unwrap();
        let (from, to) = (folder.path().join("from"), folder.path().join("to"));
        for name in [&from, &to] {
            fs::create_dir(name).unwrap();
        }
        let large = File::create(from.join("large")).unwrap();
        large.set_len(2 * CHUNK).unwrap();
        assert!(matches!(copy(&from, &to, || true), Err(CopyError::Stopped)));
        assert_eq!(fs::metadata(to.join("large")).unwrap().len(), CHUNK);
        copy(&from, &to, || false).unwrap();
        assert_eq!(fs::metadata(to.join("large")).unwrap().len(), 2 * CHUNK);
    }
}
