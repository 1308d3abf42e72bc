//! How long a run has gone on, while the Pods of its Job come and go.

use super::builders::*;
use crate::view::PodView;
use leaderboard_api::Reason;
use leaderboard_api::State::{Pending, Running};

/// When the first Pod is lost. Its agents had begun at second 10.
const LOST: i64 = 72_000;
/// Seconds that the run has had by then.
const RAN: i64 = LOST - 10;
/// When the next one gets its node.
const BACK: i64 = 90_000;
/// How long a run may take whose Pods are prepared for longer.
const LIMIT: i64 = 3600;
/// When its first Pod is lost, or its first Job.
const GONE: i64 = 1000;
/// How long the images of the next one are pulled.
const PULLS: i64 = 5000;

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

/// Such a Pod on a node, whose images are pulled.
fn pulling_pod(second: i64) -> PodView {
    PodView {
        scheduled: Some(at(second)),
        unschedulable: None,
        containers: vec![waiting("contents", "PodInitializing", "")],
        ..next_pod(second)
    }
}

/// A run that may take `LIMIT` seconds.
fn limited() -> World {
    let mut world = World::local().running();
    world.leaderboard().deadlines.run_seconds = Some(LIMIT);
    world
}

/// The first agent of the present Pod starts.
fn gets_agents(world: &mut World, second: i64) {
    world.see_agents();
    world.pod().agent_started = Some(at(second));
    world.go_to(second + 5);
    world.pass_to(Running, Reason::Running);
}

/// Its time is over at this second, and not before.
#[track_caller]
fn has_time_until(world: &mut World, end: i64) {
    world.go_to(end - 1);
    world.pass_to(Running, Reason::Running);
    world.go_to(end);
    let failure = world.pass_to(Running, Reason::Stopping).status.failure.unwrap();
    assert_eq!(failure.reason, Reason::TimeLimit);
}

#[test]
fn the_wait_of_a_new_pod_for_its_node_costs_no_time() {
    for is_watched in [true, false] {
        let mut world = World::local().running();
        world.view.pod = Some(next_pod(LOST));
        if is_watched {
            world.go_to(LOST);
            world.pass_to(Running, Reason::Replacing);
            world.go_to(86_500);
            world.pass_to(Running, Reason::Replacing);
        }
        gets_node(&mut world, BACK);
        world.go_to(BACK + 60);
        let plan = world.pass_to(Running, Reason::Running);
        assert_eq!(plan.status.ran_seconds, RAN, "watched: {is_watched}");
        world.pass_to(Running, Reason::Running);
        let end = BACK + 86_400 - RAN;
        world.go_to(end - 1);
        let plan = world.pass_to(Running, Reason::Running);
        assert!(plan.requeue.unwrap() <= std::time::Duration::from_millis(1050));
        world.go_to(end);
        let failure = world.pass_to(Running, Reason::Stopping).status.failure.unwrap();
        assert_eq!(failure.reason, Reason::TimeLimit);
    }
}

#[test]
fn the_time_without_any_pod_costs_none_either() {
    let mut world = World::local().running();
    world.go_to(LOST);
    world.view.pod = None;
    world.job().failed_create = Some("pods is forbidden: exceeded quota".into());
    world.pass_to(Running, Reason::Replacing);
    world.go_to(86_500);
    world.pass_to(Running, Reason::Replacing);
    world.job().failed_create = None;
    world.view.pod = Some(next_pod(BACK - 5));
    gets_node(&mut world, BACK);
    world.go_to(BACK);
    assert_eq!(world.pass_to(Running, Reason::Running).status.ran_seconds, RAN);
}

#[test]
fn a_pod_whose_scheduling_is_dated_anew_is_no_other() {
    let mut world = World::local().running();
    world.pod().created = Some(at(-5));
    world.pod().scheduled = Some(at(500));
    world.go_to(500);
    let plan = world.pass_to(Running, Reason::Running);
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
        world.pass_to(Running, Reason::Running);
    }
    world.go_to(10 + 86_400 - 1);
    world.pass_to(Running, Reason::Running);
    world.go_to(10 + 86_400);
    world.pass_to(Running, Reason::Stopping);
}

#[test]
fn another_job_has_the_whole_time_again() {
    let mut world = World::local().running();
    world.go_to(LOST);
    world.view.pod = Some(next_pod(LOST));
    gets_node(&mut world, LOST + 5);
    world.pass_to(Running, Reason::Running);
    assert_eq!(world.status().ran_seconds, RAN);
    world.complete();
    assert_eq!(world.pass_to(Pending, Reason::Replacing).status.ran_seconds, 0);
}

#[test]
fn the_preparation_of_a_pod_that_takes_anothers_place_costs_no_time() {
    let mut world = limited();
    let times = world.status().times;
    assert_eq!(times.agent_started, times.started, "one write has both");
    world.view.pod = Some(pulling_pod(GONE));
    for second in [GONE, GONE + LIMIT, GONE + PULLS] {
        world.go_to(second);
        let status = world.pass_to(Running, Reason::Replacing).status;
        assert_eq!((status.ran_seconds, status.times.agent_started), (GONE - 10, None));
    }
    let mut used_up = world.clone();
    used_up.leaderboard().deadlines.run_seconds = Some(GONE - 10);
    used_up.pass_to(Running, Reason::Stopping);

    gets_agents(&mut world, GONE + PULLS);
    // Its agents are started again, and nothing shows their first start any more.
    world.pod().agent_started = Some(at(GONE + PULLS + 600));
    has_time_until(&mut world, GONE + PULLS + LIMIT - (GONE - 10));
}

#[test]
fn the_preparation_of_an_earlier_pod_is_no_time_that_it_has_run() {
    let mut world = limited();
    let (third, fourth) = (GONE + 300, GONE + 900);
    for lost in [GONE, third] {
        world.go_to(lost);
        world.view.pod = Some(pulling_pod(lost));
        world.pass_to(Running, Reason::Replacing);
    }
    assert_eq!(world.status().ran_seconds, GONE - 10, "no agent of the second has run");
    gets_agents(&mut world, fourth - 200);
    world.go_to(fourth);
    world.view.pod = Some(pulling_pod(fourth));
    world.pass_to(Running, Reason::Replacing);
    assert_eq!(world.status().ran_seconds, GONE - 10 + 200);
}

#[test]
fn another_job_has_the_whole_time_from_its_own_first_agent() {
    let mut world = limited();
    world.go_to(GONE);
    world.gets_another_job();
    let scheduled = GONE + 20;
    world.view.pod = Some(pulling_pod(scheduled));
    for second in [scheduled, scheduled + LIMIT, scheduled + PULLS] {
        world.go_to(second);
        world.pass_to(Pending, Reason::Preparing);
    }
    gets_agents(&mut world, scheduled + PULLS);
    has_time_until(&mut world, scheduled + PULLS + LIMIT);
}

#[test]
fn a_run_that_an_older_operator_has_begun_keeps_its_limit() {
    let forget = |world: &mut World| {
        let status = world.submission().status.as_mut().unwrap();
        status.times.agent_started = None;
    };
    let mut first = limited();
    forget(&mut first);
    // Its agents have been started again.
    first.pod().agent_started = Some(at(GONE));
    first.go_to(GONE);
    let before = first.status();
    assert_eq!(first.pass().status, before, "nothing is written of it");
    has_time_until(&mut first, 10 + LIMIT);

    let mut second = limited();
    second.go_to(GONE);
    second.view.pod = Some(pulling_pod(GONE));
    second.pass_to(Running, Reason::Replacing);
    gets_agents(&mut second, GONE + 60);
    forget(&mut second);
    has_time_until(&mut second, GONE + 60 + LIMIT - (GONE - 10));
}
