//! Why a container of a Pod does not start: from Kubernetes' words to a reason, a sentence, and whose fault it is.
//!
//! Called by `start`. Agents and simulators that started and crashed are judged by `failure`, not here.

use crate::controller::submissions::view::{ContainerView, PodView};
use leaderboard_api::text::sentence;
use leaderboard_api::{names, reasons};

/// What is shown should `workspace` not report it itself.
const PREFIX_IN_USE: &str = "The run's place in the bucket holds another object's results. Apply it with attempt: 2 to take \
                             them up, or empty the prefix.";

/// The same for a Pod that was not isolated.
const NOT_ISOLATED: &str = "The Pod was not shown to be isolated from the network, and network.enforcement is Require. Look at the log of its \
     container workspace.";

/// A container that does not start.
pub(super) struct Trouble {
    pub(super) reason: &'static str,
    /// A sentence. It stays the same while Kubernetes goes back and forth between trying and waiting.
    pub(super) message: String,
    /// The participant's image is the cause, not the host's set-up.
    pub(super) is_participants: bool,
    /// No amount of waiting helps.
    pub(super) is_hopeless: bool,
    /// It keeps the run from starting, so that the deadline of the start counts; else it is a restart of a container
    /// that ran before, in a run under way.
    pub(super) is_start: bool,
}

/// The first container of a Pod that does not start.
pub(super) fn of_pod(pod: &PodView) -> Option<Trouble> {
    let has_started = pod.agent_started.is_some();
    pod.containers.iter().find_map(|container| {
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
    let name = &container.name;
    let (reason, words) = container
        .waiting
        .as_ref()
        .map_or(("", ""), |(reason, words)| (reason.as_str(), words.as_str()));
    match reason {
        // The host's images are the Leaderboard's to fix, and are waited for.
        "InvalidImageName" if is_agent(name) => {
            let message = format!("The image of {name} is not a valid image reference: {words}");
            Some(Trouble {
                is_hopeless: true,
                ..trouble(reasons::IMAGE_INVALID, &message, true)
            })
        }
        "ErrImagePull" | "ImagePullBackOff" | "InvalidImageName" | "ErrImageNeverPull" => {
            let words = pull_error(words);
            let message = format!("The image of {name} cannot be pulled: {words}");
            let is_participants = is_agent(name) && !is_registrys(words);
            Some(trouble(reasons::IMAGE_PULL, &message, is_participants))
        }
        "CreateContainerConfigError" => {
            let message = format!("{name} cannot be set up: {words}");
            Some(trouble(reasons::CONTAINER_CONFIG, &message, false))
        }
        "CreateContainerError" | "RunContainerError" => {
            let told = container.last.as_ref().filter(|end| end.is_start_error());
            let words = told.and_then(|end| end.why.as_deref()).unwrap_or(words);
            Some(cannot_start(name, words))
        }
        _ => of_end(container, is_init),
    }
}

/// How a container that ended, and is being tried again, speaks of its start.
fn of_end(container: &ContainerView, is_init: bool) -> Option<Trouble> {
    let end = container.last.as_ref().filter(|end| end.exit_code != 0)?;
    let name = &container.name;
    if end.is_start_error() {
        return Some(cannot_start(name, end.why.as_deref().unwrap_or(&end.reason)));
    }
    if !is_init {
        return None;
    }
    // Another try of the same Pod would find the same; the next Pod may get another node.
    let of_workspace = [
        (reasons::PREFIX_IN_USE, PREFIX_IN_USE),
        (reasons::NOT_ISOLATED, NOT_ISOLATED),
    ];
    let own_reason = end.own_reason.as_deref().filter(|_| name == names::CONTAINER_WORKSPACE);
    let found = of_workspace.into_iter().find(|(reason, _)| own_reason == Some(*reason));
    if let Some((reason, usual)) = found {
        return Some(Trouble {
            is_hopeless: true,
            ..trouble(reason, end.why.as_deref().unwrap_or(usual), false)
        });
    }
    let code = || format!("it ended with code {} ({})", end.exit_code, end.reason);
    let why = end.why.clone().unwrap_or_else(code);
    Some(trouble(reasons::PREPARING, &format!("{name} fails: {why}"), false))
}

fn trouble(reason: &'static str, message: &str, is_participants: bool) -> Trouble {
    Trouble {
        reason,
        message: sentence(message),
        is_participants,
        is_hopeless: false,
        is_start: true,
    }
}

fn cannot_start(name: &str, words: &str) -> Trouble {
    let message = format!("{name} cannot be started: {words}");
    trouble(reasons::CANNOT_START, &message, is_agent(name))
}

fn is_agent(name: &str) -> bool {
    name.starts_with("agent-")
}

/// The cause in a kubelet's words: `ErrImagePull` and `ImagePullBackOff` alternate, and differ only in what is before it.
fn pull_error(words: &str) -> &str {
    words.split_once("ErrImagePull: ").map_or(words, |(_, cause)| cause)
}

/// All that a participant reads of an image that cannot be pulled.
pub(super) fn pull_for_participants(words: &str) -> &'static str {
    let has = |signs: &[&str]| signs.iter().any(|sign| words.contains(sign));
    match () {
        () if has(&["no match for platform"]) => "The submitted image is not for linux/amd64.",
        () if has(&["manifest unknown", "not found"]) => "The submitted image is not in its registry.",
        () if has(&["401 Unauthorized", "403 Forbidden", "denied", "authorization failed"]) => {
            "The registry does not let the challenge pull the submitted image."
        }
        () => "The submitted image cannot be pulled.",
    }
}

/// Whether the registry, or the way to it, is the cause rather than the image.
fn is_registrys(words: &str) -> bool {
    const SIGNS: [&str; 13] = [
        "connection refused",
        "connection reset",
        "no such host",
        "i/o timeout",
        "no route to host",
        "network is unreachable",
        "deadline exceeded",
        "TLS handshake",
        "x509:",
        "unexpected EOF",
        "Too Many Requests",
        "toomanyrequests",
        "no space left on device",
    ];
    // `failed with status code [manifests 1]: 503 Service Unavailable`
    let is_server_error = words.contains("status code [") && words.contains("]: 5");
    is_server_error || SIGNS.iter().any(|sign| words.contains(sign))
}
