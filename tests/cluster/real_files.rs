//! Files of the real evaluator of Leaderboard 2.0, from the agents' folders to the published end. `local/challenge` has them, and the
//! stand-in evaluator leaves them as its own.

use std::time::Duration;

use leaderboard_api::{State, Submission};
use leaderboard_contract::report::{Outcome, REPORT_KEY, Report};
use serde_json::{Value, json};

use super::matrix::Case;
use crate::operator::controller;
use crate::scene::{Scene, scenario, score, state};

const LIMIT: Duration = Duration::from_mins(4);
/// The original's own merge of the four complete files: to the original the run is `Invalid`, because none of them names a sensor.
const MERGED: &str = include_str!("../../local/challenge/expected-again.json");

/// The routes of the files, four for each pair. `replays`: each pair's file; pair 4 may have more knobs behind it.
fn board(replays: [&str; 4]) -> Value {
    let knobs = (1..)
        .zip(replays)
        .map(|(pair, file)| format!("pair={pair},replay=real/{file}"));
    let knobs = knobs.collect::<Vec<_>>().join(";");
    json!({
        "evaluation": {"carla": {"pairs": 4, "routes": 16}},
        "retries": {"perWorker": 1, "infrastructure": 0},
        "agent": {"env": [{"name": "AGENT_KNOBS", "value": knobs}]},
    })
}

fn progress(submission: &Submission) -> &str {
    let progress = submission.status.as_ref().and_then(|status| status.progress.as_ref());
    progress.map_or("", |progress| progress.text.as_str())
}

async fn report(scene: &Scene, run: &str) -> Report {
    Report::parse(scene.cloud.text(run, REPORT_KEY).await.as_bytes()).unwrap()
}

#[tokio::test]
async fn complete_files_that_were_written_once_more_without_sensors_finish_with_their_score() {
    scenario("real-complete", async |scene: &Scene| {
        let files = ["done-1.json", "done-2.json", "done-3.json", "done-4.json"];
        scene.leaderboard("lb", board(files)).await;
        let _controller = controller(scene);
        scene.submit("complete", "agent:standard").await;
        let submission = scene.settled("complete", LIMIT).await;

        let merged: Value = serde_json::from_str(MERGED).unwrap();
        let means = &merged["_checkpoint"]["global_record"]["scores_mean"];
        let expected = format!("{:.2}", means["score_composed"].as_f64().unwrap());
        assert_eq!(
            (state(&submission), progress(&submission), score(&submission)),
            (Some(State::Finished), "16/16", expected.as_str())
        );
        let last = report(scene, "complete").await;
        assert!(
            last.is_final && last.eligible && last.outcome == Outcome::Finished && last.done == 16,
            "{last:?}"
        );
        assert_eq!(scene.cloud.text("complete", "agent/agent_results.json").await, MERGED);
        let results: Value = serde_json::from_str(&scene.cloud.text("complete", "evalai/results.json").await).unwrap();
        assert_eq!(results[0]["accuracies"]["Driving score"], means["score_composed"]);
    })
    .await;
}

#[tokio::test]
async fn a_route_whose_simulation_crashed_and_cannot_be_loaded_again_is_missing_at_the_end() {
    scenario("real-crashed", async |scene: &Scene| {
        let mut change = board(["done-1.json", "done-2.json", "done-3.json", "crashed.json"]);
        // The first server of pair 4 loads nothing, because its evaluator only replays.
        change["evaluation"]["carla"]["simulator"] =
            json!({"env": [{"name": "SIM_KNOBS", "value": "pair=4,crash-loading@1"}]});
        scene.leaderboard("lb", change).await;
        let _controller = controller(scene);
        scene.submit("crashed", "agent:standard").await;
        let mut case = Case::open(
            "a crashed route cannot be loaded again",
            "Failed SimulationCrashed (infrastructure, not charged); 15/16",
        );
        let submission = case.ends(scene, "crashed", LIMIT).await;
        case.also(progress(&submission));
        case.close();

        let last = report(scene, "crashed").await;
        assert!(!last.eligible && last.done == 15, "{last:?}");
        let merged: Value =
            serde_json::from_str(&scene.cloud.text("crashed", "agent/agent_results.json").await).unwrap();
        assert_eq!(
            (&merged["entry_status"], &merged["_checkpoint"]["global_record"]),
            (&json!("Started"), &json!({})),
            "it is partial"
        );
    })
    .await;
}
