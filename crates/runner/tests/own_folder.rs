//! An agent that takes its status folder from everybody else, as the folder's owner may: its end is seen all the same.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test that cannot go on fails")]

mod support;

use std::fs;
use std::io::Write;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};

use leaderboard_protocol::files::{Mark, StatusFile};
use leaderboard_protocol::verdict::What;
use rustix::fs::XattrFlags;
use rustix::io::Errno;
use support::{AGENT, COMPLETE, Pod, SIMULATOR};

const ACCESS_LIST: &str = "system.posix_acl_access";

/// A Pod whose containers may do no more than the owner of their files may: root has no right beyond that, as in a cluster.
fn pod() -> (Pod, PathBuf) {
    let mut pod = Pod::new();
    if nix::unistd::geteuid().is_root() {
        pod.starter = ["setpriv", "--bounding-set=-all", "--inh-caps=-all"]
            .map(str::to_owned)
            .into();
    }
    let folder = pod.status().join("agent-1");
    fs::create_dir(&folder).unwrap();
    fs::set_permissions(&folder, fs::Permissions::from_mode(0o777)).unwrap();
    (pod, folder)
}

/// True if every user can look into it.
fn is_open(folder: &Path) -> bool {
    let has_list = rustix::fs::getxattr(folder, ACCESS_LIST, &mut [0_u8; 256][..]).is_ok();
    let mode = fs::metadata(folder).unwrap().permissions().mode();
    !has_list && mode & 0o005 == 0o005
}

/// Forbids it to the user of `logcopy`, whatever its mode is. False where the file system keeps no such lists.
fn forbid(folder: &Path) -> bool {
    const ANYBODY: u32 = u32::MAX;
    // Owner, the user, group, mask, all others: tag, permissions, who.
    let entries: [(u16, u16, u32); 5] = [
        (0x01, 7, ANYBODY),
        (0x02, 0, 65532),
        (0x04, 7, ANYBODY),
        (0x10, 7, ANYBODY),
        (0x20, 7, ANYBODY),
    ];
    let mut list = 2_u32.to_le_bytes().to_vec();
    for (tag, permissions, who) in entries {
        list.extend(tag.to_le_bytes());
        list.extend(permissions.to_le_bytes());
        list.extend(who.to_le_bytes());
    }
    match rustix::fs::setxattr(folder, ACCESS_LIST, &list, XattrFlags::empty()) {
        Err(Errno::OPNOTSUPP) => false,
        set => {
            set.unwrap();
            true
        }
    }
}

#[test]
fn an_agent_that_shuts_its_status_folder_is_seen_to_end() {
    for (mode, last, code) in [
        ("0", "exit 1".to_owned(), 1),
        ("0500", "exit 1".to_owned(), 1),
        ("0700", "exit 1".to_owned(), 1),
        ("0700", format!("echo '{COMPLETE}' > $CHECKPOINT"), 0),
    ] {
        let (pod, folder) = pod();
        let script = format!("chmod {mode} {} && {last}", folder.display());
        let (mut simulator, mut agent) = (pod.simulator(), pod.agent(&script));
        assert_eq!(agent.code(), code, "{mode}: {}", agent.stderr());
        assert!(is_open(&folder), "{mode}");
        let (mark, what) = if code == 0 {
            (Mark::Done, What::Finished)
        } else {
            (Mark::Crash(0), What::PeerCrashed)
        };
        assert!(pod.has(AGENT, mark), "{mode}");
        pod.until(SIMULATOR, mark);
        pod.write(StatusFile::Stored);
        simulator.code();
        assert_eq!(simulator.verdict().what, what, "{mode}");
    }
}

#[test]
fn an_agent_that_names_who_may_not_look_is_seen_to_end() {
    let (pod, folder) = pod();
    let (said, go) = (pod.path("work/said"), pod.path("work/go"));
    let script = format!(
        "touch {}; until [ -e {} ]; do sleep 0.02; done; exit 1",
        said.display(),
        go.display()
    );
    let (mut simulator, mut agent) = (pod.simulator(), pod.agent(&script));
    support::until_exists(&said);
    if !forbid(&folder) {
        // Not captured: a test that is left out shows it in any run.
        let _ = writeln!(
            std::io::stderr(),
            "left out: this file system keeps no access control lists"
        );
    }
    fs::write(go, "").unwrap();
    assert_eq!((agent.code(), simulator.code()), (1, 1));
    assert!(is_open(&folder));
}

#[test]
fn an_agent_that_is_killed_after_it_has_shut_its_status_folder_goes_on_in_the_next_round() {
    let (pod, folder) = pod();
    let said = pod.path("work/said");
    let script = format!("chmod 0 {} && touch {} && sleep 60", folder.display(), said.display());
    let (mut simulator, mut agent) = (pod.simulator(), pod.agent(&script));
    support::until_exists(&said);
    agent.kill_without_a_word();
    let mut agent = pod.agent("exit 1");
    assert_eq!(simulator.code(), 1, "{}", agent.stderr());
    assert_eq!(simulator.verdict().what, What::PeerCrashed);
    assert!(is_open(&folder));
    let mut simulator = pod.simulator();
    assert_eq!((agent.code(), simulator.code()), (1, 1));
    assert_eq!([simulator.verdict().round, agent.verdict().round], [Some(1); 2]);
}
