use std::collections::HashMap;
use std::sync::Mutex;

use axum::extract::State;
use axum::http::{StatusCode, Uri};
use axum::response::{IntoResponse, Response};
use serde_json::json;

use super::*;
use crate::fixtures::{Cluster, surroundings};
use leaderboard_base::lock::lock;
use leaderboard_evalai::Patience;
use leaderboard_policy::report_digest::left_out;

/// Objects by their key below the run's prefix.
type Objects = Arc<Mutex<HashMap<&'static str, String>>>;

async fn answer(State(objects): State<Objects>, uri: Uri) -> Response {
    let objects = lock(&objects);
    let found = objects.iter().find(|(key, _)| uri.path().ends_with(*key));
    found.map_or_else(
        || {
            let error = "<Error><Code>NoSuchKey</Code><Message>no</Message></Error>";
            (StatusCode::NOT_FOUND, error).into_response()
        },
        |(_, body)| body.clone().into_response(),
    )
}

/// A bucket of the test's own, with the reader of it.
struct Bench {
    objects: Objects,
    reader: PayloadReader,
    endpoint: String,
}

fn report(stdout: &str) -> String {
    json!({
        "schema": 1, "submissionUid": "u", "attempt": 1, "podUid": "p", "round": 9, "done": 4, "total": 4,
        "unit": "routes", "workers": [], "final": true, "eligible": true, "outcome": "Finished", "results": "[1]", "partialResults": "[2]",
        "files": {"evalai/stdout.txt": {"size": stdout.len(), "sha256": hex::encode(Sha256::digest(stdout))}},
    })
    .to_string()
}

impl Bench {
    async fn new() -> Self {
        let objects = Objects::default();
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        let endpoint = format!("http://{}", listener.local_addr().unwrap());
        let router = axum::Router::new().fallback(answer).with_state(Arc::clone(&objects));
        tokio::spawn(async move { axum::serve(listener, router).await });
        let around = surroundings(Cluster::default(), &endpoint).await;
        Self {
            objects,
            reader: reader(around.aws.clone(), Clock::system()),
            endpoint,
        }
    }

    fn stores(&self, key: &'static str, body: impl Into<String>) {
        lock(&self.objects).insert(key, body.into());
    }

    /// Reads what a report with these bytes names.
    async fn read(&self, decided: &str, so_far: bool, patience: Patience) -> Result<Payload, PayloadProblem> {
        let storage = json!({"bucket": "one-bucket", "endpoint": self.endpoint});
        let stored = StoredResult {
            storage: serde_json::from_value(storage).unwrap(),
            prefix: "7/".into(),
            report: ContentId::of(decided.as_bytes()),
            done: 4,
            so_far,
            patience,
        };
        let outline = Outline {
            stored: Some(stored),
            ..Outline::default()
        };
        (self.reader)(Arc::new(outline)).await
    }
}

fn unfit_as(why: &str) -> Result<Payload, PayloadProblem> {
    Err(PayloadProblem::Unfit(why.to_owned()))
}

#[tokio::test]
async fn texts_count_only_with_the_digest_that_the_report_names() {
    let (bench, decided) = (Bench::new().await, report("all is well"));
    bench.stores(REPORT_KEY, decided.as_str());
    let read = || bench.read(&decided, false, Patience::ENDLESS);
    assert_eq!(read().await, unfit_as("evalai/stdout.txt is missing"));
    for other in ["of another", "of a later round"] {
        bench.stores(STDOUT, other);
        let expected = "evalai/stdout.txt is of another round than the report";
        assert_eq!(read().await, unfit_as(expected), "{other}");
    }
    bench.stores(STDOUT, "all is well");
    let found = read().await.unwrap();
    assert_eq!(
        (&*found.result, &*found.stdout, &*found.metadata),
        ("[1]", "all is well", "")
    );
    let so_far = bench.read(&decided, true, Patience::ENDLESS).await.unwrap();
    assert_eq!(so_far.result, "[2]");
}

#[tokio::test]
async fn a_report_that_was_not_decided_on_is_not_sent() {
    let (bench, decided) = (Bench::new().await, report("all is well"));
    let expected = "logcopy/report.json is another one than was decided on";
    for (field, value) in [("attempt", json!(2)), ("podUid", json!("another")), ("done", json!(3))] {
        let mut other: serde_json::Value = serde_json::from_str(&decided).unwrap();
        other[field] = value;
        bench.stores(REPORT_KEY, other.to_string());
        let found = bench.read(&decided, false, Patience::ENDLESS).await;
        assert_eq!(found, unfit_as(expected), "{field}");
    }
}

#[tokio::test]
async fn what_is_waited_for_long_enough_is_left_out() {
    let (bench, decided) = (Bench::new().await, report("all is well"));
    let over = Timestamp::UNIX_EPOCH;
    let patience = Patience {
        unfit: over,
        ..Patience::ENDLESS
    };
    let missing = bench.read(&decided, false, patience).await;
    assert!(missing.is_err(), "there is no result without the report");
    bench.stores(REPORT_KEY, decided.as_str());
    let found = bench.read(&decided, false, patience).await.unwrap();
    assert_eq!((&*found.result, &*found.stdout), ("[1]", ""));
    bench.stores(REPORT_KEY, "torn");
    let none = Patience {
        report: over,
        ..patience
    };
    assert_eq!(bench.read(&decided, false, none).await.unwrap().result, "[]");
}

#[tokio::test]
async fn a_text_that_is_too_large_is_left_out_at_once_and_reported() {
    let bench = Bench::new().await;
    let mut named: serde_json::Value = serde_json::from_str(&report("all is well")).unwrap();
    // It is not even asked for: the bucket of this test has none.
    named["files"][METADATA] = json!({"size": MAX_TEXT + 1, "sha256": ""});
    let decided = named.to_string();
    bench.stores(REPORT_KEY, decided.as_str());
    bench.stores(STDOUT, "all is well");
    let found = bench.read(&decided, false, Patience::ENDLESS).await.unwrap();
    assert_eq!((&*found.stdout, &*found.metadata), ("all is well", ""));
    let shown = left_out(&Report::parse(decided.as_bytes()).unwrap()).unwrap();
    assert!(
        shown.starts_with("evalai/metadata.json was left out: it has 4194305 bytes"),
        "{shown}"
    );
}
