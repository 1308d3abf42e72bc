//! Jobs that are suspended, as Kueue does it: at their creation until a queue admits them, and in mid-run.
//!
//! The real controller against a real API server; the test plays Kueue, the Job controller and the kubelet.
#![cfg(test)]

use evalai_stand_in::model::Status;
use k8s_openapi::api::batch::v1::Job;
use k8s_openapi::api::core::v1::Pod;
use kube::ResourceExt;
use kube::api::{DeleteParams, Patch, PatchParams};
use leaderboard_api::{Reason, State, Submission, SubmissionStatus, names};
use serde_json::json;

use super::world::World;
use crate::support::played;

/// Patches as Kueue, and then as the Job controller.
async fn suspend(world: &World, job: &Job, suspended: bool) {
    let patch = Patch::Merge(json!({"spec": {"suspend": suspended}}));
    let params = PatchParams {
        field_manager: Some("kueue".into()),
        ..PatchParams::default()
    };
    let jobs = world.api::<Job>();
    jobs.patch(&job.name_any(), &params, &patch).await.unwrap();
    let status = if suspended {
        played::job_suspended()
    } else {
        played::job_resumed()
    };
    world.cluster().set_job(job, &status).await;
}

fn shows(state: State, reason: Reason) -> impl Fn(&SubmissionStatus) -> bool {
    move |status| status.state == Some(state) && status.shows(reason)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_suspended_job_is_waited_for_before_its_start_and_in_mid_run() {
    let world = World::new().await;
    let more = json!({
        "jobLabels": {names::LABEL_KUEUE_QUEUE: "gpus"}, "deadlines": {"scheduleSeconds": 1},
        "retries": {"infrastructure": 0},
    });
    world.leaderboard_with("lb", 1, "Hosts", &more).await;
    let _controller = world.controller();
    let (pk, name) = world.submit("lb", 1).await;
    let job = world.job(&name, 0).await;
    assert_eq!(job.labels()[names::LABEL_KUEUE_QUEUE], "gpus");
    suspend(&world, &job, true).await;
    let says_whose = |status: &SubmissionStatus| {
        let message = status.message.as_deref().unwrap_or_default();
        shows(State::Pending, Reason::Suspended)(status) && message.contains("LocalQueue gpus")
    };
    world.until(&name, "it waits for its queue", says_whose).await;

    suspend(&world, &job, false).await;
    let cluster = world.cluster();
    let first = cluster.running_pod(&job).await;
    world
        .until(&name, "it runs", shows(State::Running, Reason::Running))
        .await;
    let started = world
        .api::<Submission>()
        .get(&name)
        .await
        .unwrap()
        .status
        .unwrap()
        .times
        .started;

    suspend(&world, &job, true).await;
    let at_once = DeleteParams::default().grace_period(0);
    world.api::<Pod>().delete(&first.name_any(), &at_once).await.unwrap();
    let is_held = shows(State::Running, Reason::Suspended);
    world.until(&name, "it keeps its state", is_held).await;

    suspend(&world, &job, false).await;
    cluster.running_pod(&job).await;
    world
        .until(&name, "it runs again", shows(State::Running, Reason::Running))
        .await;
    let status = world.api::<Submission>().get(&name).await.unwrap().status.unwrap();
    assert_eq!((status.retry, status.recreated, &status.failure), (0, 0, &None));
    assert_eq!((&status.interruptions, &status.times.started), (&None, &started));
    let jobs = world.api::<Job>();
    let after = jobs.get(&job.name_any()).await.unwrap();
    assert_eq!((after.uid(), after.spec.unwrap().suspend), (job.uid(), Some(false)));
    let in_evalai = world.evalai.with_state(|state| state.submissions[&pk].status);
    assert_eq!(in_evalai, Status::Running);
}
