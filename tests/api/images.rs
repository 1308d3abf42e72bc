//! Which images run: the whole controller against a real API server and EvalAI's stand-in. The test plays the kubelet.
#![cfg(test)]

use evalai_stand_in::model::Status;
use k8s_openapi::api::batch::v1::Job;
use k8s_openapi::api::core::v1::Container;
use kube::ResourceExt;
use kube::api::{DeleteParams, ListParams};
use kube::runtime::wait::await_condition;
use leaderboard_api::{FailureClass, Reason, Submission, SubmissionStatus};
use serde_json::json;
use tokio::time::timeout;

use super::bridge::LIMIT;
use super::objects::{Kind, causes, create};
use super::world::{PARTICIPANT, World};
use crate::support::player::running;
use crate::support::{apiserver, played};

/// A Job's first agent.
fn agent(job: &Job) -> Container {
    let pod = job.spec.as_ref().unwrap().template.spec.as_ref().unwrap();
    pod.containers.iter().find(|c| c.name == "agent-1").unwrap().clone()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_image_of_another_team_fails_before_a_job_is_made_and_evalai_gets_the_reason() {
    let world = World::new().await;
    let own_repositories = json!({"agent": {"images": ["r.example/team-{team}"]}});
    world.leaderboard_with("lb", 1, "Hosts", &own_repositories).await;
    let _controller = world.controller();
    let image = json!("r.example/team-2:1");
    let (pk, name) = world.submit_image("lb", 1, &image, &image).await;
    let failed = world
        .evalai
        .wait_until(|state, _| state.submissions[&pk].status == Status::Failed);
    timeout(LIMIT, failed).await.expect("EvalAI hears of it");
    let submission = world.api::<Submission>().get(&name).await.unwrap();
    let failure = submission.status.unwrap().failure.unwrap();
    assert_eq!(
        (failure.reason, failure.class),
        (Reason::ImageNotAllowed.into(), FailureClass::Participant)
    );
    let (_, fetched) = world.fetched(pk, PARTICIPANT).await;
    assert!(fetched.contains("ImageNotAllowed (participant)"), "{fetched}");
    let jobs = world.api::<Job>().list(&ListParams::default()).await.unwrap();
    assert_eq!(jobs.items.len(), 0);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn every_later_job_pulls_the_digest_that_the_first_agent_ran() {
    let world = World::new().await;
    world.leaderboard("lb", 1, "Hosts").await;
    let controller = world.controller();
    let (_, name) = world.submit("lb", 1).await;
    let first = world.job(&name, 0).await;
    let pulled = agent(&first);
    assert_eq!(pulled.image.as_deref(), Some("r/team-a:1"));
    assert_eq!(pulled.image_pull_policy.as_deref(), Some("IfNotPresent"));

    let digest = format!("sha256:{}", "a".repeat(64));
    let cluster = world.cluster();
    let pod = cluster.pod(&first).await;
    let mut status = running(&pod);
    played::container_of(&mut status, "agent-1")["imageID"] = json!(format!("docker.io/r/team-a@{digest}"));
    cluster.set_pod(&pod.name_any(), &status).await;
    let is_pinned = |s: &SubmissionStatus| s.image.as_ref().is_some_and(|image| image.digest == digest);
    world.until(&name, "the digest is pinned", is_pinned).await;

    // Another controller makes the Job anew, wherever the tag is by now.
    drop(controller);
    let (jobs, job) = (world.api::<Job>(), first.name_any());
    jobs.delete(&job, &DeleteParams::background()).await.unwrap();
    let _controller = world.controller();
    let is_new = |job: Option<&Job>| job.is_some_and(|job| job.metadata.uid != first.metadata.uid);
    let again = timeout(LIMIT, await_condition(jobs, &job, is_new)).await;
    let again = again.expect("the Job is made again").unwrap().unwrap();
    assert_eq!(agent(&again).image, Some(format!("r/team-a@{digest}")));
}

#[tokio::test]
async fn a_name_with_control_characters_or_bidi_marks_is_refused_by_the_api_server() {
    let server = apiserver::server().await;
    let api = Kind::Submission.api(&server.client(), &server.namespace("names").await);
    for image in [
        "r.example/a\u{1b}[2J:1",
        "r.example/\u{202e}a:1",
        "r.example/a\u{200b}:1",
        "r.example/ä",
    ] {
        let object = Kind::Submission.object("named", &[&json!({"spec": {"image": image}})]);
        let error = create(&api, object, true).await.unwrap_err();
        assert!(
            causes(&error).iter().any(|cause| cause.contains("image")),
            "{image:?}: {error}"
        );
    }
}
