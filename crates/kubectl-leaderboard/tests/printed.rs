//! What the program prints, from its first to its last line, with its exit code: files in `printed/`. UPDATE_GOLDEN=1 writes them.
//!
//! What is printed of times is in the tests of `src/tests`, which have a time of their own.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    reason = "clippy knows a test by its attribute; what tests call is a test too"
)]

mod stub;

use std::path::Path;
use std::process::{Command, Output, Stdio};

use serde_json::{Value, json};

use self::stub::{Stub, list, refusal};

const PLUGIN: &str = env!("CARGO_BIN_EXE_kubectl-leaderboard");
const GROUP: &str = "/apis/leaderboard.carla.org/v1alpha1";
/// What is in the output of commands that ask for times.
const TIME: &str = "2026-11-01T10:00:00Z";

fn plugin(stub: &Stub, arguments: &[&str]) -> Output {
    let mut command = Command::new(PLUGIN);
    command.args(arguments).env("KUBECONFIG", &stub.kubeconfig);
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

fn condition(type_: &str, truth: &str, reason: &str) -> Value {
    json!({"type": type_, "status": truth, "reason": reason, "message": "", "lastTransitionTime": TIME})
}

fn submission(name: &str, status: &Value) -> Value {
    json!({
        "apiVersion": "leaderboard.carla.org/v1alpha1", "kind": "Submission",
        "metadata": {"name": name, "namespace": "carla", "creationTimestamp": TIME, "resourceVersion": "17"},
        "spec": {"leaderboardName": "carla-20", "track": "sensors", "image": "registry.example/agent:1"}, "status": status,
    })
}

fn failed(class: &str, reason: &str) -> Value {
    json!({
        "attempt": 1, "reason": reason, "message": "It has ended.", "track": "sensors", "resultsURL": "s3://results/v2/42",
        "failure": {"class": class, "reason": reason, "message": "It has ended."},
        "times": {"finished": TIME}, "plan": plan(), "conditions": [condition("Finished", "True", reason)],
    })
}

fn plan() -> Value {
    json!({"runId": "runs",
        "carla": {"version": "V2", "codename": "S", "slices": [{"first": 0, "last": 9}, {"first": 10, "last": 19}],
            "routes": 20, "repetitions": 1, "contentsImage": "c", "simulatorImage": "s"},
        "track": "sensors",
           "storage": {"s3": {"bucket": "results"}}, "image": "a"})
}

fn submissions() -> Vec<Value> {
    let runs = json!({
        "attempt": 1, "reason": "Running", "message": "12/20 routes done.", "track": "sensors", "jobName": "runs-1",
        "times": {"started": TIME}, "plan": plan(), "resultsURL": "s3://results/v2/runs",
        "conditions": [condition("Finished", "False", "Preparing"), condition("Running", "True", "Running")],
    });
    let waits =
        json!({"attempt": 1, "reason": "WaitingForSlot", "conditions": [condition("Finished", "False", "Preparing")]});
    vec![
        submission("submission-41", &failed("Infrastructure", "NodeLost")),
        submission("submission-42", &failed("Participant", "AgentCrashed")),
        submission("submission-43", &runs),
        submission("submission-44", &failed("Infrastructure", "SimulationCrashed")),
        submission("submission-45", &waits),
    ]
}

fn leaderboard() -> Value {
    json!({
        "apiVersion": "leaderboard.carla.org/v1alpha1", "kind": "Leaderboard",
        "metadata": {"name": "carla-20", "namespace": "carla"},
        "spec": {"tracks": [{"name": "sensors"}],
                 "evaluation": {"carla": {
                     "version": "V2", "contents": {"image": "contents:1"}, "simulator": {"image": "simulator:1"},
                 }}, "storage": {"s3": {"bucket": "results"}}},
        "status": {"conditions": [condition("Ready", "True", "Ready")]},
    })
}

fn pod() -> Value {
    let labels = json!({"leaderboard.carla.org/submission": "submission-43"});
    json!({"apiVersion": "v1", "kind": "Pod", "status": {"phase": "Running"},
           "metadata": {"name": "runs-1-abcde", "namespace": "carla", "creationTimestamp": TIME, "labels": labels}})
}

fn log(query: &str) -> (u16, String) {
    let lines = match selected(query, "container=") {
        Some("workspace") => "restored 12 files\n",
        Some("contents") => "copied 3 folders\n",
        Some("agent-1") => {
            "Traceback (most recent call last):\n  File \"agent.py\", line 7\n\tred \u{1b}[31mtext\u{1b}[0m\nlast line"
        }
        Some("simulator-1") => return refusal(404, "NotFound", "pods \"runs-1-abcde\" not found"),
        _ => {
            let waits = "container \"agent-2\" in pod \"runs-1-abcde\" is waiting to start: ContainerCreating";
            return refusal(400, "BadRequest", waits);
        }
    };
    (200, lines.to_owned())
}

/// The value behind a key of a query.
fn selected<'a>(query: &'a str, key: &str) -> Option<&'a str> {
    let (_, rest) = query.split_once(key)?;
    rest.split('&').next()
}

/// A cluster whose namespace `carla` has a Leaderboard and some submissions, of which one has a Pod. Events cannot be listed.
fn cluster(method: &str, path: &str) -> (u16, String) {
    let (place, query) = path.split_once('?').unwrap_or((path, ""));
    let place = place.trim_start_matches(GROUP).trim_start_matches("/api/v1");
    let words: Vec<&str> = place.split('/').skip(1).collect();
    let (namespace, words) = match words.as_slice() {
        ["namespaces", namespace, rest @ ..] => (Some(*namespace), rest),
        rest => (None, rest),
    };
    let (kind, mut all) = match words.first().copied() {
        Some("submissions") => ("Submission", submissions()),
        Some("leaderboards") => ("Leaderboard", vec![leaderboard()]),
        Some("pods") => ("Pod", vec![pod()]),
        _ => {
            let missing = "events.events.k8s.io is forbidden: User \"host\" cannot list resource \"events\" in API group \
                           \"events.k8s.io\" in the namespace \"carla\"";
            return refusal(403, "Forbidden", missing);
        }
    };
    if method == "POST" {
        return (201, submission("carla-20-x7k2p", &Value::Null).to_string());
    }
    let name = words.get(1).copied().or_else(|| selected(query, "metadata.name%3D"));
    all.retain(|one| namespace.is_none_or(|namespace| one["metadata"]["namespace"] == namespace));
    all.retain(|one| name.is_none_or(|name| one["metadata"]["name"] == name));
    let of = selected(query, "submission%3D");
    all.retain(|one| of.is_none_or(|of| one["metadata"]["labels"]["leaderboard.carla.org/submission"] == of));
    match (words.len(), all.first()) {
        (1, _) => list(kind, &all),
        (2, Some(found)) => (200, found.to_string()),
        (3, Some(_)) => log(query),
        _ => refusal(404, "NotFound", "not found"),
    }
}

/// A cluster where this person may do nothing.
fn forbidden(method: &str, path: &str) -> (u16, String) {
    let what = path.split('?').next().unwrap().rsplit('/').next().unwrap();
    let verb = if method == "GET" { "get" } else { "change" };
    let message = format!("{what} is forbidden: User \"participant\" cannot {verb} it in the namespace \"carla\"");
    refusal(403, "Forbidden", &message)
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
