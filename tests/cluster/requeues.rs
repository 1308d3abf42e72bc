//! A host puts a run back in line: it stores what it has reached, and another Job goes on from there, at nobody's cost.

use std::time::Duration;

use leaderboard_api::{Attempt, Submission};
use serde_json::json;

use super::checks::plugin;
use super::losses::{REPEATED, assert_finished, half_way_of};
use super::matrix::Case;
use crate::operator::controller;
use crate::scene::{Scene, scenario};

const WHY: &str = "A host has requeued the submission: The nodes are upgraded.";

#[tokio::test]
async fn a_requeued_run_goes_on_in_another_job_at_nobodys_cost() {
    scenario("requeue", async |scene: &Scene| {
        let _controller = controller(scene);
        // No failure is retried.
        let spec = json!({"agent": {"env": [{"name": "ROUTE_MS", "value": "4000"}]}, "retries": {"infrastructure": 0}});
        half_way_of(scene, "moved", spec).await;
        let mut case = Case::open("a host requeues a run", REPEATED);
        let words = ["requeue", "moved", "--why", "The nodes are upgraded."];
        let (code, text) = plugin(scene, &words).await;
        assert_eq!(code, Some(0), "{text}");
        let printed = "Requeued moved: its run stops and continues in attempt 1, when its turn comes.";
        assert!(text.contains(printed), "{text}");
        let says = |s: &Submission| {
            let message = s.status.as_ref().and_then(|status| status.message.as_deref());
            message.is_some_and(|message| message.starts_with(WHY))
        };
        scene
            .submission("moved", "it says why it stops", Duration::from_mins(1), says)
            .await;
        assert_finished(&mut case, scene, "moved").await;
        assert_free_of_charge(scene, "moved").await;
        case.close();
    })
    .await;
}

/// The request was carried out once, and nothing else is left of it.
async fn assert_free_of_charge(scene: &Scene, name: &str) {
    let status = scene.api::<Submission>().get(name).await.unwrap().status.unwrap();
    assert_eq!((status.attempt, status.retry), (Some(Attempt(1)), 1));
    let requeued = status.requeued.unwrap();
    assert_eq!((requeued.number, requeued.retries), (1, 1));
    assert_eq!((status.failure, status.routes_before), (None, None));
    assert_eq!(status.interruptions, None);
    assert!(status.pairs.iter().all(|pair| pair.crashes == 0), "{:?}", status.pairs);
    assert_eq!(scene.jobs().await, [format!("{name}-1"), format!("{name}-1-r1")]);
    let events = scene.events(name).await;
    let told = events
        .iter()
        .filter(|event| event.note.as_deref().is_some_and(|note| note.contains(WHY)));
    assert_eq!(told.count(), 1, "{events:?}");
}
