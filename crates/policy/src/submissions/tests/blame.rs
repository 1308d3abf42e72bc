//! The table of blame: a row for each case.

use super::builders::*;
use crate::submissions::blame::last_crash;
use crate::view::ContainerView;
use leaderboard_api::EndReason;
use leaderboard_protocol::files::Host;

pub(super) struct Row {
    what: &'static str,
    simulator: Option<ContainerView>,
    agent: Option<ContainerView>,
    expected: Expected,
}

#[derive(Debug, PartialEq)]
pub(super) enum Expected {
    Settled(EndReason),
    /// It is settled only 120 s after the end.
    Awaited(EndReason),
    NoCrash,
}

use Expected::{Awaited, NoCrash, Settled};

pub(super) fn row(what: &'static str, simulator: ContainerView, agent: ContainerView, expected: Expected) -> Row {
    Row {
        what,
        simulator: Some(simulator),
        agent: Some(agent),
        expected,
    }
}

/// Both sides ended in round 2, at the same second.
fn both(what: &'static str, simulator: &str, agent: &str, cause: EndReason) -> Row {
    let simulator = ended("simulator-1", 2, simulator, 1, 100);
    row(what, simulator, ended("agent-1", 2, agent, 1, 100), Settled(cause))
}

pub(super) fn without_verdict(mut container: ContainerView, reason: &str, exit_code: i32) -> ContainerView {
    let end = container.last.as_mut().unwrap();
    (end.verdict, end.exit_code) = (None, exit_code);
    reason.clone_into(&mut end.reason);
    container
}

/// An agent that claims another round than the one it ended in.
fn claims(round: Option<u32>, mut agent: ContainerView) -> ContainerView {
    agent.last.as_mut().unwrap().verdict.as_mut().unwrap().round = round;
    agent
}

/// This container with a life that began at this second.
pub(super) fn since(second: i64, mut container: ContainerView) -> ContainerView {
    container.last.as_mut().unwrap().began = Some(at(second));
    container
}

pub(super) fn check(rows: Vec<Row>) {
    check_of(Host::Simulator, rows);
}

pub(super) fn check_of(kind: Host, rows: Vec<Row>) {
    for row in rows {
        let judge = |second| last_crash(kind, row.simulator.as_ref(), row.agent.as_ref(), at(second));
        let found = match judge(120) {
            None => NoCrash,
            Some(crash) if crash.is_settled => Settled(crash.cause),
            Some(crash) => {
                assert!(judge(220).unwrap().is_settled, "{}", row.what);
                Awaited(crash.cause)
            }
        };
        assert_eq!(found, row.expected, "{}", row.what);
    }
}

#[test]
fn a_simulator_that_failed_in_the_round_is_the_cause_whatever_the_agent_reports() {
    use EndReason::{GraphicsDriverMissing, NoGPU, SimulatorCrashed, SimulatorNotReady, SimulatorSilent};
    check(vec![
        both("no GPU", "noGpu", "peerCrashed", NoGPU),
        both(
            "nothing to draw with",
            "graphicsDriverMissing",
            "exited",
            GraphicsDriverMissing,
        ),
        Row {
            what: "no GPU, and the agent's image is still pulled",
            simulator: Some(ended("simulator-1", 1, "noGpu", 69, 100)),
            agent: None,
            expected: Settled(NoGPU),
        },
        both("exited", "exited", "peerCrashed", SimulatorCrashed),
        both("the agent noticed first", "exited", "exited", SimulatorCrashed),
        both("killed", "killed", "exited", SimulatorCrashed),
        both("could not start", "cannotStart", "peerCrashed", SimulatorCrashed),
        both("killed with its runner", "silentDeath", "peerCrashed", SimulatorCrashed),
        both("ended from outside", "stopped", "peerCrashed", SimulatorCrashed),
        both("not ready", "notReady", "notReady", SimulatorNotReady),
        both("silent while the agent idles", "serverSilent", "idle", SimulatorSilent),
        row(
            "it took the agent long to end",
            restarted("simulator-1", 3, "exited", 1, 80),
            ended("agent-1", 2, "exited", 1, 100),
            Settled(SimulatorCrashed),
        ),
        Row {
            what: "the agent waits on",
            simulator: Some(ended("simulator-1", 2, "exited", 1, 100)),
            agent: Some(running("agent-1")),
            expected: Settled(SimulatorCrashed),
        },
        row(
            "a later round than the agent's last",
            ended("simulator-1", 3, "exited", 1, 100),
            restarted("agent-1", 3, "exited", 1, 60),
            Settled(SimulatorCrashed),
        ),
    ]);
}

#[test]
fn an_agent_whose_simulator_followed_it_is_the_cause_by_its_own_report() {
    use EndReason::{BlamesHost, CannotStart, Exited, Idle, Incomplete, OutOfMemory, PortTaken, SilentDeath, Unseen};
    let killed = without_verdict(ended("agent-1", 2, "exited", 1, 100), "OOMKilled", 137);
    check(vec![
        both("exited", "peerCrashed", "exited", Exited),
        both("idle", "peerCrashed", "idle", Idle),
        both("ended without results", "peerCrashed", "incomplete", Incomplete),
        both("could not start", "peerCrashed", "cannotStart", CannotStart),
        both("killed with its runner", "peerCrashed", "silentDeath", SilentDeath),
        both("says done and crashes", "finished", "exited", Exited),
        both("blames its simulator", "peerCrashed", "notReady", BlamesHost),
        both("blames its node", "peerCrashed", "noGpu", BlamesHost),
        both("each blames the other", "peerCrashed", "peerCrashed", BlamesHost),
        both("took a port", "portTaken", "peerCrashed", PortTaken),
        row(
            "was killed for lack of memory",
            ended("simulator-1", 2, "peerCrashed", 1, 100),
            killed,
            Settled(OutOfMemory),
        ),
        row(
            "forges a verdict without a round",
            ended("simulator-1", 2, "peerCrashed", 1, 100),
            claims(None, ended("agent-1", 2, "notReady", 1, 100)),
            Settled(BlamesHost),
        ),
        row(
            "its own end is not seen yet",
            ended("simulator-1", 2, "peerCrashed", 1, 100),
            restarted("agent-1", 2, "exited", 1, 40),
            Awaited(Unseen),
        ),
    ]);
}

#[test]
fn an_agent_that_claims_to_have_been_asked_to_end_is_the_cause_unless_its_simulator_was_ended_too() {
    use EndReason::{EndedFromOutside, Killed, SimulatorCrashed};
    let followed = || ended("simulator-1", 2, "peerCrashed", 1, 100);
    let claim = |what| ended("agent-1", 2, what, 143, 100);
    let again = |what| restarted("agent-1", 3, what, 143, 100);
    let mut paused = claim("stopped");
    paused.waiting = Some(("CrashLoopBackOff".into(), String::new()));
    let outside = |mut simulator: ContainerView| {
        simulator.running = true;
        simulator
    };
    check(vec![
        row(
            "its simulator followed it",
            followed(),
            claim("stopped"),
            Settled(Killed),
        ),
        row("and it runs again", followed(), again("stopped"), Settled(Killed)),
        row("it says cancelled", followed(), claim("cancelled"), Settled(Killed)),
        row("it says finished", followed(), claim("finished"), Settled(Killed)),
        row(
            "it claims no round",
            followed(),
            claims(None, claim("stopped")),
            Settled(Killed),
        ),
        row(
            "it runs again alone",
            running("simulator-1"),
            again("stopped"),
            Awaited(Killed),
        ),
        row(
            "it is started again soon",
            running("simulator-1"),
            paused,
            Awaited(Killed),
        ),
        row(
            "its simulator failed",
            ended("simulator-1", 2, "exited", 1, 100),
            again("stopped"),
            Settled(SimulatorCrashed),
        ),
        row(
            "its Pod is being ended",
            running("simulator-1"),
            claim("stopped"),
            NoCrash,
        ),
        row(
            "its node was started again, and with it both sides",
            outside(ended("simulator-1", 2, "stopped", 143, 100)),
            again("stopped"),
            Settled(EndedFromOutside),
        ),
    ]);
}

#[test]
fn a_simulator_that_the_kubelet_could_not_start_is_the_cause() {
    use EndReason::{SimulatorCrashed, SimulatorNotStarted};
    let agent = || ended("agent-1", 0, "notReady", 1, 100);
    let start_error = without_verdict(ended("simulator-1", 1, "", 1, 100), "StartError", 128);
    let mut pulling = ended("simulator-1", 1, "peerCrashed", 1, 40);
    pulling.waiting = Some(("ImagePullBackOff".into(), String::new()));
    let mut out_of_memory = without_verdict(ended("simulator-1", 1, "", 1, 100), "OOMKilled", 137);
    out_of_memory.last.as_mut().unwrap().at = Some(at(100));
    check(vec![
        row(
            "it never ran",
            waiting("simulator-1", "ErrImagePull", "no such image"),
            agent(),
            Settled(SimulatorNotStarted),
        ),
        row(
            "its program is missing",
            start_error,
            agent(),
            Settled(SimulatorNotStarted),
        ),
        row(
            "its image is gone at the restart",
            pulling,
            since(50, ended("agent-1", 2, "notReady", 1, 100)),
            Settled(SimulatorNotStarted),
        ),
        row(
            "it was killed without a verdict",
            out_of_memory,
            agent(),
            Settled(SimulatorCrashed),
        ),
    ]);
}

#[test]
fn an_agent_that_the_kubelet_cannot_start_is_its_images_only_by_the_kubelets_words() {
    use EndReason::{NodeCannotStart, StartError};
    let start_error = |why: Option<&str>| {
        let mut agent = without_verdict(ended("agent-1", 2, "", 1, 100), "StartError", 128);
        agent.last.as_mut().unwrap().why = why.map(str::to_owned);
        agent
    };
    let followed = || ended("simulator-1", 2, "peerCrashed", 1, 100);
    let no_user = "unable to start container process: unable to find user carla: no matching entries in passwd file";
    check(vec![
        row(
            "no such user",
            followed(),
            start_error(Some(no_user)),
            Settled(StartError),
        ),
        row(
            "a full node",
            followed(),
            start_error(Some("too many open files in system")),
            Settled(NodeCannotStart),
        ),
        row("no words", followed(), start_error(None), Settled(NodeCannotStart)),
    ]);
}

#[test]
fn an_agent_that_ends_alone_is_the_cause_after_a_while() {
    use EndReason::{BlamesHost, CannotStart, Exited, SilentDeath};
    let round_2 = || restarted("simulator-1", 2, "peerCrashed", 1, 40);
    let later = |what| since(50, ended("agent-1", 2, what, 1, 100));
    let mut paused = ended("simulator-1", 2, "peerCrashed", 1, 40);
    paused.waiting = Some(("CrashLoopBackOff".into(), String::new()));
    let not_started = without_verdict(restarted("simulator-1", 1, "", 1, 30), "StartError", 128);
    check(vec![
        row(
            "exited",
            running("simulator-1"),
            ended("agent-1", 0, "exited", 1, 100),
            Awaited(Exited),
        ),
        row(
            "its runner can write no status file",
            running("simulator-1"),
            ended("agent-1", 0, "cannotStart", 74, 100),
            Awaited(CannotStart),
        ),
        row("killed", round_2(), later("silentDeath"), Awaited(SilentDeath)),
        row(
            "blames its simulator",
            round_2(),
            later("notReady"),
            Awaited(BlamesHost),
        ),
        row(
            "claims a later round",
            paused,
            claims(Some(9), later("notReady")),
            Awaited(BlamesHost),
        ),
        // The kubelet knows better: its simulator failed before this life of the agent began.
        row(
            "claims the round in which its simulator failed",
            restarted("simulator-1", 2, "exited", 1, 40),
            claims(Some(1), later("peerCrashed")),
            Awaited(BlamesHost),
        ),
        row(
            "its simulator was started at the second try, long before",
            not_started,
            since(10, ended("agent-1", 0, "exited", 1, 100)),
            Awaited(Exited),
        ),
        row(
            "its simulator's Pod is being ended",
            ended("simulator-1", 3, "stopped", 143, 100),
            since(20, ended("agent-1", 2, "exited", 1, 60)),
            Awaited(Exited),
        ),
    ]);
}

#[test]
fn ends_that_were_asked_for_are_no_crashes() {
    check(vec![
        row(
            "stopped",
            ended("simulator-1", 0, "stopped", 143, 100),
            ended("agent-1", 0, "stopped", 143, 100),
            NoCrash,
        ),
        row(
            "cancelled",
            ended("simulator-1", 0, "cancelled", 0, 100),
            ended("agent-1", 0, "cancelled", 0, 100),
            NoCrash,
        ),
        row(
            "done",
            ended("simulator-1", 0, "finished", 0, 100),
            ended("agent-1", 0, "incomplete", 0, 100),
            NoCrash,
        ),
        row("both run", running("simulator-1"), running("agent-1"), NoCrash),
        Row {
            what: "neither is known: the Pod or its node is lost",
            simulator: None,
            agent: None,
            expected: NoCrash,
        },
    ]);
}
