//! Other readers of the queue, as `leaderboard-operator import` lists them: against a stand-in for the two services of AWS that have
//! them. Untried: AWS itself.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};

use axum::extract::{Query, State};
use axum::http::{HeaderMap, StatusCode, header};
use axum::response::{IntoResponse as _, Response};
use axum::routing::get;
use axum::{Json, Router};
use leaderboard_operator::services::aws::Aws;
use leaderboard_operator::services::event_sources::{EventSource, Kind, QueueArn, readers};
use serde_json::json;
use tokio::net::TcpListener;

use crate::support::ministack;

const ARN: &str = "arn:aws:sqs:us-west-2:123456789012:leaderboard";

/// What it was asked.
type Asked = Arc<Mutex<Vec<(BTreeMap<String, String>, String)>>>;

fn note(asked: &Asked, query: BTreeMap<String, String>, headers: &HeaderMap) {
    let authorization = headers[header::AUTHORIZATION].to_str().unwrap().to_owned();
    asked.lock().unwrap().push((query, authorization));
}

/// Two pages of Pipes, the first with one of another queue.
async fn pipes(
    State(asked): State<Asked>,
    Query(query): Query<BTreeMap<String, String>>,
    headers: HeaderMap,
) -> Response {
    let pipe = |name: &str, source: &str| json!({"Name": name, "Source": source, "CurrentState": "RUNNING"});
    let page = if query.contains_key("NextToken") {
        json!({"Pipes": [pipe("second", ARN)]})
    } else {
        json!({"Pipes": [pipe("staging", &format!("{ARN}-staging")), pipe("first", ARN)], "NextToken": "a+b/="})
    };
    note(&asked, query, &headers);
    Json(page).into_response()
}

async fn mappings(
    State(asked): State<Asked>,
    Query(query): Query<BTreeMap<String, String>>,
    headers: HeaderMap,
) -> Response {
    note(&asked, query, &headers);
    let code = [("x-amzn-errortype", "AccessDeniedException:http://internal.amazon.com/")];
    let body = json!({"Message": "User: arn:aws:iam::123456789012:user/a is not authorized"});
    (StatusCode::FORBIDDEN, code, Json(body)).into_response()
}

async fn stand_in() -> (String, Asked) {
    let asked = Asked::default();
    let router = Router::new()
        .route("/v1/pipes", get(pipes))
        .route("/2015-03-31/event-source-mappings/", get(mappings))
        .with_state(asked.clone());
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let endpoint = format!("http://{}", listener.local_addr().unwrap());
    tokio::spawn(async move { axum::serve(listener, router).await });
    (endpoint, asked)
}

fn queue() -> QueueArn {
    QueueArn::of_url("https://sqs.us-west-2.amazonaws.com/123456789012/leaderboard", None).unwrap()
}

#[tokio::test]
async fn all_pages_are_read_with_signed_requests_and_a_refusal_is_kept() {
    let (endpoint, asked) = stand_in().await;
    let aws: Aws = ministack::aws(&endpoint).await;
    let found = readers(&aws, &queue(), Some(&endpoint)).await;
    let pipe = |name: &str| EventSource::Pipe {
        name: name.to_owned(),
        region: "us-west-2".to_owned(),
    };
    assert_eq!(found.found, [pipe("first"), pipe("second")]);
    assert_eq!(found.unread.len(), 1);
    assert_eq!(found.unread[0].kind, Kind::Lambda);
    let why = "AccessDeniedException: User: arn:aws:iam::123456789012:user/a is not authorized";
    assert_eq!(found.unread[0].why, why);

    let asked = asked.lock().unwrap();
    assert_eq!(asked.len(), 3);
    for (query, authorization) in asked.iter() {
        let service = if query.contains_key("SourcePrefix") {
            "pipes"
        } else {
            "lambda"
        };
        assert!(
            authorization.starts_with("AWS4-HMAC-SHA256 Credential=test/"),
            "{authorization}"
        );
        assert!(
            authorization.contains(&format!("/us-west-2/{service}/aws4_request")),
            "{authorization}"
        );
    }
    assert_eq!(
        (asked[0].0["SourcePrefix"].as_str(), asked[0].0["CurrentState"].as_str()),
        (ARN, "RUNNING")
    );
    assert_eq!(asked[1].0["NextToken"], "a+b/=");
    assert_eq!(asked[2].0["EventSourceArn"], ARN);
}

#[tokio::test]
async fn a_service_that_does_not_answer_is_named_and_hides_nothing() {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let endpoint = format!("http://{}", listener.local_addr().unwrap());
    drop(listener);
    let aws = ministack::aws(&endpoint).await;
    let found = readers(&aws, &queue(), Some(&endpoint)).await;
    assert_eq!(found.found, []);
    let kinds: Vec<Kind> = found.unread.iter().map(|unread| unread.kind).collect();
    assert_eq!(kinds, Kind::ALL);
    assert!(found.unread.iter().all(|unread| !unread.why.is_empty()));
}
