//! Limits of the kernel that containers share: by user, or with the whole machine. An image that uses one up must cost another team's run
//! nothing, and never an attempt.
//!
//! Each process gives its part back after a time of its own, however the others end. The test runs these alone.

use std::fs::{self, File};
use std::io::{self, BufRead as _, BufReader, Write as _};
use std::process::{Child, Command, Stdio};
use std::thread;
use std::time::{Duration, Instant};

use nix::errno::Errno;
use nix::libc;
use nix::sys::resource::{Resource, getrlimit, setrlimit};
use nix::unistd::getuid;

use crate::call::{call, of};
use crate::endings::Image;

/// One limit.
#[derive(Debug, Clone, Copy)]
pub struct Limit {
    /// Its name in `PROBE_ENDING`.
    pub id: &'static str,
    pub attack: &'static str,
    pub image: Image,
    /// How the run of another team next to it may end.
    pub neighbor: &'static str,
}

/// All of them.
pub const LIMITS: &[Limit] = &[
    Limit {
        id: "epoll-watches",
        attack: "use up all watches of events that the kernel gives the user of the operator's image",
        image: Image::Operator,
        neighbor: "finished; 1 Job",
    },
    Limit {
        id: "open-files",
        attack: "open as many files as the machine may have open",
        image: Image::User,
        neighbor: "not charged",
    },
];

/// Beginnings of a log line: of one when a limit is used up, and of one when the machine has no such limit.
pub const USED_UP: &str = "probe: used up: ";
pub const NOT_SHOWN: &str = "probe: not shown: ";

/// How long a limit stays used up.
const HOLD: Duration = Duration::from_secs(30);
/// How long using one up may take; after both everything is given back.
const FILL: Duration = Duration::from_mins(1);
/// Files that are watched, and so many that each process opens: fewer than a container's limit of files.
const WATCHED: usize = 3000;
const FILES: usize = 20_000;
const PROCESSES: usize = 200;
/// `EPOLL_CTL_ADD`
const ADD: usize = 1;

/// Uses a limit up and gives it back. None for the id of another attack.
pub(crate) fn run(id: &str) -> Option<io::Result<()>> {
    LIMITS.iter().find(|limit| limit.id == id).map(|limit| {
        let mut child = Command::new("/proc/self/exe")
            .args(["--background", limit.id])
            .spawn()?;
        child.wait().map(|_| ())
    })
}

/// Does the work of a background process; `None` for work of another name.
pub(crate) fn background_work(name: &str) -> Option<io::Result<()>> {
    match name {
        "epoll-watches" => Some(watches()),
        "open-files" => Some(all_files()),
        "some-files" => Some(some_files()),
        _ => None,
    }
}

fn say(text: &str) -> io::Result<()> {
    writeln!(io::stdout(), "{text}")?;
    io::stdout().flush()
}

/// The number in a file of the kernel's.
fn number(path: &str) -> io::Result<usize> {
    let text = fs::read_to_string(path)?;
    text.trim().parse().map_err(io::Error::other)
}

fn watches() -> io::Result<()> {
    let (_, hard) = getrlimit(Resource::RLIMIT_NOFILE)?;
    setrlimit(Resource::RLIMIT_NOFILE, hard, hard)?;
    let most = number("/proc/sys/fs/epoll/max_user_watches")?;
    let descriptor = |made: Result<libc::c_long, Errno>| usize::try_from(made?).map_err(io::Error::other);
    let event = descriptor(call(libc::SYS_eventfd2, of([0, 0])))?;
    let files: Vec<usize> = (0..WATCHED)
        .map(|_| descriptor(call(libc::SYS_dup, of([event]))))
        .collect::<io::Result<_>>()?;
    let begun = Instant::now();
    let (mut held, mut refusal) = (0_usize, None);
    'all: while held <= most && begun.elapsed() < FILL {
        let epoll = descriptor(call(libc::SYS_epoll_create1, of([0])))?;
        for file in &files {
            let no_event = [0_u32; 3];
            let address = no_event.as_ptr().expose_provenance();
            if let Err(errno) = call(libc::SYS_epoll_ctl, of([epoll, ADD, *file, address])) {
                refusal = Some(errno);
                break 'all;
            }
            held += 1;
        }
    }
    let user = getuid();
    match refusal {
        Some(Errno::ENOSPC) => say(&format!(
            "{USED_UP}user {user} holds {held} watches of events, the kernel's limit"
        ))?,
        other => say(&format!(
            "{NOT_SHOWN}user {user} holds {held} of {most} watches of events after {:?}: {other:?}",
            begun.elapsed()
        ))?,
    }
    thread::sleep(HOLD);
    Ok(())
}

fn all_files() -> io::Result<()> {
    let most = number("/proc/sys/fs/file-max")?;
    if most > FILES * PROCESSES {
        let bound = FILES * PROCESSES;
        return say(&format!(
            "{NOT_SHOWN}this machine may have {most} files open, and this probe opens {bound} at most"
        ));
    }
    let begun = Instant::now();
    let mut holders: Vec<Child> = Vec::new();
    let mut is_used_up = false;
    while !is_used_up && holders.len() < PROCESSES && begun.elapsed() < FILL {
        let Ok(mut child) = Command::new("/proc/self/exe")
            .args(["--background", "some-files"])
            .stdout(Stdio::piped())
            .spawn()
        else {
            // Not even a pipe is left.
            is_used_up = true;
            break;
        };
        let mut line = String::new();
        if let Some(output) = child.stdout.take() {
            BufReader::new(output).read_line(&mut line)?;
        }
        holders.push(child);
        is_used_up = line.trim() == "refused";
    }
    let processes = holders.len();
    if is_used_up {
        say(&format!(
            "{USED_UP}{processes} processes hold all {most} files of the machine"
        ))?;
        thread::sleep(HOLD);
    } else {
        say(&format!(
            "{NOT_SHOWN}{processes} processes do not hold the {most} files of the machine"
        ))?;
    }
    for mut holder in holders {
        // One that has ended by itself is as good.
        _ = holder.kill();
        holder.wait()?;
    }
    Ok(())
}

/// Opens its share, reports how that went, and takes what others give back, until it has lasted long enough.
fn some_files() -> io::Result<()> {
    let (_, hard) = getrlimit(Resource::RLIMIT_NOFILE)?;
    setrlimit(Resource::RLIMIT_NOFILE, hard, hard)?;
    let begun = Instant::now();
    let mut files = Vec::with_capacity(FILES);
    let mut is_reported = false;
    while begun.elapsed() < FILL + HOLD {
        match File::open("/dev/null") {
            Ok(file) if files.len() < FILES => {
                files.push(file);
                if files.len() < FILES {
                    continue;
                }
            }
            Ok(_) => {}
            Err(_) if is_reported => {}
            Err(error) => {
                say(if error.raw_os_error() == Some(libc::ENFILE) {
                    "refused"
                } else {
                    "limited"
                })?;
                is_reported = true;
            }
        }
        if files.len() == FILES && !is_reported {
            say("full")?;
            is_reported = true;
        }
        thread::sleep(Duration::from_millis(10));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::endings::ENDINGS;

    #[test]
    fn no_limit_has_the_name_of_an_ending() {
        assert!(
            LIMITS
                .iter()
                .all(|limit| ENDINGS.iter().all(|ending| ending.id != limit.id))
        );
        assert!(run("nothing").is_none());
    }
}
