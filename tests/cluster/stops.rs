//! A run is stopped: by its host, by its participant in EvalAI, by deleting it.

use std::time::{Duration, Instant};

use k8s_openapi::api::core::v1::Pod;
use kube::ResourceExt;
use kube::api::DeleteParams;
use leaderboard_api::Submission;
use serde_json::{Value, json};

use super::matrix::{Case, measured};
use crate::evalai::Evalai;
use crate::operator::{Kept, bridge, controller};
use crate::processes;
use crate::scene::{Scene, done, scenario};

const CANCEL_SECONDS: u64 = 20;

/// Long after what a busy machine needs for a look at something.
const LIMIT: Duration = Duration::from_mins(3);

/// Six routes for two pairs. Both stop in their second ones, so that the run waits for what ends it.
fn endless() -> Value {
    json!({
        "evaluation": {"carla": {"pairs": 2, "routes": 6}},
        "agent": {"env": [{"name": "AGENT_KNOBS", "value": "hang@2"}]},
        "deadlines": {"cancelSeconds": CANCEL_SECONDS, "idleSeconds": 600},
    })
}

/// Waits until each pair has done a route.
async fn under_way(scene: &Scene, name: &str) {
    let some = |s: &Submission| done(s) >= 2;
    scene.submission(name, "two routes are done", LIMIT, some).await;
}

/// Waits until a Submission's Pod has ended: it is sent a SIGTERM, then deleted, then removed by force.
async fn pod_ended(scene: &Scene, pod: &str) {
    let ended = |pod: Option<&Pod>| {
        let phase = pod
            .and_then(|pod| pod.status.as_ref())
            .and_then(|status| status.phase.as_deref());
        pod.is_none() || matches!(phase, Some("Succeeded" | "Failed"))
    };
    scene
        .wait(
            pod,
            "its Pod has ended",
            Duration::from_secs(CANCEL_SECONDS + 105),
            ended,
        )
        .await;
}

/// Fails unless S3 has the results that the run had reached.
async fn assert_partial(scene: &Scene, run: &str) {
    let merged: Value = serde_json::from_str(&scene.cloud.text(run, "agent/agent_results.json").await).unwrap();
    let records = merged["_checkpoint"]["records"].as_array().map_or(0, Vec::len);
    assert_eq!(records, 2, "each pair's first route is kept");
    let keys = scene.cloud.keys(run).await;
    assert!(keys.contains_key("containers-status/simulation.cancel"), "{keys:?}");
}

#[tokio::test]
async fn a_cancelled_submission_stops_in_time_and_keeps_its_results() {
    scenario("cancel", async |scene: &Scene| {
        scene.leaderboard("lb", endless()).await;
        let _controller = controller(scene);
        scene.submit("stopped", "agent:standard").await;
        under_way(scene, "stopped").await;
        let pod = scene.pod("stopped").await;
        let agent = processes::named(&pod, "agent-1", "python3", LIMIT).await;
        let mut case = Case::open("cancel while it runs", "Cancelled");
        case.cause();
        let since = Instant::now();
        scene.change_submission("stopped", &json!({"cancel": true})).await;
        let ended = processes::ended(&[agent], LIMIT).await;
        measured(
            "cancel by kubectl → SIGTERM in the container",
            ended - since,
            "aim p99 < 2 s",
        );
        pod_ended(scene, &pod.name_any()).await;
        case.ends(scene, "stopped", LIMIT).await;
        assert_partial(scene, "stopped").await;
        case.close();
    })
    .await;
}

/// A submission of EvalAI, with what serves it.
async fn submitted(scene: &Scene) -> (Evalai, [Kept; 2], u64) {
    let evalai = Evalai::start(scene).await;
    scene.evalai_leaderboard("lb", &evalai, endless()).await;
    let operator = [controller(scene), bridge(scene)];
    let pk = evalai.submit(&scene.lab.challenge("agent:standard"), 1).await;
    (evalai, operator, pk)
}

#[tokio::test]
async fn a_cancel_in_evalai_stops_the_run() {
    scenario("evalai-cancel", async |scene: &Scene| {
        let (evalai, _operator, pk) = submitted(scene).await;
        let name = format!("submission-{pk}");
        under_way(scene, &name).await;
        let pod = scene.pod(&name).await;
        let agent = processes::named(&pod, "agent-1", "python3", LIMIT).await;
        let mut case = Case::open(
            "cancel in EvalAI while it runs",
            "Cancelled EndedInEvalAI; EvalAI cancelled",
        );
        case.cause();
        let since = Instant::now();
        evalai.cancel(pk).await;
        let ended = processes::ended(&[agent], LIMIT).await;
        measured(
            "cancel in EvalAI → SIGTERM in the container",
            ended - since,
            "aim < 15 s",
        );
        pod_ended(scene, &pod.name_any()).await;
        case.ends(scene, &name, LIMIT).await;
        // Nothing revives it.
        case.evalai(evalai.submission(pk).status);
        let row = scene.cloud.row(&scene.cloud.table).await;
        assert_eq!(row["submission_status"], "CANCELLED");
        assert_partial(scene, &pk.to_string()).await;
        case.close();
    })
    .await;
}

#[tokio::test]
async fn a_submission_deleted_while_it_runs_goes_when_its_end_is_published() {
    scenario("delete", async |scene: &Scene| {
        let (evalai, _operator, pk) = submitted(scene).await;
        let name = format!("submission-{pk}");
        under_way(scene, &name).await;
        let pod = scene.pod(&name).await.name_any();
        let deleted = scene
            .api::<Submission>()
            .delete(&name, &DeleteParams::default())
            .await
            .unwrap();
        let mut case = Case::open("deleted while it runs", "gone; EvalAI cancelled; row CANCELLED");
        let uid = deleted.left().expect("a finalizer holds it").uid().unwrap();
        pod_ended(scene, &pod).await;
        let gone = move |found: Option<&Submission>| found.is_none_or(|found| found.uid().as_ref() != Some(&uid));
        scene.wait(&name, "it is gone", LIMIT, gone).await;
        case.also("gone");
        case.evalai(evalai.submission(pk).status);
        let row = scene.cloud.row(&scene.cloud.table).await;
        case.also(&format!("row {}", row["submission_status"]));
        assert_partial(scene, &pk.to_string()).await;
        case.close();
    })
    .await;
}
