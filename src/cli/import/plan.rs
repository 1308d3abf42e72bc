//! What the original's entries become: objects of Kubernetes, what is dropped, and what a person still has to decide. Pure.

use jiff::Timestamp;
use leaderboard_api::{GROUP, Leaderboard, LeaderboardVersion, VERSION};
use serde_json::{Map, Value, json};

use super::entries::{BoardEntry, EVALAI, Entries, TrackEntry};
use super::taint::Taint;
use crate::services::event_sources::QueueArn;
use crate::services::token::WARN_BEFORE;

/// Requests a minute of one operator of two, which share EvalAI's 60.
const SHARED_BUDGET: i32 = 27;
/// Nodes of the original: four GPUs each, one for each pair.
const INSTANCE_TYPE: &str = "g5.12xlarge";
/// What simulators request of the device plugin.
const GPU: &str = "nvidia.com/gpu";
/// The key of the token in its entry.
const TOKEN_KEY: &str = "auth_token";
const NO_ROLE: &str = "podIdentity: the role that may write to bucket and log group (--role-arn); without it the Pods have no \
                       credentials of their own";
const NO_EGRESS: &str = "network.egress: the addresses of the VPC's interface endpoints of S3, STS and CloudWatch Logs (--egress, each as \
                         address/32); where policies are enforced, nothing is stored without them";
const NO_TAINTS: &str = "tracks[].tolerations: do the GPU nodes have a taint (--taint)? The original's had none; with one that is not \
                         tolerated submissions stay Unschedulable";

/// What the entries do not hold.
#[derive(Clone, Debug)]
pub(super) struct Options {
    pub(super) namespace: String,
    pub(super) service_account: String,
    pub(super) role_arn: Option<String>,
    /// Of the entries, the buckets, the tables and the log groups.
    pub(super) region: String,
    /// In place of Secrets Manager's own.
    pub(super) endpoint: Option<String>,
    pub(super) challenge: i64,
    pub(super) queue: Option<Queue>,
    pub(super) dead_letter: Option<String>,
    pub(super) egress: Vec<String>,
    /// Of the GPU nodes.
    pub(super) taints: Vec<Taint>,
    /// Each Leaderboard has a cluster and an operator of its own.
    pub(super) two_operators: bool,
}

/// The queue of the challenge.
#[derive(Clone, Debug)]
pub(super) struct Queue {
    pub(super) url: String,
    pub(super) arn: QueueArn,
}

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
}

/// One object, with comments before fields of its spec.
#[derive(Clone, Debug)]
pub(super) struct Document {
    pub(super) comment: Option<String>,
    pub(super) object: Value,
    pub(super) notes: Vec<(&'static str, String)>,
}

/// Why an object cannot be printed: a mistake of this program, or a value that the API would refuse.
#[derive(thiserror::Error, Debug)]
#[error(
    "the Leaderboard {name} would not be one: {source}; report this with the keys of the entry, without their texts"
)]
pub(super) struct NotALeaderboard {
    name: &'static str,
    source: serde_json::Error,
}

/// Makes the objects.
pub(super) fn plan(entries: &Entries, options: &Options, now: Timestamp) -> Result<Import, NotALeaderboard> {
    let mut documents = vec![namespace(options), service_account(options)];
    for board in &entries.boards {
        documents.push(leaderboard(entries, board, options)?);
    }
    let dropped = entries.dropped.iter();
    Ok(Import {
        documents,
        dropped: dropped.map(|d| format!("{}: {} ({})", d.entry, d.key, d.why)).collect(),
        decide: decide(entries, options, now),
        values: values(options),
    })
}

/// Leaderboards may name only what the chart's values allow.
fn values(options: &Options) -> Value {
    let queues = options.queue.iter().map(|queue| &queue.url).chain(&options.dead_letter);
    json!({"leaderboards": [{
        "namespace": options.namespace,
        "secretsManager": [EVALAI],
        "queues": queues.collect::<Vec<_>>(),
    }]})
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

fn leaderboard(entries: &Entries, board: &BoardEntry, options: &Options) -> Result<Document, NotALeaderboard> {
    let name = board.board.entry();
    let object = json!({
        "apiVersion": format!("{GROUP}/{VERSION}"), "kind": "Leaderboard",
        "metadata": {"name": name, "namespace": options.namespace},
        "spec": spec(entries, board, options),
    });
    // Read back as the operator reads it.
    let read: Result<Leaderboard, _> = serde_json::from_value(object.clone());
    read.map_err(|source| NotALeaderboard { name, source })?;
    Ok(Document {
        comment: Some(format!("From the entry {name}.")),
        object,
        notes: notes(board, options),
    })
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
        "challenge": options.challenge,
        "token": {"secretsManager": token},
    });
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

fn track(board: &BoardEntry, track: &TrackEntry, taints: &[Taint]) -> Value {
    let short = track.codename.to_ascii_lowercase().replace(['_', '.'], "-");
    let short = short.trim_matches('-');
    let same = board
        .tracks
        .iter()
        .filter(|other| other.codename == track.codename)
        .count();
    // Names are unique, and two phases may have the same track.
    let name = match (same, short) {
        (_, "") => format!("phase-{}", track.phase),
        (1, short) => short.to_owned(),
        (_, short) => format!(
            "{}-{}",
            short.get(..12).unwrap_or(short).trim_end_matches('-'),
            track.phase
        ),
    };
    let mut fields = json!({
        "name": name, "codename": track.codename, "phase": track.phase,
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

fn notes(board: &BoardEntry, options: &Options) -> Vec<(&'static str, String)> {
    let mut notes = vec![
        (
            "pairs",
            "As in the original: 20 routes over 4 pairs (0-4, 5-9, 10-14, 15-19).".to_owned(),
        ),
        (
            "gpu",
            "As in the original: pair n has GPU n-1 of its node. That needs a default runtime nvidia and the device plugin's strategy \
             envvar. Later: mode PerContainer works with every plugin."
                .to_owned(),
        ),
        ("simulator", simulator_note(board)),
        (
            "deadlines",
            "As in the original, a run has no time limit, so an agent that does not end keeps its node until it is cancelled. \
             Pulls of its images may take 90 minutes (pullSeconds), and the rest of its start 30 (startSeconds)."
                .to_owned(),
        ),
        (
            "concurrency",
            "The most nodes that the original's node group had for this Leaderboard; one submission takes one node.".to_owned(),
        ),
        (
            "agent",
            "The original requested no CPU, memory or disk; these let four pairs fit on a g5.12xlarge.".to_owned(),
        ),
    ];
    if options.queue.is_none() {
        notes.push((
            "leaderboardVersion",
            "TODO: queue: {url: …, region: …}, the SQS queue of the challenge. Without it submissions come from EvalAI's lists alone, \
             one minute and more after they were made."
                .to_owned(),
        ));
    } else if options.two_operators {
        notes.push((
            "queue",
            "Two operators read this queue: each leaves the other's messages, and takes half of EvalAI's requests."
                .to_owned(),
        ));
    }
    if board.log_group.is_none() {
        notes.push((
            "storage",
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

const FLUENTD: &str = "logGroup: does the original's FluentD run on these nodes? Then each line is stored twice: leave logGroup out, or take \
                       the namespace out of FluentD's source (docs/migrate.md, Logs twice)";

fn decide(entries: &Entries, options: &Options, now: Timestamp) -> Vec<String> {
    let queue = match &options.queue {
        None => "queue: the URL of the SQS queue that EvalAI writes to (--queue), and its region".to_owned(),
        Some(queue) => format!(
            "queue: is {} the region of the queue? The original's was in us-west-2, its participants' images in us-east-1",
            queue.arn.region()
        ),
    };
    let challenge = format!(
        "evalai.challenge: is {} the challenge of these phases? No entry holds it",
        options.challenge
    );
    let open = |is_open: bool, question: &str| is_open.then(|| question.to_owned());
    let questions = [
        Some(token(entries, now)),
        Some(queue),
        open(
            options.queue.is_some() && options.dead_letter.is_none(),
            "queue.deadLetterURL: a queue for messages that cannot be used (--dead-letter); the original had none, and without \
             one they stay in the queue until it drops them",
        ),
        Some(challenge),
        open(options.role_arn.is_none(), NO_ROLE),
        open(options.egress.is_empty(), NO_EGRESS),
        Some("tracks[].nodeSelector: is g5.12xlarge still the instance type of the GPU nodes?".to_owned()),
        Some("concurrency: how many submissions may run at once, in all and of one team".to_owned()),
        Some(
            "resources: CPU, memory and disk of simulators and agents; the original requested one GPU and nothing else"
                .to_owned(),
        ),
        Some("deadlines.runSeconds: how long a run may take; 0 is no limit, as in the original".to_owned()),
        open(entries.boards.iter().any(|board| board.log_group.is_some()), FLUENTD),
        open(options.taints.is_empty(), NO_TAINTS),
        open(
            options.two_operators,
            "which cluster gets which Leaderboard: apply only one of the two in each (--only prints one)",
        ),
    ];
    questions.into_iter().flatten().collect()
}

fn token(entries: &Entries, now: Timestamp) -> String {
    match &entries.token {
        Err(why) => format!("the entry {EVALAI}: {why}"),
        Ok(Some(end)) if end.duration_since(now) <= WARN_BEFORE => {
            format!(
                "the entry {EVALAI}: the token ends on {}; renew it on EvalAI's profile page",
                end.strftime("%Y-%m-%d")
            )
        }
        Ok(_) => format!(
            "the entry {EVALAI}: may the operator's AWS identity read it (secretsmanager:GetSecretValue)? The token stays there"
        ),
    }
}

#[cfg(test)]
#[path = "plan_tests.rs"]
mod tests;
