//! `check` against a real API server. No controller runs; the test writes what one would.

use std::pin::pin;
use std::process::Stdio;

use futures::StreamExt;
use kube::ResourceExt;
use kube::api::{DynamicObject, ListParams};
use kube::runtime::wait::await_condition;
use kube::runtime::{WatchStreamExt, watcher};
use serde_json::{Value, json};
use tokio::io::AsyncReadExt;
use tokio::process::Command;
use tokio::time::timeout;

use super::terminal::{Terminal, assert_has, condition};
use crate::api::bridge::LIMIT;
use crate::api::objects::Kind;

/// The Submission of the check that the command has created.
async fn created(terminal: &Terminal) -> DynamicObject {
    let api = terminal.api(Kind::Submission);
    let seen = watcher(api, watcher::Config::default())
        .default_backoff()
        .touched_objects();
    let mut checks = pin!(seen.filter_map(async |one| one.ok().filter(|one| one.name_any().starts_with("check-"))));
    timeout(LIMIT, checks.next())
        .await
        .expect("the check is created")
        .unwrap()
}

fn check(terminal: &Terminal, arguments: &[&str]) -> Command {
    let mut command = terminal.command(&[&["check"], arguments].concat());
    command.stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}

fn ended(reason: &str, changes: &Value) -> Value {
    let mut status = json!({
        "state": "Finished", "attempt": 1, "reason": (reason != "Finished").then_some(reason), "message": "It has ended.", "track": "sensors", "jobName": "a-1",
        "resultsURL": "s3://results/check", "progress": {"done": 1, "total": 1, "unit": "routes", "text": "1/1"},
        "times": {"started": "2026-11-01T10:00:00Z", "finished": "2026-11-01T10:00:00Z"},
        "conditions": [condition("Accepted", "True", "Accepted"), condition("Finished", "True", reason),
                       condition("Archived", "True", "Stored"), condition("Recorded", "False", "NotRequired")],
    });
    crate::api::objects::merge(&mut status, changes);
    status
}

/// Plays the controller: ends the check.
async fn play(terminal: &Terminal, status: &Value) -> DynamicObject {
    let check = created(terminal).await;
    terminal.status(Kind::Submission, &check.name_any(), status).await;
    check
}

async fn output(command: &mut Command) -> (Option<i32>, String, String) {
    let mut child = command.spawn().unwrap();
    let (mut out, mut err) = (String::new(), String::new());
    let (mut stdout, mut stderr) = (child.stdout.take().unwrap(), child.stderr.take().unwrap());
    let read = async {
        tokio::try_join!(stdout.read_to_string(&mut out), stderr.read_to_string(&mut err)).unwrap();
        child.wait().await.unwrap().code()
    };
    let code = timeout(LIMIT, read).await.expect("it ends");
    (code, out, err)
}

async fn is_deleted(terminal: &Terminal, name: &str) {
    let gone = await_condition(terminal.api(Kind::Submission), name, |one: Option<&DynamicObject>| {
        one.is_none()
    });
    timeout(LIMIT, Box::pin(gone)).await.expect("it is deleted").unwrap();
}

#[tokio::test]
async fn a_check_is_created_shown_until_its_end_and_deleted() {
    let terminal = Terminal::new().await;
    terminal
        .leaderboard(&json!({"check": {"image": "host/baseline:1"}}))
        .await;
    let mut command = check(&terminal, &["local"]);
    let well = ended("Finished", &json!({}));
    let ((code, out, err), object) = tokio::join!(output(&mut command), play(&terminal, &well));
    assert_eq!((code, err.as_str()), (Some(0), ""), "{out}");
    let name = object.name_any();
    assert_eq!(object.data["spec"]["check"], true);
    assert_eq!(object.data["spec"]["image"], "host/baseline:1");
    assert_has(
        &out,
        &[
            &format!("{name} is Finished since"),
            "Results:     s3://results/check",
            "Ready:       True, Ready",
            "The check passed.",
        ],
    );
    is_deleted(&terminal, &name).await;
}

#[tokio::test]
async fn a_fault_is_named_and_the_code_is_one() {
    let terminal = Terminal::new().await;
    terminal.leaderboard(&json!({})).await;
    let failure = json!({"class": "Infrastructure", "reason": "ImagePull",
                         "message": "The image of simulator-1 cannot be pulled: not found."});
    let bad = ended(
        "ImagePull",
        &json!({"state": "Failed", "failure": failure, "progress": null, "times": {"started": null}}),
    );
    let mut command = check(&terminal, &["local", "--image", "host/other:2", "--keep"]);
    let ((code, out, err), object) = tokio::join!(output(&mut command), play(&terminal, &bad));
    assert_eq!(code, Some(1), "{out}");
    assert_has(
        &out,
        &[
            "The image of simulator-1 cannot be pulled: not found.",
            "The check did not pass.",
        ],
    );
    let name = object.name_any();
    assert_has(&err, &[&format!("{name} is kept, for `kubectl leaderboard why {name}")]);
    assert!(terminal.api(Kind::Submission).get_opt(&name).await.unwrap().is_some());
}

#[tokio::test]
async fn what_does_not_end_in_time_is_shown_and_deleted() {
    let terminal = Terminal::new().await;
    terminal.leaderboard(&json!({})).await;
    let waits = json!({"attempt": 1, "reason": "Unschedulable", "message": "0/3 nodes are available.",
                       "conditions": [condition("Finished", "False", "Preparing")]});
    let mut command = check(&terminal, &["local", "--image", "host/a:1", "--timeout", "5"]);
    let ((code, out, err), object) = tokio::join!(output(&mut command), play(&terminal, &waits));
    assert_eq!(code, Some(1), "{out}");
    assert_has(&out, &["Unschedulable: ", "0/3 nodes are available."]);
    assert_has(&err, &["did not end within 5 s (--timeout)"]);
    is_deleted(&terminal, &object.name_any()).await;
}

#[tokio::test]
async fn without_image_or_leaderboard_nothing_is_created() {
    let terminal = Terminal::new().await;
    terminal.leaderboard(&json!({})).await;
    for (arguments, expected) in [
        (
            &["check", "local"][..],
            "Give the image of an agent of your own with --image, or set spec.check.image",
        ),
        (&["check", "other"], "there is no Leaderboard other in namespace"),
        (
            &["check", "local", "--track", "map", "--image", "a:1"],
            "has no track map. It has sensors",
        ),
    ] {
        let words = terminal.run(arguments).await.refused();
        assert!(words.contains(expected), "{words}");
    }
    let all = terminal.api(Kind::Submission).list(&ListParams::default()).await;
    assert_eq!(all.unwrap().items.len(), 0);
}
