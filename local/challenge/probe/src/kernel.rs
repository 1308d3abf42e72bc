//! Requests that the kernel grants to a container with more rights. Each probe asks for something harmless: wrong sizes, folders of its
//! own, values that are set already.

use std::ffi::CStr;
use std::fs;
use std::net::TcpListener;

use nix::libc::{self, c_long};
use nix::unistd::getuid;

use crate::call::{call, negative, of};
use crate::probe::{Probe, by_policy, held};
use crate::seen::Seen;

const DROPPED: &str = "every capability is dropped";
const FILTERED: &str = "the seccomp profile `RuntimeDefault`";
/// A folder of the probe's own, to mount on.
const OWN_FOLDER: &CStr = c"/tmp/probe-mount";

pub(crate) const PROBES: &[Probe] = &[
    held(
        "capabilities",
        "Have any capability, also as root",
        "`capabilities: {drop: [ALL]}`",
        capabilities,
    )
    .opens_with_rights(),
    held(
        "new-privileges",
        "Gain rights through a setuid program",
        "`allowPrivilegeEscalation: false`",
        || status_is("NoNewPrivs", "1"),
    )
    .opens_with_rights(),
    held("no-filter", "Run without a seccomp filter", FILTERED, || {
        status_is("Seccomp", "2")
    })
    .opens_with_rights(),
    held("change-user", "Become another user", DROPPED, || {
        let other = if getuid().is_root() { 1000 } else { 0 };
        plain(libc::SYS_setuid, [other])
    })
    .opens_with_rights(),
    held("mount", "Mount a file system", DROPPED, mount).opens_with_rights(),
    held("remount", "Make a read-only mount writable", DROPPED, remount).opens_with_rights(),
    held("umount", "Take a mount away", DROPPED, || {
        own_folder();
        plain(libc::SYS_umount2, [address(OWN_FOLDER)])
    })
    .opens_with_rights(),
    held("pivot-root", "Change the root file system", DROPPED, || {
        plain(libc::SYS_pivot_root, [address(c"/"), address(c"/")])
    })
    .opens_with_rights(),
    held("chroot", "Change the root folder", DROPPED, || {
        plain(libc::SYS_chroot, [address(c"/")])
    })
    .opens_with_rights(),
    held(
        "namespaces",
        "Make namespaces, a user's own among them",
        FILTERED,
        namespaces,
    )
    .opens_with_rights(),
    held("enter-namespace", "Enter a namespace", DROPPED, enter_namespace).opens_with_rights(),
    held("device-node", "Make a device file", DROPPED, device_node).opens_with_rights(),
    held("raw-socket", "Open a raw socket", DROPPED, || {
        socket(libc::AF_INET, libc::SOCK_RAW, libc::IPPROTO_ICMP)
    })
    .opens_with_rights(),
    held("packet-socket", "Read the Pod's network packets", DROPPED, || {
        socket(libc::AF_PACKET, libc::SOCK_RAW, 0)
    })
    .opens_with_rights(),
    held("host-name", "Change the host name", DROPPED, || {
        // Longer than any, so it is never set.
        plain(libc::SYS_sethostname, [address(c"probe"), 4096])
    })
    .opens_with_rights(),
    held("file-handles", "Open files of the node by handle", FILTERED, || {
        plain(libc::SYS_open_by_handle_at, [negative(libc::AT_FDCWD as isize)])
    })
    .opens_with_rights(),
    held("clock", "Set the clock", FILTERED, || {
        plain(libc::SYS_settimeofday, [0, 0])
    }),
    held("bpf", "Load a BPF program", FILTERED, || {
        plain(libc::SYS_bpf, [0, 0, 0])
    }),
    held("perf", "Watch the processor's counters", FILTERED, || {
        plain(libc::SYS_perf_event_open, [0, 0, negative(-1), negative(-1), 0])
    })
    .opens_with_rights(),
    held("key-rings", "Use the kernel's key rings", FILTERED, key_rings).opens_with_rights(),
    held("page-faults", "Handle page faults (userfaultfd)", FILTERED, || {
        plain(libc::SYS_userfaultfd, [0])
    }),
    held("module", "Load or remove a kernel module", FILTERED, module),
    held("kexec", "Start another kernel", FILTERED, || {
        // More segments than there may be: refused even where it is allowed.
        plain(libc::SYS_kexec_load, [0, 4096, 0, 0])
    }),
    held("reboot", "Restart the node", FILTERED, || {
        plain(libc::SYS_reboot, [0, 0, 0, 0])
    }),
    held("swap", "Change the node's swap space", FILTERED, || {
        plain(libc::SYS_swapon, [address(c"/nothing"), 0])
    })
    .opens_with_rights(),
    by_policy(
        "io-uring",
        "Use io_uring, which has been a way out of containers",
        "the seccomp profile of the node's containerd: 1.7 and newer refuse it",
        io_uring,
    ),
    by_policy(
        "vsock",
        "Open a socket to the machine below a virtual one",
        "the seccomp profile of the node's containerd: 1.7 and newer refuse it",
        || socket(libc::AF_VSOCK, libc::SOCK_STREAM, 0),
    ),
    by_policy(
        "low-ports",
        "Listen on a port below 1024",
        "containerd's `enable_unprivileged_ports`; the ports are the Pod's own",
        || Seen::of_io(&TcpListener::bind(("127.0.0.1", 80))),
    ),
];

fn plain<const N: usize>(number: c_long, arguments: [usize; N]) -> Seen {
    Seen::of_call(&call(number, of(arguments)))
}

fn address(text: &CStr) -> usize {
    text.as_ptr().expose_provenance()
}

/// A field of the process's own status.
fn status(field: &str) -> Option<String> {
    let status = fs::read_to_string("/proc/self/status").ok()?;
    let line = status
        .lines()
        .find_map(|line| line.strip_prefix(field)?.strip_prefix(':'));
    line.map(|value| value.trim().to_owned())
}

fn capabilities() -> Seen {
    Seen::of_all(["CapInh", "CapPrm", "CapEff", "CapBnd", "CapAmb"].map(|set| {
        let seen = match status(set) {
            Some(mask) if mask.bytes().all(|digit| digit == b'0') => Seen::Denied("none".to_owned()),
            Some(mask) => Seen::Open(mask),
            None => Seen::Unclear("not in /proc/self/status".to_owned()),
        };
        (set.to_owned(), seen)
    }))
}

fn status_is(field: &str, wanted: &str) -> Seen {
    match status(field) {
        Some(value) if value == wanted => Seen::Denied(format!("{field} {value}")),
        Some(value) => Seen::Open(format!("{field} {value}")),
        None => Seen::Unclear(format!("no {field} in /proc/self/status")),
    }
}

fn own_folder() {
    // It may be there already; a mount that lacks it fails with its own error.
    _ = fs::create_dir(OWN_FOLDER.to_str().unwrap_or_default());
}

fn mount() -> Seen {
    own_folder();
    let kind = address(c"tmpfs");
    plain(libc::SYS_mount, [kind, address(OWN_FOLDER), kind, 0, 0])
}

/// Where it gets through it is undone: the probes after it would write what stops their own run.
fn remount() -> Seen {
    let again = |more| {
        let flags = usize::try_from(libc::MS_REMOUNT | libc::MS_BIND | more).unwrap_or_default();
        plain(libc::SYS_mount, [0, address(c"/tmp/status"), 0, flags, 0])
    };
    let seen = again(0);
    if let Seen::Open(_) = seen {
        again(libc::MS_RDONLY);
    }
    seen
}

/// Each kind alone: together the first refusal would hide the others. The mount namespace is last, and this process ends after it.
fn namespaces() -> Seen {
    let kinds = [
        ("user", libc::CLONE_NEWUSER),
        ("network", libc::CLONE_NEWNET),
        ("ipc", libc::CLONE_NEWIPC),
        ("uts", libc::CLONE_NEWUTS),
        ("cgroup", libc::CLONE_NEWCGROUP),
        ("pid", libc::CLONE_NEWPID),
        ("mount", libc::CLONE_NEWNS),
    ];
    let tried = kinds.map(|(name, flag)| {
        let flag = usize::try_from(flag).unwrap_or_default();
        (name.to_owned(), plain(libc::SYS_unshare, [flag]))
    });
    Seen::of_all(tried)
}

/// Its own: even that takes a capability.
fn enter_namespace() -> Seen {
    use std::os::fd::AsRawFd as _;

    match fs::File::open("/proc/self/ns/net") {
        Ok(file) => plain(
            libc::SYS_setns,
            [usize::try_from(file.as_raw_fd()).unwrap_or_default(), 0],
        ),
        Err(error) => Seen::Unclear(error.to_string()),
    }
}

/// The device that /dev/null is, in a folder that every image has.
fn device_node() -> Seen {
    let path = c"/tmp/probe-null";
    let kind = usize::try_from(libc::S_IFCHR | 0o600).unwrap_or_default();
    let device = usize::try_from(libc::makedev(1, 3)).unwrap_or_default();
    let here = negative(libc::AT_FDCWD as isize);
    let seen = plain(libc::SYS_mknodat, [here, address(path), kind, device]);
    _ = fs::remove_file("/tmp/probe-null");
    seen
}

fn socket(family: i32, kind: i32, protocol: i32) -> Seen {
    plain(
        libc::SYS_socket,
        [family, kind, protocol].map(|number| usize::try_from(number).unwrap_or_default()),
    )
}

fn key_rings() -> Seen {
    const SESSION: isize = -3;
    const PROCESS: isize = -2;
    let add = [address(c"user"), address(c"probe"), address(c"x"), 1, negative(PROCESS)];
    Seen::of_all([
        ("keyctl".to_owned(), plain(libc::SYS_keyctl, [0, negative(SESSION), 0])),
        ("add_key".to_owned(), plain(libc::SYS_add_key, add)),
    ])
}

/// Neither is a module.
fn module() -> Seen {
    Seen::of_all([
        (
            "init_module".to_owned(),
            plain(libc::SYS_init_module, [address(c""), 0, address(c"")]),
        ),
        (
            "finit_module".to_owned(),
            plain(libc::SYS_finit_module, [negative(-1), address(c""), 0]),
        ),
        (
            "delete_module".to_owned(),
            plain(libc::SYS_delete_module, [address(c"probe_has_none"), 0]),
        ),
    ])
}

fn io_uring() -> Seen {
    let parameters = [0_u64; 16];
    plain(libc::SYS_io_uring_setup, [1, parameters.as_ptr().expose_provenance()])
}
