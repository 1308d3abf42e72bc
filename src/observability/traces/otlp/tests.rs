//! The sender against a collector that is there, that refuses, and that never answers.

use std::sync::Arc;
use std::sync::Mutex;

use axum::Router;
use axum::body::Bytes;
use axum::http::StatusCode;
use axum::routing::post;
use jiff::Timestamp;
use opentelemetry_proto::tonic::collector::trace::v1::ExportTraceServiceRequest;
use prost::Message;

use super::*;
use crate::metrics::Program;
use leaderboard_base::shutdown::Stop;
use leaderboard_base::trace_id::TraceId as Trace;

/// A collector that answers with one status.
async fn collector(status: StatusCode) -> (String, Arc<Mutex<Vec<ExportTraceServiceRequest>>>) {
    let got: Arc<Mutex<Vec<ExportTraceServiceRequest>>> = Arc::default();
    let kept = Arc::clone(&got);
    let take = async move |body: Bytes| {
        kept.lock()
            .unwrap()
            .push(ExportTraceServiceRequest::decode(body).unwrap());
        status
    };
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let url = format!("http://{}/v1/traces", listener.local_addr().unwrap());
    tokio::spawn(async move { axum::serve(listener, Router::new().route("/v1/traces", post(take))).await });
    (url, got)
}

fn span(id: u64) -> Span {
    Span {
        trace: Trace::of("uid-1"),
        id,
        parent: Some(7),
        name: "run",
        kind: Kind::Internal,
        start: Timestamp::from_second(1_800_000_000).unwrap(),
        end: Timestamp::from_second(1_800_000_060).unwrap(),
        attributes: vec![("leaderboard.attempt", Value::Number(2))],
        error: Some("AgentCrashed"),
    }
}

fn started(url: &str) -> (Traces, Sending, Arc<Metrics>) {
    // It fails only where a provider is installed already.
    let _ = rustls::crypto::ring::default_provider().install_default();
    let metrics = Arc::new(Metrics::new(Program::Controller));
    let (_stop, signal) = Stop::new();
    let (traces, sending) = start(Some(url), &metrics, &Tasks::new(signal)).unwrap();
    (traces, sending, metrics)
}

fn shows(metrics: &Metrics, outcome: &str, count: u64) -> bool {
    let line = format!("leaderboard_trace_spans_total{{outcome=\"{outcome}\"}} {count}");
    metrics.text().unwrap().lines().any(|found| found == line)
}

#[tokio::test]
async fn a_span_arrives_as_otlp_with_its_ids_times_and_status() {
    let (url, got) = collector(StatusCode::OK).await;
    let (traces, sending, metrics) = started(&url);
    traces.send(|| vec![span(9)]);
    sending.finish().await;
    let got = got.lock().unwrap();
    let found = &got[0].resource_spans[0];
    let resource = found.resource.as_ref().unwrap();
    let name = resource.attributes.iter().find(|of| of.key == "service.name").unwrap();
    assert!(format!("{:?}", name.value).contains("leaderboard-operator"), "{name:?}");
    let sent = &found.scope_spans[0].spans[0];
    assert_eq!(sent.trace_id, Trace::of("uid-1").number().to_be_bytes());
    assert_eq!(
        (&sent.span_id[..], &sent.parent_span_id[..]),
        (&9_u64.to_be_bytes()[..], &7_u64.to_be_bytes()[..])
    );
    assert_eq!(sent.start_time_unix_nano, 1_800_000_000_000_000_000);
    assert_eq!(sent.end_time_unix_nano - sent.start_time_unix_nano, 60_000_000_000);
    assert_eq!(sent.status.as_ref().unwrap().message, "AgentCrashed");
    assert_eq!(sent.attributes[0].key, "leaderboard.attempt");
    assert!(shows(&metrics, "sent", 1));
}

#[tokio::test]
async fn a_collector_that_refuses_costs_the_spans_and_is_counted() {
    let (url, got) = collector(StatusCode::BAD_REQUEST).await;
    let (traces, sending, metrics) = started(&url);
    traces.send(|| vec![span(1), span(2)]);
    sending.finish().await;
    assert_eq!(got.lock().unwrap().len(), 1, "what is refused is not sent again");
    assert!(shows(&metrics, "failed", 2));
}

#[tokio::test]
async fn a_collector_that_never_answers_holds_nobody_up() {
    // It takes connections and never answers.
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let url = format!("http://{}/v1/traces", listener.local_addr().unwrap());
    let (traces, _sending, metrics) = started(&url);
    // On this thread nothing else runs meanwhile, so the queue is not emptied.
    for id in 0..QUEUE as u64 + 3 {
        traces.send(|| vec![span(id)]);
    }
    assert!(shows(&metrics, "dropped", 3));
}

#[test]
fn only_an_endpoint_turns_traces_on_and_the_standard_switches_turn_them_off() {
    let endpoint = ("OTEL_EXPORTER_OTLP_ENDPOINT", "http://127.0.0.1:4318");
    let of_traces = ("OTEL_EXPORTER_OTLP_TRACES_ENDPOINT", "http://127.0.0.1:4318/v1/traces");
    for (wanted, variables) in [
        (false, vec![]),
        (true, vec![endpoint]),
        (true, vec![of_traces]),
        (false, vec![("OTEL_EXPORTER_OTLP_ENDPOINT", " ")]),
        (false, vec![endpoint, ("OTEL_SDK_DISABLED", "TRUE")]),
        (true, vec![endpoint, ("OTEL_SDK_DISABLED", "false")]),
        (false, vec![endpoint, ("OTEL_TRACES_EXPORTER", "none")]),
        (true, vec![endpoint, ("OTEL_TRACES_EXPORTER", "otlp")]),
    ] {
        let of = |name: &str| {
            variables
                .iter()
                .find(|(known, _)| *known == name)
                .map(|(_, value)| (*value).to_owned())
        };
        assert_eq!(is_wanted(of), wanted, "{variables:?}");
    }
}
