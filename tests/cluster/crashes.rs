//! Containers and Pods die without a word at random moments of a run: the score is that of a run without.
//!
//! A few kills of real containers; `tests/resume.rs` has hundreds of the same programs as plain processes.

use std::time::Duration;

use fastrand::Rng;
use k8s_openapi::api::core::v1::Pod;
use kube::ResourceExt;
use kube::api::DeleteParams;
use leaderboard_api::Submission;
use serde_json::json;

use super::expected::{assert_finished, assert_results};
use crate::operator::controller;
use crate::processes::kill_if_running;
use crate::scene::{Scene, containers, done, say, scenario};

/// Kills happen when the status has so many routes. It is behind the run on a busy machine: after the last one each pair that is
/// furthest has two routes left.
const MOMENTS: [i32; 5] = [1, 3, 5, 7, 10];
const ROUTE_MS: &str = "10000";
const ROUTES: usize = 20;
const PAIRS: usize = 4;
/// Restarted containers and Pods wait for the kubelet, which doubles its pauses.
const LIMIT: Duration = Duration::from_mins(5);

#[tokio::test]
async fn kills_at_random_moments_change_no_score_and_cost_a_route_of_a_pair_each() {
    let seed = std::env::var("LEADERBOARD_TEST_SEED")
        .ok()
        .and_then(|seed| seed.parse().ok());
    let seed = seed.unwrap_or_else(|| fastrand::u64(..1 << 32));
    say(&format!("crashes: LEADERBOARD_TEST_SEED={seed} repeats them"));
    scenario("crashes", async |scene: &Scene| {
        let change = json!({
            "agent": {"env": [{"name": "ROUTE_MS", "value": ROUTE_MS}]},
            "retries": {"perWorker": 19},
        });
        scene.leaderboard("lb", change).await;
        let _controller = controller(scene);
        scene.submit("killed", "agent:standard").await;
        let mut random = Rng::with_seed(seed);
        for moment in MOMENTS {
            let reached = move |s: &Submission| done(s) >= moment;
            scene
                .submission("killed", "so many routes are done", LIMIT, reached)
                .await;
            kill_something(scene, &mut random).await;
        }
        let submission = scene.settled("killed", LIMIT).await;
        assert_finished(&submission);
        assert_results(&scene.cloud.text("killed", "evalai/results.json").await);
        assert_eq!(scene.jobs().await, ["killed-1"]);
        let begun = begun(scene).await;
        say(&format!(
            "crashes: {} kills, {} routes were run again",
            MOMENTS.len(),
            begun - ROUTES
        ));
        assert!(begun <= ROUTES + PAIRS * MOMENTS.len(), "{begun} routes were begun");
    })
    .await;
}

/// Kills one container that runs, or deletes the Pod.
async fn kill_something(scene: &Scene, random: &mut Rng) {
    let name = scene.first_pod("killed", LIMIT).await.name_any();
    let alive = |pod: Option<&Pod>| pod.is_some_and(|pod| !running(pod).is_empty());
    let pod = scene.wait(&name, "a container runs", LIMIT, alive).await.unwrap();
    if random.u8(0..5) == 0 {
        say("crashes: the Pod");
        let params = DeleteParams::default();
        scene.api::<Pod>().delete(&name, &params).await.unwrap();
        scene
            .wait(&name, "it is gone", LIMIT, |pod: Option<&Pod>| pod.is_none())
            .await;
        return;
    }
    let mut victims = running(&pod);
    random.shuffle(&mut victims);
    let victim = victims.iter().find(|name| kill_if_running(&pod, name));
    say(&format!(
        "crashes: {}",
        victim.expect("the run had ended before the last kill")
    ));
}

fn running(pod: &Pod) -> Vec<String> {
    let all = containers(pod).into_iter();
    let running = all.filter(|container| container.state.as_ref().is_some_and(|state| state.running.is_some()));
    running.map(|container| container.name).collect()
}

/// How often a route was begun, over all Pods: the agents' logs go on where they were.
async fn begun(scene: &Scene) -> usize {
    let mut count = 0;
    for pair in 1..=PAIRS {
        let log = scene
            .cloud
            .text("killed", &format!("agent/agent{pair}/leaderboard.log"))
            .await;
        count += log
            .lines()
            .filter(|line| line.starts_with("========= Preparing "))
            .count();
    }
    count
}
