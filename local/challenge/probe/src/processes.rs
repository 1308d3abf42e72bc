//! The runner, which is PID 1 of the container, and what else could run there.

use std::fs;
use std::io::Read;

use nix::errno::Errno;
use nix::libc;

use crate::call::{call, of};
use crate::probe::{Probe, held, inherent};
use crate::seen::Seen;

const RUNNER: usize = 1;
const NOT_DUMPABLE: &str = "the runner is not dumpable";
/// Names of the programs in the Pod's other containers, as the kernel cuts them short.
const FOREIGN: [&str; 4] = ["leaderboard-ope", "challenge-simul", "CarlaUE4", "pause"];

pub(crate) const PROBES: &[Probe] = &[
    held(
        "other-processes",
        "See the processes of other containers",
        "`shareProcessNamespace: false`, no host PIDs",
        other_processes,
    ),
    held("runner-memory", "Open the runner's memory", NOT_DUMPABLE, || {
        read_of_runner("mem")
    }),
    held(
        "runner-environment",
        "Read the runner's environment",
        NOT_DUMPABLE,
        || read_of_runner("environ"),
    ),
    held("runner-maps", "Read where the runner's code lies", NOT_DUMPABLE, || {
        read_of_runner("maps")
    }),
    held(
        "runner-files",
        "Take the runner's open files, root or folder",
        NOT_DUMPABLE,
        runner_files,
    ),
    held("runner-trace", "Trace the runner with ptrace", NOT_DUMPABLE, || {
        Seen::of_call(&call(
            libc::SYS_ptrace,
            of([usize::try_from(libc::PTRACE_SEIZE).unwrap_or_default(), RUNNER]),
        ))
    }),
    held(
        "runner-copy",
        "Read the runner's memory with process_vm_readv",
        NOT_DUMPABLE,
        copy_of_runner,
    ),
    held(
        "runner-descriptor",
        "Take a descriptor of the runner with pidfd_getfd",
        NOT_DUMPABLE,
        descriptor_of_runner,
    ),
    held(
        "runner-kill",
        "Kill or stop the runner by a signal",
        "PID 1 gets no SIGKILL and no SIGSTOP from within; SIGTERM ends the round, which is counted",
        kill_runner,
    ),
    inherent(
        "runner-limits",
        "Set the runner's limits with prlimit",
        "same user, so the kernel allows it; a runner kept silent so has no say (the endings below)",
        limit_runner,
    ),
];

fn other_processes() -> Seen {
    let Ok(entries) = fs::read_dir("/proc") else {
        return Seen::Unclear("/proc can't be listed".to_owned());
    };
    let names = entries
        .flatten()
        .filter_map(|entry| fs::read_to_string(entry.path().join("comm")).ok());
    let names: Vec<String> = names.map(|name| name.trim().to_owned()).collect();
    if names.is_empty() {
        return Seen::Unclear("/proc shows no process at all".to_owned());
    }
    let foreign = names
        .iter()
        .filter(|name| FOREIGN.iter().any(|one| name.starts_with(one)));
    Seen::of_finds(&foreign.cloned().collect::<Vec<_>>(), "only own processes")
}

fn read_of_runner(file: &str) -> Seen {
    let read = fs::File::open(format!("/proc/1/{file}")).and_then(|mut file| file.read(&mut [0; 1]));
    Seen::of_io(&read)
}

fn runner_files() -> Seen {
    // Root may list the numbers; what they stand for is what counts.
    let opened = ("fd".to_owned(), Seen::of_io(&fs::metadata("/proc/1/fd/1")));
    let links = ["root", "cwd", "exe"].map(|link| {
        let followed = fs::metadata(format!("/proc/1/{link}/.")).or_else(|_| fs::metadata(format!("/proc/1/{link}")));
        (link.to_owned(), Seen::of_io(&followed))
    });
    Seen::of_all(links.into_iter().chain([opened]))
}

fn copy_of_runner() -> Seen {
    let mut page = [0_u8; 16];
    let local = [page.as_mut_ptr().expose_provenance(), page.len()];
    // Any address: without the right to look the kernel refuses before it looks there.
    let remote = [0x40_0000_usize, page.len()];
    let [local, remote] = [&local, &remote].map(|pair| pair.as_ptr().expose_provenance());
    Seen::of_call(&call(libc::SYS_process_vm_readv, of([RUNNER, local, 1, remote, 1])))
}

fn descriptor_of_runner() -> Seen {
    let taken = call(libc::SYS_pidfd_open, of([RUNNER])).and_then(|pidfd| {
        let pidfd = usize::try_from(pidfd).map_err(|_| Errno::EBADF)?;
        call(libc::SYS_pidfd_getfd, of([pidfd, 1]))
    });
    Seen::of_call(&taken)
}

fn kill_runner() -> Seen {
    for signal in [libc::SIGSTOP, libc::SIGKILL] {
        let number = usize::try_from(signal).unwrap_or_default();
        if let Err(errno) = call(libc::SYS_kill, of([RUNNER, number])) {
            return Seen::of_errno(errno);
        }
    }
    // The state is the third field, after the name in brackets.
    let stat = fs::read_to_string("/proc/1/stat").unwrap_or_default();
    let state = stat.rsplit_once(") ").and_then(|(_, rest)| rest.chars().next());
    match state {
        Some('T' | 't' | 'Z' | 'X') => Seen::Open(format!("state {state:?}")),
        Some(_) => Seen::Denied("no effect".to_owned()),
        None => Seen::Unclear("/proc/1/stat can't be read".to_owned()),
    }
}

/// Sets the limit that it has.
fn limit_runner() -> Seen {
    let mut limit = [0_u64; 2];
    let address = limit.as_mut_ptr().expose_provenance();
    let files = usize::try_from(libc::RLIMIT_NOFILE).unwrap_or_default();
    let read = call(libc::SYS_prlimit64, of([RUNNER, files, 0, address]));
    Seen::of_call(&read.and_then(|_| call(libc::SYS_prlimit64, of([RUNNER, files, address, 0]))))
}
