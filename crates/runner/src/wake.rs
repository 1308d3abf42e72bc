//! Events that wake the runner: signals (SIGCHLD among them), changes in the folders of its peer and of `logcopy`, and a checkpoint
//! that was written. Called by `run` only. It reports that something may have changed, never what: the caller looks again.

use std::ffi::OsString;
use std::io::{self, Read};
use std::os::fd::{AsFd, BorrowedFd};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};

use nix::errno::Errno;
use nix::sys::inotify::{AddWatchFlags, InitFlags, Inotify, InotifyEvent, WatchDescriptor};
use signal_hook::consts::{SIGCHLD, SIGHUP, SIGINT, SIGQUIT, SIGTERM, SIGUSR1, SIGUSR2};
use signal_hook::low_level::pipe;

/// Images may name another stop signal than SIGTERM, so each of the usual ones asks this container to end.
const ENDING: [i32; 6] = [SIGTERM, SIGINT, SIGQUIT, SIGHUP, SIGUSR1, SIGUSR2];

/// Signals, as bytes in a pipe. They are handled, not blocked: PID 1 ignores what it does not handle, and a command would
/// inherit what is blocked.
#[derive(Debug)]
pub(crate) struct Signals {
    ending: UnixStream,
    child: UnixStream,
}

impl Signals {
    /// Installs the handlers.
    pub(crate) fn open() -> io::Result<Self> {
        let (ending, writer) = UnixStream::pair()?;
        for signal in ENDING {
            pipe::register(signal, writer.try_clone()?)?;
        }
        let (child, writer) = UnixStream::pair()?;
        pipe::register(SIGCHLD, writer)?;
        ending.set_nonblocking(true)?;
        child.set_nonblocking(true)?;
        Ok(Self { ending, child })
    }

    /// Reads all that have come; whether one of them asks this container to end.
    pub(crate) fn drain(&mut self) -> bool {
        drain(&mut self.child);
        drain(&mut self.ending)
    }

    /// Both are readable when a signal has come.
    pub(crate) fn fds(&self) -> [BorrowedFd<'_>; 2] {
        [self.ending.as_fd(), self.child.as_fd()]
    }
}

fn drain(stream: &mut UnixStream) -> bool {
    let mut bytes = [0; 64];
    let mut any = false;
    while matches!(stream.read(&mut bytes), Ok(length) if length > 0) {
        any = true;
    }
    any
}

/// Watched folders. The peers' appear only when the kubelet creates their containers, so their parent is watched too.
#[derive(Debug)]
pub(crate) struct Folders {
    inotify: Option<Inotify>,
    missing: Vec<PathBuf>,
    written: Option<Written>,
}

/// A file whose writers are watched, through its folder: it is replaced, or not there yet.
#[derive(Debug)]
struct Written {
    folder: PathBuf,
    name: OsString,
    watch: Option<WatchDescriptor>,
}

impl Folders {
    /// Watches `root` and `folders` in it, and the writers of `file`. Without inotify (`is_wanted` is false, or the node has none
    /// left) the caller's slow poll does alone.
    pub(crate) fn watch(root: &Path, folders: &[String], file: Option<&Path>, is_wanted: bool) -> Self {
        let opened = if is_wanted {
            Inotify::init(InitFlags::IN_NONBLOCK | InitFlags::IN_CLOEXEC).map_err(|error| error.to_string())
        } else {
            Err("it is switched off".to_owned())
        };
        let inotify = opened
            .inspect_err(|why| crate::say(format_args!("no inotify ({why}): looking once a second instead")))
            .ok();
        let missing = [root.to_owned()]
            .into_iter()
            .chain(folders.iter().map(|folder| root.join(folder)))
            .collect();
        let written = file.and_then(|file| {
            Some(Written {
                folder: file.parent()?.to_owned(),
                name: file.file_name()?.to_owned(),
                watch: None,
            })
        });
        let mut watched = Self {
            inotify,
            missing,
            written,
        };
        watched.refresh();
        watched
    }

    /// Watches what was not there before.
    pub(crate) fn refresh(&mut self) {
        let Some(inotify) = &self.inotify else { return };
        let flags = AddWatchFlags::IN_CREATE | AddWatchFlags::IN_MOVED_TO | AddWatchFlags::IN_ONLYDIR;
        self.missing
            .retain(|folder| inotify.add_watch(folder.as_path(), flags).is_err());
        if let Some(written) = self.written.as_mut().filter(|written| written.watch.is_none()) {
            let flags = AddWatchFlags::IN_CLOSE_WRITE | AddWatchFlags::IN_MOVED_TO | AddWatchFlags::IN_ONLYDIR;
            written.watch = inotify.add_watch(written.folder.as_path(), flags).ok();
        }
    }

    /// Reads pending events; whether somebody has come to the end of writing the file. Bounded, so that a folder somebody floods
    /// with files cannot hold the runner here.
    pub(crate) fn drain(&mut self) -> bool {
        let Some(inotify) = &self.inotify else { return false };
        let mut written = false;
        for _ in 0..64 {
            match inotify.read_events() {
                Ok(events) => written |= events.iter().any(|event| self.is_written(event)),
                Err(Errno::EINTR) => {}
                Err(_) => break,
            }
        }
        self.refresh();
        written
    }

    fn is_written(&self, event: &InotifyEvent) -> bool {
        let of_file = |written: &Written| written.watch == Some(event.wd) && event.name.as_ref() == Some(&written.name);
        event.mask.contains(AddWatchFlags::IN_Q_OVERFLOW) || self.written.as_ref().is_some_and(of_file)
    }

    pub(crate) fn fd(&self) -> Option<BorrowedFd<'_>> {
        self.inotify.as_ref().map(AsFd::as_fd)
    }
}
