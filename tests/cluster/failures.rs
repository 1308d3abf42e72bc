//! What goes wrong with the participant's image, and what everybody is told of it.

use std::time::Duration;

use evalai_stand_in::model::Status;
use leaderboard_operator::api::{FailureClass, State, Submission};
use serde_json::json;

use crate::evalai::Evalai;
use crate::operator::{bridge, controller};
use crate::scene::{Scene, reason, scenario, state};

#[tokio::test]
async fn an_agent_that_always_crashes_fails_and_everybody_is_told() {
    scenario("crash-always", async |scene: &Scene| {
        let evalai = Evalai::start(scene).await;
        let change = json!({"pairs": 2, "routes": 6, "retries": {"pair": 2}});
        scene.evalai_leaderboard("lb", &evalai, change).await;
        let (_controller, _bridge) = (controller(scene), bridge(scene));
        let pk = evalai.submit(&scene.lab.challenge("agent:crash-always"), 1).await;
        let submission = scene.settled(&format!("submission-{pk}"), Duration::from_mins(4)).await;

        assert_eq!(
            (state(&submission), reason(&submission)),
            (Some(State::Failed), "AgentCrashed")
        );
        let failure = submission.status.unwrap().failure.unwrap();
        assert_eq!((failure.class, failure.charged), (FailureClass::Participant, true));
        let row = evalai.submission(pk);
        assert_eq!(row.status, Status::Failed);
        let words = evalai.file(row.stderr_file.as_ref());
        assert!(
            words.contains(&failure.message),
            "the participant reads {words:?}, not {:?}",
            failure.message
        );
        let shown = evalai.leaderboard(1).await;
        assert!(
            shown.is_empty(),
            "a failed run has no place on the leaderboard: {shown:?}"
        );
        let row = scene.cloud.row(&scene.cloud.table).await;
        assert_eq!(
            (row["submission_status"].as_str(), row["attempt"].as_str()),
            ("FAILED", "1")
        );
    })
    .await;
}

#[tokio::test]
async fn a_missing_image_is_named_within_a_minute_and_fails_after_its_time() {
    scenario("no-image", async |scene: &Scene| {
        let change = json!({"pairs": 2, "routes": 6, "deadlines": {"startSeconds": 25, "cancelSeconds": 10}});
        scene.leaderboard("lb", change).await;
        let _controller = controller(scene);
        scene.submit("nowhere", "agent:nobody-pushed-this").await;
        let named = |s: &Submission| state(s) == Some(State::Pending) && reason(s) == "ImagePull";
        let pending = scene
            .submission("nowhere", "it says which image", Duration::from_mins(1), named)
            .await;
        let message = pending.status.unwrap().message.unwrap();
        assert!(message.contains("agent:nobody-pushed-this"), "{message}");

        let failed = scene.settled("nowhere", Duration::from_mins(3)).await;
        assert_eq!((state(&failed), reason(&failed)), (Some(State::Failed), "ImagePull"));
        let failure = failed.status.unwrap().failure.unwrap();
        assert_eq!(failure.class, FailureClass::Participant);
        assert!(failure.message.contains("25 s"), "{}", failure.message);
    })
    .await;
}
