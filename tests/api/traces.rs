//! Traces of one submission's life outside the cluster: its trace at an OpenTelemetry Collector, and its lines in the log.

mod collector;

use std::collections::{BTreeMap, BTreeSet};
use std::io::Write;
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;

use evalai_stand_in::Knobs;
use evalai_stand_in::faults::{Failure, Fault, When};
use evalai_stand_in::model::Status;
use kube::{Api, ResourceExt};
use leaderboard_api::{State, Submission, SubmissionStatus};
use leaderboard_base::shutdown::Stop;
use leaderboard_base::trace_id::TraceId;
use leaderboard_contract::report::REPORT_KEY;
use leaderboard_operator::observability::Observability;
use leaderboard_operator::observability::logging::{Format, subscriber};
use leaderboard_operator::observability::traces::{Traces, otlp};
use opentelemetry_proto::tonic::common::v1::KeyValue;
use opentelemetry_proto::tonic::common::v1::any_value::Value as Any;
use opentelemetry_proto::tonic::trace::v1::Span;
use serde_json::{Value, json};
use tokio::sync::watch;
use tracing::Dispatch;

use super::boards::make_table;
use super::counts::lifecycle::{Controller, Scenario, Watched, World};
use super::{operator, world};
use crate::support::{apiserver, ministack};
use collector::Collector;

/// Far longer than anything here takes.
const LINES: Duration = Duration::from_mins(2);

#[derive(Clone, Default)]
struct Lines(Arc<watch::Sender<Vec<u8>>>);

impl Write for Lines {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.0.send_modify(|all| all.extend_from_slice(bytes));
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

    fn text(&self) -> String {
        String::from_utf8(self.0.borrow().clone()).unwrap()
    }

    /// The lines that name a submission.
    fn of_submissions(&self) -> Vec<Value> {
        let text = self.text();
        let lines = text.lines().map(|line| serde_json::from_str::<Value>(line).unwrap());
        lines.filter(|line| line.get("submission").is_some()).collect()
    }

    /// Once one holds this text.
    async fn with(&self, text: &str) {
        let mut written = self.0.subscribe();
        let holds = |all: &Vec<u8>| String::from_utf8_lossy(all).contains(text);
        let found = tokio::time::timeout(LINES, written.wait_for(holds)).await.is_ok();
        assert!(found, "no line holds {text:?}:\n{}", self.text());
    }
}

fn traces(url: &str) -> (Traces, otlp::Sending) {
    let (_stop, signal) = Stop::new();
    let telemetry = Observability::new(signal);
    otlp::start(Some(url), &telemetry.metrics, &telemetry.tasks).unwrap()
}

fn attributes(span: &Span) -> BTreeMap<&str, String> {
    let of = span.attributes.iter();
    of.map(|one| (one.key.as_str(), text(one).unwrap())).collect()
}

fn text(attribute: &KeyValue) -> Option<String> {
    Some(match attribute.value.as_ref()?.value.as_ref()? {
        Any::StringValue(text) => text.clone(),
        Any::IntValue(number) => number.to_string(),
        Any::BoolValue(flag) => flag.to_string(),
        other => panic!("an attribute of another kind: {other:?}"),
    })
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
            to => [format!("{} -> {to}", text("from")), text("reason")]
                .join(" ")
                .trim_end()
                .to_owned(),
        }
    };
    let found: Vec<String> = lines.iter().map(said).collect();
    let mut last = found.clone();
    let deliveries: BTreeSet<String> = last.split_off(found.len().saturating_sub(2)).into_iter().collect();
    let expected = ["none -> Pending Preparing", "Pending -> Running", "Running -> Finished"];
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
    for resource in &collector.resources {
        let service = resource.attributes.iter().find(|of| of.key == "service.name");
        assert_eq!(service.and_then(text).as_deref(), Some("leaderboard-operator"));
    }
    check_lines(&lines.of_submissions(), &uid, &world.namespace);
    controller.end().await;
    sending.finish().await;
}

/// A controller on a thread of its own, which logs there.
struct Logged {
    stop: watch::Sender<bool>,
    thread: JoinHandle<()>,
}

impl Logged {
    async fn start(world: &world::World, log: Dispatch) -> Self {
        let config = apiserver::server().await.config();
        let (stop, signal) = Stop::new();
        let (namespace, endpoint) = (world.namespace.clone(), world.aws.endpoint.clone());
        let thread = std::thread::spawn(move || {
            let _log = tracing::dispatcher::set_default(&log);
            let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
            let work = async {
                let aws = ministack::aws(&endpoint).await;
                Box::pin(operator::run(&namespace, aws, config, Observability::new(signal))).await
            };
            runtime.unwrap().block_on(work).unwrap();
        });
        Self { stop, thread }
    }

    async fn end(self) {
        self.stop.send_replace(true);
        let ended = tokio::task::spawn_blocking(|| self.thread.join().unwrap());
        tokio::time::timeout(LINES, ended).await.expect("it ends").unwrap();
    }
}

/// A run whose report cannot be read at first, whose agent crashes, and whose end neither table nor EvalAI takes at once.
async fn fail(world: &world::World, table: &str, lines: &Lines) -> String {
    let (pk, name) = world.submit("lb", 1).await;
    let job = world.job(&name, 0).await;
    let cluster = world.cluster();
    let pod = cluster.running_pod(&job).await;
    let runs = |s: &SubmissionStatus| s.state == Some(State::Running);
    world.until(&name, "it runs", runs).await;
    let archive = world.archive(pk);
    archive.put(REPORT_KEY, b"no report".to_vec()).await.unwrap();
    lines.with("a stored report is not used").await;
    let s3 = world.aws.aws.s3(None, Some(&world.aws.endpoint));
    let key = format!("{pk}/{REPORT_KEY}");
    s3.delete_object().bucket(&world.bucket).key(key).send().await.unwrap();
    let dynamo = world.aws.aws.dynamodb(None, Some(&world.aws.endpoint));
    dynamo.delete_table().table_name(table).send().await.unwrap();
    world.evalai.set_knobs(Knobs {
        fail_next: vec![Fault {
            method: Some("PUT".into()),
            path_prefix: None,
            answer: Failure::Status(500),
            times: 1,
            when: When::Before,
        }],
        ..Knobs::default()
    });
    cluster.set_pod(&pod.name_any(), &world::crashed(&pod)).await;
    cluster.stops(&job).await;
    let failed = world
        .evalai
        .wait_until(|state, _| state.submissions[&pk].status == Status::Failed);
    tokio::time::timeout(LINES, failed)
        .await
        .expect("EvalAI has the failure");
    name
}

#[tokio::test(flavor = "multi_thread")]
async fn every_line_about_a_submission_that_fails_has_its_names_and_its_trace() {
    let world = world::World::new().await;
    let table = world.aws.name("traces");
    make_table(&world.aws, &table).await;
    let more = json!({"table": {"dynamoDB": {"name": table, "endpoint": world.aws.endpoint}}});
    world.leaderboard_with("lb", 1, "Hosts", &more).await;
    let lines = Lines::default();
    let _second = Dispatch::new(tracing_subscriber::registry());
    let controller = Logged::start(&world, lines.dispatch()).await;
    let name = fail(&world, &table, &lines).await;
    for text in [
        "EvalAI request failed",
        "the row is not in the table",
        "EvalAI has the end",
    ] {
        lines.with(text).await;
    }
    let api: Api<Submission> = world.api();
    let trace = TraceId::of(&api.get(&name).await.unwrap().metadata.uid.unwrap()).to_string();
    let text = lines.text();
    let about: Vec<&str> = text.lines().filter(|line| line.contains(&name)).collect();
    assert!(about.len() >= 7, "{text}");
    for line in about {
        let found: Value = serde_json::from_str(line).unwrap();
        let fields = ["submission", "leaderboard", "attempt", "trace_id"].map(|field| &found[field]);
        let expected = json!([format!("{}/{name}", world.namespace), "lb", 1, trace]);
        assert_eq!(json!(fields), expected, "{line}");
    }
    // No line about it has lost all of its names.
    for text in [
        "a stored report is not used",
        "EvalAI request failed",
        "the row is not in the table",
    ] {
        let nameless = lines.text();
        let nameless = nameless
            .lines()
            .find(|line| line.contains(text) && !line.contains(&name));
        assert_eq!(nameless, None);
    }
    controller.end().await;
}
