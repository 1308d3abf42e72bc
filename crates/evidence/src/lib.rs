//! A folder whose content strangers write: opened without following anything, read within limits.
//!
//! Called by everything in the Pod that reads or writes the `logs` volume. An agent can put links, pipes and millions of files into
//! its folder; none of that may lead out of the volume, block a reader, or cost more than a bound.

use std::collections::BTreeMap;
use std::ffi::CString;
use std::fs::File;
use std::io::{self, Read};
use std::os::fd::OwnedFd;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use nix::dir::Dir;
use nix::errno::Errno;
use nix::fcntl::{AtFlags, OFlag, OpenHow, ResolveFlag, openat, openat2};
use nix::sys::stat::{FileStat, Mode, SFlag, fchmod, fstatat, mkdirat};
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

/// Why an entry of a folder is left out.
#[derive(thiserror::Error, Clone, Copy, Debug, PartialEq, Eq)]
pub enum LeftOut {
    /// A link, pipe, socket or device.
    #[error("it is neither a regular file nor a folder")]
    NotRegular,
    /// A name that is no text, or a path that can be no key.
    #[error("its name has characters that are not taken, or its path is too long")]
    Name,
    /// Deeper than is looked.
    #[error("it lies in more than {MAX_DEPTH} folders")]
    Deep,
    /// One more than is looked at.
    #[error("there are too many files and folders")]
    Many,
    /// The system's own reason.
    #[error("it can't be read ({})", .0.desc())]
    Unreadable(Errno),
}

impl LeftOut {
    /// True if the entry is the reason, which its writer can change; see [`TreeError::is_the_writers`].
    pub fn is_the_writers(self) -> bool {
        match self {
            Self::Unreadable(errno) => TreeError::from(errno).is_the_writers(),
            Self::NotRegular | Self::Name | Self::Deep | Self::Many => true,
        }
    }
}

/// The files found by [`Tree::walk`].
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Walk {
    /// By path below the tree's root.
    pub files: BTreeMap<String, Stamp>,
    /// Number of entries that are left out.
    pub left_out: usize,
    /// The first of them, whose path is a stranger's text.
    pub first: Option<(String, LeftOut)>,
    /// True if their writer can have files among them. A link or a pipe holds no bytes.
    pub hides: bool,
}

impl Walk {
    fn leave_out(&mut self, path: String, why: LeftOut) {
        self.left_out = self.left_out.saturating_add(1);
        self.hides |= why != LeftOut::NotRegular && why.is_the_writers();
        self.first.get_or_insert((path, why));
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
            let most = limit.saturating_sub(looked_at).saturating_add(1);
            let (dir, names) = match self.names(&folder, most) {
                Ok(Some(listed)) => listed,
                Ok(None) => continue,
                Err(why) => {
                    walk.leave_out(folder, why);
                    continue;
                }
            };
            for name in names {
                looked_at = looked_at.saturating_add(1);
                let path = format!("{folder}/{}", name.to_string_lossy());
                if looked_at > limit {
                    walk.leave_out(path, LeftOut::Many);
                    return walk;
                }
                if name.to_str().is_err() || !is_plain(&path) {
                    walk.leave_out(path, LeftOut::Name);
                    continue;
                }
                let stat = match fstatat(&dir, name.as_c_str(), AtFlags::AT_SYMLINK_NOFOLLOW) {
                    Ok(stat) => stat,
                    Err(Errno::ENOENT) => continue,
                    Err(errno) => {
                        walk.leave_out(path, LeftOut::Unreadable(errno));
                        continue;
                    }
                };
                match SFlag::from_bits_truncate(stat.st_mode & SFlag::S_IFMT.bits()) {
                    SFlag::S_IFDIR if depth < MAX_DEPTH => folders.push((path, depth.saturating_add(1))),
                    SFlag::S_IFDIR => walk.leave_out(path, LeftOut::Deep),
                    SFlag::S_IFREG => _ = walk.files.insert(path, Stamp::of_stat(&stat)),
                    _ => walk.leave_out(path, LeftOut::NotRegular),
                }
            }
        }
        walk
    }

    /// An open folder, and at most so many names in it; `None` if there is no folder.
    fn names(&self, folder: &str, most: usize) -> Result<Option<(Dir, Vec<CString>)>, LeftOut> {
        let opened = self.at(folder, OFlag::O_RDONLY | OFlag::O_DIRECTORY);
        let mut dir = match opened.and_then(|fd| Ok(Dir::from_fd(fd)?)) {
            Ok(dir) => dir,
            Err(TreeError::Io(error)) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
            Err(TreeError::Io(error)) => {
                return Err(LeftOut::Unreadable(Errno::from_raw(error.raw_os_error().unwrap_or(0))));
            }
            Err(_) => return Err(LeftOut::NotRegular),
        };
        let names = dir.iter().map(|entry| entry.map(|entry| entry.file_name().to_owned()));
        let names = names.filter(|name| !name.as_ref().is_ok_and(|name| matches!(name.to_bytes(), b"." | b"..")));
        let names: Result<Vec<CString>, Errno> = names.take(most).collect();
        Ok(Some((dir, names.map_err(LeftOut::Unreadable)?)))
    }

    /// Makes a folder and those above it, writable for every user: containers of any user work in them.
    pub fn folder(&self, relative: &str) -> Result<OwnedFd, TreeError> {
        plain(relative)?;
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

    /// Empties a folder, and makes it if there is none. No stranger may write where it lies.
    pub fn clear(&self, relative: &str) -> Result<(), TreeError> {
        plain(relative)?;
        match std::fs::remove_dir_all(self.path.join(relative)) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error.into()),
            _ => {}
        }
        self.folder(relative).map(drop)
    }

    /// Makes a file that every user may read and write, in place of what is there.
    pub fn create(&self, relative: &str) -> Result<File, TreeError> {
        let (folder, name) = relative.rsplit_once('/').ok_or(TreeError::Path)?;
        plain(relative)?;
        let folder = self.folder(folder)?;
        unlink(&folder, name)?;
        let flags = OFlag::O_WRONLY | OFlag::O_CREAT | OFlag::O_EXCL | OFlag::O_NOFOLLOW | OFlag::O_CLOEXEC;
        let mode = Mode::from_bits_truncate(0o666);
        let file = openat(&folder, name, flags, mode)?;
        fchmod(&file, mode)?;
        Ok(file.into())
    }

    /// Removes a file, if there is one.
    pub fn remove(&self, relative: &str) -> Result<(), TreeError> {
        let (folder, name) = relative.rsplit_once('/').ok_or(TreeError::Path)?;
        let folder = self.at(folder, OFlag::O_RDONLY | OFlag::O_DIRECTORY)?;
        unlink(&folder, name)
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
        plain(relative)?;
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
        plain(relative)?;
        let flags = flags | OFlag::O_CLOEXEC | OFlag::O_NOFOLLOW | OFlag::O_NOCTTY;
        let beneath = ResolveFlag::RESOLVE_BENEATH
            | ResolveFlag::RESOLVE_NO_SYMLINKS
            | ResolveFlag::RESOLVE_NO_MAGICLINKS
            | ResolveFlag::RESOLVE_NO_XDEV;
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

    fn of_stat(stat: &FileStat) -> Self {
        Self {
            size: u64::try_from(stat.st_size).unwrap_or(0),
            mtime: (stat.st_mtime, stat.st_mtime_nsec),
            inode: stat.st_ino,
        }
    }
}

fn plain(path: &str) -> Result<(), TreeError> {
    if is_plain(path) { Ok(()) } else { Err(TreeError::Path) }
}

fn unlink(folder: &OwnedFd, name: &str) -> Result<(), TreeError> {
    match unlinkat(folder, name, UnlinkatFlags::NoRemoveDir) {
        Ok(()) | Err(Errno::ENOENT) => Ok(()),
        Err(errno) => Err(errno.into()),
    }
}

/// True if a path is relative, stays below its root, and can be a key.
pub fn is_plain(path: &str) -> bool {
    path.len() <= MAX_PATH
        && !path.chars().any(char::is_control)
        && path.split('/').all(|name| !matches!(name, "" | "." | ".."))
}

#[cfg(test)]
mod tests;
