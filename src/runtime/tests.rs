//! The whole controller on a mock of the API server: what becomes of the process when one of its tasks ends.

use std::future::{pending, ready};

use http::{Request, Response};
use kube::client::Body;
use serde_json::{Value, json};
use tokio::sync::watch;
use tower_test::mock::{Handle, pair};

use super::*;
use crate::fixtures;
use crate::kubernetes::Namespaces;
use crate::runtime::leader::Identity;
use crate::runtime::leader::tests::fake_server::FakeServer;
use leaderboard_base::shutdown::Stop;
use leaderboard_pod_spec::job::OwnImage;
use leaderboard_policy::allowed::Allowed;

/// All that runs in a leader without Leaderboards, in the order of names.
const TASKS: [&str; 30] = [
    "ask buckets",
    "ask dead-letter queues",
    "ask log groups",
    "ask queues",
    "ask tables",
    "ask tables for rows",
    "ask tokens",
    "events of Jobs",
    "events of Pods",
    "failure logs",
    "fences",
    "gauges",
    "inbox",
    "inputs",
    "lease",
    "nodes",
    "policies",
    "reconciles",
    "records",
    "reports",
    "rows",
    "slots",
    "sweep",
    "try Pods",
    "watch of jobs",
    "watch of leaderboards",
    "watch of networkpolicies",
    "watch of nodes",
    "watch of pods",
    "watch of submissions",
];

/// Serves our kinds, empty lists and watches without news.
async fn serve(mut handle: Handle<Request<Body>, Response<Body>>) {
    let mut watches = Vec::new();
    while let Some((request, answer)) = handle.next_request().await {
        let is_watch = request.uri().query().is_some_and(|query| query.contains("watch="));
        if is_watch {
            watches.push(answer);
            continue;
        }
        let body = answer_to(request.uri().path());
        answer.send_response(Response::new(Body::from(body.to_string().into_bytes())));
    }
}

fn answer_to(path: &str) -> Value {
    let kind =
        |plural, kind| json!({"name": plural, "singularName": "", "namespaced": true, "kind": kind, "verbs": ["get"]});
    match path {
        "/apis/leaderboard.carla.org/v1alpha1" => json!({
            "kind": "APIResourceList", "apiVersion": "v1", "groupVersion": "leaderboard.carla.org/v1alpha1",
            "resources": [kind("leaderboards", "Leaderboard"), kind("submissions", "Submission")],
        }),
        _ => json!({"apiVersion": "v1", "kind": "List", "metadata": {"resourceVersion": "1"}, "items": []}),
    }
}

struct Process {
    telemetry: Observability,
    stop: watch::Sender<bool>,
    task: JoinHandle<Result<(), RunError>>,
}

/// A controller that leads.
async fn leader() -> Process {
    let (service, handle) = pair::<Request<Body>, Response<Body>>();
    tokio::spawn(serve(handle));
    let client = Client::new(service, "default");
    let clients = Clients {
        api: client.clone(),
        watch: client,
        lease: FakeServer::default().client(),
    };
    let (stop, signal) = Stop::new();
    let telemetry = Observability::new(signal);
    let lease = leader::Settings::new("ns", "operator", Identity::random("test"));
    let settings = Settings {
        own: OwnImage {
            image: "operator:1".into(),
            ..OwnImage::default()
        },
        operator: lease.installation(),
        namespaces: Namespaces::All,
        has_cluster_rights: true,
        allowed: Allowed::default(),
        concurrency: 4,
    };
    let aws = fixtures::aws("http://127.0.0.1:9").await;
    let task = tokio::spawn(Box::pin(run(clients, lease, settings, aws, None, telemetry.clone())));
    // Tasks have no event for their start.
    while !telemetry.tasks.names().contains(&"reconciles".to_owned()) {
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
    Process { telemetry, stop, task }
}

#[tokio::test(start_paused = true)]
async fn the_end_of_any_task_ends_the_process_by_its_name() {
    for name in TASKS {
        let process = leader().await;
        let mut names = process.telemetry.tasks.names();
        names.sort();
        assert_eq!(names, TASKS);
        process.telemetry.tasks.end(name);
        let ended = tokio::time::timeout(Duration::from_mins(1), process.task).await;
        let result = ended.unwrap_or_else(|_| panic!("the process goes on without {name}"));
        assert_eq!(
            result.unwrap().unwrap_err().to_string(),
            format!("task {name} has ended; the process exits, so that the kubelet restarts it")
        );
    }
}

#[tokio::test(start_paused = true)]
async fn a_stop_is_no_failure_of_the_tasks_that_it_ends() {
    let process = leader().await;
    assert_eq!(process.telemetry.readiness.missing(), Vec::<String>::new());
    process.stop.send_replace(true);
    process.task.await.unwrap().unwrap();
}

#[tokio::test(start_paused = true)]
async fn reconciles_are_waited_for_until_they_have_ended_and_no_longer_than_the_limit() {
    let began = Instant::now();
    let stopped = async |reconciles| end(reconciles, ready(()), ready(true), pending()).await.unwrap();
    assert!(stopped(tokio::spawn(async {})).await);
    assert_eq!(began.elapsed(), Duration::ZERO);
    assert!(stopped(tokio::spawn(tokio::time::sleep(Duration::from_secs(3)))).await);
    assert_eq!(began.elapsed(), Duration::from_secs(3));
    let (reconciles, dropped) = hanging();
    assert!(stopped(reconciles).await);
    assert_eq!(began.elapsed(), Duration::from_secs(3) + DRAIN);
    assert!(dropped.await.is_err(), "one that hangs is given up");
    let unanswered = end(tokio::spawn(async {}), ready(()), ready(false), pending()).await;
    assert!(!unanswered.unwrap());
}

#[tokio::test(start_paused = true)]
async fn a_lost_lease_drops_reconciles_also_after_a_stop() {
    let lost = async || {
        tokio::time::sleep(Duration::from_secs(2)).await;
        "other holds the Lease".to_owned()
    };
    let began = Instant::now();
    let (reconciles, dropped) = hanging();
    let result = end(reconciles, pending(), ready(true), lost()).await;
    assert!(matches!(result, Err(RunError::LostLease(_))));
    assert!(dropped.await.is_err());
    let (reconciles, dropped) = hanging();
    let result = end(reconciles, ready(()), ready(true), lost()).await;
    assert!(matches!(result, Err(RunError::LostLease(_))), "a stop comes first");
    assert!(dropped.await.is_err());
    assert_eq!(began.elapsed(), Duration::from_secs(4));
}

/// Reconciles that never end, and what shows that they were dropped.
fn hanging() -> (JoinHandle<()>, tokio::sync::oneshot::Receiver<()>) {
    let (alive, dropped) = tokio::sync::oneshot::channel::<()>();
    let reconciles = tokio::spawn(async move {
        let _alive = alive;
        pending::<()>().await;
    });
    (reconciles, dropped)
}
