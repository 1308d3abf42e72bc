//! A folder that is copied, by a real process: what the copy holds, and what is refused.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on fails")]

use std::fs::{self, Permissions};
use std::os::unix::fs::{PermissionsExt, symlink};
use std::path::{Path, PathBuf};
use std::process::Command;

use nix::sys::stat::Mode;
use nix::unistd::mkfifo;
use tempfile::TempDir;

/// A folder with the folders `from`, which holds `a/b`, and `to`; its path without links.
fn folders() -> (TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let top = folder.path().canonicalize().unwrap();
    fs::create_dir_all(top.join("from/a/b")).unwrap();
    fs::create_dir(top.join("to")).unwrap();
    (folder, top)
}

/// Copies one folder to another; the exit code, and the message, which is the same on stderr.
fn copy(folder: &Path, from: &str, to: &str) -> (Option<i32>, String) {
    let log = folder.join("log");
    fs::write(&log, "").unwrap();
    let paths = [
        ("from", folder.join(from)),
        ("to", folder.join(to)),
        ("termination-log", log.clone()),
    ];
    let output = Command::new(env!("CARGO_BIN_EXE_leaderboard-runner"))
        .arg("copy")
        .args(paths.map(|(option, path)| format!("--{option}={}", path.display())))
        .output()
        .unwrap();
    let message = fs::read_to_string(log).unwrap();
    let stderr = String::from_utf8(output.stderr).unwrap();
    if !message.is_empty() {
        assert_eq!(stderr, format!("leaderboard-runner: {message}\n"));
    }
    (output.status.code(), message)
}

fn write(path: &Path, text: &str, mode: u32) {
    fs::write(path, text).unwrap();
    fs::set_permissions(path, Permissions::from_mode(mode)).unwrap();
}

fn mode(path: &Path) -> u32 {
    fs::symlink_metadata(path).unwrap().permissions().mode() & 0o7777
}

#[test]
fn a_copy_is_the_same_for_all_users_and_can_be_made_again() {
    let (_folder, top) = folders();
    let (from, to) = (top.join("from"), top.join("to"));
    write(&from.join("a/closed"), "closed", 0o600);
    write(&from.join("a/b/program"), "program", 0o711);
    write(&from.join("open"), "", 0o666);
    symlink("../../open", from.join("a/b/link")).unwrap();
    fs::create_dir(from.join("empty")).unwrap();
    for name in ["a/b", "empty"] {
        fs::set_permissions(from.join(name), Permissions::from_mode(0o700)).unwrap();
    }
    // The folder may be named by a link.
    symlink("from", top.join("named")).unwrap();
    // A copy that was broken off left half of a file, and a link may be there already.
    for _ in 0..2 {
        assert_eq!(copy(&top, "named", "to"), (Some(0), String::new()));
        for (name, text, rights) in [
            ("a/closed", "closed", 0o644),
            ("a/b/program", "program", 0o755),
            ("open", "", 0o644),
        ] {
            assert_eq!(fs::read_to_string(to.join(name)).unwrap(), text, "{name}");
            assert_eq!(mode(&to.join(name)), rights, "{name}");
        }
        for name in ["a", "a/b", "empty"] {
            assert_eq!(mode(&to.join(name)), 0o755, "{name}");
        }
        assert_eq!(fs::read_link(to.join("a/b/link")).unwrap(), Path::new("../../open"));
        write(&to.join("a/closed"), "clo", 0o400);
    }
}

#[test]
fn what_would_be_something_else_elsewhere_is_refused() {
    let (_folder, top) = folders();
    let at = top.join("from/a/b/it");
    let relative = "make it a relative path inside the copied folder, with each .. at its front";
    for target in ["/etc/passwd", "../../../to", "x/../../y"] {
        symlink(target, &at).unwrap();
        let message = format!("the link {} has the target {target}; {relative}", at.display());
        assert_eq!(copy(&top, "from", "to"), (Some(1), message));
        fs::remove_file(&at).unwrap();
    }
    mkfifo(&at, Mode::S_IRWXU).unwrap();
    let message = format!(
        "{} is neither a file, a folder nor a link; remove it from the image",
        at.display()
    );
    assert_eq!(copy(&top, "from", "to"), (Some(1), message));
}

#[test]
fn a_folder_that_cannot_be_copied_is_named() {
    let (_folder, top) = folders();
    fs::write(top.join("file"), "").unwrap();
    let inside = "is where the copy goes, so it cannot hold the data; keep the data in another folder of the image";
    for (from, to, message) in [
        (
            "no",
            "to",
            "/no cannot be read: No such file or directory (os error 2)".to_owned(),
        ),
        (
            "file",
            "to",
            "/file cannot be read: Not a directory (os error 20)".to_owned(),
        ),
        (
            "from",
            "no",
            "/no cannot be opened: No such file or directory (os error 2)".to_owned(),
        ),
        ("from", "from", format!("/from {inside}")),
        ("from", "from/a/b", format!("/from {inside}")),
    ] {
        assert_eq!(
            copy(&top, from, to),
            (Some(1), format!("{}{message}", top.display())),
            "{from} {to}"
        );
    }
}
