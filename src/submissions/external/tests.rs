//! Rows of an end, against a stand-in for DynamoDB of the test's own.

use leaderboard_contract::report::ContentId;
use leaderboard_policy::report_digest::ReportDigest;
use std::collections::BTreeMap;

use axum::body::Bytes;
use axum::extract::State as Shared;
use axum::http::{HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};
use jiff::Timestamp;
use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;
use serde_json::{Value, json};
use tokio::sync::mpsc;

use super::*;
use crate::fixtures::{Cluster, Surroundings, leaderboard, surroundings, with_job};
use leaderboard_api::conditions::{self, Truth};
use leaderboard_api::{Attempt, Reason, State};
use leaderboard_policy::view::{ObservedReport, Turn};

/// Longer than a write takes on a busy machine.
const LIMIT: std::time::Duration = std::time::Duration::from_mins(1);

type Item = BTreeMap<String, String>;

/// One row in one table.
#[derive(Clone)]
struct Stored {
    item: Arc<Mutex<Item>>,
    /// Told each row that was written.
    written: mpsc::UnboundedSender<Item>,
}

impl Stored {
    fn update(&self, request: &Value) {
        let mut item = self.item.lock().unwrap();
        let update = request["UpdateExpression"].as_str().unwrap();
        let (set, remove) = update.split_once(" REMOVE ").unwrap_or((update, ""));
        for name in remove.split(", ").filter(|name| !name.is_empty()) {
            item.remove(request["ExpressionAttributeNames"][name].as_str().unwrap());
        }
        for set in set.trim_start_matches("SET ").split(", ") {
            let (name, value) = set.split_once(" = ").unwrap();
            let column = request["ExpressionAttributeNames"][name].as_str().unwrap();
            let value = &request["ExpressionAttributeValues"][value];
            let text = value["S"].as_str().or(value["N"].as_str()).unwrap();
            item.insert(column.to_owned(), text.to_owned());
        }
        self.written.send(item.clone()).unwrap();
    }
}

async fn answer(Shared(stored): Shared<Stored>, headers: HeaderMap, body: Bytes) -> Response {
    let target = &headers["x-amz-target"];
    if target.to_str().unwrap().ends_with("UpdateItem") {
        stored.update(&serde_json::from_slice(&body).unwrap());
        return "{}".into_response();
    }
    let denied = json!({"__type": "AccessDeniedException", "message": "no"});
    (StatusCode::BAD_REQUEST, denied.to_string()).into_response()
}

struct Bench {
    around: Surroundings,
    written: mpsc::UnboundedReceiver<Item>,
    view: View,
    status: SubmissionStatus,
}

/// A submission that has come to this end, whose row has the metrics of a partial result of an earlier operator's.
async fn bench(state: State) -> Bench {
    let (sender, written) = mpsc::unbounded_channel();
    let partial = BTreeMap::from([("driving_score".to_owned(), "10.5".to_owned())]);
    let stored = Stored {
        item: Arc::new(Mutex::new(partial)),
        written: sender,
    };
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let endpoint = format!("http://{}", listener.local_addr().unwrap());
    let router = axum::Router::new().fallback(answer).with_state(stored.clone());
    tokio::spawn(async move { axum::serve(listener, router).await });
    let board = leaderboard("one", &endpoint);
    let (mut submission, _) = with_job("sub", &board);
    let now = Timestamp::now();
    let status = submission.status.as_mut().unwrap();
    let failure = json!({"class": "Participant", "reason": "Test", "message": "It failed."});
    status.failure = (state == State::Failed).then(|| serde_json::from_value(failure).unwrap());
    let (type_, reason) = (conditions::FINISHED, state.as_str());
    conditions::set(&mut status.conditions, type_, Truth::True, reason, "", None, &Time(now));
    let status = status.clone();
    let view = View {
        now,
        submission: Arc::new(submission),
        leaderboard: Some(Arc::new(board)),
        turn: Turn::Go,
        record: Some(RecordView::default()),
        ..View::default()
    };
    Bench {
        around: surroundings(Cluster::default(), &endpoint).await,
        written,
        view,
        status,
    }
}

impl Bench {
    fn records_the_end(&self) {
        self.around
            .context
            .external
            .record(&self.view, &self.status, TableUpdate::End);
    }

    async fn row(&mut self) -> Item {
        let row = tokio::time::timeout(LIMIT, self.written.recv()).await;
        row.expect("a row is written").unwrap()
    }
}

fn last() -> ObservedReport {
    let results = json!([{"split": "leaderboard", "accuracies": {"Driving score": 43.125}}]);
    let report = json!({
        "schema": 1, "submissionUid": "uid-of-sub", "attempt": 1, "podUid": "p", "round": 9, "done": 4, "total": 4,
        "unit": "routes", "workers": [], "final": true, "eligible": true, "outcome": "Finished", "results": results.to_string(),
    });
    let report: leaderboard_contract::report::Report = serde_json::from_value(report).unwrap();
    ObservedReport::Ours(Arc::new(ReportDigest::of(&report, ContentId::default())))
}

#[tokio::test]
async fn the_row_of_an_end_has_the_metrics_of_the_last_report() {
    let mut bench = bench(State::Finished).await;
    bench.view.report.stored = last();
    bench.records_the_end();
    let row = bench.row().await;
    assert_eq!(row["submission_status"], "FINISHED");
    assert_eq!(row["driving_score"], "43.125", "not those of a partial result");
}

#[tokio::test]
async fn the_row_of_an_end_without_results_that_count_has_no_metrics() {
    for (state, status) in [(State::Cancelled, "CANCELLED"), (State::Failed, "FAILED")] {
        let mut bench = bench(state).await;
        bench.view.report.stored = last();
        bench.records_the_end();
        let row = bench.row().await;
        assert_eq!(
            (row["submission_status"].as_str(), row.get("driving_score")),
            (status, None)
        );
    }
}

#[tokio::test]
async fn nothing_is_recorded_for_a_leaderboard_that_may_not_name_its_table() {
    let mut bench = bench(State::Finished).await;
    bench.view.report.stored = last();
    bench.view.not_allowed = Some("It may not name the table theirs.".to_owned());
    bench.records_the_end();
    let known = &bench.around.context.external;
    let key = key_of(bench.view.submission.as_ref());
    assert!(known.records.get(&key.uid).asked.is_none());
    let strict = ExternalSystems::new(known.hub.clone(), known.records.clone(), "{}".parse().unwrap());
    let board = bench.view.leaderboard.clone().unwrap();
    let shown = strict.record_view(&board, &bench.view.submission).unwrap();
    assert!(!shown.end_written && shown.error.is_some_and(|why| why.contains("may not name")));
    bench.view.not_allowed = None;
    bench.records_the_end();
    assert_eq!(bench.row().await["submission_status"], "FINISHED");
}

#[test]
fn an_attempt_that_evalai_has_asked_for_differs_from_one_that_a_person_has_begun() {
    let (mut submission, _) = with_job("sub", &leaderboard("one", "http://s3"));
    let mut of = |attempt, record: Option<Value>| {
        submission.spec.attempt = Attempt(attempt);
        submission.status.as_mut().unwrap().attempt = Some(Attempt(attempt));
        let annotations = record.map(|record| (names::ANNOTATION_INGESTED.to_owned(), record.to_string()));
        submission.metadata.annotations = annotations.map(|annotation| [annotation].into());
        run_of(&submission).by_hand
    };
    let by_message = || Some(json!({"message": "m", "sent": 1, "attempt": 2}));
    assert!(!of(2, by_message()));
    assert!(of(3, by_message()), "raised after the one that the message began");
    let by_sweep = || Some(json!({"message": "sweep", "sent": 1, "attempt": 3, "withoutMessage": [2, 3]}));
    assert!(!of(2, by_sweep()) && !of(3, by_sweep()) && of(4, by_sweep()));
    assert!(of(2, None), "nobody but people made it");
    assert!(of(2, Some(json!({"message": "m", "sent": 1}))), "no message began one");
}

#[test]
fn an_attempt_that_goes_on_from_a_live_one_is_nobodys_new_request() {
    let (mut submission, _) = with_job("sub", &leaderboard("one", "http://s3"));
    submission.spec.attempt = Attempt(2);
    let restart = |reason: Reason| {
        json!({"attempt": 2, "conditions": [{"type": "Finished", "status": "False", "reason": reason, "message": "",
                                              "lastTransitionTime": "2026-01-01T00:00:00Z"}]})
    };
    for (reason, is_restart) in [(Reason::Replacing, true), (Reason::Preparing, false)] {
        submission.status = serde_json::from_value(restart(reason)).unwrap();
        let run = run_of(&submission);
        assert_eq!((run.by_hand, run.has_job), (!is_restart, is_restart), "{reason}");
    }
}

#[test]
fn a_run_has_a_job_once_that_of_this_attempt_was_asked_for() {
    let (mut submission, _) = with_job("sub", &leaderboard("one", "http://s3"));
    assert!(run_of(&submission).has_job);
    let status = submission.status.as_mut().unwrap();
    (status.job_name, status.retry) = (None, 1);
    assert!(run_of(&submission).has_job, "between two tries");
    submission.status.as_mut().unwrap().retry = 0;
    assert!(!run_of(&submission).has_job);
}

#[test]
fn an_attempt_that_is_asked_for_early_is_not_the_one_that_runs() {
    let (mut submission, _) = with_job("sub", &leaderboard("one", "http://s3"));
    submission.spec.attempt = Attempt(2);
    let run = run_of(&submission);
    assert_eq!(
        (run.attempt, run.job.as_str(), run.has_job),
        (Attempt(1), "sub-1", true)
    );
    let ended_in_evalai = SubmissionState {
        attempt: Attempt(1),
        ended: Some(Status::Cancelled),
        ..SubmissionState::default()
    };
    assert!(map_view(&ended_in_evalai, &submission, false).cancelled);
    submission.status = None;
    assert_eq!(run_of(&submission).attempt, Attempt(2));
}

#[test]
fn an_end_that_evalai_showed_already_is_published_at_one_moment_whatever_is_read_later() {
    let (submission, _) = with_job("sub", &leaderboard("one", "http://s3"));
    let at = Timestamp::UNIX_EPOCH;
    let end_after = |seconds: i64| {
        let seen = SubmissionState {
            attempt: Attempt(1),
            end: Some(Ended::Agreed {
                status: Status::Cancelled,
                at,
            }),
            read_at: Timestamp::from_second(seconds).ok(),
            ..SubmissionState::default()
        };
        map_view(&seen, &submission, false).end
    };
    for seconds in [0, 10] {
        assert_eq!(end_after(seconds), Some(EvalaiEnd::Published { at }));
    }
}

#[test]
fn what_had_finished_in_evalai_before_is_its_own_end() {
    let of = |end: Ended| map_end(&end);
    let at = Timestamp::UNIX_EPOCH;
    let agreed = |status| Ended::Agreed { status, at };
    let kept = EvalaiEnd::Ended(Status::Finished);
    assert_eq!(of(agreed(Status::Finished)), kept);
    assert_eq!(of(agreed(Status::Cancelled)), EvalaiEnd::Published { at });
}

#[test]
fn the_image_of_an_uploaded_file_is_asked_for_where_images_are_submitted() {
    let (mut submission, _) = with_job("sub", &leaderboard("one", "http://s3"));
    submission.spec.image = None;
    let of_mode = |mode: &str| {
        let mut board = leaderboard("one", "http://s3");
        let evaluation = json!({"container": {"mode": mode, "image": "e", "command": ["/e"]}});
        board.spec.evaluation = serde_json::from_value(evaluation).unwrap();
        board
    };
    let carla = leaderboard("one", "http://s3");
    assert!(wants_image(&submission, Some(&carla)));
    for (mode, expected) in [("Interactive", true), ("Batch", true), ("Predictions", false)] {
        assert_eq!(wants_image(&submission, Some(&of_mode(mode))), expected, "{mode}");
    }
    submission.spec.image = Some("team/agent:1".into());
    assert!(!wants_image(&submission, Some(&of_mode("Batch"))));
}

#[test]
fn a_row_is_an_answer_without_the_image_that_nobody_asked_for() {
    let (submission, _) = with_job("sub", &leaderboard("one", "http://s3"));
    let row: evalai::Row = serde_json::from_value(json!({"id": 7, "status": "submitted"})).unwrap();
    let seen = SubmissionState {
        attempt: Attempt(1),
        answered: Some(Attempt(1)),
        row: Some(Arc::new(row)),
        ..SubmissionState::default()
    };
    let is_known = |wants_image| map_view(&seen, &submission, wants_image).info.is_some();
    assert_eq!((is_known(false), is_known(true)), (true, false));
}
