//! Somebody deletes what the operator made: the run goes on from S3.

use std::collections::BTreeMap;
use std::time::Duration;

use k8s_openapi::api::batch::v1::Job;
use k8s_openapi::api::core::v1::Pod;
use kube::ResourceExt;
use kube::api::{DeleteParams, EvictParams, Patch, PatchParams};
use leaderboard_api::{Attempt, State, Submission};
use serde_json::{Value, json};

use super::expected::SIX_ROUTES;
use super::matrix::Case;
use crate::operator::controller;
use crate::scene::{Scene, done, lay_over, scenario, score, state};

/// How the matrix has these cases.
pub(super) const REPEATED: &str = "Finished; at most one route of a pair repeated";
const SUSPENDED: &str = "Running Suspended; Finished; at most one route of a pair repeated";

/// Six routes for two pairs, one in 9 s: at two routes, the run is far from its end, also on a busy machine.
fn slow() -> Value {
    json!({
        "evaluation": {"carla": {"pairs": 2, "routes": 6}},
        "agent": {"env": [{"name": "ROUTE_MS", "value": "9000"}]},
    })
}

/// Starts a run and waits until it is half-way. No failure of the infrastructure is retried if `retries` is 0.
pub(super) async fn half_way(scene: &Scene, name: &str, retries: i32) {
    half_way_of(scene, name, json!({"retries": {"infrastructure": retries}})).await;
}

/// Like [`half_way`], with these fields of the Leaderboard's spec.
pub(super) async fn half_way_of(scene: &Scene, name: &str, change: Value) {
    let mut spec = slow();
    lay_over(&mut spec, change);
    scene.leaderboard("lb", spec).await;
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

pub(super) async fn assert_finished(case: &mut Case, scene: &Scene, name: &str) {
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
        half_way(scene, "lost", 2).await;
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

/// As Kueue does it when it admits a Job, takes its quota back, and admits it again.
#[tokio::test]
async fn a_job_suspended_in_mid_run_goes_on_and_costs_no_retry() {
    scenario("job-suspended", async |scene: &Scene| {
        let _controller = controller(scene);
        half_way(scene, "held", 0).await;
        let mut case = Case::open("Job suspended in mid-run", SUSPENDED);
        case.cause();
        suspend(scene, "held-1", true).await;
        case.shows(scene, "held", "Suspended", "no deadline runs").await;
        // The kubelet ends the Pod in its grace, and logcopy stores what was reached.
        let is_empty = |job: Option<&Job>| {
            let status = job.and_then(|job| job.status.as_ref());
            status.is_some_and(|status| status.active.unwrap_or_default() + status.terminating.unwrap_or_default() == 0)
        };
        scene
            .wait("held-1", "its Pod is gone", Duration::from_mins(3), is_empty)
            .await;
        suspend(scene, "held-1", false).await;
        assert_finished(&mut case, scene, "held").await;
        let status = scene.api::<Submission>().get("held").await.unwrap().status.unwrap();
        assert_eq!((status.retry, status.recreated, status.interruptions), (0, 0, None));
        assert!(
            status.workers.iter().all(|pair| pair.crashes == 0),
            "{:?}",
            status.workers
        );
        assert_eq!(scene.jobs().await, ["held-1"], "the same Job makes the next Pod");
        case.close();
    })
    .await;
}

async fn suspend(scene: &Scene, job: &str, suspended: bool) {
    let patch = Patch::Merge(json!({"spec": {"suspend": suspended}}));
    let jobs = scene.api::<Job>();
    jobs.patch(job, &PatchParams::default(), &patch).await.unwrap();
}

/// Fails unless the run shows one interruption: its one Pod was taken away, and failures of the infrastructure are not retried.
pub(super) async fn assert_interrupted_once(scene: &Scene, name: &str) {
    let status = scene.api::<Submission>().get(name).await.unwrap().status.unwrap();
    assert_eq!(
        (status.attempt, status.retry, status.failure),
        (Some(Attempt(1)), 1, None)
    );
    assert_eq!(status.interruptions.unwrap().number, 1);
    assert!(
        status.workers.iter().all(|pair| pair.crashes == 0),
        "{:?}",
        status.workers
    );
    assert_eq!(scene.jobs().await, [format!("{name}-1"), format!("{name}-1-r1")]);
}

#[tokio::test]
async fn an_evicted_pod_costs_one_route_of_each_pair_and_no_retry() {
    scenario("pod-evicted", async |scene: &Scene| {
        let _controller = controller(scene);
        half_way(scene, "lost", 0).await;
        let pod = scene.pod("lost").await;
        // As a drain does it, and what takes Spot instances away.
        let evicted = scene.api::<Pod>().evict(&pod.name_any(), &EvictParams::default()).await;
        evicted.unwrap();
        let mut case = Case::open("Pod evicted", REPEATED);
        assert_finished(&mut case, scene, "lost").await;
        assert_interrupted_once(scene, "lost").await;
        case.close();
    })
    .await;
}

#[tokio::test]
async fn a_job_deleted_by_hand_is_made_again() {
    scenario("job-deleted", async |scene: &Scene| {
        let _controller = controller(scene);
        half_way(scene, "lost", 2).await;
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
