//! Ends that look like a further crash of a pair, and are none or are neither side's. Examples are an end that was counted, a sandbox
//! made anew, and a node or a Pod that lacks what a start needs.

use super::builders::*;
use crate::view::ContainerView;
use leaderboard_api::FailureClass::{Infrastructure, Participant};
use leaderboard_api::Reason;
use leaderboard_api::State::Running;

/// Both sides of pair 1 come back after this many restarts; their last life was ended from outside.
fn see_sandbox_made_anew(world: &mut World, restarts: i32, second: i64) {
    for name in ["simulator-1", "agent-1"] {
        world.see_alone(restarted(name, restarts, "silentDeath", 137, second));
    }
    world.go_to(second + 1);
    world.pass_to(Running, Reason::Running);
}

#[test]
fn a_sandbox_that_is_made_anew_uses_up_no_retry() {
    let mut world = World::local().running();
    for time in 1..=5 {
        see_sandbox_made_anew(&mut world, time, 100 * i64::from(time));
        assert_eq!(world.pass().status.workers[0].crashes, 0, "{time}");
    }
    // The runners' rounds count them, too.
    let mut told = report(1);
    told.workers[0].crashes = 5;
    world.report(told);
    assert_eq!(world.pass_to(Running, Reason::Running).status.workers[0].crashes, 0);
    for (crashes, restarts) in [(1, 5), (2, 6), (3, 7)] {
        world.see(ended(
            "agent-1",
            restarts,
            "exited",
            1,
            1000 + 100 * i64::from(restarts),
        ));
        let plan = world.pass_to(Running, Reason::Running);
        assert_eq!(plan.status.workers[0].crashes, crashes);
        world.see_alone(running("simulator-1"));
    }
    world.see(ended("agent-1", 8, "exited", 1, 1800));
    let failure = world.pass_to(Running, Reason::Stopping).status.failure.unwrap();
    assert_eq!(
        (failure.reason.known().unwrap(), failure.class),
        (Reason::AgentCrashed, Participant)
    );
    assert!(
        failure.message.starts_with("Agent 1 crashed 4 times."),
        "{}",
        failure.message
    );
}

#[test]
fn of_a_sandbox_that_is_made_anew_one_side_may_be_seen_first() {
    let mut world = World::local().running();
    world.see_alone(ended("simulator-1", 0, "silentDeath", 137, 100));
    world.go_to(101);
    let plan = world.pass_to(Running, Reason::Running);
    assert_eq!(plan.status.workers[0].crashes, 1, "so far the simulator has crashed");
    see_sandbox_made_anew(&mut world, 1, 100);
    assert_eq!(world.pass().status.workers[0].crashes, 0);
}

#[test]
fn a_simulator_that_is_kept_away_for_want_of_processes_ends_the_run_at_the_agents_cost() {
    let mut world = World::local().running();
    world.leaderboard().retries.per_worker = 1;
    world.see(ended("agent-2", 0, "exited", 1, 100));
    world.pass_to(Running, Reason::Running);
    world.see_alone(running("agent-2"));
    for restarts in 1..6 {
        let mut simulator = ended("simulator-2", restarts, "", 128, 100 + i64::from(restarts));
        let end = simulator.last.as_mut().unwrap();
        end.reason = "StartError".into();
        end.why = Some("runc create failed: read init-p: connection reset by peer".into());
        simulator.waiting = Some(("CrashLoopBackOff".into(), String::new()));
        world.see_alone(simulator);
        let plan = world.pass();
        let found = (plan.status.workers[0].crashes, plan.status.failure);
        assert_eq!(found, (1, None), "it is waited for");
    }
    let mut agent = ended("agent-2", 1, "notReady", 1, 900);
    agent.last.as_mut().unwrap().began = Some(at(110));
    world.see_alone(agent);
    world.go_to(1021);
    let failure = world.pass_to(Running, Reason::Stopping).status.failure.unwrap();
    assert_eq!((failure.class, failure.worker), (Participant, Some(2)));
}

#[test]
fn an_agent_that_its_node_starts_no_more_is_charged_to_nobody() {
    let mut world = World::local().running();
    world.see(ended("agent-1", 3, "nodeRefused", 71, 100));
    let failure = world.pass_to(Running, Reason::Stopping).status.failure.unwrap();
    let found = (failure.reason.known().unwrap(), failure.class);
    assert_eq!(found, (Reason::NodeCannotStart, Infrastructure));
    assert_eq!(
        failure.message,
        "The container of agent 1 could not be started 4 times on node node-a; nothing of its image is the cause."
    );
}

#[test]
fn agents_that_leave_no_process_to_start_one_of_them_again_are_charged() {
    let mut world = World::local().running();
    world.see(ended("agent-1", 3, "noProcess", 75, 100));
    let failure = world.pass_to(Running, Reason::Stopping).status.failure.unwrap();
    assert_eq!(
        (failure.reason.known().unwrap(), failure.class),
        (Reason::AgentCrashed, Participant)
    );
    assert!(
        failure.message.contains("left the Pod no process to start it again"),
        "{}",
        failure.message
    );
}

#[test]
fn a_crash_that_only_the_report_knows_ends_no_run_by_the_cause_of_the_one_before() {
    let mut world = World::local().running();
    world.see_alone(ended("simulator-1", 0, "exited", 1, 100));
    let mut told = report(1);
    told.workers[0].crashes = 4;
    world.report(told);
    world.go_to(101);
    let plan = world.pass_to(Running, Reason::Running);
    assert_eq!(plan.status.workers[0].crashes, 1);
    // The last ends come: another container had the port.
    world.see_alone(ended("simulator-1", 3, "portTaken", 1, 102));
    world.go_to(103);
    let plan = world.pass_to(Running, Reason::Stopping);
    let failure = plan.status.failure.unwrap();
    assert_eq!(
        (failure.reason.known().unwrap(), failure.class),
        (Reason::AgentCrashed, Participant)
    );
}

/// On a busy node the kubelet reports a container that it has made and not begun as one that waits after its end.
#[test]
fn a_crash_counts_once_while_its_container_is_about_to_begin_again() {
    for begins_anew in [true, false] {
        let mut world = World::local().running();
        for (name, verdict) in [("agent-1", "exited"), ("simulator-1", "peerCrashed")] {
            world.see_alone(ContainerView {
                restarts: 3,
                begins_anew,
                waiting: Some(("CrashLoopBackOff".into(), String::new())),
                ..ended(name, if begins_anew { 2 } else { 3 }, verdict, 1, 100)
            });
        }
        world.go_to(101);
        let reason = if begins_anew { Reason::Running } else { Reason::Stopping };
        let plan = world.pass_to(Running, reason);
        assert_eq!(plan.status.workers[0].crashes, if begins_anew { 3 } else { 4 });
    }
}
