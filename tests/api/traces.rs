//! What is left of one submission's life outside the cluster: its trace at a collector, and its lines in the log.

use std::collections::{BTreeMap, BTreeSet};
use std::io::Write;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use axum::Router;
use axum::body::Bytes;
use axum::routing::post;
use kube::Api;
use leaderboard_api::Submission;
use leaderboard_operator::observability::Observability;
use leaderboard_operator::observability::logging::{Format, subscriber};
use leaderboard_operator::observability::shutdown::Stop;
use leaderboard_operator::observability::trace_id::TraceId;
use leaderboard_operator::observability::traces::{Traces, otlp};
use opentelemetry_proto::tonic::collector::trace::v1::ExportTraceServiceRequest;
use opentelemetry_proto::tonic::common::v1::any_value::Value as Any;
use opentelemetry_proto::tonic::trace::v1::Span;
use prost::Message;
use serde_json::Value;
use tokio::net::TcpListener;
use tokio::sync::watch;
use tracing::Dispatch;

use super::counts::lifecycle::{Controller, Scenario, Watched, World};

/// Longer than a batch is filled.
const LIMIT: Duration = Duration::from_mins(1);

/// A collector on loopback.
struct Collector {
    url: String,
    spans: watch::Receiver<Vec<Span>>,
}

impl Collector {
    async fn start() -> Self {
        let (kept, spans) = watch::channel(Vec::new());
        let take = async move |body: Bytes| {
            let request = ExportTraceServiceRequest::decode(body).unwrap();
            let scopes = request.resource_spans.into_iter().flat_map(|of| of.scope_spans);
            kept.send_modify(|all: &mut Vec<Span>| all.extend(scopes.flat_map(|scope| scope.spans)));
        };
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let url = format!("http://{}/v1/traces", listener.local_addr().unwrap());
        tokio::spawn(async move { axum::serve(listener, Router::new().route("/v1/traces", post(take))).await });
        Self { url, spans }
    }

    /// Once it has a span of each name.
    async fn with(&mut self, names: &[&str]) -> Vec<Span> {
        let all = self
            .spans
            .wait_for(|spans| names.iter().all(|name| spans.iter().any(|span| span.name == *name)));
        let found = match tokio::time::timeout(LIMIT, all).await {
            Ok(all) => Some(all.unwrap().clone()),
            Err(_) => None,
        };
        found.unwrap_or_else(|| panic!("not all of {names:?}: {:?}", self.spans.borrow()))
    }
}

#[derive(Clone, Default)]
struct Lines(Arc<Mutex<Vec<u8>>>);

impl Write for Lines {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.0.lock().unwrap().extend_from_slice(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

impl Lines {
    fn dispatch(&self) -> Dispatch {
        let writer = self.clone();
        Dispatch::new(subscriber(Format::Json, None, move || writer.clone(), false).unwrap())
    }

    /// Those that name a submission.
    fn of_submissions(&self) -> Vec<Value> {
        let text = String::from_utf8(self.0.lock().unwrap().clone()).unwrap();
        let lines = text.lines().map(|line| serde_json::from_str::<Value>(line).unwrap());
        lines.filter(|line| line.get("submission").is_some()).collect()
    }
}

fn traces(url: &str) -> (Traces, otlp::Sending) {
    let (_stop, signal) = Stop::new();
    let telemetry = Observability::new(signal);
    otlp::start(Some(url), &telemetry.metrics, &telemetry.tasks).unwrap()
}

fn attributes(span: &Span) -> BTreeMap<&str, String> {
    let text = |value: &Any| match value {
        Any::StringValue(text) => text.clone(),
        Any::IntValue(number) => number.to_string(),
        Any::BoolValue(flag) => flag.to_string(),
        other => panic!("an attribute of another kind: {other:?}"),
    };
    let of = span.attributes.iter();
    of.map(|one| {
        (
            one.key.as_str(),
            text(one.value.as_ref().unwrap().value.as_ref().unwrap()),
        )
    })
    .collect()
}

fn check_tree(spans: &[Span], uid: &str, namespace: &str) {
    let of = |name: &str| {
        let found: Vec<&Span> = spans.iter().filter(|span| span.name == name).collect();
        assert_eq!(found.len(), 1, "{name} in {spans:?}");
        found[0]
    };
    let (root, attempt) = (of("intake"), of("attempt"));
    assert!(root.parent_span_id.is_empty());
    for (parent, names) in [
        (root, &["attempt", "record", "publish"][..]),
        (attempt, &["accept", "wait", "schedule", "start", "run", "archive"]),
    ] {
        for name in names {
            assert_eq!(of(name).parent_span_id, parent.span_id, "{name}");
        }
    }
    let ids: BTreeSet<_> = spans.iter().map(|span| &span.span_id).collect();
    assert_eq!((ids.len(), spans.len()), (10, 10), "each span once");
    for span in spans {
        assert_eq!(span.trace_id, TraceId::of(uid).number().to_be_bytes(), "{}", span.name);
        assert!(span.start_time_unix_nano <= span.end_time_unix_nano, "{}", span.name);
        let found = attributes(span);
        let common = [
            ("k8s.namespace.name", namespace),
            ("leaderboard.name", "carla"),
            ("leaderboard.submission", "one"),
            ("leaderboard.attempt", "1"),
        ];
        for (key, value) in common {
            assert_eq!(
                found.get(key).map(String::as_str),
                Some(value),
                "{key} of {}",
                span.name
            );
        }
        assert!(
            !found.values().any(|value| value.contains("registry.example")),
            "{found:?}"
        );
    }
    assert_eq!(
        attributes(attempt).get("leaderboard.state").map(String::as_str),
        Some("Finished")
    );
    assert!(attributes(of("run")).contains_key("k8s.job.name"));
    assert!(of("wait").end_time_unix_nano <= of("run").start_time_unix_nano + 1_000_000_000);
    assert!(of("run").end_time_unix_nano <= of("publish").end_time_unix_nano);
}

fn check_lines(lines: &[Value], uid: &str, namespace: &str) {
    let said = |line: &Value| {
        let text = |field: &str| line[field].as_str().unwrap_or_default().to_owned();
        match text("to") {
            to if to.is_empty() => text("message"),
            to => format!("{} -> {to}: {}", text("from"), text("reason")),
        }
    };
    let found: Vec<String> = lines.iter().map(said).collect();
    let mut last = found.clone();
    let deliveries: BTreeSet<String> = last.split_off(found.len().saturating_sub(2)).into_iter().collect();
    let expected = [
        "none -> Pending: Preparing",
        "Pending -> Running: Running",
        "Running -> Finished: Finished",
    ];
    assert_eq!(last, expected, "{found:?}");
    assert_eq!(
        deliveries,
        ["EvalAI has the end", "the table has the end"]
            .map(str::to_owned)
            .into()
    );
    for line in lines {
        assert_eq!(line["submission"], format!("{namespace}/one"), "{line}");
        assert_eq!(
            (&line["leaderboard"], &line["attempt"]),
            (&"carla".into(), &1.into()),
            "{line}"
        );
        assert_eq!(line["trace_id"], TraceId::of(uid).to_string(), "{line}");
        assert_eq!(line["level"], "INFO", "{line}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_life_is_one_trace_and_one_line_for_each_transition() {
    let mut collector = Collector::start().await;
    let world = World::new(Scenario::PUBLISHED).await;
    let (traces, sending) = traces(&collector.url);
    let lines = Lines::default();
    let log = Some(lines.dispatch());
    // With a single subscriber in the process, a line that a thread of another test reaches first is off for good.
    let _second = Dispatch::new(tracing_subscriber::registry());
    let controller = Controller::start(&world, Watched { traces, log }).await;
    world.ready().await;
    controller.quiet().await;
    world.live(&controller).await;
    let spans = collector.with(&["attempt", "record", "publish", "archive"]).await;
    let api: Api<Submission> = Api::namespaced(world.client.clone(), &world.namespace);
    let uid = api.get("one").await.unwrap().metadata.uid.unwrap();
    check_tree(&spans, &uid, &world.namespace);
    check_lines(&lines.of_submissions(), &uid, &world.namespace);
    controller.end().await;
    sending.finish().await;
}
