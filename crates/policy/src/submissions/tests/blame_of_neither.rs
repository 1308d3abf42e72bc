//! The table of blame, where neither side is the cause: rows for nodes, sandboxes and Pods that lack processes.

use super::blame::Expected::{Awaited, NoCrash, Settled};
use super::blame::{check, row, since, without_verdict};
use super::builders::*;
use crate::view::ContainerView;
use leaderboard_api::EndReason;

#[test]
fn what_ends_both_sides_at_once_is_no_crash_of_either() {
    use EndReason::{EndedFromOutside, SimulatorCrashed};
    let killed = |name: &str, code| restarted(name, 3, "silentDeath", code, 100);
    let lost = |name: &str| without_verdict(restarted(name, 3, "", 255, 100), "Unknown", 255);
    let for_memory = |mut container: ContainerView| {
        container.last.as_mut().unwrap().reason = "OOMKilled".into();
        container
    };
    check(vec![
        row(
            "killed with their sandbox",
            killed("simulator-1", 137),
            killed("agent-1", 137),
            Settled(EndedFromOutside),
        ),
        row(
            "lost from the engine's sight",
            lost("simulator-1"),
            lost("agent-1"),
            Settled(EndedFromOutside),
        ),
        row(
            "one was asked to end, and the other killed",
            restarted("simulator-1", 3, "stopped", 143, 100),
            killed("agent-1", 137),
            Settled(EndedFromOutside),
        ),
        row(
            "the agent killed itself, and its simulator followed",
            restarted("simulator-1", 3, "peerCrashed", 1, 100),
            killed("agent-1", 137),
            Settled(EndReason::SilentDeath),
        ),
        row(
            "the agent kills itself again, later",
            restarted("simulator-1", 3, "silentDeath", 137, 40),
            since(50, restarted("agent-1", 4, "silentDeath", 137, 100)),
            Awaited(EndReason::SilentDeath),
        ),
        row(
            "the simulator lacked memory",
            for_memory(killed("simulator-1", 137)),
            killed("agent-1", 137),
            Settled(SimulatorCrashed),
        ),
    ]);
}

#[test]
fn what_a_node_refuses_before_an_agents_command_runs_is_not_the_agents() {
    use EndReason::{CannotStart, NoProcess, NodeCannotStart};
    let followed = |restarts| ended("simulator-1", restarts, "peerCrashed", 1, 100);
    let by_itself = |restarts, code| ended("agent-1", restarts, "nodeRefused", code, 100);
    check(vec![
        row(
            "no file, no memory",
            followed(2),
            by_itself(2, 71),
            Settled(NodeCannotStart),
        ),
        row(
            "not even a file for its verdict",
            followed(2),
            without_verdict(by_itself(2, 71), "Error", 71),
            Settled(NodeCannotStart),
        ),
        row(
            "nor for its mark",
            running("simulator-1"),
            without_verdict(by_itself(0, 71), "Error", 71),
            Awaited(NodeCannotStart),
        ),
        row(
            "no process at all",
            followed(0),
            by_itself(0, 75),
            Settled(NodeCannotStart),
        ),
        row(
            "no process once agents run",
            followed(1),
            by_itself(1, 75),
            Settled(NoProcess),
        ),
        // The code is its runner's, the verdict can be its own.
        row(
            "it claims to have been refused",
            followed(2),
            ended("agent-1", 2, "nodeRefused", 1, 100),
            Settled(EndReason::Killed),
        ),
        row(
            "its image lacks the command",
            followed(2),
            ended("agent-1", 2, "cannotStart", 127, 100),
            Settled(CannotStart),
        ),
    ]);
}

/// The kubelet's words of a container for which there is no process.
fn without_process(container: ContainerView) -> ContainerView {
    let mut container = without_verdict(container, "StartError", 128);
    container.last.as_mut().unwrap().why =
        Some("failed to create containerd task: runc create failed: read init-p: connection reset by peer".into());
    container
}

#[test]
fn a_simulator_that_has_run_and_lacks_processes_is_waited_for() {
    use EndReason::{BlamesHost, NoProcess, SimulatorNotStarted};
    let kept_away = || {
        let mut simulator = without_process(ended("simulator-1", 2, "", 128, 60));
        simulator.waiting = Some(("CrashLoopBackOff".into(), "back-off 10s".into()));
        simulator
    };
    let mut refused = ended("simulator-1", 1, "peerCrashed", 1, 40);
    let words = "runc create failed: unable to start container process: Resource temporarily unavailable";
    refused.waiting = Some(("RunContainerError".into(), words.into()));
    let no_server = || ended("simulator-1", 1, "noProcess", 75, 60);
    let late = || since(50, ended("agent-1", 1, "notReady", 1, 100));
    check(vec![
        row("its agent waits", kept_away(), running("agent-1"), NoCrash),
        row("its agent gives up", kept_away(), late(), Awaited(BlamesHost)),
        row("the kubelet tries again", refused, late(), Awaited(BlamesHost)),
        row(
            "its runner starts no server",
            no_server(),
            running("agent-1"),
            Settled(NoProcess),
        ),
        row("and its agent gives up", no_server(), late(), Settled(NoProcess)),
        row(
            "its runner has never started one",
            ended("simulator-1", 0, "noProcess", 75, 60),
            running("agent-1"),
            Settled(EndReason::SimulatorCrashed),
        ),
        row(
            "neither can be started again",
            kept_away(),
            without_process(since(50, ended("agent-1", 1, "", 128, 100))),
            Awaited(NoProcess),
        ),
        row(
            "it has not run yet",
            without_process(ended("simulator-1", 0, "", 128, 60)),
            ended("agent-1", 0, "notReady", 1, 100),
            Settled(SimulatorNotStarted),
        ),
    ]);
}
