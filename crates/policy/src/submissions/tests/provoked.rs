//! Which infrastructure failures that an agent can provoke get another Job.

use super::builders::*;
use crate::submissions::end::may_go_on;
use crate::submissions::failure::{infrastructure, participant};
use leaderboard_api::FailureClass::Infrastructure;
use leaderboard_api::State::{Failed, Pending, Running};
use leaderboard_api::{Attempt, FailedNode, Failure, Reason};

/// Its simulator fails as often as it may with this many routes stored, and its Job ends.
fn simulator_fails(world: &mut World, routes: u32) {
    world.see_alone(ended("simulator-1", 3, "exited", 1, 100));
    world.pass_to(Running, Reason::Stopping);
    world.complete();
    world.report(report(routes));
}

/// It is tried again, and the next Job runs.
fn runs_again(world: &mut World) {
    world.pass_to(Pending, Reason::Replacing);
    world.job_gone();
    world.go_to(world.view.now.as_second() - at(0).as_second() + 60);
    world.pass_to(Pending, Reason::Preparing);
    world.see_job();
    world.view.pod = Some(pod(0));
    world.see_agents();
    world.pass_to(Running, Reason::Running);
}

fn of_pair(reason: Reason) -> Failure {
    Failure {
        worker: Some(1),
        ..infrastructure(reason, "It failed.")
    }
}

#[test]
fn the_first_is_tried_again_and_a_further_one_only_after_a_route() {
    for (what, before, stored, goes_on) in [
        ("the first one", None, 0, true),
        ("without a route", Some(0), 0, false),
        ("after a route", Some(0), 1, true),
        ("with what was there before", Some(3), 3, false),
        ("with less than before", Some(3), 2, false),
        ("a last route after many", Some(3), 4, true),
    ] {
        let found = of_pair(Reason::SimulationCrashed);
        assert_eq!(may_go_on(&found, before, stored), goes_on, "{what}");
    }
}

#[test]
fn only_what_an_agent_can_provoke_has_to_be_earned() {
    let of_hosts = |reason: Reason| infrastructure(reason, "It failed.");
    let agents = participant(Reason::CannotStart, "It failed.", "Fix it.");
    for (what, found, goes_on) in [
        (
            "results that are kept from S3",
            of_hosts(Reason::ResultsNotStored),
            false,
        ),
        ("a Job that nothing explains", of_hosts(Reason::JobFailed), false),
        ("a simulator that does not start", of_hosts(Reason::CannotStart), false),
        (
            "a node that starts nothing more",
            of_pair(Reason::NodeCannotStart),
            false,
        ),
        ("a node that falls silent", of_hosts(Reason::NodeLost), false),
        ("a disk that is full", of_hosts(Reason::DiskFull), false),
        ("an agent's image that is not pulled", of_pair(Reason::ImagePull), false),
        ("a host's image that is not pulled", of_hosts(Reason::ImagePull), true),
        ("a node without a GPU", of_pair(Reason::NoGPU), true),
        ("a node that is taken away", of_hosts(Reason::NodeInterrupted), true),
        ("a start that takes too long", of_hosts(Reason::StartDeadline), true),
        ("the agent's own", agents, true),
    ] {
        assert_eq!(may_go_on(&found, Some(0), 0), goes_on, "{what}");
    }
}

#[test]
fn an_agent_that_crashes_its_simulator_gets_a_second_job_and_a_third_only_if_it_has_finished_a_route() {
    let mut world = World::local().running();
    world.leaderboard().retries.infrastructure = 9;
    simulator_fails(&mut world, 1);
    runs_again(&mut world);
    let suspect = FailedNode {
        node_name: "node-a".into(),
        jobs: 0,
    };
    assert_eq!(
        (world.status().done_before, world.status().failed_nodes),
        (Some(1), vec![suspect]),
        "the next Job prefers other nodes, and no node is forbidden"
    );

    simulator_fails(&mut world, 2);
    runs_again(&mut world);
    assert_eq!((world.status().retry, world.status().done_before), (2, Some(2)));

    simulator_fails(&mut world, 2);
    let status = world.pass_to(Failed, Reason::SimulationCrashed).status;
    let failure = status.failure.unwrap();
    assert_eq!((failure.class, status.retry), (Infrastructure, 2));
    assert_eq!(
        failure.message,
        "The simulator of pair 1 failed 4 times: it crashed. The attempt had such an end before, and this Job has finished no route, so \
         no further Job follows. Look at the simulator's log, then resume the submission; it repeats the route it was at."
    );
    assert!(!failure.participant_message.unwrap().contains("such an end"));

    world.submission().spec.attempt = Attempt(2);
    let status = world.pass_to(Pending, Reason::Preparing).status;
    assert_eq!(status.done_before, None, "another attempt begins anew");
}

#[test]
fn results_that_an_agent_keeps_from_being_stored_get_one_more_job() {
    let mut world = World::local().running();
    world.leaderboard().retries.infrastructure = 9;
    world.complete();
    runs_again(&mut world);
    world.complete();
    let status = world.pass_to(Failed, Reason::ResultsNotStored).status;
    assert_eq!((status.failure.unwrap().class, status.retry), (Infrastructure, 1));
}

#[test]
fn an_interruption_between_two_failures_counts_the_routes_of_its_own_job_alone() {
    let mut world = World::local().running();
    world.leaderboard().retries.infrastructure = 9;
    simulator_fails(&mut world, 1);
    runs_again(&mut world);
    world.view.node.leaving = Some("karpenter.sh/disrupted".into());
    world.pass_to(Running, Reason::Replacing);
    world.complete();
    world.report(report(2));
    world.view.node.leaving = None;
    runs_again(&mut world);
    assert_eq!(world.status().done_before, Some(2));
    simulator_fails(&mut world, 2);
    world.pass_to(Failed, Reason::SimulationCrashed);
}

#[test]
fn no_more_jobs_follow_than_the_leaderboard_allows() {
    let mut world = World::local().running();
    world.leaderboard().retries.infrastructure = 1;
    simulator_fails(&mut world, 1);
    runs_again(&mut world);
    simulator_fails(&mut world, 2);
    let failure = world.pass_to(Failed, Reason::SimulationCrashed).status.failure;
    assert!(!failure.unwrap().message.contains("such an end"));
}
