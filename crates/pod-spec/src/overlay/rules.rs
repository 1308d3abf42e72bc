//! Fields that an overlay may not set, and why. Pure; the messages are shown in a Leaderboard's `InvalidPod`.

use std::borrow::Cow;

use k8s_openapi::api::core::v1::PodTemplateSpec;
use serde_json::{Map, Value};

use super::without_nulls;
use crate::layout::{ANNOTATION_SKIP_CONTAINERS, is_own_volume, protected_mounts};
use leaderboard_api::{Agents, DataSource, LeaderboardSpec, Part, names};
use leaderboard_contract::run::{ENV_POD_UID, ENV_ROLE_ARN, ENV_RUN};
use leaderboard_evaluation::workload::{Data, Reserved};
use leaderboard_protocol::files::{Host, Member, Side};

/// Why a Leaderboard's `podOverrides` cannot be used. `path` is below `spec` of the Leaderboard.
#[derive(thiserror::Error, Debug, PartialEq, Eq)]
pub enum OverlayError {
    /// Something else where an object, a list or a name is needed.
    #[error("{path} is not {expected}")]
    Shape {
        /// Where.
        path: String,
        /// The shape that is needed there.
        expected: &'static str,
    },
    /// A field of another type than Kubernetes' own.
    #[error("podOverrides is not a partial Pod template: {message}")]
    Template {
        /// The error of Kubernetes' types.
        message: String,
    },
    /// A field that is the operator's.
    #[error("{path} cannot be overridden: {why}")]
    Protected {
        /// Where.
        path: String,
        /// The reason, with where to say it instead if there is such a place.
        why: Cow<'static, str>,
    },
}

type Checked = Result<(), OverlayError>;
/// An item of a list with its path.
type Named<'a> = (String, &'a Map<String, Value>);

/// The Pods of a Leaderboard, as far as an overlay can meet them.
struct Pods<'a> {
    host: Host,
    agents: Agents,
    reserved: Reserved,
    data: Vec<Data<'a>>,
}

impl<'a> Pods<'a> {
    fn of(spec: &'a LeaderboardSpec) -> Self {
        let kind = leaderboard_evaluation::of(spec);
        Self {
            host: kind.host(),
            agents: kind.agents(),
            reserved: kind.reserved(spec),
            data: kind.data(spec),
        }
    }

    /// True for a volume that nobody but the operator mounts.
    fn is_own_volume(&self, name: &str) -> bool {
        is_own_volume(name) || self.data.iter().any(|data| data.volume.name == name)
    }

    /// True for a claim with data, which a volume of another name would give to any container.
    fn is_own_claim(&self, claim: &Value) -> bool {
        self.data.iter().any(|data| match data.source {
            DataSource::Image(_) => false,
            DataSource::PersistentVolumeClaim(own) => *claim == own.claim_name,
        })
    }

    /// True for the init container that fills a volume with data.
    fn fills(&self, name: &str) -> bool {
        let mut of_images = self.data.iter().filter(|data| data.source.image().is_some());
        of_images.any(|data| data.volume.name == name)
    }
}

const STATUS_IS_READ: &str = "the controller reads how each container ended there";
const RUN_BY_US: &str = "the operator runs it and knows how";
/// Fields of the Pod's spec that stay ours.
const POD_FIELDS: [(&str, &str); 11] = [
    ("restartPolicy", "a crashed worker resumes by OnFailure"),
    (
        "serviceAccountName",
        "it is the Pod's identity; set podIdentity.serviceAccountName",
    ),
    (
        "serviceAccount",
        "it is the Pod's identity; set podIdentity.serviceAccountName",
    ),
    (
        "automountServiceAccountToken",
        "strangers' images would get a token of the cluster",
    ),
    (
        "shareProcessNamespace",
        "strangers' images could read logcopy's environment",
    ),
    ("hostPID", "strangers' images could read every process of the node"),
    (
        "hostIPC",
        "strangers' images could read the shared memory of the node's processes",
    ),
    ("hostNetwork", "the NetworkPolicy would not hold for the Pod"),
    ("activeDeadlineSeconds", "it follows from deadlines; set those"),
    (
        "runtimeClassName",
        "the Leaderboard has a field of its own; set runtimeClassName",
    ),
    ("ephemeralContainers", "a template has none"),
];
/// Fields of every container of ours, with where else they are set.
const CONTAINER_FIELDS: [(&str, &str); 5] = [
    (
        "image",
        "it is pinned with the run; set the image in evaluation, the agent's is the participant's",
    ),
    (
        "command",
        "the runner stands in front of it; set command in evaluation or agent",
    ),
    (
        "args",
        "the runner stands in front of them; set args in evaluation or agent",
    ),
    ("terminationMessagePath", STATUS_IS_READ),
    ("terminationMessagePolicy", STATUS_IS_READ),
];
const OWN_ENV: [&str; 6] = [
    ENV_RUN,
    ENV_POD_UID,
    ENV_ROLE_ARN,
    "AWS_ACCESS_KEY_ID",
    "AWS_SECRET_ACCESS_KEY",
    "AWS_SESSION_TOKEN",
];

/// Checks all of a Leaderboard that goes into its Pods: `podOverrides`, and the variables of its containers.
pub fn validate(spec: &LeaderboardSpec) -> Checked {
    let reserved = leaderboard_evaluation::of(spec).reserved(spec);
    for hosts in [Part::Host, Part::Agent]
        .into_iter()
        .filter_map(|part| spec.given(None, part))
    {
        let names = hosts.env.iter().map(|variable| variable.name.as_str());
        fixed_names(&format!("{}.env", hosts.path), names, &reserved)?;
    }
    let overlay = spec.pod_overrides.as_ref();
    overlay.map_or(Ok(()), |pod| validate_overlay(pod, spec))
}

/// Checks a Leaderboard's `podOverrides`. The API server's answer to a dry run of the Job then judges what is left.
pub fn validate_overlay(pod: &Value, leaderboard: &LeaderboardSpec) -> Checked {
    let template = object(pod, "podOverrides")?;
    only(
        template,
        "podOverrides",
        &["metadata", "spec"],
        "a template has metadata and spec",
    )?;
    if let Some(value) = template.get("metadata") {
        metadata(object(value, "podOverrides.metadata")?)?;
    }
    if let Some(value) = template.get("spec") {
        spec(object(value, "podOverrides.spec")?, &Pods::of(leaderboard))?;
    }
    let typed: Result<PodTemplateSpec, _> = serde_json::from_value(without_nulls(pod));
    typed.map(|_| ()).map_err(|error| OverlayError::Template {
        message: error.to_string(),
    })
}

fn metadata(metadata: &Map<String, Value>) -> Checked {
    let path = "podOverrides.metadata";
    only(
        metadata,
        path,
        &["labels", "annotations"],
        "the Job names its Pods and owns them",
    )?;
    for field in ["labels", "annotations"] {
        let Some(value) = metadata.get(field) else { continue };
        let path = format!("{path}.{field}");
        for key in object(value, &path)?.keys() {
            let prefix = key.split_once('/').map_or("", |(prefix, _)| prefix);
            let ours = prefix == leaderboard_api::GROUP
                || [names::LABEL_MANAGED_BY, ANNOTATION_SKIP_CONTAINERS].contains(&key.as_str());
            let kubernetes = prefix == "batch.kubernetes.io" || ["job-name", "controller-uid"].contains(&key.as_str());
            if ours || kubernetes {
                return protected(format!("{path}[{key}]"), "the operator finds and guards its Pods by it");
            }
        }
    }
    Ok(())
}

fn spec(spec: &Map<String, Value>, pods: &Pods<'_>) -> Checked {
    fields(spec, "podOverrides.spec", &POD_FIELDS)?;
    if let Some(value) = spec.get("volumes") {
        volumes(value, pods)?;
    }
    for (field, init) in [("initContainers", true), ("containers", false)] {
        let Some(value) = spec.get(field) else { continue };
        for (path, container) in named(value, &format!("podOverrides.spec.{field}"))? {
            check_container(&path, container, init, pods)?;
        }
    }
    Ok(())
}

fn volumes(value: &Value, pods: &Pods<'_>) -> Checked {
    for (path, volume) in named(value, "podOverrides.spec.volumes")? {
        if let Some(name) = volume["name"].as_str()
            && (pods.is_own_volume(name) || pods.reserved.volumes.iter().any(|known| known.name == name))
        {
            return protected(path, "the operator fills this volume; give yours another name");
        }
        let claim = volume.get("persistentVolumeClaim");
        if claim.is_some_and(|claim| pods.is_own_claim(&claim["claimName"])) {
            return protected(path, "the operator mounts this claim where evaluation.container says");
        }
        let sources = volume
            .get("projected")
            .and_then(|projected| projected["sources"].as_array());
        if sources.is_some_and(|sources| sources.iter().any(|source| source.get("serviceAccountToken").is_some())) {
            return protected(
                path,
                "strangers' images would get a token of the Pod's identity; set podIdentity",
            );
        }
    }
    Ok(())
}

/// Whose container an entry of the overlay speaks of.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Whose {
    /// `workspace`, `logcopy`, `collect`.
    Own,
    /// `contents`.
    Contents,
    /// `dataset`, `labels`.
    Data,
    /// The host's or the agent's of one worker or all.
    Worker,
    /// The agent that ends before the hosts' containers start.
    First,
    /// An init container of the host's.
    Added,
    /// One that only Pods of other Leaderboards have.
    OfOthers,
}

fn check_container(path: &str, container: &Map<String, Value>, init: bool, pods: &Pods<'_>) -> Checked {
    let whose = whose(container["name"].as_str().unwrap_or_default(), pods);
    match (whose, init) {
        (Whose::OfOthers, _) => {
            let why = "no Pod of this Leaderboard has it, and the name is the operator's; take another name";
            return protected(path.into(), why);
        }
        (Whose::Own | Whose::Contents | Whose::Data | Whose::First, false) => {
            return protected(path.into(), "it is an init container");
        }
        (Whose::Worker, true) => return protected(path.into(), "it belongs to containers"),
        (Whose::Added, false) => {
            let why = "a further container would keep the Pod from ending; add it to initContainers with restartPolicy Always";
            return protected(path.into(), why);
        }
        _ => {}
    }
    mounts(path, container, pods)?;
    if whose == Whose::Added {
        return Ok(());
    }
    fields(container, path, &CONTAINER_FIELDS)?;
    fields(
        container,
        path,
        &[("restartPolicy", RUN_BY_US), ("restartPolicyRules", RUN_BY_US)],
    )?;
    if whose == Whose::Data {
        fields(container, path, &[("volumeMounts", RUN_BY_US)])?;
    }
    env(path, container, whose, &pods.reserved)
}

fn whose(name: &str, pods: &Pods<'_>) -> Whose {
    let mut sides = [Side::Host(pods.host), Side::Agent].into_iter();
    let alias = sides.find(|side| side.name() == name);
    match (name, Member::parse(name).map(|member| member.side).or(alias)) {
        (names::CONTAINER_WORKSPACE | names::CONTAINER_LOGCOPY, _) => Whose::Own,
        (names::CONTAINER_COLLECT, _) if pods.agents == Agents::First => Whose::Own,
        (names::CONTAINER_CONTENTS, _) if !pods.reserved.volumes.is_empty() => Whose::Contents,
        (names::CONTAINER_DATASET | names::CONTAINER_LABELS, _) if pods.fills(name) => Whose::Data,
        (names::CONTAINER_CONTENTS, _) => Whose::OfOthers,
        // A Leaderboard of CARLA may have one of its own by such a name.
        (names::CONTAINER_COLLECT | names::CONTAINER_DATASET | names::CONTAINER_LABELS, _)
            if pods.host == Host::Evaluator =>
        {
            Whose::OfOthers
        }
        (_, Some(Side::Agent)) => match pods.agents {
            Agents::Beside => Whose::Worker,
            Agents::First => Whose::First,
            Agents::Absent => Whose::OfOthers,
        },
        (_, Some(Side::Host(host))) if host == pods.host => Whose::Worker,
        (_, Some(Side::Host(_))) => Whose::OfOthers,
        (_, None) => Whose::Added,
    }
}

fn env(path: &str, container: &Map<String, Value>, whose: Whose, reserved: &Reserved) -> Checked {
    let path = format!("{path}.env");
    let Some(value) = container.get("env") else {
        return Ok(());
    };
    let variables = named(value, &path)?;
    let mut names = variables.iter().filter_map(|(_, variable)| variable["name"].as_str());
    match whose {
        Whose::Own => match names.find(|name| OWN_ENV.contains(name)) {
            Some(name) => protected(
                format!("{path}[{name}]"),
                "it is the container's task or identity; set podIdentity",
            ),
            None => Ok(()),
        },
        Whose::Worker | Whose::First => fixed_names(&path, names, reserved),
        Whose::Contents | Whose::Data | Whose::Added | Whose::OfOthers => Ok(()),
    }
}

fn fixed_names<'a>(path: &str, mut names: impl Iterator<Item = &'a str>, reserved: &Reserved) -> Checked {
    match names.find(|name| reserved.env.contains(name)) {
        Some(name) => protected(
            format!("{path}[{name}]"),
            "it follows from the plan of the run; set the fields of evaluation, or of the track, that the plan is made of",
        ),
        None => Ok(()),
    }
}

fn mounts(path: &str, container: &Map<String, Value>, pods: &Pods<'_>) -> Checked {
    let path = format!("{path}.volumeMounts");
    let Some(value) = container.get("volumeMounts") else {
        return Ok(());
    };
    for (index, mount) in list(value, &path)?.iter().enumerate() {
        let path = format!("{path}[{index}]");
        let mount = object(mount, &path)?;
        let Some(target) = mount.get("mountPath").and_then(Value::as_str) else {
            return Err(OverlayError::Shape {
                path: format!("{path}.mountPath"),
                expected: "a path",
            });
        };
        if let Some(ours) = protected_mounts(&pods.reserved).find(|ours| below(target, ours)) {
            return protected(path, format!("the operator mounts {ours}"));
        }
        let volume = mount.get("name").and_then(Value::as_str).unwrap_or_default();
        let read_only = mount.get("readOnly") == Some(&Value::Bool(true));
        if pods.is_own_volume(volume) {
            return protected(path, format!("volume {volume} is mounted by the operator alone"));
        }
        if !read_only && pods.reserved.volumes.iter().any(|known| known.name == volume) {
            return protected(
                path,
                format!("volume {volume} holds the contents; mount it with readOnly true"),
            );
        }
    }
    Ok(())
}

/// True if `target` is `ours` or lies below it, however it is spelled.
fn below(target: &str, ours: &str) -> bool {
    let mut parts: Vec<&str> = Vec::new();
    for part in target.split('/').filter(|part| !part.is_empty() && *part != ".") {
        match part {
            ".." => drop(parts.pop()),
            part => parts.push(part),
        }
    }
    let ours: Vec<&str> = ours.split('/').filter(|part| !part.is_empty()).collect();
    parts.starts_with(&ours)
}

fn fields(object: &Map<String, Value>, path: &str, known: &[(&'static str, &'static str)]) -> Checked {
    match known.iter().find(|(field, _)| object.contains_key(*field)) {
        Some((field, why)) => protected(format!("{path}.{field}"), *why),
        None => Ok(()),
    }
}

fn only(object: &Map<String, Value>, path: &str, known: &[&str], why: &'static str) -> Checked {
    match object.keys().find(|key| !known.contains(&key.as_str())) {
        Some(key) => protected(format!("{path}.{key}"), why),
        None => Ok(()),
    }
}

fn protected(path: String, why: impl Into<Cow<'static, str>>) -> Checked {
    Err(OverlayError::Protected { path, why: why.into() })
}

/// Refuses `null` as well: it would remove what is ours.
fn object<'a>(value: &'a Value, path: &str) -> Result<&'a Map<String, Value>, OverlayError> {
    value.as_object().ok_or_else(|| OverlayError::Shape {
        path: path.into(),
        expected: "an object",
    })
}

fn list<'a>(value: &'a Value, path: &str) -> Result<&'a Vec<Value>, OverlayError> {
    value.as_array().ok_or_else(|| OverlayError::Shape {
        path: path.into(),
        expected: "a list",
    })
}

/// The items of a list by name, each with its path.
fn named<'a>(value: &'a Value, path: &str) -> Result<Vec<Named<'a>>, OverlayError> {
    let items = list(value, path)?.iter().enumerate().map(|(index, item)| {
        let item = object(item, &format!("{path}[{index}]"))?;
        match item.get("name").and_then(Value::as_str) {
            Some(name) => Ok((format!("{path}[{name}]"), item)),
            None => Err(OverlayError::Shape {
                path: format!("{path}[{index}].name"),
                expected: "a name",
            }),
        }
    });
    items.collect()
}
