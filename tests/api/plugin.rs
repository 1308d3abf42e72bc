//! The built `kubectl-leaderboard` against a real API server: what it prints, what it changes, its exit codes, and which
//! rights it needs. No controller runs; the test writes the status.
#![cfg(test)]

mod desk;
mod rights;

use serde_json::json;

use self::desk::{Desk, assert_has, condition, end, evalai, failed, finished, running, waiting};
use super::objects::Kind;

#[tokio::test]
async fn why_says_state_cause_and_next_step() {
    let desk = Desk::new().await;
    desk.leaderboard(&json!({"concurrency": {"total": 2}})).await;
    for (name, status, expected) in [
        (
            "in-line",
            waiting(),
            &[
                "in-line is Pending since 2026-11-01 10:00:00 UTC (",
                "In line:     place 3; it starts in about 20-35 min. concurrency.total is 2.",
                "Next:        Wait, or raise the limits.",
            ][..],
        ),
        (
            "crashed",
            failed("Participant", "AgentCrashed"),
            &[
                "Failure:     AgentCrashed, the participant's, charged, in pair 2.",
                "aws s3 cp s3://results/42/evalai/environment_log.txt -",
                "Next:        Look at agent/agent2/leaderboard.log of the results; the participant fixes the agent",
            ],
        ),
        (
            "lost",
            failed("Infrastructure", "NodeLost"),
            &[
                "Failure:     NodeLost, the infrastructure's, not charged, in pair 2.",
                &format!("kubectl leaderboard resume lost -n {}", desk.namespace),
            ],
        ),
        (
            "done",
            finished(),
            &[
                "Routes:      20/20 done, driving score 43.13.",
                "Results:     s3://results/42",
                "EvalAI:      Published: EvalAI has the end.",
                "Next:        Nothing.",
            ],
        ),
    ] {
        desk.submission(name, &json!({}), &status).await;
        assert_has(&desk.run(&["why", name]).await.well(), expected);
    }
    let all = desk.run(&["why"]).await.well();
    assert_has(
        &all,
        &["NAME", "in-line  Pending", "crashed  Failed", "lost     Failed"],
    );
    assert!(!all.contains("done "), "{all}");
}

#[tokio::test]
async fn why_names_a_leaderboard_that_is_missing_or_paused() {
    let desk = Desk::new().await;
    let status = json!({"state": "Pending", "attempt": 1, "reason": "LeaderboardNotFound", "message": "Apply it."});
    desk.submission("a", &json!({}), &status).await;
    for arguments in [&["why", "a"][..], &["why"]] {
        let words = desk.run(arguments).await.well();
        assert_has(
            &words,
            &["There is no Leaderboard local in this namespace: nothing new starts."],
        );
    }
    desk.leaderboard(&json!({"paused": true})).await;
    for arguments in [&["why", "a"][..], &["why"]] {
        let words = desk.run(arguments).await.well();
        assert_has(
            &words,
            &["Leaderboard local is paused: nothing new starts, and what runs goes on."],
        );
    }
}

#[tokio::test]
async fn an_unknown_name_is_answered_with_the_nearest() {
    let desk = Desk::new().await;
    for name in ["submission-42", "baseline"] {
        desk.submission(name, &json!({}), &waiting()).await;
    }
    for (command, wrong, meant) in [
        ("why", "submision-42", "Do you mean submission-42?"),
        ("cancel", "42", "Do you mean submission-42?"),
        ("resume", "basline", "Do you mean baseline?"),
        ("why", "something-else", "lists all; -n names another namespace"),
    ] {
        let words = desk.run(&[command, wrong]).await.refused();
        let start = format!("there is no submission {wrong} in namespace {}. ", desk.namespace);
        assert!(words.starts_with(&start) && words.ends_with(meant), "{words}");
    }
    assert_eq!(desk.wished("submission-42").await, (1, false));
}

#[tokio::test]
async fn cancel_is_wished_once_and_not_of_what_has_ended() {
    let desk = Desk::new().await;
    desk.leaderboard(&json!({"deadlines": {"cancelSeconds": 77}})).await;
    desk.submission("runs", &json!({}), &running()).await;
    let words = desk.run(&["cancel", "runs"]).await.well();
    assert_has(
        &words,
        &["runs is to be cancelled.", "if it takes longer than 77 s, its Job is"],
    );
    assert_eq!(desk.wished("runs").await, (1, true));
    let words = desk.run(&["cancel", "runs"]).await.well();
    assert_has(&words, &["runs is being cancelled already."]);

    for (name, status) in [
        ("done", finished()),
        ("failed", failed("Participant", "Idle")),
        ("stopped", end("Cancelled", "Cancelled")),
    ] {
        desk.submission(name, &json!({}), &status).await;
        let words = desk.run(&["cancel", name]).await.refused();
        assert_has(
            &words,
            &[
                "since 2026-11-01 10:00:00 UTC",
                "so there is nothing to cancel. See `kubectl leaderboard why",
            ],
        );
        assert_eq!(desk.wished(name).await, (1, false));
    }
}

#[tokio::test]
async fn resume_raises_the_attempt_of_what_failed_or_was_cancelled() {
    let desk = Desk::new().await;
    desk.leaderboard(&json!({})).await;
    desk.submission("failed", &json!({}), &failed("Infrastructure", "NodeLost"))
        .await;
    let words = desk.run(&["resume", "failed"]).await.well();
    assert_has(
        &words,
        &[
            "Attempt 2 of failed is wished.",
            "takes up what is stored in s3://results/42",
        ],
    );
    assert_eq!(desk.wished("failed").await, (2, false));
    let words = desk.run(&["resume", "failed"]).await.refused();
    assert_has(&words, &["attempt 2 of failed is wished already"]);
    assert_eq!(desk.wished("failed").await, (2, false));

    let cancelled = end("Cancelled", "Cancelled");
    desk.submission("stopped", &json!({"cancel": true}), &cancelled).await;
    desk.run(&["resume", "stopped"]).await.well();
    assert_eq!(desk.wished("stopped").await, (2, false));
}

#[tokio::test]
async fn resume_of_anything_else_is_refused_with_the_next_step() {
    let desk = Desk::new().await;
    desk.submission("runs", &json!({}), &running()).await;
    desk.submission("done", &json!({}), &finished()).await;
    let words = desk.run(&["resume", "runs"]).await.refused();
    assert_has(
        &words,
        &[
            "runs is Running; only what is Failed or Cancelled is resumed.",
            "kubectl leaderboard cancel runs",
        ],
    );
    let words = desk.run(&["resume", "done"]).await.refused();
    assert_has(&words, &["done is Finished, which is for ever."]);
    for name in ["runs", "done"] {
        assert_eq!(desk.wished(name).await, (1, false));
    }
}

/// The highest attempt there may be: what the API server's rules refuse is told in its words, with EvalAI as the other way.
#[tokio::test]
async fn what_the_api_server_refuses_is_done_in_evalai() {
    let desk = Desk::new().await;
    let mut status = failed("Infrastructure", "NodeLost");
    status["attempt"] = json!(9999);
    let mut spec = evalai(42);
    spec["attempt"] = json!(9999);
    desk.submission("submission-42", &spec, &status).await;
    let words = desk.run(&["resume", "submission-42"]).await.refused();
    assert_has(
        &words,
        &[
            "the API server refuses it: ",
            "9999",
            "Resume submission 42 in EvalAI (challenge 3)",
        ],
    );
}

#[tokio::test]
async fn who_waits_for_a_cancel_sees_the_states_until_the_end() {
    let desk = Desk::new().await;
    desk.submission("runs", &json!({}), &running()).await;
    let mut waits = desk.waits(&["cancel", "runs", "--wait"]);
    waits.until("runs is Running (Running): 12/20 routes done.").await;
    let stopping = json!({"reason": "Stopping", "message": "It is being stopped as wished."});
    desk.status(Kind::Submission, "runs", &stopping).await;
    waits
        .until("runs is Running (Stopping): It is being stopped as wished.")
        .await;
    desk.status(Kind::Submission, "runs", &end("Cancelled", "Cancelled"))
        .await;
    waits.until("runs is Cancelled (Cancelled): It has ended.").await;
    assert_eq!(waits.code().await, Some(0));
}

#[tokio::test]
async fn who_waits_for_a_resume_hears_whether_it_finished() {
    let desk = Desk::new().await;
    for (name, last, code) in [("good", finished(), 0), ("bad", failed("Participant", "Idle"), 1)] {
        desk.submission(name, &json!({}), &failed("Infrastructure", "NodeLost"))
            .await;
        let mut waits = desk.waits(&["resume", name, "--wait"]);
        waits.until("is wished.").await;
        let begun = json!({"state": "Pending", "attempt": 2, "reason": "Preparing", "failure": null,
                           "conditions": [condition("Finished", "False", "Preparing")]});
        desk.status(Kind::Submission, name, &begun).await;
        waits.until("is Pending (Preparing)").await;
        let mut last = last;
        last["attempt"] = json!(2);
        desk.status(Kind::Submission, name, &last).await;
        assert_eq!(waits.code().await, Some(code), "{name}");
    }
}

#[tokio::test]
async fn one_that_is_deleted_is_waited_for_no_longer() {
    let desk = Desk::new().await;
    desk.submission("runs", &json!({}), &running()).await;
    let mut waits = desk.waits(&["cancel", "runs", "--wait"]);
    waits.until("runs is Running").await;
    let api = desk.api(Kind::Submission);
    api.delete("runs", &kube::api::DeleteParams::default()).await.unwrap();
    assert_eq!(waits.code().await, Some(1));
}
