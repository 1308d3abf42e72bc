//! Reports that something in a few folders may have changed, so that a round need not wait for its period.
//!
//! Called by `logcopy`. It never reports what changed: who is woken reads everything again. Where inotify does not work (some sandboxed
//! runtimes do not carry it between containers), the period is all there is.

use std::ffi::OsStr;
use std::io::{self, PipeReader, PipeWriter};
use std::os::fd::AsFd;
use std::path::Path;
use std::sync::Arc;

use nix::errno::Errno;
use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use nix::sys::inotify::{AddWatchFlags, InitFlags, Inotify, InotifyEvent};
use tokio::sync::Notify;

/// Watches folders, on a thread of its own that ends with it.
#[derive(Debug)]
pub struct Watch {
    inotify: Arc<Inotify>,
    changed: Arc<Notify>,
    /// Closed when this is dropped, which ends the thread.
    _alive: PipeWriter,
}

impl Watch {
    /// Nothing is watched yet. Only files and folders whose names `matter` will wake.
    pub fn new(matters: fn(&OsStr) -> bool) -> io::Result<Self> {
        let inotify = Arc::new(Inotify::init(InitFlags::IN_NONBLOCK | InitFlags::IN_CLOEXEC)?);
        let changed = Arc::new(Notify::new());
        let (end, alive) = io::pipe()?;
        let thread = {
            let (inotify, changed) = (Arc::clone(&inotify), Arc::clone(&changed));
            move || listen(&inotify, &end, matters, &changed)
        };
        std::thread::Builder::new().name("watch".to_owned()).spawn(thread)?;
        Ok(Self {
            inotify,
            changed,
            _alive: alive,
        })
    }

    /// Watches a folder; one that is watched already or does not exist is fine. Returns whether it is watched.
    pub fn add(&self, folder: &Path) -> bool {
        let flags = AddWatchFlags::IN_CREATE
            | AddWatchFlags::IN_MOVED_TO
            | AddWatchFlags::IN_CLOSE_WRITE
            | AddWatchFlags::IN_ONLYDIR
            | AddWatchFlags::IN_DONT_FOLLOW;
        self.inotify.add_watch(folder, flags).is_ok()
    }

    /// Waits until something was made, written or moved in, since the last time this was waited for.
    pub async fn changed(&self) {
        self.changed.notified().await;
    }
}

fn listen(inotify: &Inotify, end: &PipeReader, matters: fn(&OsStr) -> bool, changed: &Notify) {
    loop {
        let mut fds = [
            PollFd::new(inotify.as_fd(), PollFlags::POLLIN),
            PollFd::new(end.as_fd(), PollFlags::POLLIN),
        ];
        match poll(&mut fds, PollTimeout::NONE) {
            Ok(_) | Err(Errno::EINTR) => {}
            Err(_) => return,
        }
        if fds[1].any().unwrap_or(true) {
            return;
        }
        match inotify.read_events() {
            Ok(events) if events.iter().any(|event| is_news(event, matters)) => changed.notify_one(),
            Ok(_) | Err(Errno::EAGAIN | Errno::EINTR) => {}
            Err(_) => return,
        }
    }
}

fn is_news(event: &InotifyEvent, matters: fn(&OsStr) -> bool) -> bool {
    event.mask.contains(AddWatchFlags::IN_Q_OVERFLOW) || event.name.as_deref().is_some_and(matters)
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::time::Duration;

    use super::*;

    #[tokio::test]
    async fn only_names_that_matter_wake() {
        let folder = tempfile::tempdir().unwrap();
        let watch = Watch::new(|name| name == "agent-1.done").unwrap();
        assert!(!watch.add(&folder.path().join("missing")));
        assert!(watch.add(folder.path()) && watch.add(folder.path()));
        let inotify = Arc::downgrade(&watch.inotify);
        fs::write(folder.path().join("noise"), "x").unwrap();
        fs::write(folder.path().join("agent-1.done"), "").unwrap();
        tokio::time::timeout(Duration::from_secs(20), watch.changed())
            .await
            .unwrap();
        drop(watch);
        let ended = tokio::task::spawn_blocking(move || {
            while inotify.strong_count() > 0 {
                std::thread::yield_now();
            }
        });
        tokio::time::timeout(Duration::from_secs(20), ended)
            .await
            .unwrap()
            .unwrap();
    }
}
