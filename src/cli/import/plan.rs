//! What the original's entries become: objects of Kubernetes, what is dropped, and what a person still has to decide. Pure.

use std::collections::{BTreeMap, BTreeSet};

use jiff::Timestamp;
use leaderboard_api::{GROUP, LeaderboardSpec, LeaderboardVersion, Storage, VERSION};
use serde_json::{Map, Value, json};

use super::decisions::{DecisionError, Decisions};
use super::entries::{Board, BoardEntry, EVALAI, Entries, TrackEntry};
use super::options::{Options, Queue};
use super::questions;
use super::taint::Taint;

/// Requests a minute of one operator of two, which share EvalAI's 60.
const SHARED_BUDGET: i32 = 27;
/// Nodes of the original: four GPUs each, one for each pair.
const INSTANCE_TYPE: &str = "g5.12xlarge";
/// What simulators request of the device plugin.
const GPU: &str = "nvidia.com/gpu";
/// The key of the token in its entry.
const TOKEN_KEY: &str = "auth_token";

/// All that is printed.
#[derive(Clone, Debug)]
pub(super) struct Import {
    pub(super) documents: Vec<Document>,
    /// What is not taken over, and why.
    pub(super) dropped: Vec<String>,
    /// What a person has to decide.
    pub(super) decide: Vec<String>,
    /// Values of the chart that let the operator serve these objects.
    pub(super) values: Value,
    /// The queues that are read, by URL and region.
    pub(super) queues: BTreeSet<(String, Option<String>)>,
    /// The log groups that are written to.
    pub(super) log_groups: BTreeSet<String>,
}

/// One object, with comments before fields of its spec.
#[derive(Clone, Debug)]
pub(super) struct Document {
    pub(super) comment: Option<String>,
    pub(super) object: Value,
    pub(super) notes: Vec<(String, String)>,
}

/// Why there is nothing to print.
#[derive(thiserror::Error, Debug)]
pub(super) enum PlanError {
    #[error("{}", .0.iter().map(ToString::to_string).collect::<Vec<_>>().join("\n"))]
    Decisions(Vec<DecisionError>),
    #[error(
        "--challenge is missing: no entry holds the id of the challenge; it is in the address of its page in EvalAI, or may be \
         evalai.challenge of --decisions"
    )]
    NoChallenge,
    /// A mistake of this program, or a field that a decision has removed.
    #[error("the Leaderboard {name} would not be one: {source}; {next}")]
    NotALeaderboard {
        name: &'static str,
        source: serde_json::Error,
        next: String,
    },
}

/// Makes the objects.
pub(super) fn plan(
    entries: &Entries,
    options: &Options,
    decisions: &Decisions,
    now: Timestamp,
) -> Result<Import, PlanError> {
    let tracks = entries.boards.iter().map(|board| (board.board, track_names(board)));
    let unknown = decisions.unknown_tracks(&tracks.collect::<BTreeMap<Board, BTreeSet<String>>>());
    if !unknown.is_empty() {
        return Err(PlanError::Decisions(unknown));
    }
    let mut documents = vec![namespace(options), service_account(options)];
    let mut specs = Vec::new();
    for board in &entries.boards {
        let mut spec = spec(entries, board, options);
        decisions.lay_over(board.board, &mut spec);
        specs.push(read(board, &spec, decisions)?);
        documents.push(leaderboard(board, spec, options, decisions));
    }
    let dropped = entries.dropped.iter();
    Ok(Import {
        documents,
        dropped: dropped.map(|d| format!("{}: {} ({})", d.entry, d.key, d.why)).collect(),
        decide: questions::open(entries, options, decisions, now),
        values: values(options, &specs),
        queues: specs.iter().filter_map(queue_of).collect(),
        log_groups: specs
            .iter()
            .filter_map(|spec| Some(spec.log_group.as_ref()?.name.clone()))
            .collect(),
    })
}

/// A spec as the operator reads it.
fn read(board: &BoardEntry, spec: &Value, decisions: &Decisions) -> Result<LeaderboardSpec, PlanError> {
    if spec["evalai"].is_object() && spec["evalai"]["challenge"].is_null() {
        return Err(PlanError::NoChallenge);
    }
    let next = match decisions.file() {
        "" => "report this with the keys of the entry, without their texts".to_owned(),
        file => format!("look at what {file} removes"),
    };
    let name = board.board.entry();
    serde_json::from_value(spec.clone()).map_err(|source| PlanError::NotALeaderboard { name, source, next })
}

/// Leaderboards may name only what the chart's values allow.
fn values(options: &Options, specs: &[LeaderboardSpec]) -> Value {
    let queues = specs.iter().filter_map(|spec| spec.queue.as_ref());
    let queues: BTreeSet<_> = queues
        .flat_map(|queue| std::iter::once(&queue.url).chain(&queue.dead_letter_url))
        .collect();
    let tokens = || specs.iter().filter_map(|spec| Some(&spec.evalai.as_ref()?.token));
    let entries: BTreeSet<_> = tokens()
        .filter_map(|token| Some(&token.secrets_manager.as_ref()?.id))
        .collect();
    let secrets: BTreeSet<_> = tokens()
        .filter_map(|token| Some(&token.secret_key_ref.as_ref()?.name))
        .collect();
    let mut values = json!({"namespace": options.namespace, "secretsManager": entries, "queues": queues});
    if !secrets.is_empty() {
        values["secrets"] = json!(secrets);
    }
    let tables = specs.iter().filter_map(|spec| Some(&spec.table.as_ref()?.name));
    let groups = specs.iter().filter_map(|spec| Some(&spec.log_group.as_ref()?.name));
    values["buckets"] = json!(specs.iter().map(|spec| bucket(&spec.storage)).collect::<BTreeSet<_>>());
    values["tables"] = json!(tables.collect::<BTreeSet<_>>());
    values["logGroups"] = json!(groups.collect::<BTreeSet<_>>());
    json!({"leaderboards": [values]})
}

/// A bucket with its prefix, or all of it.
fn bucket(storage: &Storage) -> String {
    let prefix = storage.prefix.as_deref().filter(|prefix| !prefix.is_empty());
    prefix.map_or_else(
        || storage.bucket.clone(),
        |prefix| format!("{}/{prefix}", storage.bucket),
    )
}

fn queue_of(spec: &LeaderboardSpec) -> Option<(String, Option<String>)> {
    let queue = spec.queue.as_ref()?;
    Some((queue.url.clone(), queue.region.clone()))
}

fn plain(comment: &str, object: Value) -> Document {
    Document {
        comment: Some(comment.to_owned()),
        object,
        notes: Vec::new(),
    }
}

fn namespace(options: &Options) -> Document {
    plain(
        "Privileged simulators need the Pod Security level privileged.",
        json!({
            "apiVersion": "v1", "kind": "Namespace",
            "metadata": {
                "name": options.namespace,
                "labels": {"pod-security.kubernetes.io/enforce": "privileged"},
            },
        }),
    )
}

fn service_account(options: &Options) -> Document {
    plain(
        "The Pods of submissions. It needs no rights in the cluster and no annotation; its role is in podIdentity.",
        json!({
            "apiVersion": "v1", "kind": "ServiceAccount",
            "metadata": {"name": options.service_account, "namespace": options.namespace},
        }),
    )
}

fn leaderboard(board: &BoardEntry, spec: Value, options: &Options, decisions: &Decisions) -> Document {
    let name = board.board.entry();
    let mut object = json!({
        "apiVersion": format!("{GROUP}/{VERSION}"), "kind": "Leaderboard",
        "metadata": {"name": name, "namespace": options.namespace},
    });
    object["spec"] = spec;
    Document {
        comment: Some(format!("From the entry {name}.")),
        object,
        notes: notes(board, options, decisions),
    }
}

fn spec(entries: &Entries, board: &BoardEntry, options: &Options) -> Value {
    let version = board.board.version();
    let mut spec = json!({
        "evalai": evalai(entries, options),
        "leaderboardVersion": version,
        "pairs": 4, "routes": 20,
        "repetitions": if version == LeaderboardVersion::V1 { 5 } else { 1 },
        "tracks": board.tracks.iter().map(|track| self::track(board, track, &options.taints)).collect::<Vec<_>>(),
        "contents": {"image": board.contents_image},
        "gpu": {"mode": "NodeIndex", "resourceName": GPU},
        "simulator": simulator(board),
        "agent": {"resources": resources("6", "16Gi", "20Gi")},
        "storage": {"bucket": board.bucket, "region": options.region},
        "table": {"name": board.table, "region": options.region},
        "network": {"egress": options.egress.iter().map(|cidr| json!({"cidr": cidr, "ports": [443]})).collect::<Vec<_>>()},
        "deadlines": {"runSeconds": 0},
        "concurrency": {"total": if version == LeaderboardVersion::V1 { 2 } else { 4 }},
    });
    if let Some(queue) = &options.queue {
        spec["queue"] = self::queue(queue, options);
    }
    if let Some(group) = &board.log_group {
        spec["logGroup"] = json!({"name": group, "region": options.region});
    }
    if let Some(role) = &options.role_arn {
        spec["podIdentity"] = json!({"serviceAccountName": options.service_account, "roleARN": role});
    }
    if options.egress.is_empty()
        && let Some(fields) = spec.as_object_mut()
    {
        fields.remove("network");
    }
    spec
}

fn evalai(entries: &Entries, options: &Options) -> Value {
    let mut token = json!({"id": EVALAI, "key": TOKEN_KEY, "region": options.region});
    if let Some(endpoint) = &options.endpoint {
        token["endpoint"] = json!(endpoint);
    }
    let mut evalai = json!({
        "apiServer": entries.api_server,
        "token": {"secretsManager": token},
    });
    if let Some(challenge) = options.challenge {
        evalai["challenge"] = json!(challenge);
    }
    if options.two_operators {
        evalai["requestsPerMinute"] = json!(SHARED_BUDGET);
    }
    evalai
}

fn queue(queue: &Queue, options: &Options) -> Value {
    let mut fields = Map::from_iter([
        ("url".to_owned(), json!(queue.url)),
        ("region".to_owned(), json!(queue.arn.region())),
    ]);
    if let Some(dead) = &options.dead_letter {
        fields.insert("deadLetterURL".to_owned(), json!(dead));
    }
    if options.two_operators {
        fields.insert("foreign".to_owned(), json!("Leave"));
    }
    Value::Object(fields)
}

fn track_names(board: &BoardEntry) -> BTreeSet<String> {
    board.tracks.iter().map(|track| board.track_name(track)).collect()
}

fn track(board: &BoardEntry, track: &TrackEntry, taints: &[Taint]) -> Value {
    let mut fields = json!({
        "name": board.track_name(track), "codename": track.codename, "phase": track.phase,
        "routesFile": "/workspace/leaderboard/data/routes_testing.xml",
        "nodeSelector": {"node.kubernetes.io/instance-type": INSTANCE_TYPE},
    });
    if !taints.is_empty() {
        fields["tolerations"] = taints.iter().map(Taint::toleration).collect();
    }
    if board.board.version() == LeaderboardVersion::V1 {
        fields["scenariosFile"] = json!("/workspace/leaderboard/data/all_towns_traffic_scenarios_private.json");
    }
    fields
}

fn simulator(board: &BoardEntry) -> Value {
    json!({
        "image": board.simulator_image,
        // The original's 1.0 draws without an X server.
        "display": if board.board.version() == LeaderboardVersion::V1 { "Offscreen" } else { "X11Socket" },
        "securityContext": {"privileged": true},
        "resources": resources("4", "12Gi", "10Gi"),
    })
}

/// Requests that let four pairs fit on one node of the original's. No limit of memory: a guessed one ends honest agents.
fn resources(cpu: &str, memory: &str, disk: &str) -> Value {
    json!({
        "requests": {"cpu": cpu, "memory": memory, "ephemeral-storage": "2Gi"},
        "limits": {"ephemeral-storage": disk},
    })
}

/// Comments: why a field is as it is, and which fields a person has decided.
fn notes(board: &BoardEntry, options: &Options, decisions: &Decisions) -> Vec<(String, String)> {
    let reasons = reasons(board).into_iter().chain(reasons_of_the_command(board, options));
    let left = reasons.filter(|(_, field, _)| !decisions.set(board.board, field));
    let mut notes: Vec<_> = left.map(|(key, _, text)| (key.to_owned(), text)).collect();
    let decided = decisions.keys(board.board).into_iter();
    notes.extend(decided.map(|key| (key.to_owned(), format!("Decided in {}.", decisions.file()))));
    notes
}

/// The key before which a comment stands, the field that it explains, and its text.
fn reasons(board: &BoardEntry) -> [(&'static str, &'static str, String); 6] {
    [
        (
            "pairs",
            "pairs",
            "As in the original: 20 routes over 4 pairs (0-4, 5-9, 10-14, 15-19).".to_owned(),
        ),
        (
            "gpu",
            "gpu",
            "As in the original: pair n has GPU n-1 of its node. That needs a default runtime nvidia and the device plugin's strategy \
             envvar. Later: mode PerContainer works with every plugin."
                .to_owned(),
        ),
        ("simulator", "simulator.securityContext", simulator_note(board)),
        (
            "deadlines",
            "deadlines.runSeconds",
            "As in the original, a run has no time limit, so an agent that does not end keeps its node until it is cancelled. \
             Pulls of its images may take 90 minutes (pullSeconds), and the rest of its start 30 (startSeconds)."
                .to_owned(),
        ),
        (
            "concurrency",
            "concurrency",
            "The most nodes that the original's node group had for this Leaderboard; one submission takes one node.".to_owned(),
        ),
        (
            "agent",
            "agent.resources",
            "The original requested no CPU, memory or disk; these let four pairs fit on a g5.12xlarge.".to_owned(),
        ),
    ]
}

/// The same for what neither the entry nor the command's options name.
fn reasons_of_the_command(board: &BoardEntry, options: &Options) -> Vec<(&'static str, &'static str, String)> {
    let mut notes = Vec::new();
    if options.queue.is_none() {
        notes.push((
            "leaderboardVersion",
            "queue",
            "TODO: queue: {url: …, region: …}, the SQS queue of the challenge. Without it submissions come from EvalAI's lists alone, \
             one minute and more after they were made."
                .to_owned(),
        ));
    } else if options.two_operators {
        notes.push((
            "queue",
            "queue.foreign",
            "Two operators read this queue: each leaves the other's messages, and takes half of EvalAI's requests."
                .to_owned(),
        ));
    }
    if board.log_group.is_none() {
        notes.push((
            "storage",
            "logGroup",
            "TODO: logGroup: {name: …, region: …}; the entry has no cloudwatch_log_group.".to_owned(),
        ));
    }
    notes
}

fn simulator_note(board: &BoardEntry) -> String {
    let display = match board.board.version() {
        LeaderboardVersion::V1 => "",
        LeaderboardVersion::V2 => {
            " The X server of the node too is the original's; with an image that draws on no screen, display: Offscreen needs none."
        }
    };
    format!(
        "As in the original: privileged. Remove that once the simulator runs without it, since a hostile agent that takes over a \
         privileged simulator has the node.{display}"
    )
}

#[cfg(test)]
#[path = "plan_tests.rs"]
mod tests;
