//! The containers of a run's workers, by the kind of evaluation. Pure.

use super::JobInput;
use leaderboard_api::{Agents, RunPlan};
use leaderboard_evaluation::workload::{Role, Workload};
use leaderboard_protocol::files::{Member, Pair, Side};

/// Containers of all workers, in their order.
pub(super) fn workloads(input: &JobInput<'_>) -> Vec<Workload> {
    let (kind, asked) = (input.kind(), input.asked());
    Pair::first(input.plan.workers())
        .filter_map(|worker| kind.workload(&asked, worker))
        .collect()
}

/// The hosts' containers of all workers, then the agents'.
pub(super) fn members(plan: &RunPlan) -> impl Iterator<Item = Member> {
    let host = leaderboard_evaluation::of_plan(plan).host();
    let hosts = Pair::first(plan.workers()).map(move |worker| worker.host(host));
    hosts.chain(Pair::first(plan.agent_count()).map(Pair::agent))
}

/// True for an init container: an agent that ends before the hosts' containers start.
pub(super) fn is_first(plan: &RunPlan, member: Member) -> bool {
    member.side == Side::Agent && plan.agents() == Agents::First
}

/// The role of one container.
pub(super) fn role(workloads: &[Workload], member: Member) -> Option<&Role> {
    let workload = workloads.get(member.pair.index())?;
    match member.side {
        Side::Host(_) => Some(&workload.host),
        Side::Agent => workload.agent.as_ref(),
    }
}
