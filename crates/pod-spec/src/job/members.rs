//! The containers of a run's workers, by the kind of evaluation. Pure.

use super::JobInput;
use leaderboard_evaluation::workload::{Role, Workload};
use leaderboard_protocol::files::{Member, Pair, Side};

/// Containers of all workers, in their order.
pub(super) fn workloads(input: &JobInput<'_>) -> Vec<Workload> {
    let (kind, asked) = (input.kind(), input.asked());
    Pair::first(input.workers())
        .filter_map(|worker| kind.workload(&asked, worker))
        .collect()
}

/// The hosts' containers of all workers, then the agents'.
pub(super) fn members(input: &JobInput<'_>) -> impl Iterator<Item = Member> {
    let (host, workers) = (input.kind().host(), Pair::first(input.workers()));
    let hosts = workers.clone().map(move |worker| worker.host(host));
    hosts.chain(workers.map(Pair::agent))
}

/// The role of one container.
pub(super) fn role(workloads: &[Workload], member: Member) -> Option<&Role> {
    let workload = workloads.get(member.pair.index())?;
    match member.side {
        Side::Host(_) => Some(&workload.host),
        Side::Agent => workload.agent.as_ref(),
    }
}
