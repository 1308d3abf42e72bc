//! How long a run has gone on, while the Pods of its Job come and go.

use super::builders::*;
use crate::controller::submissions::view::PodView;
use leaderboard_api::State::{Pending, Running};
use leaderboard_api::reasons;

/// When the first Pod is lost. Its agents had begun at second 10.
const LOST: i64 = 72_000;
/// What the run has had by then.
const RAN: i64 = LOST - 10;
/// When the next one gets its node.
const BACK: i64 = 90_000;

/// A Pod that takes another's place, and has no node.
fn next_pod(second: i64) -> PodView {
    PodView {
        uid: format!("pod-of-{second}"),
        created: Some(at(second)),
        scheduled: None,
        unschedulable: Some("0/1 nodes are available.".into()),
        ..pod(second)
    }
}

fn gets_node(world: &mut World, second: i64) {
    (world.pod().unschedulable, world.pod().scheduled) = (None, Some(at(second)));
    world.see_agents();
}

#[test]
fn the_wait_of_a_new_pod_for_its_node_costs_no_time() {
    for is_watched in [true, false] {
        let mut world = World::local().running();
        world.view.pod = Some(next_pod(LOST));
        if is_watched {
            world.go_to(LOST);
            world.pass_to(Running, reasons::REPLACING);
            world.go_to(86_500);
            world.pass_to(Running, reasons::REPLACING);
        }
        gets_node(&mut world, BACK);
        world.go_to(BACK + 60);
        let plan = world.pass_to(Running, reasons::RUNNING);
        assert_eq!(plan.status.ran_seconds, RAN, "watched: {is_watched}");
        world.pass_to(Running, reasons::RUNNING);
        let end = BACK + 86_400 - RAN;
        world.go_to(end - 1);
        let plan = world.pass_to(Running, reasons::RUNNING);
        assert!(plan.requeue.unwrap() <= std::time::Duration::from_millis(1050));
        world.go_to(end);
        let failure = world.pass_to(Running, reasons::STOPPING).status.failure.unwrap();
        assert_eq!(failure.reason, reasons::TIME_LIMIT);
    }
}

#[test]
fn the_time_without_any_pod_costs_none_either() {
    let mut world = World::local().running();
    world.go_to(LOST);
    world.view.pod = None;
    world.job().failed_create = Some("pods is forbidden: exceeded quota".into());
    world.pass_to(Running, reasons::REPLACING);
    world.go_to(86_500);
    world.pass_to(Running, reasons::REPLACING);
    world.job().failed_create = None;
    world.view.pod = Some(next_pod(BACK - 5));
    gets_node(&mut world, BACK);
    world.go_to(BACK);
    assert_eq!(world.pass_to(Running, reasons::RUNNING).status.ran_seconds, RAN);
}

#[test]
fn a_pod_whose_scheduling_is_dated_anew_is_no_other() {
    let mut world = World::local().running();
    world.pod().created = Some(at(-5));
    world.pod().scheduled = Some(at(500));
    world.go_to(500);
    let plan = world.pass_to(Running, reasons::RUNNING);
    assert_eq!(
        (plan.status.ran_seconds, plan.status.times.scheduled.unwrap().0),
        (0, at(0))
    );
}

#[test]
fn an_agent_wins_no_time_by_having_its_pod_evicted() {
    let mut world = World::local().running();
    for lost in [20_000, 40_000, 60_000, 80_000] {
        world.go_to(lost);
        world.view.pod = Some(next_pod(lost));
        gets_node(&mut world, lost);
        world.pass_to(Running, reasons::RUNNING);
    }
    world.go_to(10 + 86_400 - 1);
    world.pass_to(Running, reasons::RUNNING);
    world.go_to(10 + 86_400);
    world.pass_to(Running, reasons::STOPPING);
}

#[test]
fn another_job_has_the_whole_time_again() {
    let mut world = World::local().running();
    world.go_to(LOST);
    world.view.pod = Some(next_pod(LOST));
    gets_node(&mut world, LOST + 5);
    world.pass_to(Running, reasons::RUNNING);
    assert_eq!(world.status().ran_seconds, RAN);
    world.complete();
    assert_eq!(world.pass_to(Pending, reasons::REPLACING).status.ran_seconds, 0);
}
