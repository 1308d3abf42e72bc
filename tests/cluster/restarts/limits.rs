//! An image uses up a limit of the kernel that all containers of its user, or of the machine, share. The run of another team next to it
//! must never pay for that.

use std::future::ready;
use std::pin::pin;
use std::time::Duration;

use challenge_probe::endings::VARIABLE;
use challenge_probe::exhaust::{LIMITS, Limit, NOT_SHOWN, USED_UP};
use futures::{AsyncBufReadExt, TryStreamExt};
use k8s_openapi::api::core::v1::Pod;
use kube::ResourceExt;
use kube::api::LogParams;
use leaderboard_api::{FailureClass, State};
use serde_json::json;
use tokio::time::timeout;

use super::super::matrix::Case;
use crate::operator::controller;
use crate::scene::{Scene, say, scenario, state};

/// An image is pulled, a limit used up, and a run goes on after it was given back.
const LIMIT: Duration = Duration::from_mins(8);
/// The neighbor runs while the limit is used up: each of its four pairs drives five such routes.
const ROUTE_MS: &str = "6000";

#[tokio::test]
#[ignore = "it disturbs all other tests: make test runs it after them"]
async fn an_image_that_uses_up_watches_of_events_costs_another_team_nothing() {
    uses_up("epoll-watches").await;
}

#[tokio::test]
#[ignore = "it disturbs all other tests: make test runs it after them"]
async fn an_image_that_uses_up_open_files_costs_another_team_no_attempt() {
    uses_up("open-files").await;
}

async fn uses_up(id: &str) {
    let limit = LIMITS.iter().find(|limit| limit.id == id).unwrap();
    scenario(limit.id, async |scene: &Scene| {
        let _controller = controller(scene);
        let mut case = Case::open(limit.attack, limit.neighbor);
        scene
            .leaderboard(
                "lb",
                json!({"agent": {"env": [{"name": "ROUTE_MS", "value": ROUTE_MS}]}}),
            )
            .await;
        let hostile = json!({"evaluation": {"carla": {"pairs": 1, "routes": 2}}, "agent": {"env": [{"name": VARIABLE, "value": limit.id}]}});
        scene.leaderboard("hostile", hostile).await;
        scene.submit("neighbor", "agent:standard").await;
        scene.running("neighbor", LIMIT).await;
        scene
            .submit_to("hostile", "hostile", &format!("agent:{}", limit.image.tag()))
            .await;
        let found = report_of(scene, "hostile").await;
        say(&found);
        assert!(found.starts_with(USED_UP), "this machine cannot show it: {found}");
        // A later submission has the same troubles, and more containers that have them.
        scene.submit("late", "agent:standard").await;
        let neighbor = judge(scene, limit, "neighbor").await;
        assert_eq!(judge(scene, limit, "late").await, neighbor);
        case.also(&neighbor);
        case.close();
    })
    .await;
}

/// The hostile agent's line about the limit, read from its node: the stored log may wait until the limit is given back.
async fn report_of(scene: &Scene, submission: &str) -> String {
    scene.running(submission, LIMIT).await;
    let pod = scene.pod(submission).await;
    let parameters = LogParams {
        container: Some("agent-1".to_owned()),
        follow: true,
        ..LogParams::default()
    };
    let pods = scene.api::<Pod>();
    let log = pods.log_stream(&pod.name_any(), &parameters).await.unwrap();
    let says = |line: &String| line.starts_with(USED_UP) || line.starts_with(NOT_SHOWN);
    let lines = log.lines().try_filter(|line| ready(says(line)));
    let found = timeout(LIMIT, pin!(lines).try_next()).await;
    found.unwrap().unwrap().unwrap()
}

/// A neighbor's end, as the table of limits has it.
async fn judge(scene: &Scene, limit: &Limit, name: &str) -> String {
    let ended = scene.settled(name, LIMIT).await;
    let failure = ended.status.as_ref().and_then(|status| status.failure.clone());
    let charged = failure
        .as_ref()
        .is_some_and(|failure| failure.class == FailureClass::Participant);
    assert!(!charged, "{name}: {failure:?}");
    if limit.neighbor == "not charged" {
        return limit.neighbor.to_owned();
    }
    assert_eq!(state(&ended), Some(State::Finished), "{name}: {failure:?}");
    let jobs = scene.jobs().await;
    let its = jobs.iter().filter(|job| job.starts_with(&format!("{name}-1"))).count();
    format!("finished; {its} Job")
}
