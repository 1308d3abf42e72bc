//! The program's whole output with its exit code, compared with files in `printed/`. UPDATE_GOLDEN=1 writes them.
//!
//! Output that depends on the time is tested in `src/tests`, which have a time of their own.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    reason = "clippy knows a test by its attribute; what tests call is a test too"
)]

#[cfg(unix)]
mod bucket;
mod stub;

use std::path::Path;
use std::process::{Command, Output, Stdio};

use self::stub::Stub;
use self::stub::cluster::{cluster, forbidden};

const PLUGIN: &str = env!("CARGO_BIN_EXE_kubectl-leaderboard");

fn plugin(stub: &Stub, arguments: &[&str]) -> Output {
    let mut command = Command::new(PLUGIN);
    command.args(arguments).env("KUBECONFIG", &stub.kubeconfig);
    command.current_dir(env!("CARGO_MANIFEST_DIR"));
    // No program of this machine is asked.
    command.env("PATH", "").stdin(Stdio::null()).output().unwrap()
}

/// Compares what commands print with their file.
fn assert_printed(name: &str, stub: &Stub, commands: &[&[&str]]) {
    let mut text = String::new();
    for arguments in commands {
        let output = plugin(stub, arguments);
        let (out, err) = (
            String::from_utf8(output.stdout).unwrap(),
            String::from_utf8(output.stderr).unwrap(),
        );
        assert!(
            !out.contains('\u{1b}') && !err.contains('\u{1b}'),
            "a pipe has no colours: {out}{err}"
        );
        let code = output.status.code().unwrap();
        let line = format!("$ kubectl leaderboard {}", arguments.join(" "));
        text =
            format!("{text}{line}\n{out}--- errors, exit code {code}\n{err}\n").replace(&stub.address, "http://SERVER");
        // `local/lab owner` changes the address.
        text = text.replace(env!("CARGO_PKG_REPOSITORY"), "https://REPOSITORY");
    }
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("tests/printed/{name}.txt"));
    if std::env::var_os("UPDATE_GOLDEN").is_some() {
        return std::fs::write(file, text).unwrap();
    }
    let known = std::fs::read_to_string(&file).unwrap_or_default();
    assert_eq!(
        text, known,
        "{name} prints something else; set UPDATE_GOLDEN=1 and read the difference"
    );
}

#[test]
fn a_wrong_name_or_namespace_is_answered_with_the_right_one() {
    let stub = Stub::start(cluster);
    assert_printed(
        "names",
        &stub,
        &[
            &["status", "-n", "default"],
            &["why", "-n", "default"],
            &["top", "-n", "default"],
            &["resume", "--all", "-n", "default"],
            &["status", "-l", "leaderboard.carla.org/phase=8", "-n", "default"],
            &["why", "submission-42", "-n", "default"],
            &["cancel", "submision-42"],
            &["logs", "42"],
            &["resume", "something-else"],
            &["check", "carla-20", "-n", "default"],
            &[
                "submit",
                "--leaderboard",
                "carla20",
                "--track",
                "sensors",
                "--image",
                "a:1",
            ],
            &[
                "submit",
                "--leaderboard",
                "carla-20",
                "--track",
                "map",
                "--image",
                "a:1",
            ],
        ],
    );
}

#[test]
fn without_rights_each_command_names_what_is_missing() {
    let stub = Stub::start(forbidden);
    assert_printed(
        "rights",
        &stub,
        &[
            &["why"],
            &["status", "submission-42"],
            &["top"],
            &["cancel", "submission-42"],
            &["resume", "--all"],
            &["logs", "submission-42"],
            &["check", "carla-20"],
            &[
                "submit",
                "--leaderboard",
                "carla-20",
                "--track",
                "sensors",
                "--image",
                "a:1",
            ],
        ],
    );
}

#[test]
fn without_a_cluster_its_address_is_named() {
    // Nothing listens on the first port.
    let stub = Stub::at("http://127.0.0.1:1".to_owned());
    assert_printed(
        "cluster",
        &stub,
        &[
            &["why"],
            &["cancel", "submission-42"],
            &["report"],
            &["resume", "--all"],
        ],
    );
    assert!(
        !Path::new("leaderboard-report-carla.json").exists(),
        "no empty report is written"
    );
}

#[test]
fn a_command_that_changes_something_prints_what_and_how_to_go_on() {
    let stub = Stub::start(cluster);
    assert_printed(
        "changes",
        &stub,
        &[
            &[
                "submit",
                "--leaderboard",
                "carla-20",
                "--track",
                "sensors",
                "--image",
                "registry.example/agent:1",
            ],
            &["cancel", "submission-43"],
            &["cancel", "submission-45"],
            &["resume", "submission-41"],
            &["resume", "submission-43"],
            &["resume", "submission-43", "submission-44"],
            &["resume", "--all", "--reason", "ImagePull"],
            &["resume", "submission-43", "--restart"],
        ],
    );
}

#[test]
fn a_leaderboard_is_paused_with_what_becomes_of_its_submissions() {
    let stub = Stub::start(cluster);
    assert_printed(
        "pause",
        &stub,
        &[&["pause", "carla-20"], &["unpause", "carla-20"], &["pause", "carla"]],
    );
}

#[test]
fn the_versions_of_both_programs_are_compared() {
    let stub = Stub::start(cluster);
    assert_printed(
        "version",
        &stub,
        &[
            &["version"],
            &["version", "--client"],
            &["version", "-o", "yaml"],
            &["version", "--operator-namespace", "default"],
            &["version", "-n", "default"],
        ],
    );
}

#[test]
fn a_list_shows_what_fits_and_names_what_nothing_fits() {
    let stub = Stub::start(cluster);
    assert_printed(
        "lists",
        &stub,
        &[
            &["status", "--state", "running,pending", "-o", "json"],
            &["status", "--state", "Finished", "--track", "sensors"],
            &["top", "--leaderboard", "carla-10"],
            &["resume", "submission-41", "--team", "7"],
            &["resume", "--all", "--team", "7", "--dry-run"],
            &["why", "-o", "wide"],
        ],
    );
}

#[test]
fn manifests_are_checked_without_a_cluster() {
    // Nothing listens there, and nothing is asked.
    let stub = Stub::at("http://127.0.0.1:1".to_owned());
    assert_printed(
        "lint",
        &stub,
        &[
            &["lint", "tests/manifests/good.yaml"],
            &["lint", "tests/manifests/bad.yaml"],
            &["lint", "tests/manifests/broken.yaml", "tests/manifests/good.yaml"],
            &["lint", "tests/manifests/result.json"],
            &["lint", "tests/manifests/bad-result.json"],
            &["lint", "tests/manifests/missing.yaml"],
            &["lint", "-"],
        ],
    );
}

#[test]
fn each_example_manifest_has_no_fault() {
    let examples = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples");
    let mut files: Vec<String> = Vec::new();
    for entry in std::fs::read_dir(examples).unwrap() {
        let path = entry.unwrap().path();
        if path.extension().is_some_and(|end| end == "yaml") {
            files.push(path.display().to_string());
        }
    }
    assert!(files.len() > 5, "{files:?}");
    let stub = Stub::at("http://127.0.0.1:1".to_owned());
    let arguments: Vec<&str> = std::iter::once("lint")
        .chain(files.iter().map(String::as_str))
        .collect();
    let output = plugin(&stub, &arguments);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stdout));
}

#[test]
fn logs_have_the_label_of_their_container_and_come_in_its_order() {
    let stub = Stub::start(cluster);
    assert_printed(
        "logs",
        &stub,
        &[
            &["logs", "submission-43"],
            &["logs", "submission-43", "--of", "start"],
            &["logs", "submission-43", "--of", "simulator", "--worker", "1"],
            &["logs", "submission-43", "--worker", "3"],
            &["logs", "submission-42", "--worker", "2"],
            &["logs", "submission-42", "--worker", "2", "-f"],
            &["logs", "submission-42", "--of", "start"],
            &["logs", "submission-45"],
        ],
    );
}

#[test]
fn a_report_counts_what_it_has_and_names_what_it_has_not() {
    let stub = Stub::start(cluster);
    let file = std::env::temp_dir().join(format!("leaderboard-report-{}.json", std::process::id()));
    let output = plugin(&stub, &["report", "--file", file.to_str().unwrap()]);
    let text = String::from_utf8(output.stdout).unwrap();
    assert!(output.status.success() && file.exists(), "{text}");
    std::fs::remove_file(&file).unwrap();
    let words = text.split_whitespace().collect::<Vec<_>>().join(" ");
    for part in [
        "of namespace carla: 1 Leaderboard, 5 submissions, 1 Pod.",
        "Without events: missing right: events.events.k8s.io is forbidden",
    ] {
        assert!(words.contains(part), "{part}\n\n{text}");
    }
}

/// A terminal of 80 columns.
fn on_a_terminal(stub: &Stub, arguments: &str) -> String {
    let mut command = Command::new("script");
    let line = format!("stty cols 80 rows 24; {PLUGIN} {arguments}");
    command
        .args(["-qec", &line, "/dev/null"])
        .env("KUBECONFIG", &stub.kubeconfig)
        .env("TERM", "xterm");
    let output = command.env_remove("NO_COLOR").stdin(Stdio::null()).output().unwrap();
    String::from_utf8(output.stdout).unwrap()
}

#[test]
fn a_terminal_has_colours_unless_they_are_turned_off() {
    let stub = Stub::start(cluster);
    for arguments in ["status", "why submission-42", "logs submission-43", "resume --help"] {
        let coloured = on_a_terminal(&stub, arguments);
        assert!(coloured.contains('\u{1b}'), "{arguments}: {coloured}");
        for flag in ["--no-color", "--color never", "--color=never"] {
            let plain = on_a_terminal(&stub, &format!("{arguments} {flag}"));
            assert!(
                plain.lines().count() > 3 && !plain.contains('\u{1b}'),
                "{arguments} {flag}: {plain}"
            );
        }
    }
}

#[test]
fn errors_and_help_are_broken_between_words_on_a_narrow_terminal() {
    let stub = Stub::start(forbidden);
    for arguments in ["why", "resume --help"] {
        let text = on_a_terminal(&stub, &format!("{arguments} --no-color"));
        assert!(text.lines().count() > 2, "{text}");
        for line in text.lines() {
            assert!(line.trim_end().chars().count() <= 80, "{line}");
        }
    }
}
