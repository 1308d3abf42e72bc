//! Submissions and Leaderboards as an evening before a deadline has them, for the tests of the page.

use std::sync::Arc;

use jiff::{SignedDuration, Timestamp};
use leaderboard_api::{Leaderboard, Submission};
use serde::Serialize;
use serde_json::{Value, json};

pub(super) const NAMESPACE: &str = "leaderboard";
const MINUTE: i64 = 60;
const HOUR: i64 = 60 * MINUTE;

/// Compares a value with a file of src/page/golden; `UPDATE_GOLDEN=1` writes the file.
pub(super) fn golden(file: &str, value: &impl Serialize) {
    let file = std::path::Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("src/page/golden")
        .join(file);
    let found = serde_json::to_string_pretty(value).unwrap() + "\n";
    if std::env::var_os("UPDATE_GOLDEN").is_some() {
        std::fs::write(&file, &found).unwrap();
    }
    let expected = std::fs::read_to_string(&file).unwrap_or_default();
    assert!(found == expected, "run it with UPDATE_GOLDEN=1 and read the difference");
}

/// The moment of all samples.
pub(super) fn now() -> Timestamp {
    "2026-11-01T12:00:00Z".parse().unwrap()
}

/// So many seconds before.
pub(super) fn ago(seconds: i64) -> String {
    (now() - SignedDuration::from_secs(seconds)).to_string()
}

fn condition(type_: &str, status: &str, reason: &str, seconds: i64) -> Value {
    json!({"type": type_, "status": status, "reason": reason, "message": "", "lastTransitionTime": ago(seconds)})
}

pub(super) fn submission(name: &str, board: &str, team: &str, status: &Value) -> Arc<Submission> {
    let number: Option<i64> = name.strip_prefix("submission-").and_then(|number| number.parse().ok());
    let evalai = number.map(|number| json!({"challenge": 2050, "phase": 4101, "submission": number}));
    let object = json!({
        "apiVersion": "leaderboard.carla.org/v1alpha1", "kind": "Submission",
        "metadata": {"name": name, "namespace": NAMESPACE, "creationTimestamp": ago(12 * HOUR)},
        "spec": {"leaderboardName": board, "track": "sensors", "image": "agent:1", "team": {"name": team}, "evalai": evalai},
        "status": status,
    });
    Arc::new(serde_json::from_value(object).unwrap())
}

pub(super) fn waiting(name: &str, team: &str, position: Option<i32>, reason: &str, message: &str) -> Arc<Submission> {
    let place = position.map(|position| {
        let eta = i64::from(position) * 20 * MINUTE;
        json!({"position": position, "etaMinSeconds": eta, "etaMaxSeconds": eta + 15 * MINUTE, "text": ""})
    });
    let since = 10 * MINUTE * i64::from(position.unwrap_or(1));
    let status = json!({
        "attempt": 1, "reason": reason, "message": message, "track": "sensors", "waiting": place,
        "conditions": [condition("Finished", "False", reason, since)],
    });
    submission(name, "carla-20", team, &status)
}

/// One that runs since so many hours, with what its workers have done of 20 routes and how often each crashed.
pub(super) fn running(name: &str, team: &str, attempt: i64, hours: i64, workers: &[(i32, i32)]) -> Arc<Submission> {
    let done: i32 = workers.iter().map(|(done, _)| done).sum();
    let total = 20 * i32::try_from(workers.len()).unwrap();
    let all: Vec<Value> = (1..)
        .zip(workers)
        .map(|(id, (done, crashes))| worker(id, *done, *crashes))
        .collect();
    let started = hours * HOUR;
    let status = json!({
        "attempt": attempt, "track": "sensors", "jobName": format!("{name}-{attempt}"),
        "nodeName": format!("ip-10-0-17-{hours}.eu-central-1.compute.internal"), "workers": all,
        "progress": {"done": done, "total": total, "unit": "routes", "text": format!("{done}/{total}")},
        "score": {"name": "Driving score", "value": "41.20", "final": false, "text": format!("~4{hours}.20")},
        "metrics": [{"name": "Route completion", "value": "71.33"}, {"name": "Infraction penalty", "value": "0.61"}],
        "resultsURL": format!("s3://results-20/v2/{name}"),
        "times": {"submitted": ago(started + hours * 20 * MINUTE), "scheduled": ago(started + 7 * MINUTE), "started": ago(started)},
        "conditions": [
            condition("Accepted", "True", "Accepted", started + hours * 20 * MINUTE),
            condition("Running", "True", "Running", started),
            condition("Finished", "False", "Running", started + hours * 20 * MINUTE),
        ],
    });
    submission(name, "carla-20", team, &status)
}

fn worker(id: i32, done: i32, crashes: i32) -> Value {
    let state = match (done, crashes) {
        (20, _) => "Done",
        (_, 2..) => "Crashed",
        _ => "Running",
    };
    let last = (crashes > 0).then(|| json!({"reason": "SimulatorCrashed", "exitCode": 139}));
    json!({"id": id, "done": done, "total": 20, "crashes": crashes, "state": state, "last": last})
}

/// One that finished so many minutes ago.
pub(super) fn finished(name: &str, team: &str, score: &str, minutes: i64, hours: i64) -> Arc<Submission> {
    let end = minutes * MINUTE;
    let status = json!({
        "attempt": 1, "track": "sensors",
        "progress": {"done": 80, "total": 80, "unit": "routes", "text": "80/80"},
        "score": {"name": "Driving score", "value": score, "final": true, "text": score},
        "metrics": [{"name": "Route completion", "value": "88.10"}, {"name": "Infraction penalty", "value": "0.72"}],
        "resultsURL": format!("s3://results-20/v2/{name}"), "workers": (1..=4).map(|id| worker(id, 20, 0)).collect::<Vec<_>>(),
        "times": {
            "submitted": ago(end + 2 * hours * HOUR), "scheduled": ago(end + hours * HOUR + 6 * MINUTE),
            "started": ago(end + hours * HOUR), "finished": ago(end), "published": ago(end - 20),
        },
        "conditions": [
            condition("Accepted", "True", "Accepted", end + 2 * hours * HOUR),
            condition("Archived", "True", "Archived", end),
            condition("Published", "True", "Published", end - 20),
            condition("Finished", "True", "Finished", end),
            condition("Succeeded", "True", "Finished", end),
        ],
    });
    submission(name, "carla-20", team, &status)
}

/// One that failed so many minutes ago.
pub(super) fn failed(
    name: &str,
    team: &str,
    class: &str,
    (reason, message): (&str, &str),
    minutes: i64,
) -> Arc<Submission> {
    let end = minutes * MINUTE;
    let status = json!({
        "attempt": 1, "reason": reason, "track": "sensors",
        "progress": {"done": 22, "total": 80, "unit": "routes", "text": "22/80"},
        "failure": {"class": class, "reason": reason, "message": message},
        "times": {
            "submitted": ago(end + 2 * HOUR), "scheduled": ago(end + HOUR), "started": ago(end + HOUR - 5 * MINUTE),
            "finished": ago(end),
        },
        "resultsURL": format!("s3://results-20/v2/{name}"),
        "conditions": [
            condition("Accepted", "True", "Accepted", end + 2 * HOUR),
            condition("Finished", "True", reason, end),
            condition("Published", "False", "Waiting", end),
        ],
    });
    submission(name, "carla-20", team, &status)
}

pub(super) fn leaderboard(name: &str, spec: &Value, status: &Value) -> Arc<Leaderboard> {
    let mut of = json!({
        "tracks": [{"name": "sensors"}, {"name": "map"}],
        "evaluation": {"carla": {
            "version": "V2", "contents": {"image": "contents:1"}, "simulator": {"image": "simulator:1"},
        }}, "storage": {"s3": {"bucket": "results"}},
    });
    of.as_object_mut().unwrap().extend(spec.as_object().unwrap().clone());
    let object = json!({
        "apiVersion": "leaderboard.carla.org/v1alpha1", "kind": "Leaderboard",
        "metadata": {"name": name, "namespace": NAMESPACE}, "spec": of, "status": status,
    });
    Arc::new(serde_json::from_value(object).unwrap())
}

fn evalai(challenge: i64) -> Value {
    let token = json!({"secretKeyRef": {"name": "evalai", "key": "token"}});
    json!({"apiServer": "https://eval.ai", "challenge": challenge, "token": token})
}

/// Team, number of its submission, minutes since its end, then score, route completion and infraction penalty; the best first.
type Scores<'a> = [(&'a str, i64, i64, [&'a str; 3])];
const SENSORS: [(&str, i64, i64, [&str; 3]); 7] = [
    ("Autobahn Labs", 4189, 9, ["68.05", "94.21", "0.72"]),
    ("KIT Drivers", 4185, 289, ["61.18", "91.70", "0.67"]),
    ("Team Seven", 4187, 149, ["55.30", "88.02", "0.63"]),
    ("Roach", 4184, 359, ["47.02", "81.95", "0.58"]),
    ("Interfuser", 4188, 79, ["41.77", "79.40", "0.53"]),
    ("Tübingen Vision", 4022, 9_000, ["38.64", "70.12", "0.55"]),
    ("Équipe Ñandú", 4186, 219, ["23.91", "52.87", "0.46"]),
];
const MAP: [(&str, i64, i64, [&str; 3]); 3] = [
    ("Team Seven", 4101, 3_000, ["74.92", "97.33", "0.77"]),
    (
        "<b>Bobby</b> & <script>alert(1)</script>",
        4097,
        3_300,
        ["70.40", "96.10", "0.73"],
    ),
    ("Roach", 4090, 4_000, ["52.11", "84.25", "0.62"]),
];

/// A track with its standings.
fn track(name: &str, scores: &Scores<'_>) -> Value {
    let standing = |(rank, (team, number, minutes, [score, completion, penalty])): (
        i64,
        &(&str, i64, i64, [&str; 3]),
    )| {
        json!({
            "rank": rank, "team": team, "submission": format!("submission-{number}"),
            "score": {"name": "Driving score", "value": score, "text": score},
            "metrics": [{"name": "Route completion", "value": completion}, {"name": "Infraction penalty", "value": penalty}],
            "finishedAt": ago(minutes * MINUTE),
        })
    };
    json!({
        "name": name, "carla": {"pairs": 4, "routes": 20, "repetitions": 1}, "ranking": {"metric": "Driving score", "order": "Descending"},
        "standings": (1..).zip(scores).map(standing).collect::<Vec<_>>(),
    })
}

/// A track whose standings are full, of teams of this name.
pub(super) fn ranked(name: &str, team: &str) -> Value {
    let scores: Vec<_> = (0..20).map(|at| (team, at, 10, ["68.05", "94.21", "0.72"])).collect();
    track(name, &scores)
}

/// Two Leaderboards: a busy one, and one that is paused and not Ready.
pub(super) fn leaderboards() -> Vec<Arc<Leaderboard>> {
    let backlog = json!({"waiting": 3, "lastExpectedTime": ago(-4 * MINUTE)});
    let busy = json!({
        "tracks": [track("sensors", &SENSORS), track("map", &MAP)],
        "evalai": {"requestsLastMinute": 41, "requestsPerMinute": 60, "backlog": backlog},
        "conditions": [condition("Ready", "True", "Ready", HOUR)],
    });
    let mut denied = condition("Ready", "False", "AwsDenied", HOUR);
    denied["message"] =
        "s3:PutObject is denied for the bucket results-10; give the role the policy of the bucket".into();
    let broken = json!({"evalai": {"requestsLastMinute": 4, "requestsPerMinute": 30}, "conditions": [denied]});
    vec![
        leaderboard(
            "carla-20",
            &json!({"concurrency": {"total": 4}, "evalai": evalai(2050)}),
            &busy,
        ),
        leaderboard("carla-10", &json!({"paused": true}), &broken),
    ]
}

/// Two of a host's own evaluator that run: an image whose agent has run first, and a file.
pub(super) fn of_modes() -> [Arc<Submission>; 2] {
    ["Batch", "Predictions"].map(|mode| {
        let name = format!("digits-{}", mode.to_lowercase());
        let score = json!({"metric": "accuracy"});
        let container = json!({"mode": mode, "workers": 1, "merge": "Mean", "score": score, "image": "evaluator:1"});
        let status = json!({
            "attempt": 1, "track": "test", "message": "40 of 100 units done", "jobName": format!("{name}-1"), "nodeName": "cpu-1",
            "plan": {"runId": name, "container": container, "track": "test", "storage": {"s3": {"bucket": "results"}}},
            "progress": {"done": 40, "total": 100, "unit": "units", "text": "40/100"},
            "score": {"name": "accuracy", "value": "0.5", "final": false, "text": "~0.5"},
            "workers": [{"id": 1, "done": 40, "total": 100, "crashes": 0, "state": "Running"}],
            "resultsURL": format!("s3://results/{name}"),
            "times": {"submitted": ago(2 * HOUR), "scheduled": ago(HOUR + 2 * MINUTE), "started": ago(HOUR)},
            "conditions": [
                condition("Accepted", "True", "Accepted", 2 * HOUR),
                condition("Running", "True", "Running", HOUR),
                condition("Finished", "False", "Running", 2 * HOUR),
            ],
        });
        let mut one = submission(&name, "digits", "Team Seven", &status);
        if mode == "Predictions" {
            let spec = &mut Arc::make_mut(&mut one).spec;
            spec.image = None;
            spec.input = serde_json::from_value(json!({"sha256": "0".repeat(64), "size": 12_800})).unwrap();
        }
        one
    })
}

/// A full evening.
pub(super) fn submissions() -> Vec<Arc<Submission>> {
    let mut all = under_way();
    all.extend(in_line());
    all.extend(broken());
    let scores = ["68.05", "41.77", "55.30", "23.91", "61.18", "47.02"];
    let teams = [
        "Autobahn Labs",
        "Interfuser",
        "Team Seven",
        "Équipe Ñandú",
        "KIT Drivers",
        "Roach",
    ];
    for (at, (score, team)) in (0_i64..).zip(scores.into_iter().zip(teams)) {
        all.push(finished(
            &format!("submission-{}", 4189 - at),
            team,
            score,
            9 + 70 * at,
            3 + at % 3,
        ));
    }
    all
}

fn under_way() -> Vec<Arc<Submission>> {
    vec![
        running(
            "submission-4200",
            "Autobahn Labs",
            1,
            5,
            &[(18, 0), (16, 0), (19, 0), (17, 0)],
        ),
        running(
            "submission-4207",
            "Team Seven",
            2,
            3,
            &[(9, 0), (7, 1), (11, 0), (10, 0)],
        ),
        running(
            "submission-4211",
            "<b>Bobby</b> & <script>alert(1)</script>",
            1,
            2,
            &[(6, 0), (3, 2), (5, 0), (20, 0)],
        ),
        running(
            "submission-4213",
            "Équipe Ñandú",
            1,
            1,
            &[(2, 0), (1, 0), (0, 0), (3, 0)],
        ),
    ]
}

fn in_line() -> Vec<Arc<Submission>> {
    let slot = "All four slots of the Leaderboard are taken";
    let team = "Its team has one running, and concurrency.perTeam is 1";
    let node = "0/3 nodes are available: 3 Insufficient nvidia.com/gpu; a node is on its way";
    vec![
        waiting("submission-4214", "KIT Drivers", Some(1), "WaitingForSlot", slot),
        waiting("submission-4215", "Team Seven", Some(2), "WaitingForSlot", team),
        waiting("submission-4217", "Tübingen Vision", Some(3), "WaitingForSlot", slot),
        waiting("submission-4218", "Autobahn Labs", Some(4), "WaitingForSlot", team),
        waiting(
            "submission-4220",
            "Perception Group of the University of Nowhere, Institute of Things",
            Some(5),
            "WaitingForSlot",
            slot,
        ),
        waiting("submission-4212", "Roach", None, "Unschedulable", node),
    ]
}

fn broken() -> Vec<Arc<Submission>> {
    let agent = "The agent of pair 2 crashed 3 times, the last time with exit code 1; look at agent/agent2/leaderboard.log of the results";
    let lost = "The node gpu-3 no longer reports; look at the node";
    vec![
        failed(
            "submission-4198",
            "KIT Drivers",
            "Participant",
            ("AgentCrashed", agent),
            130,
        ),
        failed("submission-4190", "Roach", "Participant", ("AgentCrashed", agent), 400),
        failed(
            "submission-4193",
            "Tübingen Vision",
            "Infrastructure",
            ("NodeLost", lost),
            300,
        ),
        failed("submission-4100", "Roach", "Infrastructure", ("NodeLost", lost), 3000),
    ]
}
