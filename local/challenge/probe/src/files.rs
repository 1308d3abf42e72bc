//! Files, devices and limits of the container.

use std::env;
use std::fs::{self, File, OpenOptions};
use std::io::Read as _;
use std::os::unix::fs::FileTypeExt as _;
use std::path::Path;

use nix::libc;

use crate::call::{call, of};
use crate::modes;
use crate::probe::{Probe, held, inherent};
use crate::seen::Seen;

const READ_ONLY: &str = "mounted read-only";
/// The devices that every container has in /dev.
const DEVICES: [&str; 8] = ["console", "full", "null", "ptmx", "random", "tty", "urandom", "zero"];
const STATUS: &str = "/tmp/status";
const TOOLS: &str = "/leaderboard-tools";

pub(crate) const PROBES: &[Probe] = &[
    held(
        "status-of-others",
        "Write another container's status files",
        "mounted read-only but for the own folder",
        status_of_others,
    ),
    held(
        "stop-file",
        "Stop the submission or claim that its results are stored",
        "mounted read-only but for the own folder",
        in_folder_of_logcopy,
    ),
    held(
        "contents",
        "Change the private contents: routes, Leaderboard, ScenarioRunner, Python API",
        READ_ONLY,
        contents,
    ),
    held("tools", "Replace the runner", READ_ONLY, || created_in(&[TOOLS])),
    held(
        "move-between-mounts",
        "Move or link a file into the status folder",
        "a mount is no part of another",
        move_between_mounts,
    ),
    held(
        "cgroup",
        "Change the container's own limits by its cgroup",
        "/sys is read-only",
        || created_in(&["/sys/fs/cgroup", "/sys/fs/cgroup/memory"]),
    ),
    held(
        "kernel-settings",
        "Change settings of the kernel, or press its keys",
        "/proc/sys and /proc/sysrq-trigger are read-only",
        || {
            Seen::of_all(
                ["/proc/sys/kernel/core_pattern", "/proc/sysrq-trigger"]
                    .map(|path| (path.to_owned(), opened_if_there(path))),
            )
        },
    ),
    held(
        "kernel-memory",
        "Read the kernel's memory or log",
        "masked by the container runtime",
        kernel_memory,
    ),
    held(
        "devices",
        "Use devices of the node",
        "the runtime gives a container none",
        devices,
    ),
    held(
        "name-files",
        "Lead logcopy elsewhere by /etc/hosts, /etc/resolv.conf or /etc/hostname",
        "simulators and agents have copies, mounted read-only",
        || {
            Seen::of_all(
                ["/etc/hosts", "/etc/resolv.conf", "/etc/hostname"].map(|path| (path.to_owned(), opened(path))),
            )
        },
    ),
    held(
        "core-dumps",
        "Hand a core dump to the node's program for them",
        "the runner's limit of 1 byte",
        core_limit,
    ),
    inherent(
        "termination-log",
        "Write the container's last message",
        "it is the container's own; blame does not rest on it (the endings below)",
        || opened("/dev/termination-log"),
    ),
    inherent(
        "shared-memory",
        "Talk to the run's other agents by memory of the Pod",
        "the containers of a Pod share network and IPC; all of them are the same team's, or the host's",
        shared_memory,
    ),
];

fn opened(path: &str) -> Seen {
    Seen::of_io(&OpenOptions::new().append(true).open(path))
}

/// Where the marks of a stop and of stored results lie. A name that means nothing: where it gets through, it must not stop the run.
/// The folder may not be there yet.
fn in_folder_of_logcopy() -> Seen {
    let folder = Path::new(STATUS).join("logcopy");
    Seen::of_io(&fs::create_dir_all(&folder).and_then(|()| File::create_new(folder.join("probe-mark"))))
}

/// Not every kernel has it.
fn opened_if_there(path: &str) -> Seen {
    if Path::new(path).exists() {
        opened(path)
    } else {
        Seen::Denied("not there".to_owned())
    }
}

/// Tries to make a file in each of the folders that are there; one at least must be.
fn created_in(folders: &[&str]) -> Seen {
    let there = folders.iter().filter(|folder| Path::new(folder).is_dir());
    Seen::of_all(there.map(|folder| {
        let made = File::create_new(Path::new(folder).join("probe"));
        ((*folder).to_owned(), Seen::of_io(&made))
    }))
}

fn status_of_others() -> Seen {
    let own = format!("agent-{}", modes::pair());
    let Ok(entries) = fs::read_dir(STATUS) else {
        return Seen::Unclear(format!("{STATUS} can't be listed"));
    };
    let names = entries
        .flatten()
        .map(|entry| entry.file_name().to_string_lossy().into_owned());
    let others: Vec<_> = names
        .filter(|name| *name != own)
        .map(|name| format!("{STATUS}/{name}"))
        .collect();
    if others.is_empty() {
        return Seen::Unclear("no folder of anybody else is there".to_owned());
    }
    let folders: Vec<&str> = others.iter().map(String::as_str).chain([STATUS]).collect();
    created_in(&folders)
}

fn contents() -> Seen {
    let roots = ["LEADERBOARD_ROOT", "SCENARIO_RUNNER_ROOT", "CARLA_ROOT"];
    let roots: Vec<_> = roots.into_iter().filter_map(|name| env::var(name).ok()).collect();
    if roots.len() < 3 {
        return Seen::Unclear("the variables of the contents are not set".to_owned());
    }
    let routes = env::var("ROUTES").unwrap_or_default();
    let folders: Vec<&str> = roots.iter().map(String::as_str).collect();
    Seen::of_all([
        ("folders".to_owned(), created_in(&folders)),
        ("routes".to_owned(), opened(&routes)),
    ])
}

fn move_between_mounts() -> Seen {
    let from = "/tmp/agent/probe-moved";
    let to = format!("{STATUS}/agent-{}/probe-moved", modes::pair());
    if let Err(error) = fs::write(from, "x") {
        return Seen::Unclear(error.to_string());
    }
    let linked = ("link".to_owned(), Seen::of_io(&fs::hard_link(from, &to)));
    let moved = ("rename".to_owned(), Seen::of_io(&fs::rename(from, &to)));
    _ = fs::remove_file(from);
    Seen::of_all([linked, moved])
}

/// A mask is an empty file.
fn kernel_memory() -> Seen {
    Seen::of_all(["/proc/kcore", "/dev/mem", "/dev/kmsg", "/proc/kmsg"].map(|path| {
        let seen = match File::open(path).and_then(|mut file| file.read(&mut [0; 1])) {
            Ok(0) => Seen::Denied("empty".to_owned()),
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => Seen::Denied("not there".to_owned()),
            read => Seen::of_io(&read),
        };
        (path.to_owned(), seen)
    }))
}

fn devices() -> Seen {
    let Ok(entries) = fs::read_dir("/dev") else {
        return Seen::Unclear("/dev can't be listed".to_owned());
    };
    let devices = entries.flatten().filter(|entry| {
        let kind = entry.file_type();
        kind.is_ok_and(|kind| kind.is_char_device() || kind.is_block_device())
    });
    let names = devices.map(|entry| entry.file_name().to_string_lossy().into_owned());
    let others: Vec<_> = names.filter(|name| !DEVICES.contains(&name.as_str())).collect();
    Seen::of_finds(&others, "only those of every container")
}

fn shared_memory() -> Seen {
    let path = format!("/dev/shm/probe-{}", std::process::id());
    let seen = Seen::of_io(&File::create_new(&path));
    _ = fs::remove_file(path);
    seen
}

/// A pipe to a program of the node gets no dump of a process with a limit of 1; with 0 it would.
fn core_limit() -> Seen {
    let mut limit = [0_u64; 2];
    let address = limit.as_mut_ptr().expose_provenance();
    let core = usize::try_from(libc::RLIMIT_CORE).unwrap_or_default();
    match call(libc::SYS_prlimit64, of([0, core, 0, address])) {
        Ok(_) if limit.iter().all(|bytes| *bytes <= 1) => Seen::Denied(format!("at most {} bytes", limit[1])),
        Ok(_) => Seen::Open(format!("{limit:?}")),
        Err(errno) => Seen::Unclear(errno.to_string()),
    }
}
