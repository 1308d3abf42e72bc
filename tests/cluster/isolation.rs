//! The findings of Pods about their isolation. No network plugin enforces policies here, so Pods find that.

use std::time::Duration;

use k8s_openapi::api::core::v1::Pod;
use k8s_openapi::api::networking::v1::NetworkPolicy;
use kube::api::DeleteParams;
use leaderboard_api::{FailureClass, Leaderboard, Reason, State, conditions};
use serde_json::json;

use crate::operator::controller;
use crate::scene::{Scene, containers, scenario, state};

const POLICY: &str = "leaderboard-lb";
const LIMIT: Duration = Duration::from_mins(4);
/// How long workspace tries until it is certain; the kubelet's times are whole seconds.
const A_MINUTE: Duration = Duration::from_secs(58);

/// How long a Pod's workspace ran, by the kubelet.
fn looked_for(pod: &Pod) -> Duration {
    let all = containers(pod).into_iter();
    let workspace = all.filter(|container| container.name == "workspace");
    let ended = workspace.filter_map(|container| container.state?.terminated);
    let mut took = ended.map(|ended| ended.finished_at.unwrap().0.duration_since(ended.started_at.unwrap().0));
    took.next_back().expect("workspace has not ended").try_into().unwrap()
}

/// True if the Leaderboard's condition `Isolated` has this status and reason.
fn says(status: &'static str, reason: Reason) -> impl Fn(Option<&Leaderboard>) -> bool {
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
        scene.settled("first", LIMIT).await;
        let open = says("False", Reason::NotEnforced);
        scene
            .wait("lb", "its policy is known not to be enforced", LIMIT, open)
            .await;

        // The first Pod has tried for a minute; the second looks once.
        let first = looked_for(&scene.pod("first").await);
        assert!(first >= A_MINUTE, "workspace looked for {first:?}");
        scene.submit("second", "agent:standard").await;
        scene.running("second", LIMIT).await;
        let second = looked_for(&scene.pod("second").await);
        assert!(second < A_MINUTE, "workspace looked for {second:?}");

        let policies = scene.api::<NetworkPolicy>();
        let first = policies.get(POLICY).await.unwrap();
        policies.delete(POLICY, &DeleteParams::default()).await.unwrap();
        let back = move |found: Option<&NetworkPolicy>| {
            found.is_some_and(|f| f.metadata.uid != first.metadata.uid && f.spec == first.spec)
        };
        scene.wait(POLICY, "it is restored", LIMIT, back).await;
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
        let failed = scene.settled("one", LIMIT).await;
        assert_eq!(state(&failed), Some(State::Failed));
        let status = failed.status.unwrap();
        let failure = status.failure.unwrap();
        assert_eq!(
            (failure.reason.known().unwrap(), failure.class),
            (Reason::NotIsolated, FailureClass::Infrastructure)
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
