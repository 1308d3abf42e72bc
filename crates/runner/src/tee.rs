//! The command's output: one pipe for stdout and stderr, copied byte for byte to our own stdout and to
//! a log. Called by `run` when `poll` reports it; it never blocks on the container's stdout, and holds
//! at most one buffer.

use std::fs::{File, OpenOptions};
use std::io::{self, PipeReader, PipeWriter, Read, Write};
use std::os::fd::{AsFd, BorrowedFd};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use nix::errno::Errno;
use nix::fcntl::OFlag;
use nix::poll::{PollFd, PollFlags, PollTimeout, poll};

const BUFFER: usize = 64 << 10;
/// A pipe that `poll` calls writable takes this much (PIPE_BUF) without blocking.
const PIECE: usize = 4096;

/// Pause where the kernel cannot wait, which only a lack of its memory brings about: no busy loop follows.
const PAUSE: Duration = Duration::from_millis(100);

/// Waits until one of these descriptors or the output has something, at most `limit`. Returns whether the output is readable.
pub(crate) fn wait<'a>(awake: impl Iterator<Item = BorrowedFd<'a>>, tee: Option<&'a Tee>, limit: Duration) -> bool {
    let stdout = io::stdout();
    let mut descriptors: Vec<_> = awake.map(|fd| PollFd::new(fd, PollFlags::POLLIN)).collect();
    // Input is read only while stdout has taken all of it, so a slow reader slows the command and costs no memory.
    let input = tee.and_then(Tee::input);
    if let Some(input) = input {
        descriptors.push(PollFd::new(input, PollFlags::POLLIN));
    } else if tee.is_some_and(Tee::wants_stdout) {
        descriptors.push(PollFd::new(stdout.as_fd(), PollFlags::POLLOUT));
    }
    // A millisecond more, so that what is waited for is over when the caller looks again.
    let milliseconds = u16::try_from(limit.as_millis() + 1).unwrap_or(u16::MAX);
    match poll(&mut descriptors, PollTimeout::from(milliseconds)) {
        Ok(_) | Err(Errno::EINTR) => input.is_some() && descriptors.last().and_then(PollFd::any) == Some(true),
        Err(error) => {
            crate::say(format_args!("cannot wait for events: {error}"));
            std::thread::sleep(PAUSE);
            false
        }
    }
}

/// Copies output.
#[derive(Debug)]
pub(crate) struct Tee {
    input: Option<PipeReader>,
    buffer: Box<[u8]>,
    /// The part of the buffer that stdout has not taken yet.
    pending: std::ops::Range<usize>,
    stdout_open: bool,
    log: Log,
    last_output: Instant,
}

impl Tee {
    /// Opens the pipe and the log. The write end is for the command, which holds the only copies.
    pub(crate) fn open(log: PathBuf, limit: u64) -> io::Result<(Self, PipeWriter)> {
        let (reader, writer) = io::pipe()?;
        let tee = Self {
            input: Some(reader),
            buffer: vec![0; BUFFER].into_boxed_slice(),
            pending: 0..0,
            stdout_open: true,
            log: Log::open(log, limit),
            last_output: Instant::now(),
        };
        Ok((tee, writer))
    }

    /// When the command last printed something (or started), or standard output had at last taken what was printed.
    pub(crate) const fn last_output(&self) -> Instant {
        self.last_output
    }

    /// The descriptor to read from, while there is room.
    pub(crate) fn input(&self) -> Option<BorrowedFd<'_>> {
        if self.pending.is_empty() {
            self.input.as_ref().map(AsFd::as_fd)
        } else {
            None
        }
    }

    /// True if stdout has to take something.
    pub(crate) fn wants_stdout(&self) -> bool {
        !self.pending.is_empty()
    }

    /// Everything was read and handed on.
    pub(crate) fn finished(&self) -> bool {
        self.input.is_none() && self.pending.is_empty()
    }

    /// Reads what the pipe holds, after `poll` reported it as readable.
    pub(crate) fn read(&mut self) {
        let Some(input) = &mut self.input else { return };
        match input.read(&mut self.buffer) {
            Ok(0) => self.input = None,
            Ok(length) => {
                self.log.write(&self.buffer[..length]);
                // After the log: a disk that hangs is not the command's silence.
                self.last_output = Instant::now();
                self.pending = if self.stdout_open { 0..length } else { 0..0 };
            }
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            Err(_) => self.input = None,
        }
    }

    /// Hands stdout as much as it takes without blocking.
    pub(crate) fn write(&mut self) {
        if self.pending.is_empty() {
            return;
        }
        let stdout = io::stdout();
        while !self.pending.is_empty() && is_writable(stdout.as_fd()) {
            let end = self.pending.end.min(self.pending.start + PIECE);
            match nix::unistd::write(&stdout, &self.buffer[self.pending.start..end]) {
                Ok(written) => self.pending.start += written,
                Err(Errno::EINTR | Errno::EAGAIN) => return,
                Err(error) => {
                    crate::say(format_args!(
                        "standard output takes no more ({error}); going on with the log file"
                    ));
                    self.stdout_open = false;
                    self.pending = 0..0;
                }
            }
        }
        if self.pending.is_empty() {
            // No one read the command's pipe meanwhile: its output there is found from now on.
            self.last_output = Instant::now();
        }
    }

    /// Bytes that were read and that stdout never took.
    pub(crate) fn unsent(&self) -> usize {
        self.pending.len()
    }
}

/// The log, until its limit or its first error.
#[derive(Debug)]
struct Log {
    path: PathBuf,
    file: Option<File>,
    /// Bytes that may still be written.
    room: u64,
}

impl Log {
    fn open(path: PathBuf, limit: u64) -> Self {
        let flags = OFlag::O_NOFOLLOW | OFlag::O_NONBLOCK | OFlag::O_NOCTTY;
        let opened = OpenOptions::new()
            .append(true)
            .create(true)
            .mode(0o644)
            .custom_flags(flags.bits())
            .open(&path);
        let checked = opened.and_then(|file| {
            let metadata = file.metadata()?;
            if metadata.is_file() {
                Ok((file, metadata.len()))
            } else {
                Err(io::Error::other("not a regular file"))
            }
        });
        let (file, length) = match checked {
            Ok((file, length)) => (Some(file), length),
            Err(error) => {
                report(&path, &error);
                (None, 0)
            }
        };
        Self {
            path,
            file: file.filter(|_| length < limit),
            room: limit.saturating_sub(length),
        }
    }

    fn write(&mut self, bytes: &[u8]) {
        let Some(file) = &mut self.file else { return };
        let fits = usize::try_from(self.room).unwrap_or(usize::MAX).min(bytes.len());
        let mut written = file.write_all(&bytes[..fits]);
        self.room -= fits as u64;
        if written.is_ok() && fits < bytes.len() {
            written = file.write_all(b"\nleaderboard-runner: the log limit is reached; the rest is not kept here\n");
            self.file = None;
        }
        if let Err(error) = written {
            report(&self.path, &error);
            self.file = None;
        }
    }
}

/// Also true for a descriptor that is broken: the write then shows how.
fn is_writable(fd: BorrowedFd<'_>) -> bool {
    poll(&mut [PollFd::new(fd, PollFlags::POLLOUT)], PollTimeout::ZERO).is_ok_and(|count| count > 0)
}

fn report(path: &Path, error: &io::Error) {
    crate::say(format_args!(
        "{} cannot be written ({error}); going on with standard output alone",
        path.display()
    ));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_full_disk_ends_the_log_and_nothing_else() {
        let file = OpenOptions::new().write(true).open("/dev/full").unwrap();
        let mut log = Log {
            path: PathBuf::from("full"),
            file: Some(file),
            room: 100,
        };
        log.write(b"text");
        assert!(log.file.is_none());
        log.write(b"more");
    }

    #[test]
    fn an_older_log_counts_towards_the_limit() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("leaderboard.log");
        std::fs::write(&path, "12345").unwrap();
        let mut log = Log::open(path.clone(), 8);
        log.write(b"678");
        assert_eq!(std::fs::read_to_string(&path).unwrap(), "12345678");
        log.write(b"9");
        assert_eq!(std::fs::read_to_string(&path).unwrap().matches("limit").count(), 1);
        let after = std::fs::metadata(&path).unwrap().len();
        Log::open(path.clone(), 8).write(b"later");
        assert_eq!(std::fs::metadata(&path).unwrap().len(), after);
    }
}
