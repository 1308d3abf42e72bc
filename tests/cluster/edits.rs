//! A Leaderboard is edited while one of its submissions runs, whose agent crashes once.

use std::time::Duration;

use leaderboard_api::Submission;
use serde_json::json;

use super::expected::{assert_finished, assert_results};
use super::matrix::Case;
use crate::operator::controller;
use crate::scene::{Scene, done, scenario};

#[tokio::test]
async fn a_run_ends_as_it_began_whatever_becomes_of_its_leaderboard_and_a_crash_costs_no_points() {
    scenario("edits", async |scene: &Scene| {
        let slow = json!({"agent": {"env": [{"name": "ROUTE_MS", "value": "3000"}]}});
        scene.leaderboard("lb", slow).await;
        let _controller = controller(scene);
        // A container that starts again after the edit is still of the old plan.
        scene.submit("steady", "agent:crash-once").await;
        let under_way = |s: &Submission| done(s) >= 4;
        let before = scene
            .submission("steady", "4 routes are done", Duration::from_mins(3), under_way)
            .await;
        let change = json!({
            "evaluation": {"carla": {
                "pairs": 2, "routes": 6, "simulator": {"image": scene.lab.challenge("simulator:missing")},
            }},
        });
        scene.change_leaderboard("lb", &change).await;

        let mut case = Case::open("agent crashes once", "Finished");
        let after = case.ends(scene, "steady", Duration::from_mins(4)).await;
        assert_finished(&after);
        let (before, after) = (before.status.unwrap(), after.status.unwrap());
        assert_eq!(after.plan, before.plan);
        let crashes: Vec<_> = after.workers.iter().map(|worker| worker.crashes).collect();
        assert_eq!(crashes, [0, 1, 0, 0]);
        assert_results(&scene.cloud.text("steady", "evalai/results.json").await);
        assert_eq!(scene.jobs().await, ["steady-1"]);
        case.close();
    })
    .await;
}
