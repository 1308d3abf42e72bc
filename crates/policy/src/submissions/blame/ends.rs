//! One end of a container: its cause, and the round that it belongs to. Pure.

use jiff::Timestamp;

use crate::submissions::cause;
use crate::view::{ContainerView, EndView};
use leaderboard_api::EndReason;
use leaderboard_protocol::verdict::{CODE_NO_PROCESS, CODE_NODE_REFUSED, What};

/// Exit codes of a container that was ended with all others of its Pod, as by a sandbox that is made anew: killed, or lost from sight.
const FROM_OUTSIDE: [i32; 2] = [137, 255];

/// The kubelet's and the runtime's words where a container cannot be started for want of processes. A Pod has a number of them, and its
/// agents can use it up.
const OF_PROCESSES: [&str; 3] = [
    "resource temporarily unavailable",
    "connection reset by peer",
    "failed to create new os thread",
];

/// The last crash of a worker.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::submissions) struct Crash {
    pub(in crate::submissions) cause: EndReason,
    pub(in crate::submissions) exit_code: i32,
    pub(in crate::submissions) at: Option<Timestamp>,
    /// Nothing that may still be seen changes it.
    pub(in crate::submissions) is_settled: bool,
}

/// A cause of the table where the host's container is an evaluator, whose agent writes no results of its own.
pub(super) fn of_evaluator(cause: EndReason) -> EndReason {
    match cause {
        EndReason::SimulatorCrashed | EndReason::SimulatorSilent => EndReason::EvaluatorCrashed,
        EndReason::SimulatorNotReady => EndReason::EvaluatorNotReady,
        EndReason::SimulatorNotStarted => EndReason::EvaluatorNotStarted,
        EndReason::Incomplete => EndReason::Exited,
        cause => cause,
    }
}

/// The last end of a container, if that can have come from outside.
pub(super) fn end_from_outside(container: &ContainerView) -> Option<&EndView> {
    let end = container.last.as_ref()?;
    let goes_on = container.running || container.waiting.is_some();
    let is_it = match what(end) {
        // In a Pod that is being ended both are asked to end, and neither comes back.
        Some(What::Stopped) => goes_on,
        None | Some(What::SilentDeath) => is_killed_from_outside(end),
        _ => false,
    };
    (is_it && !end.is_start_error()).then_some(end)
}

pub(super) fn is_killed_from_outside(end: &EndView) -> bool {
    FROM_OUTSIDE.contains(&end.exit_code) && end.reason != "OOMKilled"
}

/// True if the kubelet could not start a host's container again that has run in this Pod, for want of processes. That is no failure of its own:
/// it is waited for, and an agent that ends meanwhile is the cause.
pub(super) fn lacked_processes(container: &ContainerView, end: &EndView) -> bool {
    !is_of_first_life(container) && is_start_without_process(end)
}

fn is_start_without_process(end: &EndView) -> bool {
    end.is_start_error() && end.why.as_deref().is_some_and(is_of_processes)
}

pub(super) fn is_of_processes(words: &str) -> bool {
    let words = words.to_lowercase();
    OF_PROCESSES.iter().any(|sign| words.contains(sign))
}

/// True if the last end of a container is that of its first life. The kubelet counts, so no agent changes it.
fn is_of_first_life(container: &ContainerView) -> bool {
    container.restarts <= i32::from(container.has_next_life())
}

/// True if an end was a crash, and not one that was asked for.
pub(in crate::submissions) fn is_crash(end: &EndView) -> bool {
    let is_asked_for = matches!(what(end), Some(What::Stopped | What::Cancelled | What::Finished));
    end.exit_code != 0 && !is_asked_for
}

/// True if an agent reports that it was asked to end, and it was not: its host had to end because of it, or the kubelet starts it
/// again, which it does in no Pod that is being ended. Where the host was ended from outside, too, the agent may be right.
pub(super) fn is_false_claim(host: Option<&ContainerView>, agent: &ContainerView, end: &EndView) -> bool {
    if end.exit_code == 0 {
        return false;
    }
    let own_end = host.and_then(|container| container.last.as_ref());
    let goes_on = agent.running || agent.waiting.is_some();
    match own_end.map(|own| (own, what(own))) {
        Some((_, Some(What::Stopped | What::Cancelled))) => false,
        Some((own, Some(What::PeerCrashed))) => goes_on || order(host, own, end) == Order::SameRound,
        _ => goes_on,
    }
}

pub(super) fn what(end: &EndView) -> Option<What> {
    end.verdict.as_ref().map(|verdict| verdict.what)
}

/// Which of the two ends belongs to the later round.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum Order {
    SameRound,
    AgentIsLater,
    HostIsLater,
}

pub(super) fn order(host: Option<&ContainerView>, end: &EndView, agent: &EndView) -> Order {
    // A runner writes a verdict as soon as it begins, so this life never began, and the one that runs now is another.
    let is_replaced = end.verdict.is_none() && host.is_some_and(|container| container.running);
    if is_replaced {
        return Order::AgentIsLater;
    }
    by_times_and_rounds(end, agent)
}

pub(super) fn by_times_and_rounds(end: &EndView, agent: &EndView) -> Order {
    // By the kubelet's times, whatever round the agent claims: a life that began after an end is of a later round.
    if agent.began.zip(end.at).is_some_and(|(began, at)| began > at) {
        return Order::AgentIsLater;
    }
    let round = |end: &EndView| end.verdict.as_ref().and_then(|verdict| verdict.round);
    match round(end).zip(round(agent)) {
        Some((host, agent)) if agent > host => Order::AgentIsLater,
        Some((host, agent)) if agent < host => Order::HostIsLater,
        // An agent without a round has replaced its verdict.
        _ => Order::SameRound,
    }
}

pub(super) fn crash(cause: EndReason, end: &EndView) -> Crash {
    Crash {
        cause,
        exit_code: end.exit_code,
        at: end.at,
        is_settled: true,
    }
}

pub(super) fn of_host(host: Option<&ContainerView>, end: &EndView) -> EndReason {
    let is_first = host.is_none_or(is_of_first_life);
    match what(end) {
        // The agents can use up the Pod's processes once they run.
        Some(What::NoProcess) if !is_first => EndReason::NoProcess,
        Some(What::NotReady | What::NoResult) => EndReason::SimulatorNotReady,
        Some(What::ServerSilent) => EndReason::SimulatorSilent,
        Some(What::PortTaken) => EndReason::PortTaken,
        Some(What::NoGpu) => EndReason::NoGPU,
        Some(What::GraphicsDriverMissing) => EndReason::GraphicsDriverMissing,
        None if end.is_start_error() => EndReason::SimulatorNotStarted,
        _ => EndReason::SimulatorCrashed,
    }
}

/// The cause that the agent's own end shows; all of it is the agent's fault, but what its node refused its runner before the agent's command ran. The
/// exit code is the runner's, which no process of the agent has. Processes alone the other agents of the Pod can use up, once they run.
pub(super) fn of_agent(container: &ContainerView, end: &EndView) -> EndReason {
    let is_first = is_of_first_life(container);
    match end.exit_code {
        CODE_NODE_REFUSED => return EndReason::NodeCannotStart,
        CODE_NO_PROCESS if is_first => return EndReason::NodeCannotStart,
        CODE_NO_PROCESS => return EndReason::NoProcess,
        _ if !is_first && is_start_without_process(end) => return EndReason::NoProcess,
        _ => {}
    }
    let exit_code = end.verdict.as_ref().and_then(|verdict| verdict.exit_code);
    match what(end) {
        Some(
            What::PeerCrashed
            | What::NotReady
            | What::NoResult
            | What::ServerSilent
            | What::PortTaken
            | What::NoGpu
            | What::GraphicsDriverMissing,
        ) => EndReason::BlamesHost,
        Some(What::Idle) => EndReason::Idle,
        Some(What::CannotStart) => EndReason::CannotStart,
        _ if end.reason == "OOMKilled" => EndReason::OutOfMemory,
        Some(What::Exited) if exit_code == Some(0) => EndReason::Incomplete,
        Some(What::Exited) => EndReason::Exited,
        Some(What::SilentDeath) => EndReason::SilentDeath,
        None if end.is_start_error() => of_start_error(end),
        _ => EndReason::Killed,
    }
}

fn of_start_error(end: &EndView) -> EndReason {
    if cause::of_start(end.why.as_deref().unwrap_or_default()).is_images() {
        EndReason::StartError
    } else {
        EndReason::NodeCannotStart
    }
}
