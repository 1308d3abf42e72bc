//! The fault for the last crash of a worker: one table over both containers. Pure.
//!
//! No participant's program runs in the host's container, so its verdict, and what the kubelet reports of it,
//! decide. An agent's processes can replace or suppress the agent's verdict; it therefore only names the agent's fault more closely.
//! Both ends are matched by their round. Where the host's end of a round is missing, it is waited for, and then the agent is the
//! cause. Where the two never live at one time, `alone` judges.

pub(super) mod alone;
pub(super) mod ends;

use std::collections::BTreeSet;

use jiff::Timestamp;
use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;

use super::failure;
use super::status::PlanBuilder;
use super::waits::Wait;
use super::workers::{agents_beside, cause_of, host_of, pair_with};
use crate::report_digest::clamp;
use crate::view::{ContainerView, EndView, PodView};
use ends::{
    Crash, Order, by_times_and_rounds, crash, end_from_outside, is_crash, is_false_claim, is_of_processes,
    lacked_processes, of_agent, of_evaluator, of_host, order, what,
};
use leaderboard_api::{Agents, EndReason, Failure, LastEnd, SubmissionStatus, WorkerState, WorkerStatus, names};
use leaderboard_protocol::files::{Host, Member, Side};
use leaderboard_protocol::verdict::What;

/// The last crash of a worker with this kind of host. `None`: neither side has crashed; whether their Pod is lost is not judged here.
pub(super) fn last_crash(
    kind: Host,
    host: Option<&ContainerView>,
    agent: Option<&ContainerView>,
    now: Timestamp,
) -> Option<Crash> {
    let crash = table(host, agent, now)?;
    if kind == Host::Simulator {
        return Some(crash);
    }
    // An evaluator has the last word: what becomes of its agent after that is no crash.
    let has_result = |host: &ContainerView| host.last.as_ref().and_then(what) == Some(What::Finished);
    let cause = of_evaluator(crash.cause);
    (!host.is_some_and(has_result)).then_some(Crash { cause, ..crash })
}

/// The table, in a simulator's words.
fn table(host: Option<&ContainerView>, agent: Option<&ContainerView>, now: Timestamp) -> Option<Crash> {
    if let Some(crash) = from_outside(host, agent) {
        return Some(crash);
    }
    let agent = agent.and_then(|container| {
        let end = container.last.as_ref()?;
        let is_its = is_crash(end) || is_false_claim(host, container, end);
        is_its.then(|| (end, crash(of_agent(container, end), end)))
    });
    let own_end = host.and_then(|container| {
        let end = container.last.as_ref()?;
        (!lacked_processes(container, end)).then_some(end)
    });
    // A host's container that was ended from outside explains its own round, and nothing else.
    let explains = |end: &&EndView| match what(end) {
        Some(What::Cancelled) => false,
        Some(What::Stopped) => agent.is_some_and(|(agent, _)| order(host, end, agent) == Order::SameRound),
        Some(What::Finished) => true,
        _ => end.exit_code != 0,
    };
    match (own_end.filter(explains), agent) {
        (None, None) => None,
        (Some(end), None) if what(end) == Some(What::Finished) => None,
        (Some(end), None) => Some(of_host_alone(host, end, now)),
        (None, Some((_, blamed))) => Some(of_agent_alone(host, blamed, now)),
        (Some(end), Some((agent, blamed))) => Some(match order(host, end, agent) {
            Order::SameRound => of_both(host, end, blamed),
            Order::AgentIsLater => of_agent_alone(host, blamed, now),
            Order::HostIsLater => of_host_alone(host, end, now),
        }),
    }
}

/// Both sides were ended in one round, and by no process of the Pod: its sandbox was made anew, or its node started again. An agent can end
/// itself in whatever way, but not its host so.
fn from_outside(host: Option<&ContainerView>, agent: Option<&ContainerView>) -> Option<Crash> {
    let (own, agent) = (end_from_outside(host?)?, end_from_outside(agent?)?);
    (by_times_and_rounds(own, agent) == Order::SameRound).then(|| crash(EndReason::EndedFromOutside, own))
}

/// True if a crash was a failure of the host's container itself, which it was not if its Pod was being ended.
fn is_hosts_own(host: Option<&ContainerView>, crash: &Crash) -> bool {
    let was_ended = host.and_then(|container| what(container.last.as_ref()?)) == Some(What::Stopped);
    failure::of_host(crash.cause, Agents::Beside).is_some() && !was_ended
}

fn of_both(host: Option<&ContainerView>, end: &EndView, blamed: Crash) -> Crash {
    match what(end) {
        // An agent that is done ends regularly: one that crashes in that round has forged its mark.
        Some(What::PeerCrashed | What::Finished | What::NoResult) => blamed,
        _ => crash(of_host(host, end), end),
    }
}

fn of_host_alone(host: Option<&ContainerView>, end: &EndView, now: Timestamp) -> Crash {
    match what(end) {
        Some(What::PeerCrashed) => Crash {
            is_settled: !is_awaited(end.at, now),
            ..crash(EndReason::Unseen, end)
        },
        _ => crash(of_host(host, end), end),
    }
}

fn of_agent_alone(host: Option<&ContainerView>, blamed: Crash, now: Timestamp) -> Crash {
    if host.is_none_or(cannot_be_started) {
        return Crash {
            cause: EndReason::SimulatorNotStarted,
            ..blamed
        };
    }
    Crash {
        is_settled: !is_awaited(blamed.at, now),
        ..blamed
    }
}

/// True if the kubelet cannot start it. The pause after a crash is none: its last end counts then. One that has run is not kept away by
/// its own fault where the Pod lacks processes.
fn cannot_be_started(host: &ContainerView) -> bool {
    let is_refused = |(reason, words): &(String, String)| reason != "CrashLoopBackOff" && !is_of_processes(words);
    let never_ran = host.last.is_none() && host.restarts == 0;
    !host.running && (never_ran || host.waiting.as_ref().is_some_and(is_refused))
}

/// True if the other side's end may still be seen. A clock that was set back does not prolong this.
fn is_awaited(at: Option<Timestamp>, now: Timestamp) -> bool {
    at.is_some_and(|at| now.duration_since(at).as_secs().abs() < Wait::PEER.longest)
}

/// Counts the crashes of each worker and remembers the last one: its Pod may be gone when the cause is looked for.
pub(super) fn note_crashes(status: &mut SubmissionStatus, pod: &PodView, now: Timestamp) {
    let kind = host_of(status);
    let ids: BTreeSet<i32> = pod.containers.iter().filter_map(|c| pair_of(&c.name)).collect();
    for id in ids {
        let agents = agents_beside(status, id);
        let its = pod.containers.iter().filter(|c| pair_of(&c.name) == Some(id));
        let counted = its.map(|its| count_crashes(its, agents)).max().unwrap_or(0);
        let crash = last_crash_of(pod, (kind, agents), id, now);
        if counted > 0 || crash.is_some() {
            let host = pair_with(id).and_then(|pair| container(pod, pair.host(kind)));
            let worker = worker_entry(status, id);
            worker.environment_failed |= crash.is_some_and(|crash| is_hosts_own(host, &crash));
            take_crash(worker, counted, crash);
        }
    }
}

/// Takes in what was seen of a pair: how often its containers ended, by whatever, and the last crash.
fn take_crash(worker: &mut WorkerStatus, counted: i32, crash: Option<Crash>) {
    if let Some(crash) = crash {
        let last = LastEnd {
            reason: crash.cause,
            exit_code: Some(crash.exit_code),
            time: crash.at.map(Time),
        };
        // Each reconcile sees an end again. One side's end may have been counted as a crash before the other side's was seen.
        if crash.cause == EndReason::EndedFromOutside && worker.last.as_deref() != Some(&last) {
            worker.ended_from_outside = worker.ended_from_outside.saturating_add(1);
            worker.crashes = worker.crashes.saturating_sub(1).max(0);
        }
        worker.last = Some(Box::new(last));
    }
    worker.crashes = worker.crashes.max(counted.saturating_sub(worker.ended_from_outside));
}

/// Ends of a container that were crashes. One that has ended counts at once, not only when it is started again. The kubelet also counts
/// how often it could not start a host's container, whose runner knows its rounds.
fn count_crashes(container: &ContainerView, agents: Agents) -> i32 {
    let Some(last) = container.last.as_ref() else {
        return container.restarts;
    };
    let is_host = Member::parse(&container.name).is_some_and(|member| member.side != Side::Agent);
    // After that only a sandbox that is made anew starts it again.
    if agents == Agents::First && !is_host && last.exit_code == 0 {
        return 0;
    }
    if is_host && agents == Agents::Beside && lacked_processes(container, last) {
        return 0;
    }
    let is_crash = is_crash(last);
    let ends = container
        .restarts
        .saturating_add(i32::from(is_crash && !container.has_next_life()));
    let round = last.verdict.as_ref().and_then(|verdict| verdict.round);
    match round.filter(|_| is_host) {
        Some(round) => ends.min(clamp(round).saturating_add(i32::from(is_crash))),
        None => ends,
    }
}

fn last_crash_of(pod: &PodView, (kind, agents): (Host, Agents), id: i32, now: Timestamp) -> Option<Crash> {
    let pair = pair_with(id)?;
    let (host, agent) = (container(pod, pair.host(kind)), container(pod, pair.agent()));
    match agents {
        Agents::Beside => last_crash(kind, host, agent, now),
        Agents::First | Agents::Absent => alone::last_crash(host, agent, pod.container(names::CONTAINER_LOGCOPY)),
    }
}

fn container(pod: &PodView, member: Member) -> Option<&ContainerView> {
    pod.container(&member.to_string())
}

fn pair_of(container: &str) -> Option<i32> {
    Some(Member::parse(container)?.pair.get().into())
}

fn worker_entry(status: &mut SubmissionStatus, id: i32) -> &mut WorkerStatus {
    if let Some(at) = status.workers.iter().position(|p| p.id == id) {
        return &mut status.workers[at];
    }
    let fresh = WorkerStatus {
        id,
        done: 0,
        total: status.plan.as_ref().map_or(0, |plan| plan.total_of(id)),
        crashes: 0,
        state: WorkerState::Waiting,
        last: None,
        ended_from_outside: 0,
        environment_failed: false,
    };
    let at = status.workers.partition_point(|p| p.id < id);
    status.workers.insert(at, fresh);
    &mut status.workers[at]
}

/// The failure of a pair that has crashed as often as it may, or cannot start at all. It waits until the cause is settled.
pub(super) fn too_many(draft: &mut PlanBuilder<'_>) -> Option<Failure> {
    let limit = draft.retries().per_worker.saturating_add(1);
    let kind = host_of(&draft.status);
    let is_too_many = |worker: &&WorkerStatus| {
        worker.crashes >= limit || (worker.crashes > 0 && cause_of(worker).is_some_and(is_hopeless))
    };
    let mut awaited = None;
    for worker in draft.status.workers.iter().filter(is_too_many) {
        let Some(cause) = cause_of(worker) else {
            continue;
        };
        let pod = draft.view.pod.as_ref();
        let sides = (kind, agents_beside(&draft.status, worker.id));
        let crash = pod.and_then(|pod| last_crash_of(pod, sides, worker.id, draft.now()));
        // Further failures while the other side's end is awaited put the end of the run off no further.
        match crash.filter(|crash| !crash.is_settled && worker.crashes <= limit) {
            None => return Some(failure::of_worker(worker, cause, &draft.status)),
            Some(crash) => awaited = awaited.or(crash.at),
        }
    }
    if let Some(at) = awaited {
        draft.requeue_at(Wait::PEER.over_at(at));
    }
    None
}

/// True if another round in the same Pod would end in the same way.
fn is_hopeless(cause: EndReason) -> bool {
    matches!(
        cause,
        EndReason::CannotStart | EndReason::StartError | EndReason::NoGPU | EndReason::GraphicsDriverMissing
    )
}
