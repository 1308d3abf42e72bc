//! Failures of the participant's image, as each system shows them.

use std::time::Duration;

use serde_json::json;

use super::matrix::Case;
use crate::evalai::Evalai;
use crate::operator::{bridge, controller};
use crate::scene::{Scene, scenario};

#[tokio::test]
async fn an_agent_that_always_crashes_fails_in_every_system() {
    scenario("crash-always", async |scene: &Scene| {
        let evalai = Evalai::start(scene).await;
        let change = json!({"evaluation": {"carla": {"pairs": 2, "routes": 6}}, "retries": {"perWorker": 1}});
        scene.evalai_leaderboard("lb", &evalai, change).await;
        let (_controller, _bridge) = (controller(scene), bridge(scene));
        let pk = evalai.submit(&scene.lab.challenge("agent:crash-always"), 1).await;
        let expected = "Failed AgentCrashed (participant, charged); EvalAI failed";
        let mut case = Case::open("agent crashes always", expected);
        let submission = case
            .ends(scene, &format!("submission-{pk}"), Duration::from_mins(4))
            .await;

        let failure = submission.status.unwrap().failure.unwrap();
        let row = evalai.submission(pk);
        case.evalai(row.status);
        let words = evalai.file(row.stderr_file.as_ref());
        let expected = failure.participant_message.unwrap();
        assert!(
            words.contains(&expected) && !words.contains("leaderboard.log"),
            "the participant reads {words:?}, not {expected:?}"
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
        case.close();
    })
    .await;
}
