//! The plugin's output and decisions as tables: objects in, lines out.

mod change;
mod check;
mod containers;
mod daily;
mod docs;
mod documents;
pub(crate) mod golden;
mod help;
mod messages;
mod overview;
mod pages;
mod resume;
mod scores;
mod shown;
mod why;

use jiff::Timestamp;
use serde_json::{Value, json};

use super::text::{Frame, WIDTH};
use leaderboard_api::{Leaderboard, Submission};

/// The moment of every test.
fn now() -> Timestamp {
    "2026-11-01T12:00:00Z".parse().unwrap()
}

/// A page of the usual width, at the time of `now`.
fn frame() -> Frame {
    Frame {
        now: now(),
        width: WIDTH,
    }
}

/// A submission of EvalAI with this status; made two hours ago.
fn submission(status: &Value) -> Submission {
    named("submission-42", status)
}

fn named(name: &str, status: &Value) -> Submission {
    let object = json!({
        "apiVersion": "leaderboard.carla.org/v1alpha1", "kind": "Submission",
        "metadata": {"name": name, "namespace": "carla", "creationTimestamp": "2026-11-01T10:00:00Z",
                     "resourceVersion": "17"},
        "spec": {"leaderboardName": "carla-20", "evalai": {"challenge": 3, "phase": 7, "submission": 42}},
        "status": status,
    });
    serde_json::from_value(object).unwrap()
}

/// A Leaderboard that is Ready, with two slots.
fn leaderboard() -> Leaderboard {
    let object = json!({
        "apiVersion": "leaderboard.carla.org/v1alpha1", "kind": "Leaderboard",
        "metadata": {"name": "carla-20", "namespace": "carla"},
        "spec": {
            "tracks": [{"name": "sensors", "phase": 7}],
            "evaluation": {"carla": {
                "version": "V2", "contents": {"image": "contents:1"}, "simulator": {"image": "simulator:1"},
            }},
            "storage": {"s3": {"bucket": "results"}}, "concurrency": {"total": 2},
        },
        "status": {
            "counts": {"pending": 4, "running": 2, "finished": 0, "failed": 0, "cancelled": 0},
            "conditions": [condition("Ready", "True", "Ready", "")],
        },
    });
    serde_json::from_value(object).unwrap()
}

fn condition(type_: &str, truth: &str, reason: &str, message: &str) -> Value {
    json!({"type": type_, "status": truth, "reason": reason, "message": message,
           "lastTransitionTime": "2026-11-01T11:00:00Z"})
}

/// Third in the line.
fn waiting() -> Value {
    json!({
        "state": "Pending", "attempt": 1, "reason": "WaitingForSlot", "track": "sensors",
        "message": "All slots of the Leaderboard are in use; concurrency.total and concurrency.perTeam set their number.",
        "team": {"id": "7", "name": "Team Seven"}, "waiting": {"position": 3, "etaMinSeconds": 1200, "etaMaxSeconds": 2100, "text": "3rd, 20-35 min"},
        "conditions": [condition("Finished", "False", "Preparing", ""), condition("Accepted", "True", "Accepted", "")],
    })
}

/// Two agents run.
fn running() -> Value {
    json!({
        "state": "Running", "attempt": 1, "message": "12/20 routes done.", "track": "sensors",
        "progress": {"done": 12, "total": 20, "unit": "routes", "text": "12/20"}, "score": {"name": "Driving score", "value": "41.20", "final": false, "text": "~41.20"}, "jobName": "submission-42-1",
        "nodeName": "gpu-3", "resultsURL": "s3://results/v2/42", "times": {"started": "2026-11-01T11:00:00Z"},
        "conditions": [condition("Finished", "False", "Preparing", ""), condition("Running", "True", "Running", ""),
                       condition("Stalled", "False", "NotStalled", "")],
    })
}

/// Its agent crashed; EvalAI does not have the result yet.
fn crashed() -> Value {
    let message = "Agent 2 crashed 4 times. Look at agent/agent2/leaderboard.log of the results; the participant fixes the \
                   agent and submits again.";
    json!({
        "state": "Failed", "attempt": 1, "reason": "AgentCrashed", "message": message, "track": "sensors",
        "progress": {"done": 12, "total": 20, "unit": "routes", "text": "12/20"}, "score": {"name": "Driving score", "value": "41.20", "final": false, "text": "~41.20"}, "jobName": "submission-42-1",
        "resultsURL": "s3://results/v2/42", "times": {"finished": "2026-11-01T11:57:00Z"},
        "failure": {"class": "Participant", "reason": "AgentCrashed", "message": message, "worker": 2},
        "workers": [
            {"id": 1, "done": 10, "total": 10, "crashes": 0, "state": "Done"},
            {"id": 2, "done": 2, "total": 10, "crashes": 4, "state": "Crashed",
             "last": {"reason": "Exited", "exitCode": 1, "time": "2026-11-01T11:55:00Z"}},
        ],
        "conditions": [
            condition("Finished", "True", "AgentCrashed", message), condition("Archived", "True", "Stored", ""),
            condition("Published", "False", "Waiting", "The last request failed: 503."),
            condition("Recorded", "False", "Waiting", ""),
        ],
    })
}

/// Its node was lost too often.
fn node_lost() -> Value {
    let message =
        "Node gpu-3 and its Pod were lost; completed routes are kept. Look at the node, then resume the submission.";
    json!({
        "state": "Failed", "attempt": 1, "retry": 2, "reason": "NodeLost", "message": message, "track": "sensors",
        "resultsURL": "s3://results/v2/42", "times": {"finished": "2026-11-01T11:57:00Z"},
        "failure": {"class": "Infrastructure", "reason": "NodeLost", "message": message},
        "conditions": [condition("Finished", "True", "NodeLost", message), condition("Published", "True", "Published", "")],
    })
}

/// All is done.
fn finished() -> Value {
    json!({
        "state": "Finished", "attempt": 1, "track": "sensors", "score": {"name": "Driving score", "value": "43.13", "final": true, "text": "43.13"},
        "message": "20 of 20 routes, Driving score 43.13.", "progress": {"done": 20, "total": 20, "unit": "routes", "text": "20/20"},
        "resultsURL": "s3://results/v2/42", "times": {"finished": "2026-11-01T11:57:00Z"},
        "conditions": [
            condition("Finished", "True", "Finished", ""), condition("Archived", "True", "Stored", ""),
            condition("Published", "True", "Published", ""), condition("Recorded", "True", "Recorded", ""),
        ],
    })
}

/// A person cancelled it.
fn cancelled() -> Value {
    let message = "The submission was cancelled; completed routes are kept.";
    json!({
        "state": "Cancelled", "attempt": 1, "message": message,
        "resultsURL": "s3://results/v2/42", "times": {"finished": "2026-11-01T11:57:00Z"},
        "conditions": [condition("Finished", "True", "Cancelled", message), condition("Published", "True", "Published", "")],
    })
}

/// A status with other fields laid over it.
fn with(mut status: Value, fields: &Value) -> Value {
    for (key, value) in fields.as_object().unwrap() {
        status[key] = value.clone();
    }
    status
}

fn assert_width(lines: &[String]) {
    for line in lines {
        assert!(
            line.chars().count() <= WIDTH,
            "{} columns: {line}",
            line.chars().count()
        );
        assert_eq!(line.trim_end(), line, "no line ends with white space");
    }
}

fn of_team(status: Value, id: &str, name: &str) -> Value {
    with(status, &json!({"team": {"id": id, "name": name}}))
}

/// The plan of a run of two pairs with this simulator.
fn plan_with(simulator: &str) -> Value {
    json!({"runId": "mine",
        "carla": {"version": "V2", "codename": "S", "slices": [{"first": 0, "last": 9}, {"first": 10, "last": 19}],
            "routes": 20, "repetitions": 1, "contentsImage": "contents:1", "simulatorImage": simulator},
        "track": "sensors",
           "storage": {"s3": {"bucket": "results"}}, "image": "agent:1"})
}

/// The status of a run with this simulator.
fn ran_with(status: Value, simulator: &str) -> Value {
    with(status, &json!({"plan": plan_with(simulator), "nodeName": "gpu-3"}))
}

/// Two workers, one of which has crashed, with all three scores.
fn driving() -> Value {
    let more = json!({
        "workers": [
            {"id": 1, "done": 9, "total": 10, "crashes": 0, "state": "Running"},
            {"id": 2, "done": 3, "total": 10, "crashes": 1, "state": "Running",
             "last": {"reason": "SimulatorCrashed", "time": "2026-11-01T11:40:00Z"}},
        ],
        "score": {"name": "Driving score", "value": "41.20", "final": false, "text": "~41.20"},
        "metrics": [{"name": "Route completion", "value": "80.00"}, {"name": "Infraction penalty", "value": "0.515"}],
        "times": {"submitted": "2026-11-01T10:00:00Z", "accepted": "2026-11-01T10:00:02Z",
                  "scheduled": "2026-11-01T10:56:00Z", "started": "2026-11-01T11:00:00Z"},
    });
    of_team(with(running(), &more), "7", "Team Seven")
}
