//! `status`, `top`, `submit`, `report` and completion against a real API server.

use kube::ResourceExt;
use kube::api::ListParams;
use serde_json::{Value, json};
use tokio::process::Command;

use super::terminal::{Printed, Terminal, assert_has, condition, end, ended, finished, plugin, running, waiting};
use crate::api::objects::Kind;

/// A namespace in which one submission runs, one waits, and one is done.
async fn three() -> Terminal {
    let terminal = Terminal::new().await;
    terminal.leaderboard(&json!({"concurrency": {"total": 2}})).await;
    let team = |id: &str| json!({"team": {"id": id, "name": format!("Team {id}")}});
    terminal.submission("runs", &team("7"), &running()).await;
    terminal.submission("waits", &team("8"), &waiting()).await;
    terminal.submission("done", &team("7"), &finished()).await;
    terminal
}

/// The first column of a table.
fn firsts(text: &str) -> Vec<&str> {
    text.lines().filter_map(|line| line.split_whitespace().next()).collect()
}

#[tokio::test]
async fn status_and_top_show_all_of_a_namespace_and_one_on_a_screen() {
    let terminal = three().await;
    let text = terminal.run(&["status"]).await.well();
    assert_eq!(firsts(&text), ["NAME", "runs", "waits", "done"]);
    let text = terminal.run(&["status", "runs"]).await.well();
    assert_has(
        &text,
        &[
            "runs is Running since",
            "Job:         a-1",
            "Next:        kubectl leaderboard why runs",
        ],
    );
    let text = terminal.run(&["top"]).await.well();
    assert_has(&text, &["local        1/2    1", "Team 7", "Team 8"]);
    let text = terminal.run(&["status", "-o", "json"]).await.out;
    let value: Value = serde_json::from_str(&text).unwrap();
    assert_eq!(value.as_array().unwrap().len(), 3);
    let text = terminal.run(&["why", "waits", "-o", "yaml"]).await.out;
    assert_has(&text, &["\"reason\": \"WaitingForSlot\"", "\"nextSteps\":\n  - "]);
}

#[tokio::test]
async fn status_shows_what_its_flags_leave() {
    let terminal = three().await;
    for (flags, expected) in [
        (&["--state", "running,pending"][..], &["runs", "waits"][..]),
        (&["--state", "Finished"], &["done"]),
        (&["--team", "7"], &["runs", "done"]),
        (&["--team", "team 8"], &["waits"]),
        (
            &["--leaderboard", "local", "--track", "sensors"],
            &["runs", "waits", "done"],
        ),
    ] {
        let text = terminal.run(&[&["status"], flags].concat()).await.well();
        assert_eq!(firsts(&text)[1..], *expected, "{flags:?}");
    }
    let text = terminal.run(&["status", "--team", "9", "--track", "map"]).await.well();
    assert_has(&text, &["has the track map and the team 9."]);
    let text = terminal.run(&["status", "-l", "a=b"]).await.well();
    assert_has(
        &text,
        &[&format!(
            "No submission of namespace {} has the labels a=b.",
            terminal.namespace
        )],
    );
}

#[tokio::test]
async fn a_wrong_namespace_is_answered_with_the_right_one() {
    let (empty, full) = (Terminal::new().await, Terminal::new().await);
    full.submission("submission-4711", &json!({}), &waiting()).await;
    for command in [&["status"][..], &["why"], &["top"], &["resume", "--all"]] {
        let text = empty.run(command).await.well().replace('\n', " ");
        assert_has(&text, &["has no submissions. There are some in ", &full.namespace]);
    }
    for command in ["status", "why", "logs", "cancel", "resume"] {
        let text = empty.run(&[command, "submission-4711"]).await.refused();
        assert_has(
            &text,
            &[&format!("There is one in namespace {0}: use -n {0}", full.namespace)],
        );
    }
    let text = empty.run(&["why", "-A"]).await.out;
    assert_has(&text, &[&format!("{}/submission-4711", full.namespace)]);
    let text = empty.run(&["status", "-A"]).await.out;
    assert_has(&text, &["NAMESPACE", &full.namespace]);
}

#[tokio::test]
async fn submit_creates_and_waits() {
    let terminal = Terminal::new().await;
    terminal.leaderboard(&json!({})).await;
    let flags = [
        "--leaderboard",
        "local",
        "--track",
        "sensors",
        "--image",
        "a:1",
        "--name",
        "mine",
        "--team-id",
        "7",
    ];
    let mut waits = terminal.waits(&[&["submit"], &flags[..], &["--wait"]].concat());
    waits
        .until("Submitted mine to track sensors of Leaderboard local.")
        .await;
    let made = terminal.api(Kind::Submission).get("mine").await.unwrap();
    assert_eq!(made.data["spec"]["team"], json!({"id": "7"}));
    terminal.status(Kind::Submission, "mine", &finished()).await;
    assert_eq!(waits.code().await, Some(0));
    let again = terminal.run(&[&["submit"], &flags[..]].concat()).await.refused();
    assert_has(&again, &["already exists"]);
    let elsewhere = Terminal::new().await;
    let text = elsewhere.run(&[&["submit"], &flags[..]].concat()).await.refused();
    // Tests next to this one have Leaderboards of the same name.
    let parts = [
        "there is no Leaderboard local in namespace ",
        &terminal.namespace,
        "use -n ",
    ];
    assert_has(&text, &parts);
    let mut wrong = flags;
    wrong[3] = "map";
    let text = terminal.run(&[&["submit"], &wrong[..]].concat()).await.refused();
    assert_has(&text, &["Leaderboard local has no track map. It has "]);
}

#[tokio::test]
async fn status_is_followed_until_the_end() {
    let terminal = Terminal::new().await;
    terminal.submission("runs", &json!({}), &running()).await;
    let mut waits = terminal.waits(&["status", "runs", "-w"]);
    waits.until("runs is Running since").await;
    terminal
        .status(Kind::Submission, "runs", &end("Cancelled", "Cancelled"))
        .await;
    waits.until("runs is Cancelled since").await;
    assert_eq!(waits.code().await, Some(0));
}

#[tokio::test]
async fn a_report_is_one_file_without_secrets() {
    let terminal = Terminal::new().await;
    terminal
        .leaderboard(&json!({"agent": {"env": [{"name": "TOKEN", "value": "s3cr3t"}]}}))
        .await;
    terminal
        .submission("runs", &json!({"team": {"id": "7", "name": "Team Seven"}}), &running())
        .await;
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("report.json");
    let text = terminal.run(&["report", "--file", file.to_str().unwrap()]).await.out;
    let text = text.replace('\n', " ");
    assert_has(
        &text,
        &["Wrote ", "report.json", "1 Leaderboard, 1 submission, 0 Pods, "],
    );
    let report = std::fs::read_to_string(&file).unwrap();
    let parts: Value = serde_json::from_str(&report).unwrap();
    for (part, count) in [("leaderboards", 1), ("submissions", 1), ("pods", 0), ("events", 0)] {
        assert_eq!(parts[part].as_array().map(Vec::len), Some(count), "{part}");
    }
    assert_has(&report, &["TOKEN", "\"runs\""]);
    assert!(!report.contains("s3cr3t") && !report.contains("Team Seven"), "{report}");
}

#[tokio::test]
async fn a_shell_gets_names_from_the_cluster() {
    let terminal = Terminal::new().await;
    terminal.leaderboard(&json!({})).await;
    terminal.submission("submission-7", &json!({}), &waiting()).await;
    let complete = async |words: &[&str]| {
        let mut command = Command::new(plugin());
        command
            .env("KUBECONFIG", &terminal.kubeconfig)
            .args(["complete", "--"])
            .args(words);
        Printed::of(&ended(&mut command).await).out
    };
    let here = &terminal.namespace;
    assert_eq!(complete(&["why", "-n", here, "sub"]).await, "submission-7\n:4\n");
    assert_eq!(complete(&["cancel", "-n", here, ""]).await, "submission-7\n:4\n");
    assert_eq!(complete(&["check", "-n", here, ""]).await, "local\n:4\n");
    assert_eq!(complete(&["re"]).await, "report\nresume\n:4\n");
}

/// A screen without any of the optional parts.
#[tokio::test]
async fn one_that_nobody_has_processed_has_a_screen_too() {
    let terminal = Terminal::new().await;
    let bare = json!({"conditions": [condition("Finished", "False", "Preparing")]});
    terminal.submission("new", &json!({}), &bare).await;
    let text = terminal.run(&["status", "new"]).await.well();
    assert_has(&text, &["new is new, created"]);
    let all = terminal
        .api(Kind::Submission)
        .list(&ListParams::default())
        .await
        .unwrap();
    assert_eq!(all.items[0].name_any(), "new");
}
