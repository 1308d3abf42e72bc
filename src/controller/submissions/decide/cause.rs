//! Why a container of a Pod does not start: from Kubernetes' words to a reason, a sentence, and whose fault it is.
//!
//! Called by `start`. `words` has the words themselves. Those of workers that started and crashed are judged by `failure`, not here.

use super::words::{self, Cause};
use crate::controller::submissions::view::{ContainerView, PodView};
use leaderboard_api::text::sentence;
use leaderboard_api::{names, reasons};
use leaderboard_contract::verdict::WorkspaceReason;
use leaderboard_protocol::files::{Member, Side};

/// What is shown should `workspace` not report it itself.
const NOT_ISOLATED: &str = "The Pod was not shown to be isolated from the network, and network.enforcement is Require. Look at the log of its \
     container workspace.";

/// A container that does not start.
pub(super) struct Trouble {
    pub(super) reason: &'static str,
    /// A sentence. It stays the same while Kubernetes goes back and forth between trying and waiting.
    pub(super) message: String,
    pub(super) cause: Cause,
    /// The worker whose agent does not start.
    pub(super) worker: Option<i32>,
    /// No amount of waiting helps.
    pub(super) is_hopeless: bool,
    /// It keeps the run from starting, so that the deadline of the start counts; else it is a restart of a container
    /// that ran before, in a run under way.
    pub(super) is_start: bool,
}

/// The container that keeps a Pod from starting: of the hosts' own ones first, which every submission has. A node that fails them fails the
/// agents for the same cause.
pub(super) fn of_pod(pod: &PodView) -> Option<Trouble> {
    let (agents, hosts): (Vec<_>, Vec<_>) = pod.containers.iter().partition(|container| agent(container).is_some());
    let mut all = hosts.into_iter().chain(agents);
    let has_started = pod.agent_started.is_some();
    all.find_map(|container| {
        let is_init = container.is_before_agents();
        if is_init && has_started {
            return None;
        }
        let never_ran = container.last.is_none() && container.restarts == 0;
        let found = of_container(container, is_init)?;
        Some(Trouble {
            is_start: !has_started || never_ran,
            ..found
        })
    })
}

/// The container before the agents that fails.
pub(super) fn failing_before_agents(pod: &PodView) -> Option<&str> {
    let is_failing = |c: &&ContainerView| c.is_before_agents() && c.last.as_ref().is_some_and(|l| l.exit_code != 0);
    pod.containers.iter().find(is_failing).map(|c| c.name.as_str())
}

fn of_container(container: &ContainerView, is_init: bool) -> Option<Trouble> {
    if container.running && (!is_init || container.name == names::CONTAINER_LOGCOPY) {
        return None;
    }
    let (reason, words) = container
        .waiting
        .as_ref()
        .map_or(("", ""), |(reason, words)| (reason.as_str(), words.as_str()));
    match reason {
        "ErrImagePull"
        | "ImagePullBackOff"
        | "InvalidImageName"
        | "ErrImageNeverPull"
        | "ImageInspectError"
        | "RegistryUnavailable"
        | "SignatureValidationFailed" => Some(cannot_be_pulled(container, reason, words)),
        "CreateContainerConfigError" => Some(cannot_be_set_up(container, words)),
        "CreateContainerError" | "RunContainerError" | "PreCreateHookError" | "PreStartHookError" => {
            let told = container.last.as_ref().filter(|end| end.is_start_error());
            let words = told.and_then(|end| end.why.as_deref()).unwrap_or(words);
            Some(cannot_start(container, words))
        }
        _ => of_end(container, is_init),
    }
}

fn cannot_be_pulled(container: &ContainerView, reason: &str, words: &str) -> Trouble {
    let name = &container.name;
    // The host's images are the Leaderboard's to fix, and are waited for.
    if reason == "InvalidImageName" && agent(container).is_some() {
        let message = format!("The image of {name} is not a valid image reference: {words}");
        return Trouble {
            is_hopeless: true,
            ..trouble(container, reasons::IMAGE_INVALID, &message, Cause::ImageName)
        };
    }
    let words = pull_error(words);
    let message = format!("The image of {name} cannot be pulled: {words}");
    trouble(container, reasons::IMAGE_PULL, &message, words::of_pull(words))
}

fn cannot_be_set_up(container: &ContainerView, words: &str) -> Trouble {
    let name = &container.name;
    let message = format!("{name} cannot be set up: {words}");
    let cause = words::of_config(words);
    if cause.is_images() && agent(container).is_some() {
        // The kubelet finds the same on every node.
        return Trouble {
            is_hopeless: true,
            ..trouble(container, reasons::IMAGE_INVALID, &message, cause)
        };
    }
    trouble(container, reasons::CONTAINER_CONFIG, &message, cause)
}

/// How a container that ended, and is being tried again, speaks of its start.
fn of_end(container: &ContainerView, is_init: bool) -> Option<Trouble> {
    let end = container.last.as_ref().filter(|end| end.exit_code != 0)?;
    let name = &container.name;
    if end.is_start_error() {
        return Some(cannot_start(container, end.why.as_deref().unwrap_or(&end.reason)));
    }
    if !is_init {
        return None;
    }
    // Another try of the same Pod would find the same; the next Pod may get another node.
    if matches!(
        end.own_reason,
        Some(WorkspaceReason::NotIsolated | WorkspaceReason::NotKnownIsolated)
    ) {
        let why = end.why.as_deref().unwrap_or(NOT_ISOLATED);
        return Some(Trouble {
            is_hopeless: true,
            ..trouble(container, reasons::NOT_ISOLATED, why, Cause::Host)
        });
    }
    let code = || format!("it ended with code {} ({})", end.exit_code, end.reason);
    let why = end.why.clone().unwrap_or_else(code);
    let message = format!("{name} fails: {why}");
    Some(trouble(container, reasons::PREPARING, &message, Cause::Host))
}

fn trouble(container: &ContainerView, reason: &'static str, message: &str, cause: Cause) -> Trouble {
    let worker = agent(container);
    // The hosts' own images are theirs to fix.
    let cause = if worker.is_none() && cause.is_images() {
        Cause::Host
    } else {
        cause
    };
    Trouble {
        reason,
        message: sentence(message),
        cause,
        worker,
        is_hopeless: false,
        is_start: true,
    }
}

fn cannot_start(container: &ContainerView, words: &str) -> Trouble {
    let message = format!("{} cannot be started: {words}", container.name);
    let cause = words::of_start(words);
    let reason = if cause == Cause::Node {
        reasons::NODE_CANNOT_START
    } else {
        reasons::CANNOT_START
    };
    trouble(container, reason, &message, cause)
}

/// The pair of an agent's container.
fn agent(container: &ContainerView) -> Option<i32> {
    let member = Member::parse(&container.name).filter(|member| member.side == Side::Agent)?;
    Some(member.pair.get().into())
}

/// The cause in a kubelet's words: `ErrImagePull` and `ImagePullBackOff` alternate, and differ only in what is before it.
fn pull_error(words: &str) -> &str {
    words.split_once("ErrImagePull: ").map_or(words, |(_, cause)| cause)
}
