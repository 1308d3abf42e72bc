//! The GPU use of a submission, over all its Jobs.

use serde_json::json;

use super::builders::*;
use crate::view::PodView;
use leaderboard_api::State::{Cancelled, Finished, Pending, Running};
use leaderboard_api::{Attempt, Reason, Use};

/// A submission whose two pairs have a GPU each, before its Job.
fn with_gpus() -> World {
    let mut world = World::local();
    let resources = json!({"limits": {"nvidia.com/gpu": "1"}});
    let carla = world.leaderboard().evaluation.carla_mut().unwrap();
    carla.simulator.resources = Some(serde_json::from_value(resources).unwrap());
    world
}

fn used(gpu_seconds: i64) -> Use {
    Use { gpus: 2, gpu_seconds }
}

#[test]
fn a_job_counts_from_its_pods_scheduling_to_its_end_and_once() {
    let mut world = with_gpus().running();
    assert_eq!(world.status().usage, Some(used(0)), "it counts when it has ended");
    world.go_to(1000);
    world.complete();
    world.report(final_report());
    assert_eq!(world.pass_to(Finished, Reason::Finished).status.usage, Some(used(2000)));
    world.go_to(2000);
    world.recorded();
    assert_eq!(world.pass().status.usage, Some(used(2000)));
}

#[test]
fn the_jobs_of_all_attempts_are_summed_up() {
    let mut world = with_gpus().running();
    world.go_to(100);
    world.complete();
    assert_eq!(world.pass_to(Pending, Reason::Replacing).status.usage, Some(used(200)));
    world.job_gone();
    world.wait(10);
    assert!(creates(&world.pass()));
    world.see_job();
    world.view.pod = Some(pod(150));
    world.see_agents();
    world.go_to(160);
    world.pass_to(Running, Reason::Running);
    world.submission().spec.cancel = true;
    world.go_to(250);
    world.complete();
    let plan = world.pass_to(Cancelled, Reason::Cancelled);
    assert_eq!(plan.status.usage, Some(used(200 + 200)));
    world.submission().spec.cancel = false;
    world.submission().spec.attempt = Attempt(2);
    world.job_gone();
    assert_eq!(
        world.pass_to(Pending, Reason::Preparing).status.usage,
        Some(used(400)),
        "a resume keeps it"
    );
}

#[test]
fn what_never_had_a_node_or_a_gpu_has_used_none() {
    let mut world = with_gpus().with_job();
    world.go_to(1000);
    world.submission().spec.cancel = true;
    world.pass();
    world.job_gone();
    assert_eq!(world.pass_to(Cancelled, Reason::Cancelled).status.usage, Some(used(0)));

    let mut world = World::local().running();
    world.go_to(1000);
    world.complete();
    world.report(final_report());
    assert_eq!(world.pass_to(Finished, Reason::Finished).status.usage, None);
}

#[test]
fn a_pod_that_waits_for_its_node_uses_none() {
    let mut world = with_gpus().running();
    world.go_to(1000);
    world.view.pod = Some(PodView {
        uid: "pod-2".into(),
        created: Some(at(1000)),
        scheduled: None,
        unschedulable: Some("0/1 nodes are available.".into()),
        ..pod(1000)
    });
    world.pass_to(Running, Reason::Replacing);
    let mut cancelled = world.clone();
    cancelled.submission().spec.cancel = true;
    cancelled.go_to(5000);
    cancelled.complete();
    let plan = cancelled.pass_to(Cancelled, Reason::Cancelled);
    assert_eq!(plan.status.usage, Some(used(2000)));

    (world.pod().unschedulable, world.pod().scheduled) = (None, Some(at(5000)));
    world.see_agents();
    world.go_to(6000);
    world.pass_to(Running, Reason::Running);
    world.complete();
    world.report(final_report());
    let plan = world.pass_to(Finished, Reason::Finished);
    assert_eq!(plan.status.usage, Some(used(2000 + 2000)));
}
