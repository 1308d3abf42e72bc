//! The fault for the last crash of a worker whose two sides never live at one time: its own end alone. Pure.
//!
//! In Batch the agent ends before the evaluators begin, and in Predictions there is none. A command that merges has none either: in Interactive
//! agents of the others live on beside it for some seconds, and no end of theirs explains its own. So no end follows from that of another
//! container, and none is waited for. The end of logcopy shows if all containers were ended from outside.

use super::ends::{
    Crash, Order, by_times_and_rounds, crash, end_from_outside, is_crash, is_false_claim, is_killed_from_outside,
    of_agent, of_evaluator, of_host,
};
use crate::view::{ContainerView, EndView};
use leaderboard_api::EndReason;
use leaderboard_protocol::verdict::CODE_NO_GRAPHICS;

/// The last crash of the agent, and once that has ended well, of the evaluator.
pub(in crate::submissions) fn last_crash(
    host: Option<&ContainerView>,
    agent: Option<&ContainerView>,
    logcopy: Option<&ContainerView>,
) -> Option<Crash> {
    let agent = agent.filter(|agent| !agent.has_ended_well());
    let one = agent.or(host)?;
    if let Some(crash) = from_outside(logcopy, one) {
        return Some(crash);
    }
    let end = one.last.as_ref()?;
    if let Some(agent) = agent {
        let is_its = is_crash(end) || is_false_claim(None, agent, end);
        return is_its.then(|| crash(of_lone_agent(agent, end), end));
    }
    is_crash(end).then(|| crash(of_lone_evaluator(one, end), end))
}

/// The container was ended together with logcopy, which no process of another container can end. By itself logcopy ends with an error alone.
fn from_outside(logcopy: Option<&ContainerView>, one: &ContainerView) -> Option<Crash> {
    let own = logcopy?.last.as_ref()?;
    let was_ended = own.exit_code == 0 || is_killed_from_outside(own);
    let is_same = was_ended && by_times_and_rounds(own, end_from_outside(one)?) == Order::SameRound;
    is_same.then(|| crash(EndReason::EndedFromOutside, own))
}

/// The processes of its earlier lives are gone: it is not the agent that leaves none.
fn of_lone_agent(agent: &ContainerView, end: &EndView) -> EndReason {
    if end.exit_code == CODE_NO_GRAPHICS {
        return EndReason::NoGPU;
    }
    match of_evaluator(of_agent(agent, end)) {
        EndReason::NoProcess => EndReason::NodeCannotStart,
        cause => cause,
    }
}

/// It has no agent to use up the Pod's processes, or to take its port. The agents of others may still do the first to one that merges, for some
/// seconds.
fn of_lone_evaluator(host: &ContainerView, end: &EndView) -> EndReason {
    match of_evaluator(of_host(Some(host), end)) {
        EndReason::NoProcess | EndReason::PortTaken => EndReason::EvaluatorCrashed,
        cause => cause,
    }
}
