//! What Pods find of their isolation. No network plugin enforces policies here, so they find that.

use std::time::Duration;

use k8s_openapi::api::networking::v1::NetworkPolicy;
use kube::api::DeleteParams;
use leaderboard_api::{Leaderboard, State, conditions, reasons};
use serde_json::json;

use crate::operator::controller;
use crate::scene::{Scene, scenario, state};

const POLICY: &str = "leaderboard-lb";

/// Whether the Leaderboard's condition `Isolated` says so.
fn says(status: &'static str, reason: &'static str) -> impl Fn(Option<&Leaderboard>) -> bool {
    move |found: Option<&Leaderboard>| {
        let status_of = found.and_then(|board| board.status.as_ref());
        let isolated = status_of.and_then(|s| conditions::get(&s.conditions, conditions::ISOLATED));
        isolated.is_some_and(|c| c.status == status && c.reason == reason)
    }
}

#[tokio::test]
async fn a_cluster_that_enforces_no_policy_is_found_out_and_loses_a_minute_once() {
    scenario("isolation", async |scene: &Scene| {
        scene
            .leaderboard("lb", json!({"network": {"enforcement": "Warn"}}))
            .await;
        let _controller = controller(scene);
        scene.submit("first", "agent:standard").await;
        scene.settled("first", Duration::from_mins(4)).await;
        let open = says("False", reasons::NOT_ENFORCED);
        scene
            .wait(
                "lb",
                "its policy is known not to be enforced",
                Duration::from_secs(30),
                open,
            )
            .await;

        // The second Pod looks once; with another minute it would not be there in time.
        scene.submit("second", "agent:standard").await;
        scene.running("second", Duration::from_secs(50)).await;

        let policies = scene.api::<NetworkPolicy>();
        let first = policies.get(POLICY).await.unwrap();
        policies.delete(POLICY, &DeleteParams::default()).await.unwrap();
        let back = move |found: Option<&NetworkPolicy>| {
            found.is_some_and(|f| f.metadata.uid != first.metadata.uid && f.spec == first.spec)
        };
        scene
            .wait(POLICY, "it is restored", Duration::from_secs(10), back)
            .await;
    })
    .await;
}

#[tokio::test]
async fn a_pod_that_has_to_be_isolated_and_is_not_runs_nothing() {
    scenario("isolation-required", async |scene: &Scene| {
        let change = json!({"network": {"enforcement": "Require"}, "retries": {"infrastructure": 0}});
        scene.leaderboard("lb", change).await;
        let _controller = controller(scene);
        scene.submit("one", "agent:standard").await;
        let failed = scene.settled("one", Duration::from_mins(4)).await;
        assert_eq!(state(&failed), Some(State::Failed));
        let status = failed.status.unwrap();
        let failure = status.failure.unwrap();
        assert_eq!(
            (failure.reason.as_str(), failure.charged),
            (reasons::NOT_ISOLATED, false)
        );
        assert!(
            failure.message.contains("network.enforcement is Require"),
            "{}",
            failure.message
        );
        assert!(status.times.started.is_none(), "no agent ran");
    })
    .await;
}
