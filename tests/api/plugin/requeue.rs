//! `requeue` against a real API server: what is changed, what is asked, and who is refused.

use serde_json::{Value, json};

use super::terminal::{Terminal, assert_has, failed, finished, running};
use crate::api::objects::Kind;

const BROKEN: &str = "registry.example/simulator:broken";

async fn of_broken_image(terminal: &Terminal, name: &str, mut status: Value) {
    status["plan"] = json!({"runId": name, "leaderboardVersion": "V2", "track": "sensors", "codename": "S",
                            "slices": [{"first": 0, "last": 0}], "routes": 1, "repetitions": 1,
                            "storage": {"bucket": "results"}, "image": "a", "contentsImage": "c", "simulatorImage": BROKEN});
    terminal.submission(name, &json!({}), &status).await;
}

async fn spec(terminal: &Terminal, name: &str) -> Value {
    terminal.api(Kind::Submission).get(name).await.unwrap().data["spec"].clone()
}

#[tokio::test]
async fn what_a_broken_image_has_failed_is_shown_and_then_requeued() {
    let terminal = Terminal::new().await;
    terminal.leaderboard(&json!({})).await;
    of_broken_image(&terminal, "charged", failed("Participant", "AgentCrashed")).await;
    of_broken_image(&terminal, "runs", running()).await;
    of_broken_image(&terminal, "done", finished()).await;
    terminal
        .submission("other", &json!({}), &failed("Participant", "Idle"))
        .await;
    let choice = ["requeue", "--all", "--simulator", BROKEN, "--state", "failed,running"];
    let text = terminal.run(&[&choice[..], &["--dry-run"]].concat()).await.well();
    assert_has(
        &text,
        &["NAME", "charged  ", "runs     ", "Would requeue 2 submissions."],
    );
    assert!(!text.contains("done") && !text.contains("other"), "{text}");
    assert_eq!(spec(&terminal, "charged").await["requeue"], Value::Null);

    let why = ["--why", "The image was broken."];
    let text = terminal.run(&[&choice[..], &why].concat()).await.well();
    assert_has(
        &text,
        &[
            "Requeued charged: attempt 2 begins when its turn comes.",
            "Requeued runs: its run stops and continues in attempt 1, when its turn comes.",
        ],
    );
    let wanted = json!({"number": 1, "reason": "The image was broken."});
    let charged = spec(&terminal, "charged").await;
    assert_eq!((&charged["requeue"], &charged["attempt"]), (&wanted, &json!(2)));
    let runs = spec(&terminal, "runs").await;
    assert_eq!((&runs["requeue"], &runs["attempt"]), (&wanted, &json!(1)));
    assert_eq!(spec(&terminal, "other").await["requeue"], Value::Null);

    let text = terminal.run(&choice).await.well();
    assert_has(&text, &["None of 4 submissions fits."]);
    let text = terminal.run(&["why", "runs"]).await.well().replace('\n', " ");
    assert_has(
        &text,
        &["Requeued:    requested by a host; not carried out yet: The image was broken."],
    );
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
    let printed = terminal.run_as(&person, &["requeue", "--all", "--yes"]).await;
    assert_eq!(printed.code, Some(1), "{printed:?}");
    assert_eq!(printed.err.matches("missing right: ").count(), 1, "{}", printed.err);
    assert_eq!(terminal.requested("a").await, (1, false));
}
