//! The program as a person starts it, without a cluster. With this file cargo builds the program for the other tests too.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    reason = "clippy knows a test by its attribute; what tests call is a test too"
)]

use std::process::{Command, Output};

const COMMANDS: [&str; 17] = [
    "why",
    "status",
    "top",
    "get",
    "submit",
    "logs",
    "check",
    "cancel",
    "resume",
    "pause",
    "unpause",
    "lint",
    "report",
    "import",
    "completion",
    "version",
    "man",
];

fn plugin(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_kubectl-leaderboard"))
        .args(arguments)
        .env("KUBECONFIG", "/nonexistent/config")
        .output()
        .unwrap()
}

#[test]
fn the_help_names_every_command() {
    let output = plugin(&["--help"]);
    let text = String::from_utf8(output.stdout).unwrap();
    assert!(output.status.success());
    for command in COMMANDS {
        assert!(
            text.contains(&format!("\n  {command} ")),
            "{command} is missing in:\n{text}"
        );
    }
}

#[test]
fn a_missing_kubeconfig_is_named() {
    let output = plugin(&["why"]);
    let text = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(1), "{text}");
    assert!(text.contains("/nonexistent/config"), "{text}");
}

#[test]
fn every_command_has_a_manual_page_with_its_flags() {
    let folder = std::env::temp_dir().join(format!("leaderboard-man-{}", std::process::id()));
    let man = folder.join("man1");
    let output = plugin(&["man", man.to_str().unwrap()]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let page = |name: &str| std::fs::read_to_string(man.join(format!("{name}.1"))).unwrap();
    for command in COMMANDS {
        let text = page(&format!("kubectl-leaderboard-{command}"));
        assert!(
            text.contains(".SH DESCRIPTION") && text.contains("Examples:"),
            "{command}: {text}"
        );
    }
    assert!(page("kubectl-leaderboard-resume").contains("\\-\\-restart"));
    let page_of_all = page("kubectl-leaderboard");
    assert!(page_of_all.contains("resume") && page_of_all.contains("\\-\\-namespace"));
    let hidden = man.join("kubectl-leaderboard-complete.1");
    assert!(!hidden.exists(), "what only shells call has no page");
    std::fs::remove_dir_all(folder).unwrap();
    let output = plugin(&["man", "/dev/null/man1"]);
    let text = String::from_utf8(output.stderr).unwrap();
    assert!(
        text.contains("cannot write /dev/null/man1") && text.contains("Name another"),
        "{text}"
    );
}
