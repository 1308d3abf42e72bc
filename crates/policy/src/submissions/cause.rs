//! The fault for a container that does not start, or for a full disk of a Pod. The words of the kubelet, the container engine, the GPU
//! toolkit, runc and the registries show it.
//!
//! An image is the cause only where the words prove it. A node without disk, driver or memory must charge no team, and its words are
//! endless. So words that the table does not know are the node's, or the registry's. Only a measurement of the agents' own disk use
//! is evidence against them.
//! Workers that started and crashed are judged by `blame`.

use serde_json::Value;

use super::failure::{self, charged, infrastructure, participant};
use super::limits;
use super::status::PlanBuilder;
use super::workers::agents_of;
use crate::view::{ContainerView, PodView};
use leaderboard_api::text::sentence;
use leaderboard_api::{Agents, Failure, LeaderboardSpec, Reason, names};
use leaderboard_contract::run::TOOLS;
use leaderboard_contract::verdict::WorkspaceReason;
use leaderboard_pod_spec::layout::{LOGS_VOLUME, SHM_VOLUME};
use leaderboard_protocol::files::{Member, Side};

/// A container that does not start.
pub(super) struct Trouble {
    pub(super) reason: Reason,
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
pub(super) fn trouble_of(pod: &PodView) -> Option<Trouble> {
    let (agents, hosts): (Vec<_>, Vec<_>) = pod.containers.iter().partition(|container| agent(container).is_some());
    let mut all = hosts.into_iter().chain(agents);
    let has_started = pod.agent_started.is_some();
    all.find_map(|container| {
        if container.is_before_agents() && has_started {
            return None;
        }
        let never_ran = container.last.is_none() && container.restarts == 0;
        let found = of_container(container, container.prepares())?;
        Some(Trouble {
            // Until `collect` is through, no evaluator starts.
            is_start: !has_started || never_ran || container.prepares(),
            ..found
        })
    })
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
            ..trouble(container, Reason::ImageInvalid, &message, Cause::ImageName)
        };
    }
    let words = pull_error(words);
    let message = format!("The image of {name} cannot be pulled: {words}");
    trouble(container, Reason::ImagePull, &message, of_pull(words))
}

fn cannot_be_set_up(container: &ContainerView, words: &str) -> Trouble {
    let name = &container.name;
    let message = format!("{name} cannot be set up: {words}");
    let cause = of_config(words);
    if cause.is_images() && agent(container).is_some() {
        // The kubelet finds the same on every node.
        return Trouble {
            is_hopeless: true,
            ..trouble(container, Reason::ImageInvalid, &message, cause)
        };
    }
    trouble(container, Reason::ContainerConfig, &message, cause)
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
    // Another try of the same Pod would find the same.
    if let Some((reason, cause)) = end.own_reason.and_then(of_verdict) {
        let why = end.why.as_deref().unwrap_or_default();
        return Some(Trouble {
            is_hopeless: true,
            ..trouble(container, reason, why, cause)
        });
    }
    let code = || format!("it ended with code {} ({})", end.exit_code, end.reason);
    let why = end.why.clone().unwrap_or_else(code);
    let message = format!("{name} fails: {why}");
    Some(trouble(container, Reason::Preparing, &message, Cause::Host))
}

/// Finding of `workspace` or `collect` that no further try changes.
fn of_verdict(verdict: WorkspaceReason) -> Option<(Reason, Cause)> {
    match verdict {
        // The next Pod may get another node.
        WorkspaceReason::NotIsolated | WorkspaceReason::NotKnownIsolated => Some((Reason::NotIsolated, Cause::Host)),
        WorkspaceReason::InputMissing => Some((Reason::InputMissing, Cause::Host)),
        WorkspaceReason::InputRefused => Some((Reason::InputInvalid, Cause::Input)),
        _ => None,
    }
}

fn trouble(container: &ContainerView, reason: Reason, message: &str, cause: Cause) -> Trouble {
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
    let cause = of_start(words);
    let reason = if cause == Cause::Node {
        Reason::NodeCannotStart
    } else {
        Reason::CannotStart
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

/// The failure of a start that was tried for so many seconds, or that no further try would change.
pub(super) fn failure_of(found: &Trouble, pod: &PodView, seconds: i64) -> Failure {
    let message = &found.message;
    let tried = format!("{message} It was tried for {seconds} s on {}.", node_of(pod));
    let failure = match found.cause {
        Cause::ImageName => charged(Reason::ImageInvalid, message),
        Cause::ImageUser => of_image(
            Reason::ImageInvalid,
            message,
            "The submitted image runs as root, or names its user, and this challenge runs agents as another user.",
            "Set USER of the image to a number other than 0, and submit again.",
        ),
        Cause::ImageProgram => {
            let step = "Push the image again and check that it runs on linux/amd64.";
            participant(Reason::CannotStart, &tried, step)
        }
        Cause::ImageMissing => of_image(
            Reason::ImageNotFound,
            &tried,
            "The submitted image is not in its registry.",
            "Push the image under the name that is submitted, and submit again.",
        ),
        Cause::ImagePlatform => of_image(
            Reason::ImagePlatform,
            &tried,
            "The submitted image is not for linux/amd64.",
            "Build the image for linux/amd64, and submit again.",
        ),
        Cause::ImageKind => of_image(
            Reason::ImageInvalid,
            &tried,
            "The submitted image is of a kind that cannot be run.",
            "Build the image with a present version of its tool, and submit again.",
        ),
        Cause::Input => failure::input_refused(message),
        Cause::Registry | Cause::Node | Cause::Host => match found.reason {
            Reason::NotIsolated | Reason::InputMissing => infrastructure(found.reason, message),
            Reason::Preparing => infrastructure(Reason::StartDeadline, &tried),
            reason => infrastructure(reason, &tried),
        },
    };
    Failure {
        worker: found.worker,
        ..failure
    }
}

pub(super) fn node_of(pod: &PodView) -> String {
    pod.node
        .as_deref()
        .map_or_else(|| "its node".to_owned(), |node| format!("node {node}"))
}

/// A failure of the image, of which hosts read all. The words of a registry or of a node would show a participant what the nodes can
/// reach.
fn of_image(reason: Reason, what: &str, for_participants: &str, step: &str) -> Failure {
    Failure {
        participant_message: Some(format!("{for_participants} {step}")),
        ..participant(reason, what, step)
    }
}

/// The cause that keeps a container from starting.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Cause {
    /// The image runs as a user that the Pod's security context forbids, or cannot judge.
    ImageUser,
    /// The image lacks what is to run, may not run it, or has it for another machine.
    ImageProgram,
    /// The registry has no such image.
    ImageMissing,
    /// The registry has the image for other machines only.
    ImagePlatform,
    /// The registry has something of a kind that no container is made of.
    ImageKind,
    /// The text that was submitted is the name of no image.
    ImageName,
    /// The files that the agent has left.
    Input,
    /// The registry, or the way to it.
    Registry,
    /// The node: its kubelet, container engine, GPU toolkit, disk or memory.
    Node,
    /// The set-up of the challenge's hosts.
    Host,
}

impl Cause {
    /// True if another image would start.
    pub(super) fn is_images(self) -> bool {
        match self {
            Self::ImageUser
            | Self::ImageProgram
            | Self::ImageMissing
            | Self::ImagePlatform
            | Self::ImageKind
            | Self::ImageName => true,
            Self::Input | Self::Registry | Self::Node | Self::Host => false,
        }
    }
}

/// Words that all have to be there, and what they show. The first row that fits counts.
type Row = (&'static [&'static str], Cause);

/// `CreateContainerConfigError`: the kubelet's own words. The settings are the hosts', unless it is the image's user that is refused.
const CONFIGS: [Row; 2] = [
    (
        &["container has runAsNonRoot and image will run as root"],
        Cause::ImageUser,
    ),
    (
        &["container has runAsNonRoot and image has non-numeric user"],
        Cause::ImageUser,
    ),
];

/// `CreateContainerError`, `RunContainerError`, `StartError`, `ContainerCannotRun`; in small letters. The words of nodes stand first:
/// they quote programs and files of their own that are missing.
const STARTS: [Row; 19] = [
    // NVIDIA's toolkit, as the runtime of a container or as a hook of it.
    (&["nvidia-container-"], Cause::Node),
    (&["cdi device"], Cause::Node),
    (&["error running ", "hook"], Cause::Node),
    // containerd's shim, which starts runc itself.
    (&["unable to retrieve oci runtime error"], Cause::Node),
    (&["failed to start shim"], Cause::Node),
    // containerd and CRI-O, which look users and groups up in the image.
    (&["unable to find user "], Cause::ImageProgram),
    (&["unable to find group "], Cause::ImageProgram),
    (&["no users found"], Cause::ImageProgram),
    (&["no groups found"], Cause::ImageProgram),
    (&["/etc/passwd: no such file or directory"], Cause::ImageProgram),
    // runc, and crun: the first process of the container.
    (
        &["container process", " exec: \"", "no such file or directory"],
        Cause::ImageProgram,
    ),
    (
        &["container process", " exec: \"", "not found in $path"],
        Cause::ImageProgram,
    ),
    (
        &["container process", " exec: \"", "permission denied"],
        Cause::ImageProgram,
    ),
    (&["container process", "exec format error"], Cause::ImageProgram),
    (&["exec user process", "exec format error"], Cause::ImageProgram),
    (&["executable file `", "no such file or directory"], Cause::ImageProgram),
    (&["chdir to cwd (", "no such file or directory"], Cause::ImageProgram),
    (&["chdir to cwd (", "permission denied"], Cause::ImageProgram),
    (&["chdir to cwd (", "not a directory"], Cause::ImageProgram),
];

/// `ErrImagePull`, `ImagePullBackOff`. An image is missing only where the registry itself has looked for it. A host, a token or a layer that
/// is `not found` is the registry's, and what containerd has lost the node's.
const PULLS: [Row; 10] = [
    (&["failed to do request"], Cause::Registry),
    (&["failed to authorize"], Cause::Registry),
    (&["no match for platform"], Cause::ImagePlatform),
    (
        &["no image found in image index for architecture"],
        Cause::ImagePlatform,
    ),
    (
        &["no image found in manifest list for architecture"],
        Cause::ImagePlatform,
    ),
    (&["manifest unknown"], Cause::ImageMissing),
    (&["name unknown"], Cause::ImageMissing),
    (&["failed to resolve reference", ": not found"], Cause::ImageMissing),
    (&["unsupported media type"], Cause::ImageKind),
    (
        &["media type", "is no longer supported since containerd"],
        Cause::ImageKind,
    ),
];

/// Why the kubelet cannot set a container up.
pub(super) fn of_config(words: &str) -> Cause {
    first(&CONFIGS, words).unwrap_or(Cause::Host)
}

/// Why a container cannot be made, or its first process not be started.
pub(super) fn of_start(words: &str) -> Cause {
    // The first process is the operator's own runner: an image can neither lack it nor forbid it.
    if ['"', '`']
        .iter()
        .any(|quote| words.contains(&format!("{quote}{TOOLS}/")))
    {
        return Cause::Node;
    }
    first(&STARTS, &words.to_ascii_lowercase()).unwrap_or(Cause::Node)
}

/// Why an image cannot be pulled.
pub(super) fn of_pull(words: &str) -> Cause {
    first(&PULLS, words).unwrap_or(Cause::Registry)
}

fn first(rows: &[Row], words: &str) -> Option<Cause> {
    let is_there = |signs: &[&str]| signs.iter().all(|sign| words.contains(sign));
    rows.iter().find(|(signs, _)| is_there(signs)).map(|(_, cause)| *cause)
}

/// The failure of a Pod that was evicted because of its own disk. Another one on the same node would run into it again.
pub(super) fn disk_full(draft: &PlanBuilder<'_>) -> Option<Failure> {
    let pod = draft.view.pod.as_ref()?;
    let (_, words) = pod.ended_by_node.as_ref().filter(|(reason, _)| reason == "Evicted")?;
    let account = Account::of(words)?;
    let what = format!("The Pod was evicted because its disk was full: {}", sentence(words));
    // Nobody else writes before the evaluators.
    let is_first = agents_of(&draft.status) == Agents::First && pod.agent_started.is_some();
    let is_alone = is_first && !limits::have_hosts_begun(pod);
    let is_agents = match account {
        Account::Container(name) => is_agent(name),
        Account::Volume(LOGS_VOLUME) | Account::Pod if is_alone => true,
        Account::Volume(LOGS_VOLUME) => {
            let report = draft.view.report.ours().filter(|report| report.pod_uid == pod.uid);
            report.is_some_and(|report| report.agents_fill_disk)
        }
        Account::Volume(name) => {
            let member = name.strip_prefix(SHM_VOLUME);
            member.is_some_and(names::is_agent_container) || is_of_agents_alone(name, draft.leaderboard())
        }
        Account::Pod => false,
    };
    Some(if is_agents {
        charged(Reason::DiskFull, &what)
    } else {
        infrastructure(Reason::DiskFull, &what)
    })
}

/// On whose account the kubelet has measured.
enum Account<'a> {
    Container(&'a str),
    Volume(&'a str),
    Pod,
}

impl<'a> Account<'a> {
    /// None: another limit, or the node's own shortage, which names containers too.
    fn of(words: &'a str) -> Option<Self> {
        if let Some((name, _)) = words
            .strip_prefix("Container ")
            .and_then(|rest| rest.split_once(" exceeded its local ephemeral storage limit"))
        {
            return Some(Self::Container(name));
        }
        if let Some((name, _)) = words
            .strip_prefix("Usage of EmptyDir volume \"")
            .and_then(|rest| rest.split_once('"'))
        {
            return Some(Self::Volume(name));
        }
        words
            .starts_with("Pod ephemeral local storage usage exceeds")
            .then_some(Self::Pod)
    }
}

/// A container of an agent, or the name that stands for those of all agents in an overlay.
fn is_agent(name: &str) -> bool {
    name == "agent" || names::is_agent_container(name)
}

/// True if agents write to a volume of the hosts' own, and no other container does.
fn is_of_agents_alone(volume: &str, leaderboard: Option<&LeaderboardSpec>) -> bool {
    let Some(pod) = leaderboard.and_then(|spec| spec.pod_overrides.as_ref()?.get("spec")) else {
        return false;
    };
    let writes = |container: &&Value| {
        let mounts = container["volumeMounts"].as_array();
        let mut mounts = mounts.into_iter().flatten();
        mounts.any(|mount| mount["name"] == volume && mount["readOnly"] != true)
    };
    let lists = ["initContainers", "containers"].map(|list| pod[list].as_array());
    let mut writers = lists.into_iter().flatten().flatten().filter(writes).peekable();
    writers.peek().is_some() && writers.all(|container| container["name"].as_str().is_some_and(is_agent))
}
