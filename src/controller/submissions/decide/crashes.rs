//! Crashes of workers: counting them, and the failure that they come to once they are too many.
//!
//! Called by `live`, `failure` and `end`. Whose fault a crash was is decided by `blame`.

use std::collections::BTreeSet;

use jiff::Timestamp;
use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;
use leaderboard_protocol::files::{Member, Pair, Side};

use super::blame::{self, Crash};
use super::failure::{infrastructure, participant};
use super::next_steps::{Steps, for_both, in_the_log_of, of_participant, smaller};
use super::status::PlanBuilder;
use super::waits::Wait;
use crate::controller::submissions::report_digest::{ReportDigest, clamp};
use crate::controller::submissions::view::{ContainerView, PodView};
use leaderboard_api::{EndReason, Failure, LastEnd, SubmissionStatus, WorkerState, WorkerStatus, reasons};

/// Counts the crashes of each worker and remembers the last one: its Pod may be gone when the cause is looked for.
pub(super) fn note(status: &mut SubmissionStatus, pod: &PodView, now: Timestamp) {
    let ids: BTreeSet<i32> = pod.containers.iter().filter_map(|c| pair_of(&c.name)).collect();
    for id in ids {
        let its = pod.containers.iter().filter(|c| pair_of(&c.name) == Some(id));
        let counted = its.map(count).max().unwrap_or(0);
        let crash = last_crash(pod, id, now);
        if counted > 0 || crash.is_some() {
            let host = pair_with(id).and_then(|pair| container(pod, pair.host()));
            let worker = worker_entry(status, id);
            worker.environment_failed |= crash.is_some_and(|crash| blame::is_hosts_own(host, &crash));
            take(worker, counted, crash);
        }
    }
}

/// Takes in what was seen of a pair: how often its containers ended, by whatever, and the last crash.
fn take(worker: &mut WorkerStatus, counted: i32, crash: Option<Crash>) {
    if let Some(crash) = crash {
        let last = LastEnd {
            reason: crash.cause,
            exit_code: Some(crash.exit_code),
            time: crash.at.map(Time),
        };
        // The same end is seen in each reconcile. One side's may have been counted as a crash before the other's was seen.
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
fn count(container: &ContainerView) -> i32 {
    let Some(last) = container.last.as_ref() else {
        return container.restarts;
    };
    let is_host = Member::parse(&container.name).is_some_and(|member| member.side == Side::Host);
    if is_host && blame::lacked_processes(container, last) {
        return 0;
    }
    let is_crash = blame::is_crash(last);
    let ends = container
        .restarts
        .saturating_add(i32::from(is_crash && !container.has_next_life()));
    let round = last.verdict.as_ref().and_then(|verdict| verdict.round);
    match round.filter(|_| is_host) {
        Some(round) => ends.min(clamp(round).saturating_add(i32::from(is_crash))),
        None => ends,
    }
}

fn last_crash(pod: &PodView, id: i32, now: Timestamp) -> Option<Crash> {
    let pair = pair_with(id)?;
    blame::last_crash(container(pod, pair.host()), container(pod, pair.agent()), now)
}

fn pair_with(id: i32) -> Option<Pair> {
    u16::try_from(id).ok().and_then(Pair::new)
}

fn container(pod: &PodView, member: Member) -> Option<&ContainerView> {
    let name = member.to_string();
    pod.containers.iter().find(|container| container.name == name)
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
    let is_too_many = |worker: &&WorkerStatus| {
        worker.crashes >= limit || (worker.crashes > 0 && cause(worker).is_some_and(is_hopeless))
    };
    let node = draft.status.node_name.as_deref();
    let mut awaited = None;
    for worker in draft.status.workers.iter().filter(is_too_many) {
        let Some(cause) = cause(worker) else { continue };
        let pod = draft.view.pod.as_ref();
        let crash = pod.and_then(|pod| last_crash(pod, worker.id, draft.now()));
        // Who goes on to fail while the other side's word is waited for puts its end off no further.
        match crash.filter(|crash| !crash.is_settled && worker.crashes <= limit) {
            None => return Some(of_worker(worker, cause, node)),
            Some(crash) => awaited = awaited.or(crash.at),
        }
    }
    if let Some(at) = awaited {
        draft.requeue_at(Wait::PEER.over_at(at));
    }
    None
}

/// The failure of the pair that has crashed most.
pub(super) fn worst(status: &SubmissionStatus) -> Option<Failure> {
    let crashed = status.workers.iter().filter(|p| p.crashes > 0 && p.last.is_some());
    let worker = crashed.max_by_key(|p| p.crashes)?;
    Some(of_worker(worker, cause(worker)?, status.node_name.as_deref()))
}

/// Whether what looked like crashes were runs to the end whose checkpoint is refused: an agent that ends by itself without
/// results that can be read is tried again as one that crashed.
pub(super) fn is_refusal(status: &SubmissionStatus, found: &Failure, report: &ReportDigest) -> bool {
    let by_itself = |worker: &WorkerStatus| matches!(cause(worker), Some(EndReason::Exited | EndReason::Incomplete));
    let is_of_results = [reasons::AGENT_CRASHED, reasons::INVALID_RESULTS].contains(&found.reason.as_str());
    is_of_results && status.workers.iter().any(by_itself) && report.is_verdict() && report.why.is_some()
}

fn cause(worker: &WorkerStatus) -> Option<EndReason> {
    worker.last.as_ref().map(|last| last.reason)
}

/// Whether another round in the same Pod would end in the same way.
fn is_hopeless(cause: EndReason) -> bool {
    matches!(
        cause,
        EndReason::CannotStart | EndReason::StartError | EndReason::NoGPU | EndReason::GraphicsDriverMissing
    )
}

fn of_worker(worker: &WorkerStatus, cause: EndReason, node: Option<&str>) -> Failure {
    let id = worker.id;
    let times = match worker.crashes {
        1 => "once".to_owned(),
        crashes => format!("{crashes} times"),
    };
    let failure = if let Some((reason, what)) = of_node(id, &times, cause, node) {
        infrastructure(reason, &what)
    } else if let Some(what) = of_host(cause) {
        let what = format!("The simulator of pair {id} failed {times}: {what}.");
        infrastructure(reasons::SIMULATION_CRASHED, &what)
    } else {
        let (reason, what, next) = of_agent(id, &times, cause);
        participant(reason, &what, &next)
    };
    Failure {
        worker: Some(id),
        ..failure
    }
}

/// What the node lacked: to draw, or to start an agent.
fn of_node(id: i32, times: &str, cause: EndReason, node: Option<&str>) -> Option<(&'static str, String)> {
    let node = node.map_or_else(|| "the node".to_owned(), |node| format!("node {node}"));
    match cause {
        EndReason::NoGPU => Some((
            reasons::NO_GPU,
            format!(
                "Pair {id} lacks a GPU on {node}, although the Leaderboard gives it one: its simulator or its agent saw none. The \
                 simulator's log says which."
            ),
        )),
        EndReason::GraphicsDriverMissing => Some((
            reasons::GRAPHICS_DRIVER_MISSING,
            format!(
                "Simulator {id} had a GPU and could not draw: the NVIDIA driver of {node} has no Vulkan/OpenGL part \
                 (nvidia_icd.json)."
            ),
        )),
        EndReason::NodeCannotStart => Some((
            reasons::NODE_CANNOT_START,
            format!(
                "The container of agent {id} could not be started {times} on {node}; nothing of its image is the cause."
            ),
        )),
        EndReason::EndedFromOutside => Some((
            reasons::JOB_FAILED,
            format!("The containers of pair {id} were ended from outside the Pod on {node}."),
        )),
        _ => None,
    }
}

/// What the host's container did, if it was the cause.
fn of_host(cause: EndReason) -> Option<&'static str> {
    match cause {
        EndReason::SimulatorCrashed => Some("it crashed"),
        EndReason::SimulatorNotReady => Some("it was not ready in time"),
        EndReason::SimulatorSilent => Some("its server did not answer any more"),
        EndReason::SimulatorNotStarted => Some("its container could not be started"),
        _ => None,
    }
}

fn of_agent(id: i32, times: &str, cause: EndReason) -> (&'static str, String, Steps) {
    match cause {
        EndReason::OutOfMemory => (
            reasons::OUT_OF_MEMORY,
            format!("Agent {id} crashed {times}, the last time for lack of memory."),
            smaller(),
        ),
        EndReason::Idle => (
            reasons::IDLE,
            format!("Agent {id} ended too early {times}, the last time because it printed nothing for too long."),
            in_the_log_of(id),
        ),
        EndReason::Incomplete => (
            reasons::INVALID_RESULTS,
            format!(
                "Agent {id} ended by itself {times} without complete results: its checkpoint is missing, malformed or has \
                 no global record."
            ),
            in_the_log_of(id),
        ),
        EndReason::CannotStart | EndReason::StartError => (
            reasons::CANNOT_START,
            format!("Agent {id} could not be started: its command is missing in the image or not for this machine."),
            for_both(&of_participant(reasons::CANNOT_START)),
        ),
        EndReason::NoProcess => (
            reasons::AGENT_CRASHED,
            format!("Pair {id} failed {times}: the agents left the Pod no process to start it again."),
            for_both("Let the agents start fewer processes and threads, and submit again."),
        ),
        EndReason::BlamesSimulator => (
            reasons::AGENT_CRASHED,
            format!("Agent {id} ended {times} and blamed its simulator, which had not failed."),
            for_both("Leave the files of the evaluator's runner alone, and submit again."),
        ),
        EndReason::PortTaken => (
            reasons::AGENT_CRASHED,
            format!("Another container of the Pod listened on the port of simulator {id}, which failed {times}."),
            for_both("Let the agents listen on no port of a simulator, and submit again."),
        ),
        _ => (
            reasons::AGENT_CRASHED,
            format!("Agent {id} crashed {times}."),
            in_the_log_of(id),
        ),
    }
}
