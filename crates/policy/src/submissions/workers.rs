//! The workers of a submission, as its status has them. Pure.

use leaderboard_api::{Agents, EndReason, RunPlan, SubmissionStatus, WorkerState, WorkerStatus};
use leaderboard_evaluation::of_plan;
use leaderboard_protocol::files::{Host, Pair};

/// The program in the hosts' containers of the workers.
pub(super) fn host_of(status: &SubmissionStatus) -> Host {
    let plan = status.plan.as_ref();
    // Without a plan nothing is decided before it is pinned anew.
    plan.map_or(Host::Simulator, |plan| of_plan(plan).host())
}

/// How the agents of a submission stand to its hosts' containers.
pub(super) fn agents_of(status: &SubmissionStatus) -> Agents {
    status.plan.as_ref().map_or(Agents::Beside, RunPlan::agents)
}

/// How they stand to the host's container of one worker.
pub(super) fn agents_beside(status: &SubmissionStatus, id: i32) -> Agents {
    let plan = status.plan.as_ref();
    let of_worker = |plan: &RunPlan| plan.agents_of(usize::try_from(id).unwrap_or_default());
    plan.map_or(Agents::Beside, of_worker)
}

/// True once every evaluator is done whose results a command merges. An agent cannot forge that end.
pub(super) fn only_merges(status: &SubmissionStatus) -> bool {
    let Some(merger) = status.plan.as_ref().and_then(RunPlan::merger) else {
        return false;
    };
    let is_done = |id: usize| {
        let mut done = status.workers.iter().filter(|worker| worker.state == WorkerState::Done);
        done.any(|worker| usize::try_from(worker.id) == Ok(id))
    };
    (1..merger).all(is_done)
}

pub(super) fn pair_with(id: i32) -> Option<Pair> {
    u16::try_from(id).ok().and_then(Pair::new)
}

pub(super) fn cause_of(worker: &WorkerStatus) -> Option<EndReason> {
    worker.last.as_ref().map(|last| last.reason)
}
