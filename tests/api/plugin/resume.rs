//! `resume` of many submissions against a real API server: which ones are asked for, and who is refused.

use serde_json::json;

use super::terminal::{Terminal, assert_has, failed, finished, running};

#[tokio::test]
async fn many_are_resumed_by_their_failures() {
    let terminal = Terminal::new().await;
    terminal
        .submission("lost", &json!({}), &failed("Infrastructure", "NodeLost"))
        .await;
    terminal
        .submission("crashed", &json!({}), &failed("Participant", "AgentCrashed"))
        .await;
    let text = terminal.run(&["resume", "--all", "--dry-run"]).await.well();
    assert_has(&text, &["crashed  ", "lost  ", "Would resume 2 submissions."]);
    let of_hosts = ["resume", "--all", "--infrastructure"];
    let text = terminal.run(&[&of_hosts[..], &["--dry-run"]].concat()).await.well();
    assert_has(&text, &["lost  ", "Would resume 1 submission."]);
    assert!(!text.contains("crashed"), "{text}");
    assert_eq!(terminal.requested("lost").await, (1, false));
    let text = terminal
        .run(&[&of_hosts[..], &["--reason", "SimulationCrashed"]].concat())
        .await
        .well();
    let none = "None of 2 submissions has failed because of the infrastructure for SimulationCrashed.";
    assert_has(&text.replace('\n', " "), &[none]);
    let text = terminal.run(&of_hosts).await.well();
    assert_has(
        &text,
        &["Requested attempt 2 of lost.", "Requested for 1 of 1 submission."],
    );
    assert_eq!(terminal.requested("lost").await, (2, false));
    assert_eq!(terminal.requested("crashed").await, (1, false));
}

#[tokio::test]
async fn only_live_runs_are_restarted() {
    let terminal = Terminal::new().await;
    terminal.submission("runs", &json!({}), &running()).await;
    terminal.submission("done", &json!({}), &finished()).await;
    terminal
        .submission("crashed", &json!({}), &failed("Participant", "AgentCrashed"))
        .await;
    let text = terminal.run(&["resume", "--all", "--restart"]).await.well();
    assert_has(
        &text,
        &[
            "runs  ",
            "Requested attempt 2 of runs: its run stores its results",
            "Requested for 1 of 1",
        ],
    );
    assert_eq!(terminal.requested("runs").await, (2, false));
    assert_eq!(terminal.requested("crashed").await, (1, false));
    let text = terminal.run(&["resume", "--all", "--restart"]).await.well();
    assert_has(&text, &["None of 3 submissions has a run to restart."]);
    let text = terminal.run(&["resume", "crashed", "--restart"]).await.refused();
    assert_has(&text, &["crashed is Failed and has no run to restart."]);
}

#[tokio::test]
async fn without_the_right_none_is_tried() {
    let terminal = Terminal::new().await;
    for name in ["a", "b"] {
        terminal
            .submission(name, &json!({}), &failed("Infrastructure", "NodeLost"))
            .await;
    }
    let (_folder, person) = super::rights::reader(&terminal).await;
    let printed = terminal.run_as(&person, &["resume", "--all"]).await;
    assert_eq!(printed.code, Some(1), "{printed:?}");
    assert_eq!(printed.err.matches("missing right: ").count(), 1, "{}", printed.err);
    assert_eq!(terminal.requested("a").await, (1, false));
}
