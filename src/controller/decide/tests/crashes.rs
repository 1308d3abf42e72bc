//! Crashes of a pair: whose they are, how many are forgiven.

use super::builders::*;
use crate::controller::view::{JobEnd, ReportSight};
use crate::pod::run::Stop;
use leaderboard_api::FailureClass::{Infrastructure, Participant};
use leaderboard_api::State::{Failed, Finished, Running};
use leaderboard_api::reasons;

/// How often each side of pair 1 ends how, and what comes of it.
#[test]
fn a_pair_that_always_fails_ends_the_run_by_its_cause() {
    let cases = [
        (
            "agent crashes",
            Some("exited"),
            Some("peerCrashed"),
            reasons::AGENT_CRASHED,
            Participant,
        ),
        (
            "agent is killed",
            Some("silentDeath"),
            None,
            reasons::AGENT_CRASHED,
            Participant,
        ),
        (
            "agent ends without results",
            Some("incomplete"),
            Some("peerCrashed"),
            reasons::INVALID_RESULTS,
            Participant,
        ),
        (
            "agent is idle",
            Some("idle"),
            Some("peerCrashed"),
            reasons::IDLE,
            Participant,
        ),
        (
            "agent cannot start",
            Some("cannotStart"),
            Some("peerCrashed"),
            reasons::CANNOT_START,
            Participant,
        ),
        (
            "simulator crashes",
            Some("peerCrashed"),
            Some("exited"),
            reasons::SIMULATION_CRASHED,
            Infrastructure,
        ),
        (
            "and the agent with it",
            Some("exited"),
            Some("killed"),
            reasons::SIMULATION_CRASHED,
            Infrastructure,
        ),
        (
            "agent says that it crashed, and runs on",
            Some("peerCrashed"),
            Some("peerCrashed"),
            reasons::AGENT_CRASHED,
            Participant,
        ),
        (
            "simulator cannot start",
            None,
            Some("cannotStart"),
            reasons::SIMULATION_CRASHED,
            Infrastructure,
        ),
        (
            "simulator is late",
            Some("notReady"),
            Some("notReady"),
            reasons::SIMULATION_CRASHED,
            Infrastructure,
        ),
    ];
    for (what, agent, simulator, reason, class) in cases {
        let mut world = World::local().running();
        for (name, word) in [("agent-1", agent), ("simulator-1", simulator)] {
            if let Some(word) = word {
                world.see(ended(name, 3, word, 1, 100));
            }
        }
        let plan = world.pass_to(Running, reasons::STOPPING);
        let failure = plan.status.failure.clone().unwrap();
        assert_eq!((failure.reason.as_str(), failure.class), (reason, class), "{what}");
        assert_eq!(annotated(&plan), Some(Stop::Retries), "{what}");
        assert_eq!(
            plan.status.pairs[0].crashes, 4,
            "{what}: the end that is not restarted yet counts"
        );
    }
}

#[test]
fn fewer_crashes_than_allowed_are_forgiven() {
    let mut world = World::local().running();
    world.see(ended("agent-1", 2, "exited", 1, 100));
    let plan = world.pass_to(Running, reasons::RUNNING);
    assert_eq!(plan.status.pairs[0].crashes, 3);
    world.report(final_report());
    world.complete();
    world.report(final_report());
    world.pass_to(Finished, reasons::FINISHED);
}

#[test]
fn memory_is_the_cause_only_of_the_agents_own_end() {
    let oom = |what: &str, name: &str| {
        let mut container = ended(name, 3, what, 137, 100);
        container.last.as_mut().unwrap().reason = "OOMKilled".into();
        container
    };
    let cases = [
        ("agent-1", "", reasons::OUT_OF_MEMORY),
        ("agent-1", "silentDeath", reasons::OUT_OF_MEMORY),
        ("agent-1", "killed", reasons::OUT_OF_MEMORY),
        ("agent-1", "idle", reasons::IDLE),
        ("simulator-1", "killed", reasons::SIMULATION_CRASHED),
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
    let mut agent = ended("agent-1", 2, "exited", 1, 100);
    agent.running = true;
    world.see(agent);
    world.see(ended("simulator-1", 3, "exited", 1, 900));
    let failure = world.pass().status.failure.unwrap();
    assert_eq!(failure.reason, reasons::SIMULATION_CRASHED);
}

#[test]
fn a_simulators_crash_of_an_earlier_round_does_not_excuse_the_agent() {
    let mut world = World::local().running();
    let mut simulator = ended("simulator-1", 1, "exited", 1, 100);
    simulator.running = true;
    world.see(simulator);
    world.see(ended("agent-1", 3, "exited", 1, 900));
    let failure = world.pass().status.failure.unwrap();
    assert_eq!(failure.reason, reasons::AGENT_CRASHED);
}

#[test]
fn ends_of_different_rounds_explain_nothing_of_each_other() {
    for (agent, simulator, reason) in [
        (("exited", 900), ("exited", 100), reasons::AGENT_CRASHED),
        (("exited", 140), ("exited", 100), reasons::SIMULATION_CRASHED),
        (("exited", 160), ("exited", 100), reasons::AGENT_CRASHED),
    ] {
        let mut world = World::local().running();
        world.see(ended("agent-1", 3, agent.0, 1, agent.1));
        world.see(ended("simulator-1", 3, simulator.0, 1, simulator.1));
        let failure = world.pass().status.failure.unwrap();
        assert_eq!(failure.reason, reason, "{agent:?} {simulator:?}");
    }
    // The agent waited for its simulator and then ran for hours, in one life.
    let mut world = World::local().running();
    let mut booted = ended("simulator-1", 3, "exited", 1, 100);
    booted.running = true;
    world.see(booted);
    let mut agent = ended("agent-1", 3, "exited", 1, 9000);
    agent.last.as_mut().unwrap().began = Some(at(60));
    world.see(agent);
    assert_eq!(world.pass().status.failure.unwrap().reason, reasons::AGENT_CRASHED);
}

/// Its simulator, which obeys at once, may run again before the agent has ended.
#[test]
fn a_forger_that_takes_its_time_to_end_is_found_out_all_the_same() {
    let mut simulator = ended("simulator-1", 4, "peerCrashed", 1, 80);
    simulator.running = true;
    let mut world = World::local().running();
    world.see(simulator);
    world.see(ended("agent-1", 3, "peerCrashed", 1, 100));
    let failure = world.pass_to(Running, reasons::STOPPING).status.failure.unwrap();
    assert_eq!(
        (failure.reason.as_str(), failure.charged),
        (reasons::AGENT_CRASHED, true)
    );
}

/// The kubelet waits for minutes before it starts a container again that has been killed often.
#[test]
fn a_simulator_that_was_killed_without_a_word_long_before_its_agent_noticed_is_the_cause() {
    let mut world = World::local().running();
    world.see(ended("simulator-1", 3, "silentDeath", 137, 100));
    let mut agent = ended("agent-1", 3, "peerCrashed", 1, 400);
    agent.last.as_mut().unwrap().began = Some(at(60));
    world.see(agent);
    let failure = world.pass_to(Running, reasons::STOPPING).status.failure.unwrap();
    assert_eq!(failure.reason, reasons::SIMULATION_CRASHED);
}

#[test]
fn an_end_of_an_earlier_round_is_not_the_word_that_is_waited_for() {
    let mut agent = ended("agent-1", 3, "peerCrashed", 1, 100);
    agent.running = true;
    let mut world = World::local().running();
    world.see(agent);
    world.see(ended("simulator-1", 3, "peerCrashed", 1, 400));
    world.go_to(401);
    let plan = world.pass_to(Running, reasons::RUNNING);
    assert_eq!((plan.status.pairs[0].crashes, plan.status.failure), (4, None));
    world.see(ended("agent-1", 3, "idle", 1, 401));
    let failure = world.pass_to(Running, reasons::STOPPING).status.failure.unwrap();
    assert_eq!(failure.reason, reasons::IDLE);
}

#[test]
fn a_word_that_has_not_come_until_the_next_crash_is_waited_for_no_longer() {
    let mut world = World::local().running();
    for (restarts, second, reason) in [(3, 100, reasons::RUNNING), (4, 130, reasons::STOPPING)] {
        world.see(ended("simulator-1", restarts, "stopped", 143, second));
        world.see(ended("agent-1", restarts, "peerCrashed", 1, second));
        world.go_to(second + 1);
        world.pass_to(Running, reason);
    }
    assert_eq!(world.status().failure.unwrap().reason, reasons::SIMULATION_CRASHED);
}

#[test]
fn an_agent_that_followed_its_simulator_waits_for_the_simulators_own_word() {
    let mut old = ended("simulator-1", 2, "peerCrashed", 1, 60);
    old.running = true;
    let mut world = World::local().running();
    world.see(old);
    world.see(ended("agent-1", 3, "peerCrashed", 1, 100));
    let plan = world.pass_to(Running, reasons::RUNNING);
    assert_eq!((plan.status.pairs[0].crashes, plan.status.failure), (4, None));
    let mut silent = world.clone();
    world.see(ended("simulator-1", 3, "exited", 1, 100));
    let failure = world.pass_to(Running, reasons::STOPPING).status.failure.unwrap();
    assert_eq!(failure.reason, reasons::SIMULATION_CRASHED);

    // It never comes: somebody from outside ends the simulator each time.
    let mut stopped = silent.clone();
    stopped.see(ended("simulator-1", 3, "stopped", 143, 100));
    stopped.go_to(219);
    stopped.pass_to(Running, reasons::RUNNING);
    stopped.go_to(220);
    let failure = stopped.pass_to(Running, reasons::STOPPING).status.failure.unwrap();
    assert_eq!(failure.reason, reasons::SIMULATION_CRASHED);

    // Or the Pod has gone with it.
    silent.view.pod = None;
    silent.leaderboard().retries.infrastructure = 0;
    silent.job().end = Some(JobEnd::Failed {
        at: None,
        reason: "BackoffLimitExceeded".into(),
        message: "no more".into(),
    });
    silent.view.report = ReportSight::Absent;
    silent.pass_to(Failed, reasons::SIMULATION_CRASHED);
}

#[test]
fn a_count_without_a_cause_waits_for_it() {
    let mut world = World::local().running();
    let mut told = report(1);
    told.pairs[0].crashes = 4;
    world.report(told);
    assert_eq!(world.pass_to(Running, reasons::RUNNING).status.failure, None);
    world.see(ended("agent-1", 3, "exited", 1, 100));
    world.pass_to(Running, reasons::STOPPING);
}

#[test]
fn a_crash_that_only_the_simulator_has_told_of_waits_for_the_agents_own_word() {
    let mut world = World::local().running();
    world.see(ended("simulator-1", 3, "peerCrashed", 1, 100));
    let plan = world.pass_to(Running, reasons::RUNNING);
    assert_eq!((plan.status.pairs[0].crashes, plan.status.failure), (4, None));
    let mut late = world.clone();
    world.see(ended("agent-1", 3, "idle", 1, 100));
    let plan = world.pass_to(Running, reasons::STOPPING);
    assert_eq!(plan.status.failure.unwrap().reason, reasons::IDLE);

    // The Pod is gone with it: that it crashed is all that will ever be known.
    late.view.pod = None;
    late.job().end = Some(JobEnd::Failed {
        at: None,
        reason: "BackoffLimitExceeded".into(),
        message: "no more".into(),
    });
    late.view.report = ReportSight::Absent;
    let failure = late.pass_to(Failed, reasons::AGENT_CRASHED).status.failure;
    assert_eq!(failure.unwrap().class, Participant);
}

#[test]
fn ends_on_command_are_no_crashes() {
    let mut world = World::local().running();
    world.report(report(1));
    for what in ["stopped", "cancelled"] {
        world.see(ended("agent-1", 0, what, 143, 100));
        let plan = world.pass_to(Running, reasons::RUNNING);
        assert_eq!(plan.status.pairs.len(), 2);
        assert!(plan.status.pairs.iter().all(|p| p.crashes == 0 && p.last.is_none()));
    }
}
