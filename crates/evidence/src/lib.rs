//! A folder whose content strangers write: opened without following anything, read within limits.
//!
//! Called by everything in the Pod that reads or writes the `logs` volume. An agent can put links, pipes and millions of files into
//! its folder; none of that may lead out of the volume, block a reader, or cost more than a bound.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, Read};
use std::os::fd::OwnedFd;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use nix::dir::Dir;
use nix::errno::Errno;
use nix::fcntl::{AtFlags, OFlag, OpenHow, ResolveFlag, openat, openat2};
use nix::sys::stat::{Mode, SFlag, fchmod, fstatat, mkdirat};
use nix::unistd::{UnlinkatFlags, unlinkat};
use serde::{Deserialize, Serialize};

/// Longest path, in bytes: with the run's prefix it stays a key S3 takes (1024).
const MAX_PATH: usize = 480;
/// Deepest folder below the one that is walked.
const MAX_DEPTH: usize = 16;

/// Size, time and inode of a file, which together identify its content without reading it.
#[derive(Serialize, Deserialize, Clone, Copy, Debug, PartialEq, Eq, Hash, Default)]
pub struct Stamp {
    /// Bytes.
    pub size: u64,
    /// Seconds and nanoseconds.
    pub mtime: (i64, i64),
    /// Which file it is.
    pub inode: u64,
}

/// Why a file is not read.
#[derive(thiserror::Error, Debug)]
pub enum TreeError {
    /// A link, pipe, device or folder.
    #[error("it is not a regular file")]
    NotRegular,
    /// More than is read.
    #[error("it has {size} bytes, more than the {limit} that are read")]
    TooLarge {
        /// Its bytes.
        size: u64,
        /// The bound.
        limit: u64,
    },
    /// It changed while it was read.
    #[error("it changed while it was read")]
    Changed,
    /// A path that leads elsewhere.
    #[error("its path is not a plain one below the folder")]
    Path,
    /// The system's own text.
    #[error("{0}")]
    Io(#[from] io::Error),
}

impl TreeError {
    /// True if the file is the reason, which its writer can change. A write lease on it, too (EWOULDBLOCK). Everything else is the trouble
    /// of this process or its node: no descriptors, no memory, a disk that fails.
    pub fn is_the_writers(&self) -> bool {
        match self {
            Self::NotRegular | Self::TooLarge { .. } | Self::Path | Self::Changed => true,
            Self::Io(error) => matches!(
                error.kind(),
                io::ErrorKind::PermissionDenied | io::ErrorKind::WouldBlock
            ),
        }
    }
}

impl From<Errno> for TreeError {
    fn from(errno: Errno) -> Self {
        match errno {
            // A link in the way, a way out, or a folder where a file should be.
            Errno::ELOOP | Errno::EXDEV | Errno::EISDIR | Errno::ENOTDIR | Errno::ENXIO => Self::NotRegular,
            other => Self::Io(other.into()),
        }
    }
}

/// The files found by [`Tree::walk`].
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Walk {
    /// By path below the tree's root.
    pub files: BTreeMap<String, Stamp>,
    /// Entries with impossible names, or beyond the limits.
    pub left_out: usize,
}

impl Walk {
    fn leave_out(&mut self) {
        self.left_out = self.left_out.saturating_add(1);
    }
}

/// The folder.
#[derive(Debug)]
pub struct Tree {
    root: OwnedFd,
    path: PathBuf,
    /// A disk that hangs, while a test holds it, or fails.
    #[cfg(any(test, feature = "fixtures"))]
    pub disk: std::sync::Mutex<Option<Errno>>,
}

impl Tree {
    /// Opens it. `path` itself is trusted.
    pub fn open(path: &Path) -> io::Result<Self> {
        let root = File::open(path)?;
        if !root.metadata()?.is_dir() {
            return Err(io::ErrorKind::NotADirectory.into());
        }
        Ok(Self {
            root: root.into(),
            path: path.to_owned(),
            #[cfg(any(test, feature = "fixtures"))]
            disk: std::sync::Mutex::new(None),
        })
    }

    /// Where it is.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Opens a regular file for reading; `None` if there is none.
    pub fn file(&self, relative: &str) -> Result<Option<(File, Stamp)>, TreeError> {
        #[cfg(any(test, feature = "fixtures"))]
        if let Some(trouble) = self.disk.lock().ok().and_then(|disk| *disk) {
            return Err(trouble.into());
        }
        let opened = self
            .look(relative)
            .and_then(|()| self.at(relative, OFlag::O_RDONLY | OFlag::O_NONBLOCK));
        let file = match opened {
            Ok(fd) => File::from(fd),
            Err(TreeError::Io(error)) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
            Err(error) => return Err(error),
        };
        // Looked at again, because it may have been swapped.
        let metadata = file.metadata()?;
        if !metadata.is_file() {
            return Err(TreeError::NotRegular);
        }
        Ok(Some((file, Stamp::of(&metadata))))
    }

    /// Reads a regular file of at most `limit` bytes; `None` if there is none.
    pub fn read(&self, relative: &str, limit: u64) -> Result<Option<(Vec<u8>, Stamp)>, TreeError> {
        let Some((file, stamp)) = self.file(relative)? else {
            return Ok(None);
        };
        let size = stamp.size;
        if size > limit {
            return Err(TreeError::TooLarge { size, limit });
        }
        let mut bytes = Vec::with_capacity(usize::try_from(size).unwrap_or(0));
        // One byte more, so that a file that grows meanwhile is noticed.
        (&file).take(size.saturating_add(1)).read_to_end(&mut bytes)?;
        if bytes.len() as u64 != size || Stamp::of(&file.metadata()?) != stamp {
            return Err(TreeError::Changed);
        }
        Ok(Some((bytes, stamp)))
    }

    /// The regular files below `folder`, looking at no more than `limit` entries. A missing folder is empty.
    pub fn walk(&self, folder: &str, limit: usize) -> Walk {
        let mut walk = Walk::default();
        let mut looked_at: usize = 0;
        let mut folders = vec![(folder.to_owned(), 0_usize)];
        while let Some((folder, depth)) = folders.pop() {
            let flags = OFlag::O_RDONLY | OFlag::O_DIRECTORY;
            let Ok(mut dir) = self.at(&folder, flags).and_then(|fd| Ok(Dir::from_fd(fd)?)) else {
                continue;
            };
            let names: Vec<_> = dir
                .iter()
                .map_while(Result::ok)
                .map(|entry| entry.file_name().to_owned())
                .filter(|name| !matches!(name.to_bytes(), b"." | b".."))
                .take(limit.saturating_sub(looked_at).saturating_add(1))
                .collect();
            for name in names {
                looked_at = looked_at.saturating_add(1);
                let path = name.to_str().map(|name| format!("{folder}/{name}")).ok();
                let Some(path) = path.filter(|path| looked_at <= limit && is_plain(path)) else {
                    walk.leave_out();
                    continue;
                };
                let Ok(stat) = fstatat(&dir, name.as_c_str(), AtFlags::AT_SYMLINK_NOFOLLOW) else {
                    continue;
                };
                match SFlag::from_bits_truncate(stat.st_mode & SFlag::S_IFMT.bits()) {
                    SFlag::S_IFDIR if depth < MAX_DEPTH => folders.push((path, depth.saturating_add(1))),
                    SFlag::S_IFREG => {
                        let stamp = Stamp {
                            size: u64::try_from(stat.st_size).unwrap_or(0),
                            mtime: (stat.st_mtime, stat.st_mtime_nsec),
                            inode: stat.st_ino,
                        };
                        walk.files.insert(path, stamp);
                    }
                    _ => walk.leave_out(),
                }
            }
            if looked_at > limit {
                break;
            }
        }
        walk
    }

    /// Makes a folder and those above it, writable for every user: containers of any user work in them.
    pub fn folder(&self, relative: &str) -> Result<OwnedFd, TreeError> {
        if !is_plain(relative) {
            return Err(TreeError::Path);
        }
        let mut at = self.root.try_clone()?;
        for name in relative.split('/') {
            match mkdirat(&at, name, Mode::from_bits_truncate(0o777)) {
                Ok(()) | Err(Errno::EEXIST) => {}
                Err(errno) => return Err(errno.into()),
            }
            let flags = OFlag::O_RDONLY | OFlag::O_DIRECTORY | OFlag::O_NOFOLLOW | OFlag::O_CLOEXEC;
            at = openat(&at, name, flags, Mode::empty())?;
            match fchmod(&at, Mode::from_bits_truncate(0o777)) {
                // Made by the kubelet as another user, and with this mode.
                Ok(()) | Err(Errno::EPERM) => {}
                Err(errno) => return Err(errno.into()),
            }
        }
        Ok(at)
    }

    /// Makes a file that every user may read and write, in place of what is there.
    pub fn create(&self, relative: &str) -> Result<File, TreeError> {
        let (folder, name) = relative.rsplit_once('/').ok_or(TreeError::Path)?;
        if !is_plain(relative) {
            return Err(TreeError::Path);
        }
        let folder = self.folder(folder)?;
        match unlinkat(&folder, name, UnlinkatFlags::NoRemoveDir) {
            Ok(()) | Err(Errno::ENOENT) => {}
            Err(errno) => return Err(errno.into()),
        }
        let flags = OFlag::O_WRONLY | OFlag::O_CREAT | OFlag::O_EXCL | OFlag::O_NOFOLLOW | OFlag::O_CLOEXEC;
        let mode = Mode::from_bits_truncate(0o666);
        let file = openat(&folder, name, flags, mode)?;
        fchmod(&file, mode)?;
        Ok(file.into())
    }

    /// Removes a file.
    pub fn remove(&self, relative: &str) -> Result<(), TreeError> {
        let (folder, name) = relative.rsplit_once('/').ok_or(TreeError::Path)?;
        let folder = self.at(folder, OFlag::O_RDONLY | OFlag::O_DIRECTORY)?;
        Ok(unlinkat(&folder, name, UnlinkatFlags::NoRemoveDir)?)
    }

    /// Writes one of our own files under another name first, so that no reader gets half of it.
    pub fn write(&self, relative: &str, bytes: &[u8]) -> Result<(), TreeError> {
        use std::io::Write;
        let (folder, name) = relative.rsplit_once('/').ok_or(TreeError::Path)?;
        let temporary = format!(".{name}.tmp");
        self.create(&format!("{folder}/{temporary}"))?.write_all(bytes)?;
        let folder = self.folder(folder)?;
        nix::fcntl::renameat(&folder, temporary.as_str(), &folder, name)?;
        Ok(())
    }

    /// Looks at a file before it is opened: opening a device can act, and a pipe lets its writer go on.
    fn look(&self, relative: &str) -> Result<(), TreeError> {
        if !is_plain(relative) {
            return Err(TreeError::Path);
        }
        let inner;
        let (folder, name) = match relative.rsplit_once('/') {
            None => (&self.root, relative),
            Some((folder, name)) => {
                inner = self.at(folder, OFlag::O_RDONLY | OFlag::O_DIRECTORY)?;
                (&inner, name)
            }
        };
        let stat = fstatat(folder, name, AtFlags::AT_SYMLINK_NOFOLLOW)?;
        match SFlag::from_bits_truncate(stat.st_mode & SFlag::S_IFMT.bits()) {
            SFlag::S_IFREG => Ok(()),
            _ => Err(TreeError::NotRegular),
        }
    }

    fn at(&self, relative: &str, flags: OFlag) -> Result<OwnedFd, TreeError> {
        if !is_plain(relative) {
            return Err(TreeError::Path);
        }
        let flags = flags | OFlag::O_CLOEXEC | OFlag::O_NOFOLLOW | OFlag::O_NOCTTY;
        let beneath =
            ResolveFlag::RESOLVE_BENEATH | ResolveFlag::RESOLVE_NO_SYMLINKS | ResolveFlag::RESOLVE_NO_MAGICLINKS;
        match openat2(&self.root, relative, OpenHow::new().flags(flags).resolve(beneath)) {
            // Some sandboxed runtimes have no openat2.
            Err(Errno::ENOSYS) => self.step_by_step(relative, flags),
            opened => Ok(opened?),
        }
    }

    /// Opens as openat2 does, one name at a time.
    fn step_by_step(&self, relative: &str, flags: OFlag) -> Result<OwnedFd, TreeError> {
        let mut at = self.root.try_clone()?;
        let mut names = relative.split('/').peekable();
        while let Some(name) = names.next() {
            let inner = OFlag::O_RDONLY | OFlag::O_DIRECTORY | OFlag::O_NOFOLLOW | OFlag::O_CLOEXEC;
            let flags = if names.peek().is_some() { inner } else { flags };
            at = openat(&at, name, flags, Mode::empty())?;
        }
        Ok(at)
    }
}

impl Stamp {
    /// The stamp of an open file.
    pub fn of(metadata: &std::fs::Metadata) -> Self {
        Self {
            size: metadata.size(),
            mtime: (metadata.mtime(), metadata.mtime_nsec()),
            inode: metadata.ino(),
        }
    }
}

/// True if a path is relative, stays below its root, and can be a key.
pub fn is_plain(path: &str) -> bool {
    path.len() <= MAX_PATH
        && !path.chars().any(char::is_control)
        && path.split('/').all(|name| !matches!(name, "" | "." | ".."))
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::os::unix::fs::{PermissionsExt, symlink};

    use super::*;

    fn tree() -> (tempfile::TempDir, Tree) {
        let folder = tempfile::tempdir().unwrap();
        fs::create_dir_all(folder.path().join("agent/agent1")).unwrap();
        let tree = Tree::open(folder.path()).unwrap();
        (folder, tree)
    }

    #[test]
    fn paths_that_lead_elsewhere_are_not_plain() {
        for bad in [
            "",
            "/etc/passwd",
            "a/../b",
            "..",
            ".",
            "a//b",
            "a/",
            "a\nb",
            &"x".repeat(481),
        ] {
            assert!(!is_plain(bad), "{bad:?}");
        }
        for good in ["a", "agent/agent1/leaderboard.log", "simulator/ü b/…", ".hidden"] {
            assert!(is_plain(good), "{good:?}");
        }
    }

    #[test]
    fn links_pipes_and_folders_are_no_files() {
        let (folder, tree) = tree();
        let at = |name: &str| folder.path().join("agent/agent1").join(name);
        let outside = tempfile::tempdir().unwrap();
        fs::write(outside.path().join("secret"), "s").unwrap();
        symlink(outside.path().join("secret"), at("link")).unwrap();
        symlink(outside.path(), at("way")).unwrap();
        nix::unistd::mkfifo(&at("pipe"), Mode::from_bits_truncate(0o666)).unwrap();
        fs::create_dir(at("folder")).unwrap();
        fs::write(at("plain"), "p").unwrap();
        for name in ["link", "way/secret", "pipe", "folder"] {
            let error = tree.read(&format!("agent/agent1/{name}"), 10).unwrap_err();
            assert!(matches!(error, TreeError::NotRegular), "{name}: {error}");
            let flags = OFlag::O_RDONLY | OFlag::O_NONBLOCK | OFlag::O_NOFOLLOW;
            let by_steps = tree.step_by_step(&format!("agent/agent1/{name}"), flags);
            assert_eq!(by_steps.is_err(), name.starts_with(['l', 'w']), "{name}");
        }
        assert!(tree.read("agent/agent1/nothing", 10).unwrap().is_none());
        assert_eq!(tree.read("agent/agent1/plain", 1).unwrap().unwrap().0, b"p");
        let walk = tree.walk("agent/agent1", 100);
        assert_eq!(walk.files.keys().collect::<Vec<_>>(), ["agent/agent1/plain"]);
        assert_eq!(walk.left_out, 3);
    }

    #[test]
    fn a_file_beyond_the_limit_is_not_read() {
        let (folder, tree) = tree();
        fs::write(folder.path().join("agent/x"), [0; 11]).unwrap();
        let error = tree.read("agent/x", 10).unwrap_err();
        assert!(matches!(error, TreeError::TooLarge { size: 11, limit: 10 }), "{error}");
    }

    #[test]
    fn a_flood_of_files_costs_no_more_than_the_limit() {
        let (folder, tree) = tree();
        for i in 0..50 {
            fs::write(folder.path().join(format!("agent/agent1/{i}")), "").unwrap();
        }
        let walk = tree.walk("agent", 10);
        assert_eq!(walk.files.len(), 9);
        assert!(walk.left_out > 0);
        assert_eq!(tree.walk("agent", 51).left_out, 0);
        assert_eq!(tree.walk("nothing", 10), Walk::default());
    }

    #[test]
    fn what_is_made_here_is_for_every_user() {
        let (folder, tree) = tree();
        drop(tree.create("simulator/a/b.log").unwrap());
        tree.write("evalai/results.json", b"[]").unwrap();
        tree.write("evalai/results.json", b"[1]").unwrap();
        let mode = |path: &str| fs::metadata(folder.path().join(path)).unwrap().permissions().mode() & 0o7777;
        assert_eq!(
            [mode("simulator/a/b.log"), mode("simulator/a"), mode("simulator")],
            [0o666, 0o777, 0o777]
        );
        assert_eq!(fs::read(folder.path().join("evalai/results.json")).unwrap(), b"[1]");
        assert_eq!(tree.walk("evalai", 10).files.len(), 1);
    }

    #[test]
    fn restored_files_never_go_through_a_link() {
        let (folder, tree) = tree();
        let outside = tempfile::tempdir().unwrap();
        symlink(outside.path(), folder.path().join("simulator")).unwrap();
        assert!(tree.create("simulator/x").is_err());
        assert!(tree.create("a/../../x").is_err());
        assert_eq!(fs::read_dir(outside.path()).unwrap().count(), 0);
    }
}
