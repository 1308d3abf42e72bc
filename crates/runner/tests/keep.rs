//! A command whose output is kept: what it prints, how it ends, and that it hears of the end of its container.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on fails")]

use std::fs;
use std::io::{BufRead as _, BufReader};
use std::path::Path;
use std::process::{Command, Output, Stdio};

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

fn keeper(log: &Path, limit: &str, script: &str) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_leaderboard-runner"));
    command.arg("keep").arg(format!("--log={}", log.display()));
    command
        .args([&format!("--log-limit={limit}"), "--", "sh", "-c", script])
        .stdin(Stdio::null());
    command
}

fn kept(limit: &str, script: &str) -> (Output, Option<String>) {
    let folder = tempfile::tempdir().unwrap();
    let log = folder.path().join("contents.log");
    let output = keeper(&log, limit, script).output().unwrap();
    (output, fs::read_to_string(log).ok())
}

#[test]
fn output_and_errors_are_in_the_log_and_in_the_containers_own() {
    let (output, log) = kept("1000", "echo copied; echo of 20 >&2; exit 3");
    assert_eq!(output.status.code(), Some(3));
    assert_eq!(log.as_deref(), Some("copied\nof 20\n"));
    assert_eq!(output.stdout, b"copied\nof 20\n");
}

#[test]
fn a_log_ends_at_its_limit_and_the_containers_own_goes_on() {
    let (output, log) = kept("4", "echo 123456");
    assert_eq!(output.stdout, b"123456\n");
    let log = log.unwrap();
    assert!(log.starts_with("1234\n") && log.contains("limit"), "{log}");
}

#[test]
fn ends_are_reported_as_a_shell_reports_them() {
    assert_eq!(kept("9", "true").0.status.code(), Some(0));
    assert_eq!(kept("9", "kill -9 $$").0.status.code(), Some(128 + 9));
    let folder = tempfile::tempdir().unwrap();
    let mut missing = Command::new(env!("CARGO_BIN_EXE_leaderboard-runner"));
    let log = format!("--log={}", folder.path().join("l").display());
    let missing = missing.args(["keep", &log, "--", "/no/such/program"]).output().unwrap();
    assert_eq!(missing.status.code(), Some(127));
    assert!(String::from_utf8_lossy(&missing.stderr).contains("cannot be started"));
}

#[test]
fn without_a_place_for_the_log_the_command_runs_all_the_same() {
    let output = keeper(Path::new("/no/such/folder/contents.log"), "9", "echo copied")
        .output()
        .unwrap();
    assert_eq!(
        (output.status.code(), output.stdout.as_slice()),
        (Some(0), &b"copied\n"[..])
    );
}

#[test]
fn the_command_hears_of_the_end() {
    let folder = tempfile::tempdir().unwrap();
    let script = "trap 'echo ended; exit 143' TERM; echo ready; while :; do sleep 1 & wait; done";
    let mut child = keeper(&folder.path().join("log"), "1000", script)
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut lines = BufReader::new(child.stdout.take().unwrap()).lines();
    assert_eq!(lines.next().unwrap().unwrap(), "ready");
    kill(Pid::from_raw(i32::try_from(child.id()).unwrap()), Signal::SIGTERM).unwrap();
    assert_eq!(lines.next().unwrap().unwrap(), "ended");
    assert_eq!(child.wait().unwrap().code(), Some(143));
}
