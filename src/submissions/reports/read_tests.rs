//! Reads of a bucket of the test's own.

use std::collections::HashMap;
use std::sync::Mutex;

use axum::extract::State as Shared;
use axum::http::{HeaderMap, StatusCode, Uri};
use axum::response::{IntoResponse, Response};
use serde_json::json;
use sha2::{Digest, Sha256};
use tokio::time::timeout;

use super::*;
use crate::fixtures::{Cluster, Surroundings, leaderboard, surroundings, with_job};
use crate::submissions::observe::workers::Workers;
use leaderboard_api::{Submission, SubmissionStatus};
use leaderboard_base::lock::lock;

/// Longer than a read takes on a busy machine.
const LIMIT: Duration = Duration::from_mins(1);

/// Objects by the end of their key.
type Objects = Arc<Mutex<HashMap<&'static str, String>>>;

async fn answer(Shared(objects): Shared<Objects>, uri: Uri, headers: HeaderMap) -> Response {
    let objects = lock(&objects);
    let found = objects.iter().find(|(key, _)| uri.path().ends_with(*key));
    let Some((_, body)) = found else {
        let error = "<Error><Code>NoSuchKey</Code><Message>no</Message></Error>";
        return (StatusCode::NOT_FOUND, error).into_response();
    };
    let etag = format!("\"{}\"", hex::encode(Sha256::digest(body)));
    if headers.get("if-none-match").is_some_and(|known| known == etag.as_str()) {
        return StatusCode::NOT_MODIFIED.into_response();
    }
    ([("etag", etag)], body.clone()).into_response()
}

struct Bench {
    around: Surroundings,
    objects: Objects,
    submission: Submission,
}

async fn bench() -> Bench {
    let objects = Objects::default();
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let endpoint = format!("http://{}", listener.local_addr().unwrap());
    let router = axum::Router::new().fallback(answer).with_state(Arc::clone(&objects));
    tokio::spawn(async move { axum::serve(listener, router).await });
    let (submission, _) = with_job("sub", &leaderboard("one", &endpoint));
    Bench {
        around: surroundings(Cluster::default(), &endpoint).await,
        objects,
        submission,
    }
}

fn report(stdout: &str) -> String {
    json!({
        "schema": 1, "submissionUid": "uid-of-sub", "attempt": 1, "podUid": "p", "round": 9, "done": 4, "total": 4,
        "unit": "routes", "workers": [], "final": true, "eligible": true, "outcome": "Finished", "results": "[1]",
        "files": {"evalai/stdout.txt": {"size": stdout.len(), "sha256": hex::encode(Sha256::digest(stdout))}},
    })
    .to_string()
}

impl Bench {
    fn stores(&self, key: &'static str, body: impl Into<String>) {
        lock(&self.objects).insert(key, body.into());
    }

    fn workers(&self) -> &Workers {
        &self.around.context.workers
    }

    fn status(&self) -> SubmissionStatus {
        self.submission.status.clone().unwrap()
    }

    fn demand(&self, stage: Stage) {
        let demand = ReportDemand {
            job: JobNumber::first(Attempt(1)),
            pod: None,
            stage,
            period: Duration::from_secs(10),
        };
        let status = self.status();
        self.workers()
            .demand_report(&self.submission, &status, jiff::Timestamp::UNIX_EPOCH, Some(demand));
    }

    /// Waits until the submission is woken; hands back what is known then.
    async fn answer(&mut self) -> ReportView {
        let woken = timeout(LIMIT, self.around.answered.recv()).await;
        assert_eq!(woken.expect("it is woken").unwrap(), "sub");
        self.seen()
    }

    fn seen(&self) -> ReportView {
        let lookup = self.workers().reports.get("uid-of-sub");
        seen(&lookup, JobNumber::first(Attempt(1)), None)
    }
}

#[tokio::test]
async fn a_report_is_read_in_the_background_and_wakes_its_submission() {
    let mut bench = bench().await;
    assert_eq!(bench.seen().stored, ObservedReport::NotRead);
    bench.demand(Stage::Live);
    assert_eq!(bench.answer().await.stored, ObservedReport::Absent);
    bench.stores("logcopy/report.json", report("all is well"));
    bench.demand(Stage::RunEnded);
    let seen = bench.answer().await;
    assert_eq!((seen.stage, seen.ours().unwrap().done), (Some(Stage::RunEnded), 4));
    // S3 answers that it is the same.
    bench.demand(Stage::JobEnded);
    let seen = bench.answer().await;
    assert_eq!((seen.stage, seen.ours().unwrap().done), (Some(Stage::JobEnded), 4));
    bench.workers().forget("uid-of-sub");
    assert_eq!(bench.seen().stored, ObservedReport::NotRead);
}

#[tokio::test]
async fn what_is_no_report_is_unreadable_and_another_objects_is_foreign() {
    let mut bench = bench().await;
    bench.stores("logcopy/report.json", "torn");
    bench.demand(Stage::JobEnded);
    let seen = bench.answer().await;
    assert!(matches!(seen.stored, ObservedReport::Unreadable(why) if why.contains("not one of ours")));
    bench.stores(
        "logcopy/report.json",
        report("").replace("uid-of-sub", "uid-of-another"),
    );
    bench.workers().forget("uid-of-sub");
    bench.demand(Stage::JobEnded);
    assert_eq!(bench.answer().await.stored, ObservedReport::Foreign);
}

#[tokio::test]
async fn a_report_of_before_a_restore_may_be_of_a_later_attempt() {
    let mut bench = bench().await;
    let later = report("").replace(r#""attempt":1"#, r#""attempt":2"#);
    let former = |text: &str| text.replace("uid-of-sub", "uid-before");
    bench.stores("logcopy/report.json", later.as_str());
    bench.demand(Stage::JobEnded);
    let seen = bench.answer().await;
    assert_eq!(seen.stored, ObservedReport::Foreign, "its own Pods are of its attempt");
    let status = bench.submission.status.as_mut().unwrap();
    status.plan.as_mut().unwrap().submission_uid = Some("uid-before".into());
    for (stored, attempt) in [(former(&later), 2), (former(&report("")), 1)] {
        bench.workers().forget("uid-of-sub");
        bench.stores("logcopy/report.json", stored);
        bench.demand(Stage::JobEnded);
        let seen = bench.answer().await;
        assert_eq!(seen.ours().unwrap().attempt, Attempt(attempt));
    }
}
