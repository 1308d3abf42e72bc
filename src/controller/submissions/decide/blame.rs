//! Whose fault the last crash of a pair was: one table over both containers. Pure.
//!
//! Called by `crashes`. The simulator's container is the host's own, so its verdict, and what the kubelet reports of it, decide.
//! An agent's processes can replace or suppress the agent's verdict; it therefore only names the agent's fault more closely. Both
//! ends are matched by their round. Where the simulator's end of a round is missing, it is waited for, and then the agent is the
//! cause.

use jiff::Timestamp;

use crate::controller::submissions::view::{ContainerView, EndView};
use leaderboard_api::EndReason;
use leaderboard_runner::verdict::What;

/// How long the other side's end of a round is waited for. A runner ends within moments of its peer.
pub(super) const PEER_SECONDS: i64 = 120;

/// The last crash of a pair.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Crash {
    pub(super) cause: EndReason,
    pub(super) exit_code: i32,
    pub(super) at: Option<Timestamp>,
    /// Nothing that may still be seen changes it.
    pub(super) is_settled: bool,
}

/// The table. `None`: neither side has crashed; whether their Pod is lost is not judged here.
pub(super) fn last_crash(
    simulator: Option<&ContainerView>,
    agent: Option<&ContainerView>,
    now: Timestamp,
) -> Option<Crash> {
    let agent = agent.and_then(|container| {
        let end = container.last.as_ref()?;
        (is_crash(end) || is_false_claim(simulator, container, end)).then_some(end)
    });
    let own_end = simulator.and_then(|container| container.last.as_ref());
    // A simulator that was ended from outside explains its own round, and nothing else.
    let explains = |end: &&EndView| match what(end) {
        Some(What::Cancelled) => false,
        Some(What::Stopped) => agent.is_some_and(|agent| order(simulator, end, agent) == Order::SameRound),
        Some(What::Finished) => true,
        _ => end.exit_code != 0,
    };
    match (own_end.filter(explains), agent) {
        (None, None) => None,
        (Some(end), None) if what(end) == Some(What::Finished) => None,
        (Some(end), None) => Some(of_simulator_alone(end, now)),
        (None, Some(agent)) => Some(of_agent_alone(simulator, agent, now)),
        (Some(end), Some(agent)) => Some(match order(simulator, end, agent) {
            Order::SameRound => of_both(end, agent),
            Order::AgentIsLater => of_agent_alone(simulator, agent, now),
            Order::SimulatorIsLater => of_simulator_alone(end, now),
        }),
    }
}

/// Whether an end was a crash, and not one that was asked for.
pub(super) fn is_crash(end: &EndView) -> bool {
    let is_asked_for = matches!(what(end), Some(What::Stopped | What::Cancelled | What::Finished));
    end.exit_code != 0 && !is_asked_for
}

/// Whether an agent reports that it was asked to end, and it was not: its simulator had to end because of it, or the kubelet starts it
/// again, which it does in no Pod that is being ended. Where the simulator was ended from outside, too, the agent may be right.
fn is_false_claim(simulator: Option<&ContainerView>, agent: &ContainerView, end: &EndView) -> bool {
    if end.exit_code == 0 {
        return false;
    }
    let own_end = simulator.and_then(|container| container.last.as_ref());
    let goes_on = agent.running || agent.waiting.is_some();
    match own_end.map(|own| (own, what(own))) {
        Some((_, Some(What::Stopped | What::Cancelled))) => false,
        Some((own, Some(What::PeerCrashed))) => goes_on || order(simulator, own, end) == Order::SameRound,
        _ => goes_on,
    }
}

/// Whether a crash was a failure of the simulator itself, which it was not if its Pod was being ended.
pub(super) fn is_simulators_own(simulator: Option<&ContainerView>, crash: &Crash) -> bool {
    let was_ended = simulator.and_then(|container| what(container.last.as_ref()?)) == Some(What::Stopped);
    let is_its = matches!(
        crash.cause,
        EndReason::SimulatorCrashed
            | EndReason::SimulatorNotReady
            | EndReason::SimulatorSilent
            | EndReason::SimulatorNotStarted
    );
    is_its && !was_ended
}

fn what(end: &EndView) -> Option<What> {
    end.verdict.as_ref().map(|verdict| verdict.what)
}

/// Which of the two ends belongs to the later round.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Order {
    SameRound,
    AgentIsLater,
    SimulatorIsLater,
}

fn order(simulator: Option<&ContainerView>, end: &EndView, agent: &EndView) -> Order {
    // By the kubelet's times, whatever round the agent claims: a life that began after an end is of a later round.
    let began_after = agent.began.zip(end.at).is_some_and(|(began, at)| began > at);
    // A runner writes a verdict as soon as it begins, so this life never began, and the one that runs now is another.
    let is_replaced = end.verdict.is_none() && simulator.is_some_and(|container| container.running);
    if began_after || is_replaced {
        return Order::AgentIsLater;
    }
    let round = |end: &EndView| end.verdict.as_ref().and_then(|verdict| verdict.round);
    match round(end).zip(round(agent)) {
        Some((simulator, agent)) if agent > simulator => Order::AgentIsLater,
        Some((simulator, agent)) if agent < simulator => Order::SimulatorIsLater,
        // An agent without a round is of an older version, or has replaced its verdict.
        _ => Order::SameRound,
    }
}

fn of_both(simulator: &EndView, agent: &EndView) -> Crash {
    match what(simulator) {
        Some(What::PeerCrashed | What::Finished) => crash(of_agent(agent), agent),
        _ => crash(of_simulator(simulator), simulator),
    }
}

fn of_simulator_alone(end: &EndView, now: Timestamp) -> Crash {
    match what(end) {
        Some(What::PeerCrashed) => Crash {
            is_settled: !is_awaited(end, now),
            ..crash(EndReason::Unseen, end)
        },
        _ => crash(of_simulator(end), end),
    }
}

fn of_agent_alone(simulator: Option<&ContainerView>, agent: &EndView, now: Timestamp) -> Crash {
    if simulator.is_none_or(cannot_be_started) {
        return crash(EndReason::SimulatorNotStarted, agent);
    }
    Crash {
        is_settled: !is_awaited(agent, now),
        ..crash(of_agent(agent), agent)
    }
}

/// Whether the kubelet cannot start it. The pause after a crash is none: its last end counts then.
fn cannot_be_started(simulator: &ContainerView) -> bool {
    let is_refused = |(reason, _): &(String, String)| reason != "CrashLoopBackOff";
    let never_ran = simulator.last.is_none() && simulator.restarts == 0;
    !simulator.running && (never_ran || simulator.waiting.as_ref().is_some_and(is_refused))
}

/// Whether the other side's end may still be seen. A clock that was set back does not prolong this.
fn is_awaited(end: &EndView, now: Timestamp) -> bool {
    end.at
        .is_some_and(|at| now.duration_since(at).as_secs().abs() < PEER_SECONDS)
}

fn crash(cause: EndReason, end: &EndView) -> Crash {
    Crash {
        cause,
        exit_code: end.exit_code,
        at: end.at,
        is_settled: true,
    }
}

fn of_simulator(end: &EndView) -> EndReason {
    match what(end) {
        Some(What::NotReady) => EndReason::SimulatorNotReady,
        Some(What::ServerSilent) => EndReason::SimulatorSilent,
        Some(What::PortTaken) => EndReason::PortTaken,
        Some(What::NoGpu) => EndReason::NoGPU,
        Some(What::GraphicsDriverMissing) => EndReason::GraphicsDriverMissing,
        None if end.is_start_error() => EndReason::SimulatorNotStarted,
        _ => EndReason::SimulatorCrashed,
    }
}

/// What the agent's own end shows; all of it is the agent's fault.
fn of_agent(end: &EndView) -> EndReason {
    let exit_code = end.verdict.as_ref().and_then(|verdict| verdict.exit_code);
    match what(end) {
        Some(
            What::PeerCrashed
            | What::NotReady
            | What::ServerSilent
            | What::PortTaken
            | What::NoGpu
            | What::GraphicsDriverMissing,
        ) => EndReason::BlamesSimulator,
        Some(What::Idle) => EndReason::Idle,
        Some(What::CannotStart) => EndReason::CannotStart,
        _ if end.reason == "OOMKilled" => EndReason::OutOfMemory,
        Some(What::Exited) if exit_code == Some(0) => EndReason::Incomplete,
        Some(What::Exited) => EndReason::Exited,
        Some(What::SilentDeath) => EndReason::SilentDeath,
        None if end.is_start_error() => EndReason::StartError,
        _ => EndReason::Killed,
    }
}
