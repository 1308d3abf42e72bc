//! S3 is away when it is needed most.

use std::time::Duration;

use k8s_openapi::api::core::v1::Pod;
use kube::ResourceExt;
use leaderboard_api::{Submission, conditions};
use serde_json::json;
use tokio::time::sleep;

use super::expected::{assert_finished, assert_results};
use super::matrix::Case;
use crate::gate::Gate;
use crate::operator::controller;
use crate::processes::kill_container;
use crate::scene::{Scene, containers, done, is_true, scenario};

const S3_AWAY: Duration = Duration::from_mins(2);

#[tokio::test]
async fn a_killed_logcopy_and_two_minutes_without_s3_lose_no_score() {
    scenario("no-s3", async |scene: &Scene| {
        let s3 = Gate::open(&scene.lab.host, &scene.cloud.endpoint).await;
        let change = json!({
            "storage": {"s3": {"endpoint": s3.url}},
            "agent": {"env": [{"name": "ROUTE_MS", "value": "3000"}]},
        });
        scene.leaderboard("lb", change).await;
        let _controller = controller(scene);
        scene.submit("unstored", "agent:standard").await;
        // The status is behind the run on a busy machine: at least three routes of each pair are left.
        let some = |s: &Submission| done(s) >= 4;
        scene
            .submission("unstored", "4 routes are done", Duration::from_mins(3), some)
            .await;
        s3.shut();
        let away = sleep(S3_AWAY);
        let pod = scene.pod("unstored").await.name_any();
        let pod = scene
            .wait(&pod, "all agents have ended", Duration::from_mins(3), have_agents_ended)
            .await
            .unwrap();
        kill_container(&pod, "logcopy");
        let again = |pod: Option<&Pod>| pod.is_some_and(|pod| restarts(pod, "logcopy") > 0);
        scene
            .wait(&pod.name_any(), "logcopy runs again", Duration::from_mins(3), again)
            .await;
        away.await;
        let waiting = scene.api::<Submission>().get("unstored").await.unwrap();
        assert!(
            !is_true(&waiting, conditions::FINISHED),
            "nobody can know the score yet"
        );
        s3.reopen();

        let mut case = Case::open("logcopy killed, and S3 away and back", "Finished");
        let submission = case.ends(scene, "unstored", Duration::from_mins(5)).await;
        assert_finished(&submission);
        assert_results(&scene.cloud.text("unstored", "evalai/results.json").await);
        case.close();
    })
    .await;
}

fn have_agents_ended(pod: Option<&Pod>) -> bool {
    let Some(pod) = pod else { return false };
    let all = containers(pod);
    let agents: Vec<_> = all
        .iter()
        .filter(|container| container.name.starts_with("agent-"))
        .collect();
    let ended = |container: &&k8s_openapi::api::core::v1::ContainerStatus| {
        container.state.as_ref().is_some_and(|state| state.terminated.is_some())
    };
    agents.len() == 4 && agents.iter().all(ended)
}

fn restarts(pod: &Pod, name: &str) -> i32 {
    let all = containers(pod);
    all.iter()
        .find(|container| container.name == name)
        .map_or(0, |container| container.restart_count)
}
