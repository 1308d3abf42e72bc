//! How long the start of a Pod may take, and how far it is. Pure.
//!
//! The kubelet's events are not watched, and no condition covers images, so a pull is known by its containers: the kubelet starts them in
//! order, and one that was never started, has no error and is next is waiting for its image. Where the agent runs first, the start of the
//! evaluators begins at its end, and anew once its files are copied.

use jiff::Timestamp;

use super::failure;
use super::waits::after;
use crate::view::{ContainerView, PodView};
use leaderboard_api::{Agents, Deadlines, Failure, Reason, names};
use leaderboard_protocol::files::Member;

/// How a container waits that the kubelet has not come to yet.
const NOT_BEGUN: [&str; 3] = ["", "ContainerCreating", "PodInitializing"];

/// When a start has taken too long.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Limit {
    pub(super) at: Timestamp,
    /// The deadline that is over then.
    pub(super) seconds: i64,
    pub(super) is_of_pulls: bool,
}

/// The limit of a start; none before the Pod has a node, and while an input is copied, which may be large. `stalled` is since when a container
/// of it does not start, and that is known.
pub(super) fn limit(pod: &PodView, agents: Agents, deadlines: &Deadlines, stalled: Option<Timestamp>) -> Option<Limit> {
    let scheduled = pod.scheduled?;
    if stalled.is_none() && copies_input(pod, agents) {
        return None;
    }
    let (began, ran) = match agents_end(pod, agents) {
        Some(end) => (end.max(collected(pod).unwrap_or(end)).max(scheduled), 0),
        None => (scheduled, run_seconds(pod)),
    };
    let pulled_by = after(after(began, ran), deadlines.pull_seconds);
    if stalled.is_none() && !waiting(pod, agents).is_empty() {
        return Some(Limit {
            at: pulled_by,
            seconds: deadlines.pull_seconds,
            is_of_pulls: true,
        });
    }
    let since = stalled.or_else(|| last_begun(pod)).unwrap_or(began);
    // Causes that take turns put the end off no further.
    let latest = after(pulled_by, deadlines.start_seconds);
    Some(Limit {
        at: after(since.max(began), deadlines.start_seconds).min(latest),
        seconds: deadlines.start_seconds,
        is_of_pulls: false,
    })
}

/// When the agent ended that runs before the evaluators, if it is through.
fn agents_end(pod: &PodView, agents: Agents) -> Option<Timestamp> {
    if agents != Agents::First {
        return None;
    }
    let is_it = |container: &&ContainerView| container.is_agents() && is_through(container);
    pod.containers.iter().find(is_it)?.last.as_ref()?.at
}

/// When its files were copied.
fn collected(pod: &PodView) -> Option<Timestamp> {
    let collect = pod.container(names::CONTAINER_COLLECT)?;
    collect.last.as_ref().filter(|end| end.exit_code == 0)?.at
}

/// True if that agent is through, and no evaluator has begun.
pub(super) fn awaits_evaluators(pod: &PodView, agents: Agents) -> bool {
    agents_end(pod, agents).is_some() && !have_hosts_begun(pod)
}

/// True if a host's container of a worker has begun.
pub(super) fn have_hosts_begun(pod: &PodView) -> bool {
    let mut of_workers = pod.containers.iter().filter(|container| is_of_worker(container));
    of_workers.any(|one| !one.is_agents() && (one.running || one.last.is_some()))
}

/// True if the files of a submission are being copied. They may be large.
pub(super) fn copies_input(pod: &PodView, agents: Agents) -> bool {
    let runs = |name: &str| pod.container(name).is_some_and(|container| container.running);
    runs(names::CONTAINER_COLLECT) || (agents != Agents::Beside && runs(names::CONTAINER_WORKSPACE))
}

/// True if a run under way takes its time for agents. One that runs first takes none before it starts in its Pod, or once it has ended well.
pub(super) fn is_agents_time(pod: Option<&PodView>, agents: Agents) -> bool {
    let works = |one: &ContainerView| one.is_agents() && !one.has_ended_well();
    match agents {
        Agents::Beside => true,
        Agents::First => pod.is_some_and(|pod| pod.agent_started.is_some() && pod.containers.iter().any(works)),
        Agents::Absent => false,
    }
}

fn is_of_worker(container: &ContainerView) -> bool {
    Member::parse(&container.name).is_some()
}

/// The containers that wait for an image, if the Pod is at a pull.
pub(super) fn waiting(pod: &PodView, agents: Agents) -> Vec<&str> {
    // Ours go one by one, and so does an agent that runs first. Containers of an overlay hold them up, wherever they stand.
    let goes_alone =
        |container: &&ContainerView| container.prepares() || (agents == Agents::First && container.is_agents());
    match pod.containers.iter().filter(goes_alone).find(|one| !is_through(one)) {
        Some(next) if is_before_its_pull(next) => vec![&next.name],
        Some(_) => Vec::new(),
        None => {
            let of_workers = pod.containers.iter().filter(|container| is_of_worker(container));
            let waiting = of_workers.filter(|container| is_before_its_pull(container));
            waiting.map(|container| container.name.as_str()).collect()
        }
    }
}

/// Seconds in which containers before the agents have run: no pull was under way then.
fn run_seconds(pod: &PodView) -> i64 {
    let before = pod.containers.iter().filter(|container| container.is_before_agents());
    before
        .filter_map(|container| {
            let end = container.last.as_ref().filter(|end| end.exit_code == 0)?;
            Some(end.at?.duration_since(end.began?).as_secs().max(0))
        })
        .fold(0, i64::saturating_add)
}

/// When the kubelet came to a container last. A restart is none of its pulls.
fn last_begun(pod: &PodView) -> Option<Timestamp> {
    let first_lives = pod.containers.iter().filter(|container| container.restarts == 0);
    let begun = first_lives.filter_map(|container| container.began.or_else(|| container.last.as_ref()?.began));
    begun.max()
}

/// True if the kubelet goes on to the next one.
fn is_through(container: &ContainerView) -> bool {
    let stays = container.running && container.name == names::CONTAINER_LOGCOPY;
    stays || (container.has_ended_well() && !container.running)
}

fn is_before_its_pull(container: &ContainerView) -> bool {
    let waits = container
        .waiting
        .as_ref()
        .is_some_and(|(reason, _)| NOT_BEGUN.contains(&reason.as_str()));
    waits && container.restarts == 0 && container.last.is_none()
}

/// The failure of a start that is over.
pub(super) fn start_deadline(pod: &PodView, agents: Agents, over: Limit) -> Failure {
    let node = pod.node.as_deref().unwrap_or("the node");
    let seconds = over.seconds;
    let what = if over.is_of_pulls {
        let names = waiting(pod, agents).join(", ");
        format!("The images of the Pod were not pulled within {seconds} s on {node}; these containers wait: {names}.")
    } else {
        let what = if pod.agent_started.is_some() {
            "The evaluators"
        } else {
            "The Pod"
        };
        format!(
            "{what} did not start within {seconds} s, and {node} reports no reason: {}.",
            stage(pod)
        )
    };
    failure::infrastructure(Reason::StartDeadline, &what)
}

/// How far a start is.
pub(super) fn stage(pod: &PodView) -> &'static str {
    if pod.logcopy_running {
        return "images are pulled, its containers start";
    }
    let is_next = |name: &&str| match pod.container(name) {
        Some(container) => !container.has_ended_well(),
        None => *name == names::CONTAINER_WORKSPACE,
    };
    match names::INIT_CONTAINERS.into_iter().find(is_next) {
        Some(names::CONTAINER_WORKSPACE) => "the operator's image is pulled and the workspace is filled",
        Some(names::CONTAINER_CONTENTS) => "contents are pulled and copied",
        Some(names::CONTAINER_DATASET) => "the dataset is pulled and copied",
        Some(names::CONTAINER_LABELS) => "the labels are pulled and copied",
        _ => "logcopy starts",
    }
}
