//! Crashes of a pair: whose they are, how many are forgiven.

use super::builders::*;
use crate::submissions::{Action, end};
use crate::view::{JobEnd, ObservedReport};
use leaderboard_api::FailureClass::{Infrastructure, Participant};
use leaderboard_api::Reason;
use leaderboard_api::State::{Failed, Finished, Pending, Running};
use leaderboard_api::{FailedNode, Failure, MAX_FAILED_NODES};
use leaderboard_contract::run::Stop;

/// Each side of pair 1 ends like this until its retries are used up: what comes of it.
fn used_up(agent: &str, simulator: &str) -> Failure {
    let mut world = World::local().running();
    for (name, verdict) in [("agent-1", agent), ("simulator-1", simulator)] {
        if !verdict.is_empty() {
            world.see_alone(ended(name, 3, verdict, 1, 100));
        }
    }
    world.go_to(221);
    let plan = world.pass_to(Running, Reason::Stopping);
    assert_eq!(annotated(&plan), Some(Stop::Retries), "{agent} {simulator}");
    assert_eq!(
        plan.status.workers[0].crashes, 4,
        "{agent} {simulator}: the end that is not restarted yet counts"
    );
    *plan.status.failure.unwrap()
}

#[test]
fn a_pair_whose_agent_always_fails_ends_the_run_at_the_participants_cost() {
    for (agent, simulator, reason) in [
        ("exited", "peerCrashed", Reason::AgentCrashed),
        ("silentDeath", "", Reason::AgentCrashed),
        ("incomplete", "peerCrashed", Reason::InvalidResults),
        ("idle", "peerCrashed", Reason::Idle),
        ("cannotStart", "peerCrashed", Reason::CannotStart),
        // It claims that its peer crashed, and runs on.
        ("peerCrashed", "peerCrashed", Reason::AgentCrashed),
    ] {
        let failure = used_up(agent, simulator);
        let found = (failure.reason.known().unwrap(), failure.class);
        assert_eq!(found, (reason, Participant), "{agent} {simulator}");
    }
}

#[test]
fn a_pair_whose_simulator_always_fails_ends_the_run_at_nobodys_cost() {
    for (agent, simulator) in [
        ("peerCrashed", "exited"),
        // The agent crashes with it.
        ("exited", "killed"),
        ("", "cannotStart"),
        ("notReady", "notReady"),
    ] {
        let failure = used_up(agent, simulator);
        let found = (failure.reason.known().unwrap(), failure.class);
        assert_eq!(
            found,
            (Reason::SimulationCrashed, Infrastructure),
            "{agent} {simulator}"
        );
    }
}

#[test]
fn fewer_crashes_than_allowed_are_forgiven() {
    let mut world = World::local().running();
    world.see(ended("agent-1", 2, "exited", 1, 100));
    let plan = world.pass_to(Running, Reason::Running);
    assert_eq!(plan.status.workers[0].crashes, 3);
    world.report(final_report());
    world.complete();
    world.report(final_report());
    world.pass_to(Finished, Reason::Finished);
}

#[test]
fn memory_is_the_cause_only_of_the_agents_own_end() {
    let oom = |what: &str, name: &str| {
        let mut container = ended(name, 3, what, 137, 100);
        container.last.as_mut().unwrap().reason = "OOMKilled".into();
        container
    };
    let cases = [
        ("agent-1", "", Reason::OutOfMemory),
        ("agent-1", "silentDeath", Reason::OutOfMemory),
        ("agent-1", "killed", Reason::OutOfMemory),
        ("agent-1", "idle", Reason::Idle),
        ("simulator-1", "killed", Reason::SimulationCrashed),
    ];
    for (name, what, reason) in cases {
        let mut world = World::local().running();
        world.see(oom(what, name));
        assert_eq!(world.pass().status.failure.unwrap().reason, reason, "{name} {what}");
    }
}

#[test]
fn the_last_round_decides_whose_crash_it_was() {
    let mut world = World::local().running();
    world.see(ended("agent-1", 1, "exited", 1, 100));
    world.pass();
    world.see_alone(restarted("agent-1", 2, "exited", 1, 100));
    world.see_alone(ended("simulator-1", 3, "exited", 1, 900));
    let failure = world.pass().status.failure.unwrap();
    assert_eq!(failure.reason, Reason::SimulationCrashed);
}

#[test]
fn a_simulators_crash_of_an_earlier_round_does_not_excuse_the_agent() {
    let mut world = World::local().running();
    world.see_alone(restarted("simulator-1", 1, "exited", 1, 100));
    // The agent waited for its simulator and then ran for hours, in one life.
    let mut agent = ended("agent-1", 3, "exited", 1, 9000);
    agent.last.as_mut().unwrap().began = Some(at(60));
    world.see_alone(agent);
    world.go_to(9001);
    world.pass_to(Running, Reason::Running);
    world.go_to(9120);
    let failure = world.pass_to(Running, Reason::Stopping).status.failure.unwrap();
    assert_eq!(failure.reason, Reason::AgentCrashed);
}

/// Whatever an agent leaves as its verdict, and whenever its simulator hears of it.
#[test]
fn an_agent_that_blames_its_simulator_is_charged() {
    for word in ["notReady", "peerCrashed", "serverSilent", "portTaken"] {
        let mut world = World::local().running();
        world.see_alone(ended("agent-1", 3, word, 1, 100));
        world.go_to(101);
        let plan = world.pass_to(Running, Reason::Running);
        assert_eq!(
            (plan.status.workers[0].crashes, plan.status.failure),
            (4, None),
            "{word}"
        );
        assert!(plan.requeue.unwrap().as_secs() <= 120, "{word}");
        let mut alone = world.clone();
        alone.go_to(220);
        world.see_alone(ended("simulator-1", 3, "peerCrashed", 1, 101));
        for mut world in [world, alone] {
            let failure = world.pass_to(Running, Reason::Stopping).status.failure.unwrap();
            let found = (failure.reason.known().unwrap(), failure.class);
            assert_eq!(found, (Reason::AgentCrashed, Participant), "{word}");
            assert!(
                failure.message.contains("blamed its simulator, which had not failed"),
                "{word}"
            );
        }
    }
}

#[test]
fn a_port_that_an_agent_has_taken_is_the_participants() {
    let mut world = World::local().running();
    world.see_alone(ended("simulator-2", 3, "portTaken", 1, 100));
    let failure = world.pass_to(Running, Reason::Stopping).status.failure.unwrap();
    assert_eq!((failure.class, failure.worker), (Participant, Some(2)));
    assert_eq!(
        failure.message,
        "Another container of the Pod listened on the port of simulator 2, which failed 4 times. Let the agents listen on no \
         port of a simulator, and submit again."
    );
}

/// The kubelet waits for minutes before it starts a container again that has been killed often.
#[test]
fn a_simulator_that_was_killed_without_a_word_long_before_its_agent_noticed_is_the_cause() {
    let mut world = World::local().running();
    world.see_alone(restarted("simulator-1", 4, "silentDeath", 137, 100));
    let mut agent = ended("agent-1", 3, "peerCrashed", 1, 400);
    agent.last.as_mut().unwrap().began = Some(at(60));
    world.see_alone(agent);
    let failure = world.pass_to(Running, Reason::Stopping).status.failure.unwrap();
    assert_eq!(failure.reason, Reason::SimulationCrashed);
}

#[test]
fn an_end_of_an_earlier_round_is_not_the_verdict_that_is_waited_for() {
    let mut world = World::local().running();
    world.see_alone(restarted("agent-1", 3, "peerCrashed", 1, 100));
    world.see_alone(ended("simulator-1", 3, "peerCrashed", 1, 400));
    world.go_to(401);
    let plan = world.pass_to(Running, Reason::Running);
    assert_eq!((plan.status.workers[0].crashes, plan.status.failure), (4, None));
    world.see_alone(ended("agent-1", 3, "idle", 1, 401));
    let failure = world.pass_to(Running, Reason::Stopping).status.failure.unwrap();
    assert_eq!(failure.reason, Reason::Idle);
}

#[test]
fn a_simulator_that_is_ended_from_outside_each_time_is_the_cause() {
    let mut world = World::local().running();
    world.see_alone(ended("simulator-1", 3, "stopped", 143, 100));
    world.see_alone(ended("agent-1", 3, "peerCrashed", 1, 100));
    let failure = world.pass_to(Running, Reason::Stopping).status.failure.unwrap();
    assert_eq!(failure.reason, Reason::SimulationCrashed);
}

#[test]
fn an_agent_that_followed_its_simulator_waits_for_the_simulators_own_verdict() {
    let mut world = World::local().running();
    world.see_alone(restarted("simulator-1", 3, "peerCrashed", 1, 40));
    world.see_alone(ended("agent-1", 3, "peerCrashed", 1, 100));
    let plan = world.pass_to(Running, Reason::Running);
    assert_eq!((plan.status.workers[0].crashes, plan.status.failure), (4, None));
    world.see_alone(ended("simulator-1", 3, "exited", 1, 100));
    let failure = world.pass_to(Running, Reason::Stopping).status.failure.unwrap();
    assert_eq!(failure.reason, Reason::SimulationCrashed);
}

#[test]
fn a_count_without_a_cause_waits_for_it() {
    let mut world = World::local().running();
    let mut told = report(1);
    told.workers[0].crashes = 4;
    world.report(told);
    assert_eq!(world.pass_to(Running, Reason::Running).status.failure, None);
    world.see(ended("agent-1", 3, "exited", 1, 100));
    world.pass_to(Running, Reason::Stopping);
}

#[test]
fn a_crash_that_only_the_simulator_has_reported_waits_for_the_agents_own_report() {
    let mut world = World::local().running();
    world.see_alone(ended("simulator-1", 3, "peerCrashed", 1, 100));
    let plan = world.pass_to(Running, Reason::Running);
    assert_eq!((plan.status.workers[0].crashes, plan.status.failure), (4, None));
    let mut late = world.clone();
    world.see_alone(ended("agent-1", 3, "idle", 1, 100));
    let plan = world.pass_to(Running, Reason::Stopping);
    assert_eq!(plan.status.failure.unwrap().reason, Reason::Idle);

    // The Pod is gone with it: that it crashed is all that will ever be known.
    late.view.pod = None;
    late.job().end = Some(JobEnd::Failed {
        at: None,
        reason: "BackoffLimitExceeded".into(),
        message: "no more".into(),
    });
    late.view.report.stored = ObservedReport::Absent;
    let failure = late.pass_to(Failed, Reason::AgentCrashed).status.failure;
    assert_eq!(failure.unwrap().class, Participant);
}

#[test]
fn an_agent_that_claims_to_have_been_stopped_is_charged_and_ends_with_one_job() {
    let mut world = World::local().running();
    for round in 0..3 {
        let second = 20 + i64::from(round) * 20;
        world.see_alone(restarted("simulator-1", round + 1, "peerCrashed", 1, second));
        world.see_alone(restarted("agent-1", round + 1, "stopped", 143, second));
        world.go_to(second);
        world.pass_to(Running, Reason::Running);
    }
    world.see_alone(ended("simulator-1", 3, "peerCrashed", 1, 80));
    world.see_alone(ended("agent-1", 3, "stopped", 143, 80));
    world.go_to(81);
    world.pass_to(Running, Reason::Stopping);
    // The stop itself ends the simulator from outside.
    world.see_alone(ended("simulator-1", 4, "stopped", 143, 90));
    world.complete();
    let status = world.pass_to(Failed, Reason::AgentCrashed).status;
    let failure = status.failure.unwrap();
    assert_eq!((failure.class, status.retry), (Participant, 0));
}

#[test]
fn an_agent_puts_its_end_off_no_longer_by_failing_again_before_its_simulators_word() {
    let mut world = World::local().running();
    world.see_alone(ended("agent-1", 3, "silentDeath", 137, 100));
    world.go_to(101);
    world.pass_to(Running, Reason::Running);
    world.see_alone(ended("agent-1", 4, "silentDeath", 137, 150));
    world.go_to(151);
    let failure = world.pass_to(Running, Reason::Stopping).status.failure.unwrap();
    assert_eq!(failure.reason, Reason::AgentCrashed);
}

#[test]
fn ends_on_command_are_no_crashes() {
    let mut world = World::local().running();
    world.report(report(1));
    for what in ["stopped", "cancelled"] {
        world.see(ended("agent-1", 0, what, 143, 100));
        let plan = world.pass_to(Running, Reason::Running);
        assert_eq!(plan.status.workers.len(), 2);
        assert!(plan.status.workers.iter().all(|p| p.crashes == 0 && p.last.is_none()));
    }
}

/// The first simulator of a Pod ended like this before any agent began.
fn see_without_graphics(world: &mut World, what: &str) {
    world.view.pod = Some(pod(0));
    world.pod().logcopy_running = true;
    world.see_alone(running("logcopy"));
    world.see_alone(ended("simulator-1", 0, what, 69, 5));
}

#[test]
fn a_simulator_without_a_gpu_ends_its_job_at_once_and_its_node_is_remembered() {
    let mut world = World::local().with_job();
    see_without_graphics(&mut world, "noGpu");
    for jobs in [1, 2] {
        let plan = world.pass_to(Pending, Reason::Stopping);
        assert!(has(&plan, |a| matches!(a, Action::DeleteJob { .. })));
        let failure = plan.status.failure.unwrap();
        assert_eq!(
            (failure.reason.known().unwrap(), failure.class),
            (Reason::NoGPU, Infrastructure)
        );
        let begin = "Pair 1 lacks a GPU on node node-a, although the Leaderboard gives it one: ";
        assert!(failure.message.starts_with(begin), "{}", failure.message);
        assert_eq!(failure.worker, Some(1));
        world.complete();
        let plan = world.pass_to(Pending, Reason::Replacing);
        let node_name = "node-a".into();
        assert_eq!(plan.status.failed_nodes, [FailedNode { node_name, jobs }]);
        world.job_gone();
        world.wait(60);
        assert!(creates(&world.pass()));
        world.see_job();
        world.view.report.stored = ObservedReport::NotRead;
        see_without_graphics(&mut world, "noGpu");
    }
    world.pass_to(Pending, Reason::Stopping);
    world.complete();
    let failure = world.pass_to(Failed, Reason::NoGPU).status.failure.unwrap();
    assert!(
        failure.class == Infrastructure && failure.message.contains("Look at the node"),
        "{}",
        failure.message
    );
    assert!(!failure.participant_message.unwrap().contains("node-a"));
}

#[test]
fn a_node_whose_driver_cannot_draw_is_no_reason_for_another_job() {
    let mut world = World::local().with_job();
    see_without_graphics(&mut world, "graphicsDriverMissing");
    world.pass_to(Pending, Reason::Stopping);
    world.complete();
    let failure = world
        .pass_to(Failed, Reason::GraphicsDriverMissing)
        .status
        .failure
        .unwrap();
    assert_eq!(failure.class, Infrastructure);
    let begin = "The simulator of pair 1 had a GPU and could not draw: the NVIDIA driver of node node-a has no Vulkan/OpenGL part (nvidia_icd.json). \
                 Use a node image";
    assert!(failure.message.starts_with(begin), "{}", failure.message);
}

#[test]
fn of_nodes_that_have_failed_the_newest_are_remembered() {
    let mut nodes = Vec::new();
    for node in 0..=MAX_FAILED_NODES {
        end::note_failed_node(&mut nodes, format!("node-{node}"), 1);
    }
    end::note_failed_node(&mut nodes, "node-1".into(), 1);
    let found: Vec<(&str, i32)> = nodes.iter().map(|node| (node.node_name.as_str(), node.jobs)).collect();
    assert_eq!((found.len(), found[0]), (MAX_FAILED_NODES, ("node-1", 2)));
}

/// Pair 1 of a running Pod whose agent the kubelet cannot start again.
fn see_start_error(world: &mut World, restarts: i32, why: &str) {
    let mut agent = ended("agent-1", restarts, "", 128, 100);
    let end = agent.last.as_mut().unwrap();
    (end.reason, end.why, end.verdict) = ("StartError".into(), Some(why.into()), None);
    world.see_alone(agent);
    world.see_alone(ended("simulator-1", restarts, "peerCrashed", 1, 100));
}

#[test]
fn an_agent_that_its_node_cannot_start_is_tried_again_there_and_then_by_another_job() {
    let mut world = World::local().running();
    let why = "runc create failed: pipe2: too many open files in system: unknown";
    see_start_error(&mut world, 2, why);
    world.pass_to(Running, Reason::NodeCannotStart);
    see_start_error(&mut world, 3, why);
    world.pass_to(Running, Reason::Stopping);
    world.complete();
    let plan = world.pass_to(Pending, Reason::Replacing);
    let begin = "The container of agent 1 could not be started 4 times on node node-a;";
    assert!(plan.status.message.unwrap().starts_with(begin));
    let node_name = "node-a".into();
    assert_eq!(plan.status.failed_nodes, [FailedNode { node_name, jobs: 1 }]);
}

#[test]
fn an_agent_whose_image_lacks_its_program_fails_at_once() {
    let mut world = World::local().running();
    see_start_error(
        &mut world,
        0,
        "unable to start container process: exec: \"/nope\": stat /nope: no such file or directory: unknown",
    );
    let failure = world.pass_to(Running, Reason::Stopping).status.failure.unwrap();
    assert_eq!(
        (failure.reason.known().unwrap(), failure.class),
        (Reason::CannotStart, Participant)
    );
}
