//! Two installations of the operator that serve the same namespace: only one of them acts.
#![cfg(test)]

use k8s_openapi::api::batch::v1::Job;
use k8s_openapi::api::coordination::v1::Lease;
use k8s_openapi::api::events::v1::Event;
use kube::ResourceExt;
use kube::api::{ListParams, Patch, PatchParams};
use kube::runtime::wait::await_condition;
use leaderboard_api::{Leaderboard, Reason, Submission};
use serde_json::json;
use tokio::time::timeout;

use std::time::Duration;

use super::bridge::LIMIT;
use super::world::World;

/// Between two looks at the events.
const POLL: Duration = Duration::from_millis(50);

/// Which image of the operator made a Job.
fn made_by(job: &Job) -> Vec<String> {
    let template = job.spec.as_ref().unwrap().template.spec.as_ref().unwrap();
    let containers = template.init_containers.iter().flatten();
    let images = containers.filter_map(|container| container.image.clone());
    images.filter(|image| image.starts_with("operator:")).collect()
}

async fn until_held(world: &World, lease: &str, is_held: bool) {
    let holds = |lease: Option<&Lease>| {
        let holder = lease.and_then(|lease| lease.spec.as_ref()?.holder_identity.as_ref());
        holder.is_some() == is_held
    };
    let found = timeout(LIMIT, await_condition(world.api::<Lease>(), lease, holds)).await;
    found.expect("the Lease changes hands").unwrap();
}

async fn until_driven_by(world: &World, leaderboard: &str, operator: &str) {
    let operator = format!("{}/{operator}", world.namespace);
    let is_driven = |board: Option<&Leaderboard>| {
        let named = board.and_then(|board| board.status.as_ref()?.operator.as_ref());
        named == Some(&operator)
    };
    let found = timeout(LIMIT, await_condition(world.api(), leaderboard, is_driven)).await;
    found.expect("it is driven").unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn of_two_operators_in_one_namespace_one_makes_the_jobs_until_a_person_hands_the_leaderboard_over() {
    let world = World::new().await;
    let first = world.installation("first", "operator:1");
    until_held(&world, "first", true).await;
    world.leaderboard("lb", 1, "Hosts").await;
    until_driven_by(&world, "lb", "first").await;
    let _second = world.installation("second", "operator:2");
    until_held(&world, "second", true).await;

    for _ in 0..3 {
        let (_, name) = world.submit("lb", 1).await;
        let makers = made_by(&world.job(&name, 0).await);
        assert!(
            !makers.is_empty() && makers.iter().all(|image| image == "operator:1"),
            "{makers:?}"
        );
    }
    until_driven_by(&world, "lb", "first").await;

    drop(first);
    until_held(&world, "first", false).await;
    let hand_over = Patch::Merge(json!({"status": {"operator": null}}));
    let boards = world.api::<Leaderboard>();
    boards
        .patch_status("lb", &PatchParams::default(), &hand_over)
        .await
        .unwrap();
    until_driven_by(&world, "lb", "second").await;
    let (_, name) = world.submit("lb", 1).await;
    let makers = made_by(&world.job(&name, 0).await);
    assert!(
        !makers.is_empty() && makers.iter().all(|image| image == "operator:2"),
        "{makers:?}"
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_another_installation_drives_is_left_alone_and_an_event_has_the_command_that_hands_it_over() {
    let world = World::new().await;
    world.leaderboard("theirs", 1, "Hosts").await;
    world.leaderboard("ours", 2, "Hosts").await;
    let boards = world.api::<Leaderboard>();
    let claim = Patch::Merge(json!({"status": {"operator": format!("{}/other", world.namespace)}}));
    let claimed = boards
        .patch_status("theirs", &PatchParams::default(), &claim)
        .await
        .unwrap();
    let (_, left) = world.submit("theirs", 1).await;
    let (_, run) = world.submit("ours", 2).await;
    let _controller = world.controller();

    world.job(&run, 0).await;
    let board = boards.get("theirs").await.unwrap();
    assert_eq!(board.status, claimed.status);
    assert!(board.finalizers().is_empty());
    let submission = world.api::<Submission>().get(&left).await.unwrap();
    assert_eq!(submission.status, None);

    let is_reported = |event: &Event| {
        let note = event.note.as_deref().unwrap_or_default();
        event.reason.as_deref() == Some(Reason::OtherOperator.as_str())
            && note.contains(
                "patch leaderboard theirs --subresource=status --type=merge -p '{\"status\":{\"operator\":null}}'",
            )
    };
    let events = world.api::<Event>();
    let reported = async {
        while !events
            .list(&ListParams::default())
            .await
            .unwrap()
            .iter()
            .any(is_reported)
        {
            tokio::time::sleep(POLL).await;
        }
    };
    timeout(LIMIT, reported).await.expect("an event reports it");

    let hand_over = Patch::Merge(json!({"status": {"operator": null}}));
    boards
        .patch_status("theirs", &PatchParams::default(), &hand_over)
        .await
        .unwrap();
    world.job(&left, 0).await;
    until_driven_by(&world, "theirs", "operator").await;
}
