//! `check` against a real API server. No controller runs; the test writes what one would.

use std::pin::pin;
use std::process::Stdio;

use futures::StreamExt;
use k8s_openapi::api::apps::v1::DaemonSet;
use k8s_openapi::api::core::v1::Pod;
use kube::api::{DynamicObject, ListParams, PostParams};
use kube::runtime::wait::await_condition;
use kube::runtime::{WatchStreamExt, watcher};
use kube::{Api, ResourceExt};
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

async fn has_no_submission(terminal: &Terminal) {
    let all = terminal
        .api(Kind::Submission)
        .list(&ListParams::default())
        .await
        .unwrap();
    assert_eq!(all.items.len(), 0);
}

/// Starts the command without an `aws` on its PATH.
fn check(terminal: &Terminal, arguments: &[&str]) -> Command {
    let mut command = terminal.command(&[&["check"], arguments].concat());
    command.env("PATH", "").stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}

fn ended(reason: &str, truth: &Value) -> Value {
    let mut status = json!({
        "state": "Finished", "attempt": 1, "reason": reason, "message": "It has ended.", "track": "sensors", "jobName": "a-1",
        "resultsURL": "s3://results/check", "progress": {"done": 1, "total": 1, "text": "1/1"},
        "times": {"started": "2026-11-01T10:00:00Z", "finished": "2026-11-01T10:00:00Z"},
        "conditions": [condition("Accepted", "True", "Accepted"), condition("Finished", "True", reason),
                       condition("Archived", "True", "Stored"), condition("Recorded", "False", "NotRequired")],
    });
    crate::api::objects::merge(&mut status, truth);
    status
}

/// Plays the controller: ends the check, and notes it in the Leaderboard.
async fn play(terminal: &Terminal, status: &Value) -> DynamicObject {
    let check = created(terminal).await;
    let name = check.name_any();
    terminal.status(Kind::Submission, &name, status).await;
    let last = json!({"lastCheck": {"time": "2026-11-01T10:00:00Z", "result": "Passed", "reason": "Finished",
                                    "leaderboardGeneration": 1, "submissionName": name}});
    terminal.status(Kind::Leaderboard, "local", &last).await;
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

#[tokio::test]
async fn a_check_is_created_followed_printed_and_deleted() {
    let terminal = Terminal::new().await;
    terminal
        .leaderboard(&json!({"check": {"image": "host/baseline:1"}}))
        .await;
    let mut command = check(&terminal, &[]);
    let well = ended("Finished", &json!({}));
    let ((code, out, err), object) = tokio::join!(output(&mut command), play(&terminal, &well));
    assert_eq!((code, err.as_str()), (Some(0), ""), "{out}");
    let name = object.name_any();
    assert_eq!(object.data["spec"]["check"], true);
    assert_eq!(object.data["spec"]["image"], "host/baseline:1");
    assert_has(
        &out,
        &[
            &format!("Check {name} of Leaderboard local: one route of track sensors with host/baseline:1."),
            &format!("{name} is Finished (Finished): It has ended."),
            "✔ Leaderboard    Ready",
            "✔ Bucket         has the results, s3://results/check",
            "✔ Route          1/1 done",
            "The check passed.",
            "aws s3 rm --recursive s3://results/check/",
        ],
    );
    let gone = await_condition(terminal.api(Kind::Submission), &name, |one: Option<&DynamicObject>| {
        one.is_none()
    });
    timeout(LIMIT, Box::pin(gone)).await.expect("it is deleted").unwrap();
}

/// The original's FluentD, and its Pod on a node.
async fn fluentd(terminal: &Terminal, node: &str) {
    let (client, namespace) = (&terminal.client, &terminal.namespace);
    let container =
        json!({"name": "fluentd", "image": "fluent/fluentd-kubernetes-daemonset:v1.16.1-debian-cloudwatch-1.2"});
    let labels = json!({"k8s-app": "fluentd"});
    let set = json!({
        "metadata": {"name": "fluentd"},
        "spec": {"selector": {"matchLabels": labels},
                 "template": {"metadata": {"labels": labels}, "spec": {"containers": [container]}}},
    });
    let sets: Api<DaemonSet> = Api::namespaced(client.clone(), namespace);
    let set: DaemonSet = serde_json::from_value(set).unwrap();
    let set = sets.create(&PostParams::default(), &set).await.unwrap();
    let owner = json!({"apiVersion": "apps/v1", "kind": "DaemonSet", "name": "fluentd", "uid": set.uid()});
    let pod = json!({
        "metadata": {"name": "fluentd-1", "ownerReferences": [owner]},
        "spec": {"nodeName": node, "containers": [container], "automountServiceAccountToken": false},
    });
    let pods: Api<Pod> = Api::namespaced(client.clone(), namespace);
    pods.create(&PostParams::default(), &serde_json::from_value(pod).unwrap())
        .await
        .unwrap();
}

#[tokio::test]
async fn what_collects_the_lines_on_the_node_of_the_check_too_is_noted() {
    let terminal = Terminal::new().await;
    let spec = json!({"check": {"image": "host/baseline:1"}, "logGroup": {"name": "group"}});
    terminal.leaderboard(&spec).await;
    fluentd(&terminal, "node-a").await;
    let name = format!("FluentD (DaemonSet {}/fluentd)", terminal.namespace);
    for (node, expected) in [
        ("node-a", [format!("! Log collectors {name},"), "on node-a".to_owned()]),
        (
            "node-b",
            ["✔ Log collectors none on node-b; elsewhere".to_owned(), name.clone()],
        ),
    ] {
        let mut command = check(&terminal, &[]);
        let status = ended("Finished", &json!({"nodeName": node}));
        let ((code, out, err), object) = tokio::join!(output(&mut command), play(&terminal, &status));
        assert_eq!((code, err.as_str()), (Some(0), ""), "{out}");
        let words = out.split_whitespace().collect::<Vec<_>>().join(" ");
        for part in expected {
            assert!(words.contains(&part), "{part}\n\n{out}");
        }
        let name = object.name_any();
        let gone = await_condition(terminal.api(Kind::Submission), &name, |one: Option<&DynamicObject>| {
            one.is_none()
        });
        timeout(LIMIT, Box::pin(gone)).await.expect("it is deleted").unwrap();
    }
}

#[tokio::test]
async fn a_fault_is_named_with_its_step_and_the_code_is_one() {
    let terminal = Terminal::new().await;
    terminal.leaderboard(&json!({})).await;
    let failure = json!({"class": "Infrastructure", "reason": "ImagePull",
                         "message": "The image of simulator-1 cannot be pulled: not found."});
    let bad = ended(
        "ImagePull",
        &json!({"state": "Failed", "failure": failure, "progress": null, "times": {"started": null}}),
    );
    let mut command = check(&terminal, &["local", "--image", "host/other:2", "--keep"]);
    let ((code, out, _), object) = tokio::join!(output(&mut command), play(&terminal, &bad));
    assert_eq!(code, Some(1), "{out}");
    assert_has(
        &out,
        &[
            "✘ Images         ImagePull: The image of simulator-1 cannot be pulled: not found.",
            "The check failed: 1 part is broken",
            &format!("  kubectl delete submission {}", object.name_any()),
        ],
    );
    let kept = terminal
        .api(Kind::Submission)
        .get_opt(&object.name_any())
        .await
        .unwrap();
    assert!(kept.is_some());
}

#[tokio::test]
async fn what_does_not_end_in_time_is_cancelled_and_deleted() {
    let terminal = Terminal::new().await;
    terminal.leaderboard(&json!({})).await;
    let mut command = check(&terminal, &["--image", "host/a:1", "--timeout", "2"]);
    let plays = async {
        let check = created(&terminal).await;
        let name = check.name_any();
        let waits = json!({"attempt": 1, "reason": "Unschedulable", "message": "0/3 nodes are available.",
                           "conditions": [condition("Finished", "False", "Preparing")]});
        terminal.status(Kind::Submission, &name, &waits).await;
        let cancelled = |one: Option<&DynamicObject>| one.is_some_and(|one| one.data["spec"]["cancel"] == true);
        let api = terminal.api(Kind::Submission);
        let asked = Box::pin(await_condition(api, &name, cancelled));
        timeout(LIMIT, asked).await.expect("it is cancelled").unwrap();
        let end = ended("Cancelled", &json!({"state": "Cancelled"}));
        terminal.status(Kind::Submission, &check.name_any(), &end).await;
        let last = json!({"lastCheck": {"time": "2026-11-01T10:00:00Z", "result": "Failed", "reason": "Cancelled",
                                        "leaderboardGeneration": 1, "submissionName": check.name_any()}});
        terminal.status(Kind::Leaderboard, "local", &last).await;
    };
    let ((code, out, _), ()) = tokio::join!(output(&mut command), plays);
    assert_eq!(code, Some(1), "{out}");
    let found = "✘ Node           The check did not end within 2 s (--timeout). Unschedulable: 0/3 nodes are";
    assert_has(&out, &[found]);
    has_no_submission(&terminal).await;
}

#[tokio::test]
async fn without_image_or_leaderboard_nothing_is_created() {
    let terminal = Terminal::new().await;
    let words = terminal.run(&["check"]).await.refused();
    assert!(
        words.ends_with("has no Leaderboard. Use -n for another namespace"),
        "{words}"
    );
    terminal.leaderboard(&json!({})).await;
    for (arguments, expected) in [
        (
            &["check"][..],
            "Give the image of an agent of your own with --image, or set spec.check.image",
        ),
        (&["check", "other"], "there is no Leaderboard other in namespace"),
        (
            &["check", "--track", "map", "--image", "a:1"],
            "has no track map. Give one of sensors",
        ),
    ] {
        let words = terminal.run(arguments).await.refused();
        assert!(words.contains(expected), "{words}");
    }
    has_no_submission(&terminal).await;
}
