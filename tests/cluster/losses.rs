//! Somebody deletes what the operator made: the run goes on from S3.

use std::collections::BTreeMap;
use std::time::Duration;

use k8s_openapi::api::batch::v1::Job;
use k8s_openapi::api::core::v1::Pod;
use kube::ResourceExt;
use kube::api::DeleteParams;
use leaderboard_api::{State, Submission};
use serde_json::{Value, json};

use super::expected::SIX_ROUTES;
use super::matrix::Case;
use crate::operator::controller;
use crate::scene::{Scene, done, scenario, score, state};

/// How the matrix has these cases.
const REPEATED: &str = "Finished; at most one route of a pair repeated";

/// Six routes for two pairs, one in 9 s: when the status has two, the run is far from its end on a busy machine too.
fn slow() -> Value {
    json!({
        "pairs": 2,
        "routes": 6,
        "agent": {"env": [{"name": "ROUTE_MS", "value": "9000"}]},
    })
}

/// Starts a run and waits until it is half-way.
async fn half_way(scene: &Scene, name: &str) {
    scene.leaderboard("lb", slow()).await;
    scene.submit(name, "agent:standard").await;
    let half = |s: &Submission| done(s) >= 2;
    scene
        .submission(name, "two routes are done", Duration::from_mins(3), half)
        .await;
}

/// How often each route was begun, over all Pods: the agents' logs go on where they were.
async fn begun(scene: &Scene, run: &str) -> Vec<BTreeMap<String, u32>> {
    let mut pairs = Vec::new();
    for pair in 1..=2 {
        let log = scene
            .cloud
            .text(run, &format!("agent/agent{pair}/leaderboard.log"))
            .await;
        let mut routes = BTreeMap::new();
        for line in log.lines().filter_map(|line| line.strip_prefix("========= Preparing ")) {
            let route = line.split(' ').next().unwrap_or_default();
            *routes.entry(route.to_owned()).or_insert(0) += 1;
        }
        pairs.push(routes);
    }
    pairs
}

async fn assert_finished(case: &mut Case, scene: &Scene, name: &str) {
    let submission = case.ends(scene, name, Duration::from_mins(5)).await;
    assert_eq!(
        (state(&submission), score(&submission)),
        (Some(State::Finished), SIX_ROUTES)
    );
    for routes in begun(scene, name).await {
        let again: Vec<_> = routes.iter().filter(|(_, count)| **count > 1).collect();
        assert_eq!(routes.len(), 3, "each pair has three routes: {routes:?}");
        assert!(
            again.len() <= 1 && routes.values().all(|count| *count <= 2),
            "more than one route is repeated: {routes:?}"
        );
    }
    case.also("at most one route of a pair repeated");
}

#[tokio::test]
async fn a_pod_deleted_by_hand_costs_one_route_of_each_pair() {
    scenario("pod-deleted", async |scene: &Scene| {
        let _controller = controller(scene);
        half_way(scene, "lost").await;
        let pod = scene.pod("lost").await;
        scene
            .api::<Pod>()
            .delete(&pod.name_any(), &DeleteParams::default())
            .await
            .unwrap();
        let mut case = Case::open("Pod deleted by hand", REPEATED);
        assert_finished(&mut case, scene, "lost").await;
        assert_eq!(scene.jobs().await, ["lost-1"], "the Job makes the next Pod");
        case.close();
    })
    .await;
}

#[tokio::test]
async fn a_job_deleted_by_hand_is_made_again() {
    scenario("job-deleted", async |scene: &Scene| {
        let _controller = controller(scene);
        half_way(scene, "lost").await;
        let old = scene.api::<Job>().get("lost-1").await.unwrap().uid();
        scene
            .api::<Job>()
            .delete("lost-1", &DeleteParams::background())
            .await
            .unwrap();
        let other = move |job: Option<&Job>| job.is_some_and(|job| job.uid() != old);
        scene
            .wait("lost-1", "it is made again", Duration::from_mins(4), other)
            .await;
        let mut case = Case::open("Job deleted by hand", REPEATED);
        assert_finished(&mut case, scene, "lost").await;
        let events = scene.events("lost").await;
        let events: Vec<_> = events
            .iter()
            .filter(|event| event.reason.as_deref() == Some("JobRecreated"))
            .collect();
        assert_eq!(events.len(), 1, "{events:?}");
        case.close();
    })
    .await;
}
