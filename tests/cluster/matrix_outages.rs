//! The matrix: the operator can't reach its API server, and the run goes on without it. Or its environment names another AWS than its
//! Leaderboards do.

use std::time::Duration;

use kube::Config;
use leaderboard_api::Submission;
use serde_json::json;

use super::matrix::Case;
use crate::evalai::Evalai;
use crate::gate::Gate;
use crate::operator::{both_with, controller_through};
use crate::scene::{Scene, done, scenario};

const LIMIT: Duration = Duration::from_mins(4);
/// A Lease that can't be renewed runs out after 15 s, and the operator ends.
const ENDED: Duration = Duration::from_mins(2);

#[tokio::test]
async fn an_api_server_out_of_reach_costs_nothing() {
    scenario("matrix-outages", async |scene: &Scene| {
        let mut case = Case::open("API server out of reach", "Finished; 1 Job");
        let server = Config::infer().await.unwrap().cluster_url.to_string();
        let api_server = Gate::open(&scene.lab.host, server.trim_end_matches('/')).await;
        let slow = json!({"evaluation": {"carla": {"pairs": 1, "routes": 4}}, "agent": {"env": [{"name": "ROUTE_MS", "value": "5000"}]}});
        scene.leaderboard("lb", slow).await;
        let mut cut_off = controller_through(scene, &api_server);
        scene.submit("alone", "agent:standard").await;
        let under_way = |s: &Submission| done(s) >= 1;
        scene.submission("alone", "a route is done", LIMIT, under_way).await;
        api_server.shut();
        let status = cut_off.ended(ENDED).await;
        assert!(
            !status.success(),
            "who can't renew the Lease ends with an error: {status}"
        );
        // As the kubelet would; this one waits for the API server.
        let _again = controller_through(scene, &api_server);
        api_server.reopen();

        case.ends(scene, "alone", LIMIT).await;
        case.also(&format!("{} Job", scene.jobs().await.len()));
        case.close();
    })
    .await;
}

/// Bucket, table and queue of a Leaderboard that names their endpoints are there, whatever the operator's environment has.
#[tokio::test]
async fn the_endpoints_of_a_leaderboard_win_over_the_environment() {
    scenario("matrix-endpoints", async |scene: &Scene| {
        let mut case = Case::open(
            "AWS_ENDPOINT_URL names another AWS than the Leaderboard",
            "Finished; row FINISHED; 0 messages left",
        );
        let evalai = Evalai::start(scene).await;
        let elsewhere = Gate::open("127.0.0.1", &scene.cloud.endpoint).await;
        elsewhere.shut();
        scene
            .evalai_leaderboard(
                "lb",
                &evalai,
                json!({"evaluation": {"carla": {"pairs": 1, "routes": 2}}}),
            )
            .await;
        let _operator = both_with(scene, "AWS_ENDPOINT_URL", &elsewhere.url);
        let pk = evalai.submit(&scene.lab.challenge("agent:standard"), 1).await;
        let name = format!("submission-{pk}");
        let exists = |found: Option<&Submission>| found.is_some();
        scene.wait(&name, "its message was read", LIMIT, exists).await;
        case.ends(scene, &name, LIMIT).await;
        let row = scene.cloud.row(&scene.cloud.table).await;
        case.also(&format!("row {}", row["submission_status"]));
        let [waiting, received] = scene.cloud.messages().await;
        case.also(&format!("{} messages left", waiting + received));
        case.close();
    })
    .await;
}
