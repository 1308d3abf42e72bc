//! The node of a run is about to be taken away. All results so far are stored in time, and the run goes on from there.
//!
//! The cluster has one node, so it is not taken away after all, and the next Pod comes to it again.

use std::panic::{AssertUnwindSafe, resume_unwind};
use std::time::Duration;

use futures::FutureExt;
use k8s_openapi::api::batch::v1::Job;
use k8s_openapi::api::core::v1::{Node, Pod};
use kube::api::{Patch, PatchParams};
use kube::{Api, ResourceExt};
use serde_json::{Value, json};
use tokio::time::Instant;

use super::super::losses::{assert_finished, assert_interrupted_once, half_way};
use super::super::matrix::Case;
use crate::operator::controller;
use crate::scene::{Scene, say, scenario};

/// As Karpenter announces that it takes a node away.
const TAINT: &str = "karpenter.sh/disrupted";
/// A Spot instance has two minutes from its notice; the taint is there some time later.
const STORED_WITHIN: Duration = Duration::from_secs(90);
/// The watch of nodes, a reconcile, the annotation: all of it takes well under a second on a quiet machine.
const ASKED_WITHIN: Duration = Duration::from_secs(15);

#[tokio::test]
#[ignore = "it disturbs all other tests: make test runs it after them"]
async fn a_node_that_is_about_to_be_taken_away_costs_one_route_of_each_pair_and_no_retry() {
    scenario("interrupted", async |scene: &Scene| {
        let _controller = controller(scene);
        half_way(scene, "lost", 0).await;
        let pod = scene.pod("lost").await;
        let node = pod.spec.as_ref().and_then(|spec| spec.node_name.clone()).unwrap();
        let mut case = Case::open(
            "node about to be taken away",
            "all stored within 90 s; Finished; at most one route of a pair repeated",
        );
        let nodes: Api<Node> = Api::all(scene.client.clone());
        taint(&nodes, &node, true).await;
        // Whatever comes of it, the other tests need the node.
        let stored = AssertUnwindSafe(all_is_stored(scene, &pod.name_any()))
            .catch_unwind()
            .await;
        taint(&nodes, &node, false).await;
        stored.unwrap_or_else(|panic| resume_unwind(panic));
        case.also("all stored within 90 s");
        assert_finished(&mut case, scene, "lost").await;
        assert_interrupted_once(scene, "lost").await;
        case.close();
    })
    .await;
}

/// Waits until the Pod has stored all and its Job has ended with it.
async fn all_is_stored(scene: &Scene, pod: &str) {
    let begun = Instant::now();
    let is_asked = |pod: Option<&Pod>| {
        let stop = pod.and_then(|pod| pod.annotations().get("leaderboard.carla.org/stop"));
        stop.is_some_and(|stop| stop == "Interruption")
    };
    scene
        .wait(pod, "it is asked to store all", ASKED_WITHIN, is_asked)
        .await;
    say(&format!(
        "interrupted: asked after {:.1} s",
        begun.elapsed().as_secs_f64()
    ));
    let has_ended = |job: Option<&Job>| {
        let status = job.and_then(|job| job.status.as_ref());
        status.is_some_and(|status| status.succeeded == Some(1))
    };
    let left = STORED_WITHIN.saturating_sub(begun.elapsed());
    scene
        .wait("lost-1", "its Job has ended in order", left, has_ended)
        .await;
    say(&format!(
        "interrupted: all stored after {:.1} s",
        begun.elapsed().as_secs_f64()
    ));
    let report: Value = serde_json::from_str(&scene.cloud.text("lost", "logcopy/report.json").await).unwrap();
    assert_eq!(
        (&report["final"], &report["stopped"]),
        (&json!(true), &json!("Interruption"))
    );
    let keys = scene.cloud.keys("lost").await;
    for pair in [1, 2] {
        for key in [
            format!("agent/agent{pair}/leaderboard.log"),
            format!("agent/agent{pair}/agent_results.json"),
        ] {
            assert!(keys.contains_key(&key), "{key} is not in {keys:?}");
        }
    }
}

/// Puts the taint on the node, or takes all taints off.
async fn taint(nodes: &Api<Node>, node: &str, is_wanted: bool) {
    let taints = if is_wanted {
        json!([{"key": TAINT, "effect": "NoSchedule"}])
    } else {
        Value::Null
    };
    let patch = Patch::Merge(json!({"spec": {"taints": taints}}));
    nodes.patch(node, &PatchParams::default(), &patch).await.unwrap();
}
