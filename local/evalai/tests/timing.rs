//! Slow lists, lists without an order, and connections that are closed while they are idle.

#![allow(clippy::unwrap_used, reason = "a helper that fails fails its test")]

mod support;

use std::time::{Duration, Instant};

use reqwest::Method;
use serde_json::{Value, json};
use support::{HOST, PARTIAL, Stand, TEAM_A, UPDATE, put_body};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;

async fn keys(stand: &Stand) -> Vec<u64> {
    let rows = stand.list("").await.ok().json();
    let rows = rows.as_array().unwrap().iter();
    rows.map(|row| row["id"].as_u64().unwrap()).collect()
}

#[tokio::test]
async fn an_updated_row_moves_to_the_end_of_the_list() {
    let stand = Stand::start().await;
    for _ in 0..4 {
        stand.submit().await;
    }
    assert_eq!(keys(&stand).await, [1, 2, 3, 4]);
    stand
        .patch(UPDATE, &json!({"submission": 2, "submission_status": "queued"}))
        .await
        .ok();
    assert_eq!(keys(&stand).await, [1, 3, 4, 2]);
    stand.cancel(1, TEAM_A).await.ok();
    assert_eq!(keys(&stand).await, [3, 4, 2, 1]);
    stand.put(UPDATE, &put_body(4, "finished", 1.0)).await.ok();
    let started = "/api/jobs/submission/3/update_started_at/";
    stand.patch(started, &Value::Null).await.ok();
    assert_eq!(keys(&stand).await, [2, 1, 4, 3]);
}

#[tokio::test]
async fn a_list_costs_time_for_each_of_its_rows() {
    let stand = Stand::start().await;
    let bulk = json!({"count": 40, "phase": 1, "team": 1});
    assert_eq!(stand.post("/_stand-in/bulk", "", &bulk).await.status, 201);
    let took = async |query: &str| {
        let began = Instant::now();
        stand.list(query).await.ok();
        began.elapsed()
    };
    let whole = took("").await;
    assert!(whole >= Duration::from_millis(400), "40 rows took {whole:?}");
    let none = took("status=running").await;
    assert!(none < whole, "{none:?}: only rows of the answer cost");
    stand.knobs(&json!({"list_row_ms": 0})).await;
    let free = took("").await;
    assert!(free < whole, "{free:?}");
}

/// Sends a request on an open connection and reads to the end of its answer, or of the connection.
async fn ask(stream: &mut TcpStream) -> String {
    let request = format!("GET /api/jobs/submission/1 HTTP/1.1\r\nHost: x\r\nAuthorization: {HOST}\r\n\r\n");
    stream.write_all(request.as_bytes()).await.unwrap();
    let mut answer = vec![0; 65_536];
    let length = stream.read(&mut answer).await.unwrap_or(0);
    String::from_utf8_lossy(&answer[..length]).into_owned()
}

/// Waits until the server closes an idle connection.
async fn closed_within(stream: &mut TcpStream, limit: Duration) -> bool {
    let read = tokio::time::timeout(limit, stream.read(&mut [0; 16])).await;
    read.is_ok_and(|read| read.unwrap() == 0)
}

#[tokio::test]
async fn a_connection_that_nobody_uses_is_closed_after_the_keep_alive() {
    let stand = Stand::start().await;
    stand.submit().await;
    let address = stand.handle.url().replace("http://", "");
    let mut stream = TcpStream::connect(&address).await.unwrap();
    assert!(ask(&mut stream).await.starts_with("HTTP/1.1 200"));
    assert!(
        !closed_within(&mut stream, Duration::from_millis(500)).await,
        "it is kept for a minute, as the load balancer does"
    );
    assert_eq!(stand.get("/_stand-in/knobs", "").await.json()["keep_alive_ms"], 60_000);
    assert!(ask(&mut stream).await.starts_with("HTTP/1.1 200"), "it is used again");

    stand.knobs(&json!({"keep_alive_ms": 300})).await;
    assert!(closed_within(&mut stream, Duration::from_secs(20)).await);
    let mut unused = TcpStream::connect(&address).await.unwrap();
    assert!(closed_within(&mut unused, Duration::from_secs(20)).await);
}

#[tokio::test]
async fn a_long_request_is_not_idle() {
    let stand = Stand::start().await;
    let pk = stand.submit().await;
    stand.knobs(&json!({"keep_alive_ms": 50, "put_delay_ms": 500})).await;
    stand.put(UPDATE, &put_body(pk, "finished", 1.0)).await.ok();
}

#[tokio::test]
async fn a_held_result_is_saved_when_it_is_let_go() {
    let stand = Stand::start().await;
    stand.submit().await;
    stand.knobs(&json!({"put_held": true})).await;
    stand.put(PARTIAL, &put_body(1, "partially_evaluated", 1.0)).await.ok();
    let body = put_body(1, "finished", 1.0);
    let mut put = std::pin::pin!(stand.put(UPDATE, &body));
    let status = async || stand.list("").await.ok().json()[0]["status"].clone();
    tokio::select! {
        answer = &mut put => panic!("answered while it is held: {answer:?}"),
        before = status() => assert_eq!(before, "partially_evaluated"),
    }
    stand.knobs(&json!({"put_held": false})).await;
    put.await.ok();
    assert_eq!(status().await, "finished");
}

#[tokio::test]
async fn a_client_that_reuses_a_connection_as_it_is_closed_gets_no_answer() {
    let stand = Stand::start().await;
    let pk = stand.submit().await;
    stand.knobs(&json!({"close_reused_ms": 0})).await;
    let patch = || {
        let body = json!({"submission": pk, "submission_status": "running"});
        stand.request(Method::PATCH, UPDATE, HOST).json(&body).send()
    };
    // The connection of the knobs is used again: this is what an operator with a pool of connections runs into.
    let error = patch().await.unwrap_err();
    let mut source: &dyn std::error::Error = &error;
    while let Some(next) = source.source() {
        source = next;
    }
    assert_eq!(source.to_string(), "connection closed before message completed");
    assert_eq!(stand.handle.state().submissions[&pk].status.as_str(), "submitted");
    let log = stand.handle.requests();
    let last = log.last().unwrap();
    assert_eq!((last.status, last.fault.as_deref()), (None, Some("close")));
    assert_eq!(patch().await.unwrap().status(), 200, "a new connection");
}
