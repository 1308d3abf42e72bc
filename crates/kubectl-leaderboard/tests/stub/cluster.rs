//! A cluster whose namespace `carla` has a Leaderboard and some submissions, and one where this person may do nothing.

use serde_json::{Value, json};

use super::{list, refusal};

const GROUP: &str = "/apis/leaderboard.carla.org/v1alpha1";
/// A time that no output shows.
const TIME: &str = "2026-11-01T10:00:00Z";

fn condition(type_: &str, truth: &str, reason: &str) -> Value {
    json!({"type": type_, "status": truth, "reason": reason, "message": "", "lastTransitionTime": TIME})
}

fn submission(name: &str, status: &Value) -> Value {
    json!({
        "apiVersion": "leaderboard.carla.org/v1alpha1", "kind": "Submission",
        "metadata": {"name": name, "namespace": "carla", "creationTimestamp": TIME, "resourceVersion": "17"},
        "spec": {"leaderboardName": "carla-20", "track": "sensors", "image": "registry.example/agent:1"}, "status": status,
    })
}

fn failed(class: &str, reason: &str) -> Value {
    json!({
        "attempt": 1, "reason": reason, "message": "It has ended.", "track": "sensors", "resultsURL": "s3://results/v2/42",
        "failure": {"class": class, "reason": reason, "message": "It has ended."},
        "times": {"finished": TIME}, "plan": plan(), "conditions": [condition("Finished", "True", reason)],
    })
}

fn plan() -> Value {
    json!({"runId": "runs",
        "carla": {"version": "V2", "codename": "S", "slices": [{"first": 0, "last": 9}, {"first": 10, "last": 19}],
            "routes": 20, "repetitions": 1, "contentsImage": "c", "simulatorImage": "s"},
        "track": "sensors",
           "storage": {"s3": {"bucket": "results"}}, "image": "a"})
}

fn submissions() -> Vec<Value> {
    let runs = json!({
        "attempt": 1, "reason": "Running", "message": "12/20 routes done.", "track": "sensors", "jobName": "runs-1",
        "times": {"started": TIME}, "plan": plan(), "resultsURL": "s3://results/v2/runs",
        "conditions": [condition("Finished", "False", "Preparing"), condition("Running", "True", "Running")],
    });
    let waits =
        json!({"attempt": 1, "reason": "WaitingForSlot", "conditions": [condition("Finished", "False", "Preparing")]});
    vec![
        submission("submission-41", &failed("Infrastructure", "NodeLost")),
        submission("submission-42", &failed("Participant", "AgentCrashed")),
        submission("submission-43", &runs),
        submission("submission-44", &failed("Infrastructure", "SimulationCrashed")),
        submission("submission-45", &waits),
    ]
}

fn leaderboard() -> Value {
    json!({
        "apiVersion": "leaderboard.carla.org/v1alpha1", "kind": "Leaderboard",
        "metadata": {"name": "carla-20", "namespace": "carla"},
        "spec": {"tracks": [{"name": "sensors"}],
                 "evaluation": {"carla": {
                     "version": "V2", "contents": {"image": "contents:1"}, "simulator": {"image": "simulator:1"},
                 }}, "storage": {"s3": {"bucket": "results"}}},
        "status": {"conditions": [condition("Ready", "True", "Ready")], "operator": "leaderboard-system/leaderboard-operator",
                   "counts": {"pending": 1, "running": 1, "finished": 0, "failed": 3, "cancelled": 0}},
    })
}

fn pod() -> Value {
    let labels = json!({"leaderboard.carla.org/submission": "submission-43"});
    let named = |names: &[&str]| names.iter().map(|name| json!({"name": name})).collect::<Vec<_>>();
    let spec = json!({
        "initContainers": named(&["workspace", "contents", "logcopy"]),
        "containers": named(&["agent-1", "agent-2", "simulator-1", "simulator-2"]),
    });
    json!({"apiVersion": "v1", "kind": "Pod", "status": {"phase": "Running"}, "spec": spec,
           "metadata": {"name": "runs-1-abcde", "namespace": "carla", "creationTimestamp": TIME, "labels": labels}})
}

/// A replica of an operator that is newer than this program.
fn replica() -> Value {
    let labels = json!({"app.kubernetes.io/version": "9.9.9"});
    json!({"apiVersion": "v1", "kind": "Pod", "metadata": {"name": "c-1", "namespace": "leaderboard-system", "labels": labels},
           "spec": {"containers": [{"name": "controller", "image": "registry.example/leaderboard-operator:9.9.9"}]}})
}

fn log(query: &str) -> (u16, String) {
    let lines = match selected(query, "container=") {
        Some("workspace") => "restored 12 files\n",
        Some("contents") => "copied 3 folders\n",
        Some("agent-1") => {
            "Traceback (most recent call last):\n  File \"agent.py\", line 7\n\tred \u{1b}[31mtext\u{1b}[0m\nlast line"
        }
        Some("simulator-1") => return refusal(404, "NotFound", "pods \"runs-1-abcde\" not found"),
        _ => {
            let waits = "container \"agent-2\" in pod \"runs-1-abcde\" is waiting to start: ContainerCreating";
            return refusal(400, "BadRequest", waits);
        }
    };
    (200, lines.to_owned())
}

/// The value behind a key of a query.
fn selected<'a>(query: &'a str, key: &str) -> Option<&'a str> {
    let (_, rest) = query.split_once(key)?;
    rest.split('&').next()
}

/// A cluster whose namespace `carla` has a Leaderboard and some submissions, of which one has a Pod. Events cannot be listed.
pub fn cluster(method: &str, path: &str) -> (u16, String) {
    let (place, query) = path.split_once('?').unwrap_or((path, ""));
    let place = place.trim_start_matches(GROUP).trim_start_matches("/api/v1");
    let words: Vec<&str> = place.split('/').skip(1).collect();
    let (namespace, words) = match words.as_slice() {
        ["namespaces", namespace, rest @ ..] => (Some(*namespace), rest),
        rest => (None, rest),
    };
    let (kind, mut all) = match words.first().copied() {
        Some("submissions") => ("Submission", submissions()),
        Some("leaderboards") => ("Leaderboard", vec![leaderboard()]),
        Some("pods") => ("Pod", vec![pod(), replica()]),
        _ => {
            let missing = "events.events.k8s.io is forbidden: User \"host\" cannot list resource \"events\" in API group \
                           \"events.k8s.io\" in the namespace \"carla\"";
            return refusal(403, "Forbidden", missing);
        }
    };
    if method == "POST" {
        return (201, submission("carla-20-x7k2p", &Value::Null).to_string());
    }
    let name = words.get(1).copied().or_else(|| selected(query, "metadata.name%3D"));
    all.retain(|one| namespace.is_none_or(|namespace| one["metadata"]["namespace"] == namespace));
    all.retain(|one| name.is_none_or(|name| one["metadata"]["name"] == name));
    let of = selected(query, "submission%3D");
    all.retain(|one| of.is_none_or(|of| one["metadata"]["labels"]["leaderboard.carla.org/submission"] == of));
    if let ("PATCH", Some("leaderboards"), Some(board)) = (method, words.first().copied(), all.first_mut()) {
        board["spec"]["paused"] = json!(true);
    }
    match (words.len(), all.first()) {
        (1, _) => list(kind, &all),
        (2, Some(found)) => (200, found.to_string()),
        (3, Some(_)) => log(query),
        _ => refusal(404, "NotFound", "not found"),
    }
}

/// A cluster where this person may do nothing.
pub fn forbidden(method: &str, path: &str) -> (u16, String) {
    let what = path.split('?').next().unwrap().rsplit('/').next().unwrap();
    let verb = if method == "GET" { "get" } else { "change" };
    let message = format!("{what} is forbidden: User \"participant\" cannot {verb} it in the namespace \"carla\"");
    refusal(403, "Forbidden", &message)
}
