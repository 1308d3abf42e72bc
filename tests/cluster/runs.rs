//! A local Leaderboard: `kubectl apply`, and what a person then sees. No EvalAI, no SQS, no table.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use leaderboard_api::conditions;
use serde_json::{Value, json};

use super::expected::{assert_finished, assert_results};
use crate::operator::controller;
use crate::scene::{Scene, is_true, scenario};

#[tokio::test]
async fn a_local_submission_runs_to_finished_with_the_expected_score() {
    scenario("local", async |scene: &Scene| {
        // Slow enough that a busy machine's controller sees it run.
        let change = json!({"agent": {"env": [{"name": "ROUTE_MS", "value": "3000"}]}});
        scene.leaderboard("lb", change).await;
        let _controller = controller(scene);
        scene.submit("first", "agent:standard").await;
        let submission = scene.settled("first", Duration::from_mins(3)).await;

        assert_finished(&submission);
        for condition in [conditions::ACCEPTED, conditions::ARCHIVED] {
            assert!(is_true(&submission, condition), "{condition}");
        }
        for condition in [conditions::PUBLISHED, conditions::RECORDED] {
            assert!(
                !is_true(&submission, condition),
                "no other system needs the end: {condition}"
            );
        }
        assert_eq!(scene.jobs().await, ["first-1"]);
        assert_layout(&scene.cloud.keys("first").await);
        assert_results(&scene.cloud.text("first", "evalai/results.json").await);
        assert_columns(scene).await;
        assert_events(scene).await;
        assert_eq!(scene.cloud.rows(&scene.cloud.table).await.len(), 0, "no table is named");
    })
    .await;
}

/// The places of the original, for four pairs.
fn assert_layout(keys: &BTreeMap<String, i64>) {
    let mut expected: BTreeSet<String> = [
        "agent/agent_results.json",
        "containers-status/logcopy.done",
        "evalai/metadata.json",
        "evalai/results.json",
        "evalai/stdout.txt",
        "logcopy/owner",
        "logcopy/report.json",
    ]
    .map(str::to_owned)
    .into();
    for pair in 1..=4 {
        expected.extend([
            format!("agent/agent{pair}/agent_results.json"),
            format!("agent/agent{pair}/leaderboard.log"),
            format!("agent/agent{pair}/live_results.txt"),
            format!("containers-status/agent-{pair}.start0"),
            format!("containers-status/agent-{pair}.done"),
            format!("containers-status/simulator-{pair}.start0"),
            format!("containers-status/simulator-{pair}.done"),
            format!("simulator/Logs/CarlaUE4-{}.log", 1900 + 100 * pair),
            format!("simulator/console-{pair}.log"),
        ]);
    }
    // The sidecar's own log is stored once it has something to log.
    let found: BTreeSet<String> = keys
        .keys()
        .filter(|key| *key != "logcopy/logcopy.log")
        .cloned()
        .collect();
    assert_eq!(found, expected);
    let empty: Vec<_> = keys
        .iter()
        .filter(|(_, size)| **size == 0)
        .map(|(key, _)| key)
        .collect();
    assert!(
        empty.iter().all(|key| key.starts_with("containers-status/")),
        "{empty:?}"
    );
}

/// Fails unless `kubectl get submissions -o wide` has the right columns.
async fn assert_columns(scene: &Scene) {
    let path = format!(
        "/apis/leaderboard.carla.org/v1alpha1/namespaces/{}/submissions",
        scene.namespace
    );
    let request = http::Request::get(path).header(http::header::ACCEPT, "application/json;as=Table;g=meta.k8s.io;v=v1");
    let table: Value = scene.client.request(request.body(Vec::new()).unwrap()).await.unwrap();
    let texts = |list: &Value, key: Option<&str>| -> Vec<String> {
        let items = list.as_array().unwrap().iter();
        let text = |item: &Value| item.as_str().map_or_else(|| item.to_string(), str::to_owned);
        items.map(|item| text(key.map_or(item, |key| &item[key]))).collect()
    };
    let titles = texts(&table["columnDefinitions"], Some("name"));
    let cells = texts(&table["rows"][0]["cells"], None);
    let shown: BTreeMap<_, _> = titles
        .iter()
        .map(String::as_str)
        .zip(cells.iter().map(String::as_str))
        .collect();
    let results = format!("s3://leaderboard-tests/{}first", scene.cloud.prefix);
    for (title, cell) in [
        ("Name", "first"),
        ("Leaderboard", "lb"),
        ("Track", "sensors"),
        ("State", "Finished"),
        ("Progress", "20/20"),
        ("Score", "69.41"),
        ("Team", "Team Seven"),
        ("Attempt", "1"),
        // The state says it all.
        ("Reason", "null"),
        ("Node", "leaderboard-local"),
        ("Results", results.as_str()),
    ] {
        assert_eq!(shown.get(title), Some(&cell), "{title} of {shown:?}");
    }
}

/// Only what a person would not learn from Kubernetes' own events and the status has one.
async fn assert_events(scene: &Scene) {
    let events = scene.events("first").await;
    let reasons: Vec<_> = events
        .iter()
        .map(|event| event.reason.clone().unwrap_or_default())
        .collect();
    assert_eq!(reasons, ["Started", "Finished"]);
    assert!(
        events.iter().all(|event| event.series.is_none()),
        "an event was sent again: {events:?}"
    );
}
