//! Images before their first Job: the whole controller against a real API server, EvalAI's stand-in and a registry on loopback.
#![cfg(test)]

use evalai_stand_in::model::Status;
use k8s_openapi::api::batch::v1::Job;
use k8s_openapi::api::core::v1::Secret;
use kube::api::{ListParams, PostParams};
use leaderboard_api::{Attempt, FailureClass, JobNumber, Submission, conditions, names, reasons};
use serde_json::{Value, json};
use tokio::time::timeout;

use super::bridge::LIMIT;
use super::objects::{Kind, causes, create};
use super::world::{PARTICIPANT, World};
use crate::support::apiserver;
use crate::support::images::{ImageRegistry, config};

/// A Leaderboard whose teams push to a repository each, below `team`.
fn images(registry: &ImageRegistry) -> Value {
    json!({"agent": {"images": [format!("{}/team", registry.host())], "imageSizeLimit": "1Mi"}})
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_image_that_can_never_run_fails_before_a_job_is_made_and_evalai_gets_the_reason() {
    let world = World::new().await;
    let registry = ImageRegistry::start().await;
    let mut with_volumes = config();
    with_volumes["config"] = json!({"Volumes": {"/data": {}}});
    let mut other = config();
    other["architecture"] = json!("arm64");
    registry.push("volumes", &with_volumes, 1);
    registry.push("other", &other, 1);
    registry.push("large", &config(), 2 << 20);
    registry.put("manifests/odd", b"[]".to_vec());
    registry.redirect("manifests/moved", "/v2/team/manifests/volumes");
    world.leaderboard_with("lb", 1, "Hosts", &images(&registry)).await;
    let _controller = world.controller();

    for (image, reason) in [
        ("team:none", reasons::IMAGE_NOT_FOUND),
        ("team:volumes", reasons::IMAGE_VOLUMES),
        ("team:moved", reasons::IMAGE_VOLUMES),
        ("team:other", reasons::IMAGE_PLATFORM),
        ("team:large", reasons::IMAGE_TOO_LARGE),
        ("team:odd", reasons::IMAGE_INVALID),
        ("other-team:one", reasons::IMAGE_NOT_ALLOWED),
    ] {
        let image = json!(format!("{}/{image}", registry.host()));
        let (pk, name) = world.submit_image("lb", 1, &image, &image).await;
        let failed = world
            .evalai
            .wait_until(|state, _| state.submissions[&pk].status == Status::Failed);
        timeout(LIMIT, failed).await.expect("EvalAI hears of it");
        let submission = world.api::<Submission>().get(&name).await.unwrap();
        let failure = submission.status.unwrap().failure.unwrap();
        assert_eq!(
            (failure.reason.as_str(), failure.class),
            (reason, FailureClass::Participant)
        );
        let (_, fetched) = world.fetched(pk, PARTICIPANT).await;
        assert!(fetched.contains(&format!("{reason} (participant)")), "{fetched}");
    }
    let jobs = world.api::<Job>().list(&ListParams::default()).await.unwrap();
    assert_eq!(jobs.items.len(), 0);
    let is_foreign = |(path, _): &(String, Option<String>)| path.contains("other-team");
    assert!(
        !registry.seen().iter().any(is_foreign),
        "no registry is asked for what is not allowed"
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn every_job_pulls_the_digest_that_the_tag_had_and_the_registry_is_asked_once() {
    let world = World::new().await;
    let registry = ImageRegistry::start().await;
    let digest = registry.push("one", &config(), 1);
    registry.guard("Basic realm=\"x\"", "Basic dXNlcjpzZWNyZXQ=");
    let auths = json!({"auths": {registry.host(): {"username": "user", "password": "secret"}}});
    let secret = json!({
        "metadata": {"name": "registry"}, "type": "kubernetes.io/dockerconfigjson",
        "stringData": {".dockerconfigjson": auths.to_string()},
    });
    let secret: Secret = serde_json::from_value(secret).unwrap();
    world.api().create(&PostParams::default(), &secret).await.unwrap();
    let mut spec = images(&registry);
    spec["podOverrides"] = json!({"spec": {"imagePullSecrets": [{"name": "registry"}]}});
    world.leaderboard_with("lb", 1, "Hosts", &spec).await;
    let controller = world.controller();

    let image = json!(format!("{}/team:one", registry.host()));
    let (_, name) = world.submit_image("lb", 1, &image, &image).await;
    let pulled = |job: &Job| {
        let pod = job.spec.as_ref().unwrap().template.spec.as_ref().unwrap();
        let agent = pod.containers.iter().find(|c| c.name == "agent-1").unwrap();
        agent.image.clone().unwrap()
    };
    let wanted = format!("{}/team@{digest}", registry.host());
    assert_eq!(pulled(&world.job(&name, 0).await), wanted);
    let has_job = |s: &leaderboard_api::SubmissionStatus| s.job_name.is_some();
    world.until(&name, "it has a Job", has_job).await;
    let status = world.api::<Submission>().get(&name).await.unwrap().status.unwrap();
    assert_eq!(status.image.unwrap().digest, digest);
    let asked = registry.seen().len();

    // The tag moves, and another controller makes the Job anew.
    registry.push("one", &config(), 2);
    drop(controller);
    let jobs = world.api::<Job>();
    let job_name = names::job(&name, JobNumber::first(Attempt(1)));
    let old = jobs.get(&job_name).await.unwrap();
    jobs.delete(&job_name, &kube::api::DeleteParams::background())
        .await
        .unwrap();
    let _controller = world.controller();
    let is_new = |job: Option<&Job>| job.is_some_and(|job| job.metadata.uid != old.metadata.uid);
    let again = kube::runtime::wait::await_condition(world.api::<Job>(), &job_name, is_new);
    let again = timeout(LIMIT, again)
        .await
        .expect("the Job is made again")
        .unwrap()
        .unwrap();
    assert_eq!(pulled(&again), wanted);
    assert_eq!(registry.seen().len(), asked, "the registry was asked once");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_registry_that_does_not_answer_holds_no_submission_up() {
    let world = World::new().await;
    let registry = ImageRegistry::start().await;
    registry.fail("manifests/one", 503);
    world.leaderboard_with("lb", 1, "Hosts", &images(&registry)).await;
    let _controller = world.controller();
    let image = json!(format!("{}/team:one", registry.host()));
    let (_, name) = world.submit_image("lb", 1, &image, &image).await;
    world.job(&name, 0).await;
    let is_noted = |s: &leaderboard_api::SubmissionStatus| {
        conditions::get(&s.conditions, conditions::ACCEPTED).is_some_and(|accepted| {
            accepted.status == "True"
                && accepted.reason == reasons::IMAGE_NOT_PINNED
                && accepted.message.contains("503")
        })
    };
    world.until(&name, "hosts see that it was not checked", is_noted).await;
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
