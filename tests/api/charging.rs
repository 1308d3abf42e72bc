//! Repeated failures that an agent can cause, as the whole controller meets them: another team's run has finished with the same
//! simulator, and a host wants the next one charged.
#![cfg(test)]

use k8s_openapi::api::batch::v1::Job;
use k8s_openapi::api::core::v1::Pod;
use kube::ResourceExt;
use kube::api::{DeleteParams, Patch, PatchParams, PostParams};
use kube::runtime::wait::await_condition;
use leaderboard_api::{FailureClass, Leaderboard, State, Submission, SubmissionStatus, names, reasons};
use leaderboard_runner::verdict::{Verdict, What};
use serde_json::{Value, json};
use tokio::time::timeout;

use super::bridge::LIMIT;
use super::world::{World, ago, running};

/// A submission of a team, with this status if it was run before.
async fn submission(world: &World, name: &str, team: &str, status: Option<Value>) {
    let spec = json!({"leaderboardName": "lb", "track": "sensors", "image": "r/a:1", "team": {"id": team}});
    let object = Submission::new(name, serde_json::from_value(spec).unwrap());
    let api = world.api::<Submission>();
    api.create(&PostParams::default(), &object).await.unwrap();
    if let Some(status) = status {
        let patch = Patch::Merge(json!({ "status": status }));
        api.patch_status(name, &PatchParams::default(), &patch).await.unwrap();
    }
}

/// The status of one that has ended so, on this node.
fn ended(reason: &str, node: &str) -> Value {
    let plan = json!({
        "runId": "old", "leaderboardVersion": "V2", "track": "sensors", "codename": "SENSORS", "slices": [{"first": 0, "last": 0}],
        "routes": 1, "repetitions": 1, "storage": {"bucket": "old-results"}, "image": "r/a:1", "contentsImage": "contents:1",
        "simulatorImage": "simulator:1",
    });
    let finished =
        json!({"type": "Finished", "status": "True", "reason": reason, "message": "", "lastTransitionTime": ago(60)});
    json!({"attempt": 1, "plan": plan, "nodeName": node, "times": {"finished": ago(60)}, "conditions": [finished]})
}

/// The simulator has crashed, and its agent followed it.
fn simulator_crashed() -> Value {
    let now = ago(0);
    let mut status = running();
    for (container, what) in [(0, What::Exited), (1, What::PeerCrashed)] {
        let container = &mut status["containerStatuses"][container];
        container["ready"] = json!(false);
        container["state"] = json!({"terminated": {
            "exitCode": 1, "reason": "Error", "message": Verdict::new(what, 0, "").to_json(), "startedAt": now, "finishedAt": now,
        }});
    }
    status
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_team_whose_runs_repeatedly_lose_the_simulator_is_shown_and_charged_if_the_host_wants_it() {
    let world = World::new().await;
    let retries = json!({"retries": {"perPair": 0, "infrastructure": 1, "onRepeatedInfrastructure": "Charge"}});
    world.leaderboard_with("lb", 1, "Hosts", &retries).await;
    submission(&world, "other", "b", Some(ended("Finished", "node-b"))).await;
    let mut lost = ended("SimulationCrashed", "node-a");
    lost["failure"] =
        json!({"class": "Infrastructure", "reason": "SimulationCrashed", "message": "m", "charged": false});
    lost["infrastructureFailures"] =
        json!({"number": 1, "firstTime": ago(120), "lastTime": ago(120), "nodes": ["node-a"]});
    submission(&world, "lost", "a", Some(lost)).await;
    let _controller = world.controller();
    submission(&world, "next", "a", None).await;

    let job = world.job("next", 0).await;
    let pod = world.pod(&job, &simulator_crashed()).await;
    let is_told = |pod: Option<&Pod>| pod.is_some_and(|p| p.annotations().contains_key(names::ANNOTATION_STOP));
    let told = timeout(LIMIT, await_condition(world.api(), &pod, is_told)).await;
    told.expect("the Pod is asked to stop").unwrap();
    let jobs = world.api::<Job>();
    jobs.delete(&job.name_any(), &DeleteParams::background()).await.unwrap();

    let has_failed = |s: &SubmissionStatus| s.state == Some(State::Failed);
    world.until("next", "it fails", has_failed).await;
    let status = world.api::<Submission>().get("next").await.unwrap().status.unwrap();
    let failure = status.failure.unwrap();
    assert_eq!(
        (failure.reason.as_str(), failure.class, failure.charged, status.retry),
        (reasons::REPEATED_FAILURES, FailureClass::Participant, true, 0),
        "{}",
        failure.message
    );
    let is_shown = |board: Option<&Leaderboard>| {
        let teams = board
            .and_then(|b| b.status.as_ref())
            .map(|s| &s.infrastructure_failures);
        teams.is_some_and(|teams| teams.len() == 1 && teams[0].team == "a" && teams[0].number == 2)
    };
    let shown = timeout(LIMIT, await_condition(world.api::<Leaderboard>(), "lb", is_shown)).await;
    shown.expect("the Leaderboard shows the team").unwrap();
}
