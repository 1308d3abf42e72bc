//! Rows of DynamoDB against the AWS stand-in.
#![cfg(test)]

use std::collections::BTreeMap;
use std::sync::Arc;

use aws_sdk_dynamodb::types::{
    AttributeDefinition, AttributeValue, BillingMode, KeySchemaElement, KeyType, ScalarAttributeType,
};
use serde_json::json;
use tokio::sync::{mpsc, watch};

use super::bridge::{LIMIT, StandIn};
use crate::support::throttle::Throttle;
use leaderboard_api as api;
use leaderboard_aws::table::{Row, Table, Tables, Written};
use leaderboard_base::object_key::ObjectKey;
use leaderboard_base::shutdown::Stop;
use leaderboard_base::spans::LogSpan;
use leaderboard_base::tasks::Tasks;
use leaderboard_operator::ask::Asker;
use leaderboard_operator::submissions::records::{self, Record};

fn client(stand_in: &StandIn) -> aws_sdk_dynamodb::Client {
    stand_in.aws.dynamodb(None, Some(&stand_in.endpoint))
}

fn named(stand_in: &StandIn, name: &str) -> api::DynamoTable {
    serde_json::from_value(json!({"name": stand_in.name(name), "endpoint": stand_in.endpoint})).unwrap()
}

/// A new table with these keys, and its description.
pub(super) async fn table(stand_in: &StandIn, name: &str, keys: &[(&str, ScalarAttributeType)]) -> api::DynamoTable {
    let mut request = client(stand_in)
        .create_table()
        .table_name(stand_in.name(name))
        .billing_mode(BillingMode::PayPerRequest);
    for ((key, kind), role) in keys.iter().zip([KeyType::Hash, KeyType::Range]) {
        let definition = AttributeDefinition::builder()
            .attribute_name(*key)
            .attribute_type(kind.clone())
            .build();
        let element = KeySchemaElement::builder().attribute_name(*key).key_type(role).build();
        request = request
            .attribute_definitions(definition.unwrap())
            .key_schema(element.unwrap());
    }
    request.send().await.unwrap();
    named(stand_in, name)
}

async fn usual(stand_in: &StandIn) -> (api::DynamoTable, Table) {
    let keys = [
        ("team_id", ScalarAttributeType::S),
        ("submission_id", ScalarAttributeType::S),
    ];
    let spec = table(stand_in, "leaderboard-20", &keys).await;
    let table = Table::describe(&stand_in.aws, &spec).await.unwrap();
    (spec, table)
}

/// All rows of a table as text.
pub(super) async fn rows(stand_in: &StandIn, name: &str) -> Vec<BTreeMap<String, String>> {
    let items = client(stand_in)
        .scan()
        .table_name(name)
        .send()
        .await
        .unwrap()
        .items
        .unwrap();
    let text = |value: AttributeValue| match value {
        AttributeValue::S(text) => text,
        AttributeValue::N(number) => format!("#{number}"),
        other => panic!("{other:?}"),
    };
    items
        .into_iter()
        .map(|item| item.into_iter().map(|(name, value)| (name, text(value))).collect())
        .collect()
}

fn row(attempt: i64, status: &str) -> Row {
    Row {
        team_id: "12".into(),
        run_id: "7".into(),
        attempt,
        submission_status: status.into(),
        progress: format!("{attempt}/9"),
        ..Row::default()
    }
}

#[tokio::test]
async fn a_trial_is_answered_and_writes_nothing() {
    let stand_in = StandIn::start().await;
    let (spec, table) = usual(&stand_in).await;
    assert_eq!(table.try_write().await, Ok(()));
    assert_eq!(rows(&stand_in, &spec.name).await.len(), 0);
    let same_keys = Row {
        team_id: "0".into(),
        run_id: "0".into(),
        ..row(1, "FINISHED")
    };
    assert_eq!(table.write(&same_keys).await, Ok(Written::Stored));
    let before = rows(&stand_in, &spec.name).await;
    assert_eq!(table.try_write().await, Ok(()));
    assert_eq!(rows(&stand_in, &spec.name).await, before, "no row is changed");
    client(&stand_in)
        .delete_table()
        .table_name(&spec.name)
        .send()
        .await
        .unwrap();
    let refused = table.try_write().await.unwrap_err();
    assert!(refused.to_string().contains("does not exist"), "{refused}");
}

#[tokio::test]
async fn a_row_holds_all_columns_under_whatever_keys_the_table_has() {
    let stand_in = StandIn::start().await;
    let full = Row {
        team_name: "Team".into(),
        track_id: "2".into(),
        track_name: "SENSORS".into(),
        submitted_image_uri: "registry.example/a:1".into(),
        submitted_time: "2026-11-20 10:00:00 UTC".into(),
        start_time: "2026-11-20 10:01:00 UTC".into(),
        end_time: "2026-11-20 12:00:00 UTC".into(),
        results: "s3://bucket/7".into(),
        gpu_seconds: "14400".into(),
        metrics: vec![
            ("driving_score".into(), Some("41.2".into())),
            ("name".into(), Some("a reserved word".into())),
            ("agent_blocked".into(), None),
        ],
        ..row(1, "FINISHED")
    };
    let names = [("team_id", "submission_id"), ("team-id", "submission-id")];
    for (kind, number) in [(ScalarAttributeType::S, ""), (ScalarAttributeType::N, "#")] {
        for (team, submission) in names {
            let name = format!("{team}.{}", kind.as_str());
            let spec = table(&stand_in, &name, &[(team, kind.clone()), (submission, kind.clone())]).await;
            let table = Table::describe(&stand_in.aws, &spec).await.unwrap();
            assert_eq!(table.write(&full).await, Ok(Written::Stored));
            let stored = rows(&stand_in, &spec.name).await.remove(0);
            assert_eq!(stored.len(), 16, "{stored:?}");
            assert_eq!(stored["gpu_seconds"], "14400");
            assert_eq!(
                (stored[team].clone(), stored[submission].clone()),
                (format!("{number}12"), format!("{number}7"))
            );
            assert_eq!(
                (stored["attempt"].as_str(), stored["submission_status"].as_str()),
                ("#1", "FINISHED")
            );
            assert_eq!(
                (stored["driving_score"].as_str(), stored["name"].as_str()),
                ("41.2", "a reserved word")
            );
            assert_eq!(stored["end_time"], "2026-11-20 12:00:00 UTC");
        }
    }
}

#[tokio::test]
async fn an_older_row_never_wins() {
    let stand_in = StandIn::start().await;
    let (spec, table) = usual(&stand_in).await;
    let status = async || rows(&stand_in, &spec.name).await.remove(0)["submission_status"].clone();
    let steps = [
        (row(1, "PENDING"), Written::Stored),
        (row(1, "RUNNING"), Written::Stored),
        (row(1, "FAILED"), Written::Stored),
        (row(1, "FAILED"), Written::Stored),
        (row(1, "RUNNING"), Written::Stale { kept: 1 }),
        (row(1, "FINISHED"), Written::Stale { kept: 1 }),
        (row(2, "RUNNING"), Written::Stored),
        (row(1, "FAILED"), Written::Stale { kept: 2 }),
        (row(2, "CANCELLED"), Written::Stored),
        (row(2, "RUNNING"), Written::Stale { kept: 2 }),
        (row(2, "FINISHED"), Written::Stale { kept: 2 }),
        (row(10, "PENDING"), Written::Stored),
        (row(9, "FINISHED"), Written::Stale { kept: 10 }),
    ];
    for (step, (row, want)) in steps.into_iter().enumerate() {
        assert_eq!(table.write(&row).await, Ok(want), "step {step}");
        if want == Written::Stored {
            assert_eq!(status().await, row.submission_status, "step {step}");
        }
    }
}

#[tokio::test]
async fn rows_of_the_pipeline_are_taken_over_and_unknown_columns_stay() {
    let stand_in = StandIn::start().await;
    let (spec, table) = usual(&stand_in).await;
    let text = |text: &str| AttributeValue::S(text.into());
    let put = client(&stand_in)
        .put_item()
        .table_name(&spec.name)
        .item("team_id", text("12"))
        .item("submission_id", text("7"));
    let put = put
        .item("submission_status", text("FINISHED"))
        .item("parallelization_workers", text("4"));
    put.item("start_time", text("-"))
        .item("team_name", text("Team"))
        .send()
        .await
        .unwrap();
    let resumed = Row {
        start_time: "2026-11-20 10:01:00 UTC".into(),
        ..row(1, "RUNNING")
    };
    assert_eq!(table.write(&resumed).await, Ok(Written::Stored));
    let stored = rows(&stand_in, &spec.name).await.remove(0);
    assert_eq!(
        (stored["parallelization_workers"].as_str(), stored["team_name"].as_str()),
        ("4", "Team")
    );
    assert_eq!(
        (stored["start_time"].as_str(), stored["submission_status"].as_str()),
        ("2026-11-20 10:01:00 UTC", "RUNNING")
    );
}

#[tokio::test]
async fn metrics_of_an_earlier_row_are_removed() {
    let stand_in = StandIn::start().await;
    let (spec, table) = usual(&stand_in).await;
    let with = |row: Row, score: Option<&str>| Row {
        metrics: vec![("driving_score".into(), score.map(str::to_owned))],
        ..row
    };
    let score = async || rows(&stand_in, &spec.name).await.remove(0).remove("driving_score");
    // As an earlier operator wrote it.
    assert_eq!(
        table.write(&with(row(1, "RUNNING"), Some("10.5"))).await,
        Ok(Written::Stored)
    );
    assert_eq!(score().await.as_deref(), Some("10.5"));
    for status in ["RUNNING", "FAILED", "FAILED"] {
        assert_eq!(table.write(&with(row(1, status), None)).await, Ok(Written::Stored));
        assert_eq!(score().await, None, "{status}");
    }
    assert_eq!(
        table.write(&with(row(1, "FAILED"), Some("10.5"))).await,
        Ok(Written::Stale { kept: 1 }),
        "it is not the same"
    );
}

/// EvalAI refused a result, whose row is written all the same; a host cancels the submission there later.
#[tokio::test]
async fn a_cancel_is_written_over_another_end_and_takes_its_metrics_away() {
    let stand_in = StandIn::start().await;
    let (spec, table) = usual(&stand_in).await;
    let with = |row: Row, score: Option<&str>| Row {
        metrics: vec![("driving_score".into(), score.map(str::to_owned))],
        ..row
    };
    for (attempt, end, score) in [(1, "FINISHED", Some("43.1")), (2, "FAILED", None)] {
        let ended = with(row(attempt, end), score);
        let cancelled = with(row(attempt, "CANCELLED"), None);
        assert_eq!(table.write(&ended).await, Ok(Written::Stored));
        for _ in 0..2 {
            assert_eq!(table.write(&cancelled).await, Ok(Written::Stored), "over {end}");
            let stored = rows(&stand_in, &spec.name).await.remove(0);
            assert_eq!(
                (stored["submission_status"].as_str(), stored.get("driving_score")),
                ("CANCELLED", None)
            );
        }
        assert_eq!(
            table.write(&ended).await,
            Ok(Written::Stale { kept: attempt }),
            "{end} does not come back"
        );
    }
    let older = with(row(1, "CANCELLED"), None);
    assert_eq!(
        table.write(&older).await,
        Ok(Written::Stale { kept: 2 }),
        "it is of an older attempt"
    );
}

#[tokio::test]
async fn of_many_writers_at_once_the_end_of_the_last_attempt_wins() {
    let stand_in = StandIn::start().await;
    let (spec, table) = usual(&stand_in).await;
    for _ in 0..5 {
        let writes = (1..=4).flat_map(|attempt| ["RUNNING", "FAILED"].map(|status| row(attempt, status)));
        let table = &table;
        let done = futures::future::join_all(writes.map(|row| async move { table.write(&row).await })).await;
        assert!(done.iter().all(Result::is_ok), "{done:?}");
        let stored = rows(&stand_in, &spec.name).await.remove(0);
        assert_eq!(
            (stored["attempt"].as_str(), stored["submission_status"].as_str()),
            ("#4", "FAILED")
        );
        let key = [("team_id", "12"), ("submission_id", "7")];
        let delete = key.into_iter().fold(
            client(&stand_in).delete_item().table_name(&spec.name),
            |delete, (key, value)| delete.key(key, AttributeValue::S(value.into())),
        );
        delete.send().await.unwrap();
    }
}

#[tokio::test]
async fn a_table_that_cannot_be_used_is_shown_with_the_next_step() {
    let stand_in = StandIn::start().await;
    let missing = Table::describe(&stand_in.aws, &named(&stand_in, "nowhere"))
        .await
        .unwrap_err()
        .to_string();
    assert!(
        missing.starts_with(&format!(
            "table {} does not exist: ResourceNotFoundException",
            stand_in.name("nowhere")
        )),
        "{missing}"
    );
    assert!(
        missing.ends_with("check table.dynamoDB.name, table.dynamoDB.region and table.dynamoDB.endpoint"),
        "{missing}"
    );
    let single = table(&stand_in, "single", &[("team_id", ScalarAttributeType::S)]).await;
    let no_sort_key = Table::describe(&stand_in.aws, &single).await.unwrap_err().to_string();
    assert!(
        no_sort_key.starts_with(&format!("table {} has no sort key", single.name)),
        "{no_sort_key}"
    );
    let (spec, usual) = usual(&stand_in).await;
    let nobody = Row {
        team_id: String::new(),
        ..row(1, "PENDING")
    };
    let text = usual.write(&nobody).await.unwrap_err().to_string();
    assert_eq!(
        text,
        format!("table {}: key team_id is empty: the team is not known", spec.name)
    );
}

#[tokio::test]
async fn a_key_that_is_a_number_takes_no_name() {
    let stand_in = StandIn::start().await;
    let keys = [
        ("team_id", ScalarAttributeType::N),
        ("submission_id", ScalarAttributeType::N),
    ];
    let numbers = table(&stand_in, "numbers", &keys).await;
    let local = Row {
        run_id: "my-run".into(),
        ..row(1, "PENDING")
    };
    let text = Table::describe(&stand_in.aws, &numbers)
        .await
        .unwrap()
        .write(&local)
        .await
        .unwrap_err()
        .to_string();
    assert_eq!(
        text,
        format!(
            "table {}: key submission_id is a number in this table, but the submission is called my-run",
            numbers.name
        )
    );
}

fn key(name: &str) -> ObjectKey {
    ObjectKey {
        namespace: "ns".into(),
        name: name.into(),
        uid: name.into(),
    }
}

fn record(table: &api::DynamoTable, status: &str, is_end: bool) -> Record {
    Record {
        table: table.clone(),
        row: row(1, status).into(),
        is_end,
    }
}

/// Writes in the background; the channel yields whose row has news.
fn records(stand_in: &StandIn) -> (Asker<Record>, mpsc::UnboundedReceiver<String>, watch::Sender<bool>) {
    let (wake, woken) = mpsc::unbounded_channel();
    let (stop, stopped) = Stop::new();
    let wake = Box::new(move |key: &ObjectKey| wake.send(key.name.clone()).unwrap());
    let tables = Arc::new(Tables::new(stand_in.aws.clone()));
    let records = records::start(tables, || true, &Tasks::new(stopped), wake);
    (records, woken, stop)
}

#[tokio::test]
async fn rows_are_written_in_the_background() {
    let stand_in = StandIn::start().await;
    let (spec, _) = usual(&stand_in).await;
    let (records, mut woken, _stop) = records(&stand_in);
    let nowhere = named(&stand_in, "nowhere");
    records.want(&key("a"), record(&spec, "FINISHED", true), LogSpan::default());
    records.want(&key("b"), record(&nowhere, "FINISHED", true), LogSpan::default());
    let mut all = Vec::new();
    for _ in 0..2 {
        all.push(tokio::time::timeout(LIMIT, woken.recv()).await.unwrap().unwrap());
    }
    all.sort();
    assert_eq!(all, ["a", "b"]);
    let view = records::seen(&records.get("a"), 1);
    assert_eq!((view.end_written, view.error), (true, None));
    let view = records::seen(&records.get("b"), 1);
    let missing = format!("table {} does not exist", stand_in.name("nowhere"));
    assert!(!view.end_written && view.error.unwrap().starts_with(&missing));
    assert_eq!(rows(&stand_in, &spec.name).await.len(), 1);
}

#[tokio::test]
async fn a_row_that_dynamodb_throttles_is_written_at_last_and_an_older_state_is_not() {
    let stand_in = StandIn::start().await;
    let (mut spec, _) = usual(&stand_in).await;
    let throttle = Throttle::start(&stand_in.endpoint, "ProvisionedThroughputExceededException").await;
    spec.endpoint = Some(throttle.endpoint().to_owned());
    let (records, mut woken, _stop) = records(&stand_in);
    // The SDK sends each call three times: so the first call fails, and part of the second.
    throttle.refuse(5);
    records.want(&key("a"), record(&spec, "RUNNING", false), LogSpan::default());
    tokio::time::timeout(LIMIT, woken.recv()).await.unwrap().unwrap();
    let view = || records::seen(&records.get("a"), 1);
    let why = view().error.unwrap();
    assert!(
        why.contains("ProvisionedThroughputExceededException") && why.contains("it is retried"),
        "{why}"
    );
    records.want(&key("a"), record(&spec, "FINISHED", true), LogSpan::default());
    while !view().end_written {
        tokio::time::timeout(LIMIT, woken.recv()).await.unwrap().unwrap();
    }
    assert_eq!(view().error, None);
    assert_eq!(throttle.refused(), 5);
    let stored = rows(&stand_in, &spec.name).await;
    assert_eq!((stored.len(), stored[0]["submission_status"].as_str()), (1, "FINISHED"));
}
