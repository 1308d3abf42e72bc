//! The program as a person starts it, without a cluster. With this file cargo builds the program for the other tests too.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    reason = "clippy knows a test by its attribute; what tests call is a test too"
)]

use std::process::{Command, Output};

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
    for command in ["why", "cancel", "resume"] {
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
