//! The columns of `kubectl get`, from the table that the API server sends.

use std::fmt::Write as _;

use kube::Client;
use kube::api::{Patch, PatchParams};
use serde_json::{Value, json};

use super::objects::{Kind, create, plural};
use crate::support::apiserver::server;

const AS_TABLE: &str = "application/json;as=Table;g=meta.k8s.io;v=v1";

/// A status with every field.
pub fn full_status() -> Value {
    let time = "2026-11-01T10:00:00Z";
    let condition = |type_: &str, reason: &str| json!({"type": type_, "status": "True", "reason": reason, "message": "", "lastTransitionTime": time});
    json!({
        "state": "Running",
        "observedGeneration": 1,
        "attempt": 2,
        "retry": 1,
        "recreated": 1,
        "nextRetryTime": time,
        "reason": "Replacing",
        "message": "The second attempt gets another Job.",
        "team": {"id": "7", "name": "Team Seven", "displayName": "Team Seven"},
        "blockedSince": {"reason": "Unschedulable", "time": time},
        "track": "sensors",
        "plan": {
            "runId": "42",
            "carla": {
                "version": "V2", "codename": "SENSORS",
                "slices": [{"first": 0, "last": 9}, {"first": 10, "last": 19}], "routes": 20, "repetitions": 1,
                "contentsImage": "contents:1", "simulatorImage": "simulator:1",
            },
            "track": "sensors",
            "phase": 7,
            "storage": {"s3": {"bucket": "results", "prefix": "a/", "sizeLimit": "20Gi"}},
            "image": "agent:1",
            "resume": true,
        },
        "progress": {"done": 12, "total": 20, "unit": "routes", "text": "12/20"},
        "workers": [{
            "id": 1,
            "done": 6,
            "total": 10,
            "crashes": 1,
            "state": "Running",
            "last": {"reason": "Idle", "exitCode": 1, "time": time},
        }],
        "score": {"name": "Driving score", "value": "41.20", "final": false, "text": "~41.20"},
        "metrics": [{"name": "Route completion", "value": "80.00"}, {"name": "Infraction penalty", "value": "0.515"}],
        "duration": "1h25m",
        "waiting": {"position": 1, "etaMinSeconds": 1200, "etaMaxSeconds": 2400, "text": "1st, 20-40 min"},
        "times": {
            "submitted": time, "accepted": time, "scheduled": time, "started": time, "stopping": time, "finished": time,
            "published": time,
        },
        "jobName": "a-2",
        "nodeName": "node-1",
        "resultsURL": "s3://results/a/42",
        "failure": {"class": "Infrastructure", "reason": "NodeLost", "message": "The node is gone. Look at it.",
                    "nextStep": "Look at it."},
        "conditions": [condition("Running", "Resumed"), condition("Published", "Published")],
    })
}

/// The table as kubectl prints it, with the age, which moves, as `<age>`.
async fn table(client: &Client, kind: Kind, namespace: &str, wide: bool) -> String {
    let path = format!(
        "/apis/leaderboard.carla.org/v1alpha1/namespaces/{namespace}/{}",
        plural(kind)
    );
    let request = http::Request::get(path).header(http::header::ACCEPT, AS_TABLE);
    let table: Value = client.request(request.body(Vec::new()).unwrap()).await.unwrap();
    let columns = table["columnDefinitions"].as_array().unwrap();
    let shown: Vec<usize> = (0..columns.len())
        .filter(|at| wide || columns[*at]["priority"] == 0)
        .collect();
    let name = |at: usize| columns[at]["name"].as_str().unwrap();
    let mut lines = vec![shown.iter().map(|at| name(*at).to_uppercase()).collect::<Vec<_>>()];
    for row in table["rows"].as_array().unwrap() {
        lines.push(shown.iter().map(|at| cell(name(*at), &row["cells"][*at])).collect());
    }
    layout(&lines)
}

fn cell(column: &str, value: &Value) -> String {
    match value {
        Value::Null => "<none>".into(),
        Value::String(_) if column == "Age" => "<age>".into(),
        Value::String(text) => text.clone(),
        other => other.to_string(),
    }
}

fn layout(lines: &[Vec<String>]) -> String {
    let width = |column: usize| lines.iter().map(|line| line[column].len()).max().unwrap_or(0) + 3;
    let mut text = String::new();
    for line in lines {
        for (column, cell) in line.iter().enumerate() {
            let last = column + 1 == line.len();
            _ = write!(text, "{cell:<0$}", if last { 0 } else { width(column) });
        }
        text.push('\n');
    }
    text
}

#[tokio::test]
async fn submissions_fill_their_columns() {
    let server = server().await;
    let (client, namespace) = (server.client(), server.namespace("columns").await);
    let api = Kind::Submission.api(&client, &namespace);
    create(&api, Kind::Submission.object("new", &[]), false).await.unwrap();
    create(&api, Kind::Submission.object("submission-42", &[]), false)
        .await
        .unwrap();
    let status = Patch::Merge(json!({"status": full_status()}));
    api.patch_status("submission-42", &PatchParams::default(), &status)
        .await
        .unwrap();
    assert_eq!(
        table(&client, Kind::Submission, &namespace, false).await,
        "\
NAME            TEAM         TRACK     STATE     REASON      PROGRESS   SCORE    QUEUE            AGE
new             <none>       <none>    <none>    <none>      <none>     <none>   <none>           <age>
submission-42   Team Seven   sensors   Running   Replacing   12/20      ~41.20   1st, 20-40 min   <age>
"
    );
    assert_eq!(
        table(&client, Kind::Submission, &namespace, true).await,
        "\
NAME            TEAM         TRACK     STATE     REASON      PROGRESS   SCORE    QUEUE            AGE     LEADERBOARD   ATTEMPT   FAILURE          PUBLISHED   DURATION   NODE     RESULTS
new             <none>       <none>    <none>    <none>      <none>     <none>   <none>           <age>   local         <none>    <none>           <none>      <none>     <none>   <none>
submission-42   Team Seven   sensors   Running   Replacing   12/20      ~41.20   1st, 20-40 min   <age>   local         2         Infrastructure   Published   1h25m      node-1   s3://results/a/42
"
    );
}

#[tokio::test]
async fn leaderboards_fill_their_columns() {
    let server = server().await;
    let (client, namespace) = (server.client(), server.namespace("columns").await);
    let api = Kind::Leaderboard.api(&client, &namespace);
    create(&api, Kind::Leaderboard.object("carla-20", &[]), false)
        .await
        .unwrap();
    create(&api, Kind::Leaderboard.object("new", &[]), false).await.unwrap();
    let condition = |kind: &str, reason: &str| {
        let time = "2026-11-01T10:00:00Z";
        json!({"type": kind, "status": "False", "reason": reason, "message": "", "lastTransitionTime": time})
    };
    let status = json!({
        "observedGeneration": 1,
        "counts": {"pending": 3, "running": 2, "finished": 40, "failed": 1, "cancelled": 0},
        "evalai": {"requestsLastMinute": 12, "requestsPerMinute": 54},
        "tracks": [{"name": "sensors", "carla": {"pairs": 4, "routes": 20, "repetitions": 1}}],
        "conditions": [
            condition("Terminating", "InUse"),
            condition("Ready", "TokenRefused"),
        ],
    });
    let patch = Patch::Merge(json!({ "status": status }));
    let read = api
        .patch_status("carla-20", &PatchParams::default(), &patch)
        .await
        .unwrap();
    assert_eq!(read.data["status"], status);
    assert_eq!(
        table(&client, Kind::Leaderboard, &namespace, false).await,
        "\
NAME       READY    REASON         PAUSED   PENDING   RUNNING   FINISHED   FAILED   CANCELLED   AGE
carla-20   False    TokenRefused   false    3         2         40         1        0           <age>
new        <none>   <none>         false    <none>    <none>    <none>     <none>   <none>      <age>
"
    );
}
