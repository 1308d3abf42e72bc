//! The built `kubectl-leaderboard` against a real API server: what it prints, what it changes, its exit codes, and which
//! rights it needs. No controller runs; the test writes the status.
#![cfg(test)]

mod checks;
mod daily;
mod dashboard;
mod files;
mod logs;
mod resume;
mod rights;
mod terminal;

use serde_json::json;

pub use self::terminal::plugin;
use self::terminal::{Terminal, assert_has, condition, end, evalai, failed, finished, running, waiting};
use super::objects::Kind;

#[tokio::test]
async fn why_shows_state_cause_and_next_step() {
    let terminal = Terminal::new().await;
    terminal.leaderboard(&json!({"concurrency": {"total": 2}})).await;
    for (name, status, expected) in [
        (
            "in-line",
            waiting(),
            &["in-line is Pending", "position 3", "concurrency.total"][..],
        ),
        (
            "crashed",
            failed("Participant", "AgentCrashed"),
            &[
                "Reason:      AgentCrashed: It has ended.",
                "participant failure in worker 2",
                "aws s3 cp s3://results/42/evalai/environment_log.txt -",
                "agent/agent2/leaderboard.log",
            ],
        ),
        (
            "lost",
            failed("Infrastructure", "NodeLost"),
            &[
                "infrastructure failure in worker 2",
                &format!("kubectl leaderboard resume lost -n {}", terminal.namespace),
            ],
        ),
        (
            "done",
            finished(),
            &["20/20 routes done", "s3://results/42", "Delivered:   EvalAI."],
        ),
    ] {
        terminal.submission(name, &json!({}), &status).await;
        assert_has(&terminal.run(&["why", name]).await.well(), expected);
    }
    let all = terminal.run(&["why"]).await.well();
    assert_has(
        &all,
        &["NAME", "in-line  Pending", "crashed  Failed", "lost     Failed"],
    );
    assert!(!all.contains("done "), "{all}");
}

#[tokio::test]
async fn why_names_a_leaderboard_that_is_missing_or_paused() {
    let terminal = Terminal::new().await;
    let status = json!({"state": "Pending", "attempt": 1, "reason": "LeaderboardNotFound", "message": "Apply it."});
    terminal.submission("a", &json!({}), &status).await;
    for arguments in [&["why", "a"][..], &["why"]] {
        let words = terminal.run(arguments).await.well();
        assert_has(&words, &["no Leaderboard local"]);
    }
    terminal.leaderboard(&json!({"paused": true})).await;
    for arguments in [&["why", "a"][..], &["why"]] {
        let words = terminal.run(arguments).await.well();
        assert_has(&words, &["Leaderboard local is paused"]);
    }
}

#[tokio::test]
async fn an_unknown_name_is_answered_with_the_nearest() {
    let terminal = Terminal::new().await;
    for name in ["submission-42", "baseline"] {
        terminal.submission(name, &json!({}), &waiting()).await;
    }
    for (command, wrong, meant) in [
        ("why", "submision-42", "Did you mean submission-42?"),
        ("cancel", "42", "Did you mean submission-42?"),
        ("resume", "basline", "Did you mean baseline?"),
        ("why", "something-else", "lists all; use -n for another namespace"),
    ] {
        let words = terminal.run(&[command, wrong]).await.refused();
        let start = format!("there is no submission {wrong} in namespace {}. ", terminal.namespace);
        assert!(words.starts_with(&start) && words.ends_with(meant), "{words}");
    }
    assert_eq!(terminal.requested("submission-42").await, (1, false));
}

#[tokio::test]
async fn cancel_is_requested_once_and_not_after_the_end() {
    let terminal = Terminal::new().await;
    terminal.leaderboard(&json!({"deadlines": {"cancelSeconds": 77}})).await;
    terminal.submission("runs", &json!({}), &running()).await;
    let words = terminal.run(&["cancel", "runs"]).await.well();
    assert_has(&words, &["Cancelling runs.", "77s"]);
    assert_eq!(terminal.requested("runs").await, (1, true));
    let words = terminal.run(&["cancel", "runs"]).await.well();
    assert_has(&words, &["already"]);

    for (name, status) in [
        ("done", finished()),
        ("failed", failed("Participant", "Idle")),
        ("stopped", end("Cancelled", "Cancelled")),
    ] {
        terminal.submission(name, &json!({}), &status).await;
        let words = terminal.run(&["cancel", name]).await.refused();
        assert_has(&words, &["since 2026-11-01 10:00:00 UTC", "nothing to cancel"]);
        assert_eq!(terminal.requested(name).await, (1, false));
    }
}

#[tokio::test]
async fn resume_raises_the_attempt_of_what_failed_or_was_cancelled() {
    let terminal = Terminal::new().await;
    terminal.leaderboard(&json!({})).await;
    terminal
        .submission("failed", &json!({}), &failed("Infrastructure", "NodeLost"))
        .await;
    let words = terminal.run(&["resume", "failed"]).await.well();
    assert_has(&words, &["Requested attempt 2 of failed.", "s3://results/42"]);
    assert_eq!(terminal.requested("failed").await, (2, false));
    let words = terminal.run(&["resume", "failed"]).await.refused();
    assert_has(&words, &["already requested"]);
    assert_eq!(terminal.requested("failed").await, (2, false));

    let cancelled = end("Cancelled", "Cancelled");
    terminal
        .submission("stopped", &json!({"cancel": true}), &cancelled)
        .await;
    terminal.run(&["resume", "stopped"]).await.well();
    assert_eq!(terminal.requested("stopped").await, (2, false));
}

#[tokio::test]
async fn resume_of_anything_else_is_refused_with_the_next_step() {
    let terminal = Terminal::new().await;
    terminal.submission("runs", &json!({}), &running()).await;
    terminal.submission("done", &json!({}), &finished()).await;
    let words = terminal.run(&["resume", "runs"]).await.refused();
    assert_has(&words, &["runs is Running", "kubectl leaderboard resume runs"]);
    let words = terminal.run(&["resume", "done"]).await.refused();
    assert_has(&words, &["has finished"]);
    for name in ["runs", "done"] {
        assert_eq!(terminal.requested(name).await, (1, false));
    }
}

/// The highest attempt there may be: a refusal by the API server's rules is shown in its own text, with EvalAI as the other way.
#[tokio::test]
async fn what_the_api_server_refuses_is_done_in_evalai() {
    let terminal = Terminal::new().await;
    let mut status = failed("Infrastructure", "NodeLost");
    status["attempt"] = json!(9999);
    let mut spec = evalai(42);
    spec["attempt"] = json!(9999);
    terminal.submission("submission-42", &spec, &status).await;
    let words = terminal.run(&["resume", "submission-42"]).await.refused();
    assert_has(&words, &["the API server refused", "9999", "EvalAI (challenge 3)"]);
}

#[tokio::test]
async fn a_wait_for_a_cancel_prints_the_states_until_the_end() {
    let terminal = Terminal::new().await;
    terminal.submission("runs", &json!({}), &running()).await;
    let mut waits = terminal.waits(&["cancel", "runs", "--wait"]);
    waits.until("runs is Running: 12/20 routes done.").await;
    let stopping = json!({"reason": "Stopping", "message": "Stopping as requested."});
    terminal.status(Kind::Submission, "runs", &stopping).await;
    waits.until("runs is Running (Stopping): Stopping as requested.").await;
    terminal
        .status(Kind::Submission, "runs", &end("Cancelled", "Cancelled"))
        .await;
    waits.until("runs is Cancelled: It has ended.").await;
    assert_eq!(waits.code().await, Some(0));
}

#[tokio::test]
async fn a_wait_for_a_resume_ends_with_whether_it_finished() {
    let terminal = Terminal::new().await;
    for (name, last, code) in [("good", finished(), 0), ("bad", failed("Participant", "Idle"), 1)] {
        terminal
            .submission(name, &json!({}), &failed("Infrastructure", "NodeLost"))
            .await;
        let mut waits = terminal.waits(&["resume", name, "--wait"]);
        waits.until("Requested attempt 2").await;
        let begun = json!({"state": "Pending", "attempt": 2, "reason": "Preparing", "failure": null,
                           "conditions": [condition("Finished", "False", "Preparing")]});
        terminal.status(Kind::Submission, name, &begun).await;
        waits.until("is Pending (Preparing)").await;
        let mut last = last;
        last["attempt"] = json!(2);
        terminal.status(Kind::Submission, name, &last).await;
        assert_eq!(waits.code().await, Some(code), "{name}");
    }
}

#[tokio::test]
async fn pause_and_unpause_change_the_leaderboard_and_name_what_goes_on() {
    let terminal = Terminal::new().await;
    terminal.leaderboard(&json!({})).await;
    let counts = json!({"counts": {"pending": 2, "running": 1, "finished": 0, "failed": 0, "cancelled": 0}});
    terminal.status(Kind::Leaderboard, "local", &counts).await;
    for (command, is_paused, parts) in [
        (
            "pause",
            true,
            &[
                "is paused: nothing new starts",
                "Running:     1, on",
                "resume --all --restart",
            ][..],
        ),
        ("pause", true, &["was paused already"]),
        ("unpause", false, &["goes on", "Waiting:     2"]),
    ] {
        assert_has(&terminal.run(&[command, "local"]).await.well(), parts);
        let stored = terminal.api(Kind::Leaderboard).get("local").await.unwrap();
        assert_eq!(stored.data["spec"]["paused"], is_paused, "{command}");
    }
    let text = terminal.run(&["pause", "lokal"]).await.refused();
    assert_has(&text, &["there is no Leaderboard lokal"]);
}

#[tokio::test]
async fn a_wait_ends_when_the_submission_is_deleted() {
    let terminal = Terminal::new().await;
    terminal.submission("runs", &json!({}), &running()).await;
    let mut waits = terminal.waits(&["cancel", "runs", "--wait"]);
    waits.until("runs is Running").await;
    let api = terminal.api(Kind::Submission);
    api.delete("runs", &kube::api::DeleteParams::default()).await.unwrap();
    assert_eq!(waits.code().await, Some(1));
}
