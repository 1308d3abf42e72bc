//! Watches and the preflight on a mock of the API server's client.

mod lists;
mod namespaces;
mod unread;

use std::time::Duration;

use futures::StreamExt;
use http::{Request, Response};
use kube::client::Body;
use serde_json::{Value, json};
use tokio::sync::{mpsc, watch};
use tokio::time::timeout;
use tower_test::mock::{Handle, pair};

use k8s_openapi::api::authorization::v1::ResourceAttributes;
use kube::ResourceExt;
use kube::runtime::watcher::Config;

use super::preflight::{access_missing, await_kinds};
use super::*;
use crate::observability::Observability;
use crate::observability::logging::tests::Lines;
use leaderboard_api::Leaderboard;
use leaderboard_base::shutdown::Stop;

/// Longer than anything here may take.
const LIMIT: Duration = Duration::from_mins(20);

/// Answer to a request.
enum Answer {
    Json(u16, Value),
    /// The lines of a watch, which then ends.
    Watch(Vec<String>),
}

type Script = mpsc::UnboundedSender<Answer>;

/// A client whose requests are answered in order with what the test sends; until it sends more, they wait.
fn scripted(answers: Vec<Answer>) -> (Client, Script) {
    let (service, handle) = pair::<Request<Body>, Response<Body>>();
    let (script, answered) = mpsc::unbounded_channel();
    send(&script, answers);
    tokio::spawn(serve(handle, answered));
    (Client::new(service, "default"), script)
}

fn send(script: &Script, answers: Vec<Answer>) {
    for answer in answers {
        assert!(script.send(answer).is_ok(), "the server has ended");
    }
}

async fn serve(mut handle: Handle<Request<Body>, Response<Body>>, mut answers: mpsc::UnboundedReceiver<Answer>) {
    while let Some((_, send)) = handle.next_request().await {
        let Some(answer) = answers.recv().await else { return };
        let (code, body) = match answer {
            Answer::Json(code, body) => (code, body.to_string()),
            Answer::Watch(lines) => (200, lines.concat()),
        };
        let response = Response::builder().status(code).body(Body::from(body.into_bytes()));
        send.send_response(response.unwrap());
    }
}

fn board(name: &str, uid: &str, version: &str) -> Value {
    json!({"apiVersion": "leaderboard.carla.org/v1alpha1", "kind": "Leaderboard",
        "metadata": {"name": name, "namespace": "ns", "uid": uid, "resourceVersion": version, "managedFields": [{}]},
        "spec": {
            "evaluation": {"carla": {
                "version": "V2", "contents": {"image": "contents:1"}, "simulator": {"image": "simulator:1"},
            }}, "tracks": [{"name": "SENSORS"}], "storage": {"s3": {"bucket": "b"}}}})
}

fn malformed(name: &str, uid: &str, version: &str) -> Value {
    let mut object = board(name, uid, version);
    object["spec"] = json!({"evaluation": {"carla": {"version": 7}}});
    object
}

fn list(items: &[Value]) -> Answer {
    Answer::Json(
        200,
        json!({"apiVersion": "v1", "kind": "List", "metadata": {"resourceVersion": "10"}, "items": items}),
    )
}

/// As the API server writes it: the type comes first.
fn line(kind: &str, object: &Value) -> String {
    format!("{{\"type\":\"{kind}\",\"object\":{object}}}\n")
}

fn gone() -> String {
    line(
        "ERROR",
        &json!({"kind": "Status", "status": "Failure", "reason": "Expired", "code": 410, "message": "too old"}),
    )
}

struct Rig {
    watch: Watch<Leaderboard>,
    events: WatchEvents<Leaderboard>,
    telemetry: Observability,
    stop: watch::Sender<bool>,
    script: Script,
}

fn rig(answers: Vec<Answer>) -> Rig {
    let (client, script) = scripted(answers);
    let (stop, receiver) = Stop::new();
    let telemetry = Observability::new(receiver);
    telemetry.readiness.registered();
    let watch = spawn_watch(
        vec![guarded(client, Some("ns"))],
        Config::default(),
        |_| None,
        &telemetry,
    );
    let events = watch.subscribe();
    Rig {
        watch,
        events,
        telemetry,
        stop,
        script,
    }
}

impl Rig {
    fn send(&self, answers: Vec<Answer>) {
        send(&self.script, answers);
    }

    async fn next(&mut self) -> (String, String, bool) {
        let event = timeout(LIMIT, self.events.next())
            .await
            .expect("an event in time")
            .expect("a watch that goes on");
        (
            event.object.name_any(),
            event.object.resource_version().unwrap_or_default(),
            event.is_gone,
        )
    }

    fn metric(&self, line: &str) -> bool {
        self.telemetry.metrics.text().unwrap().lines().any(|l| l == line)
    }
}

fn event(name: &str, version: &str, is_gone: bool) -> (String, String, bool) {
    (name.to_owned(), version.to_owned(), is_gone)
}

#[test]
fn the_test_object_is_one() {
    assert!(serde_json::from_value::<Leaderboard>(board("a", "1", "1")).is_ok());
    assert!(serde_json::from_value::<Leaderboard>(malformed("a", "1", "1")).is_err());
}

#[tokio::test(start_paused = true)]
async fn objects_come_trimmed_and_deletions_are_events() {
    let mut rig = rig(vec![list(&[board("a", "1", "5")])]);
    assert_eq!(
        rig.telemetry.readiness.missing(),
        ["leaderboards synced: the first list has not come yet"]
    );
    assert_eq!(rig.next().await, event("a", "5", false));
    assert!(rig.telemetry.readiness.missing().is_empty());
    let first = rig.watch.store.state().remove(0);
    assert!(first.metadata.managed_fields.is_none());
    rig.send(vec![Answer::Watch(vec![
        line("ADDED", &board("b", "2", "11")),
        line("DELETED", &board("a", "1", "12")),
    ])]);
    assert_eq!(rig.next().await, event("b", "11", false));
    assert_eq!(rig.next().await, event("a", "12", true));
    assert_eq!(rig.watch.store.len(), 1);
    assert!(rig.metric("leaderboard_watch_errors_total{kind=\"Leaderboard\"} 0"));
    rig.stop.send(true).unwrap();
    assert!(rig.events.next().await.is_none());
    assert!(rig.telemetry.liveness.problems().is_empty());
}

#[tokio::test(start_paused = true)]
async fn a_list_after_an_expired_watch_reports_only_what_changed_and_what_went_away() {
    let all = [board("a", "1", "5"), board("b", "2", "6"), board("c", "3", "7")];
    let mut rig = rig(vec![list(&all)]);
    let mut first = vec![rig.next().await.0, rig.next().await.0, rig.next().await.0];
    first.sort();
    assert_eq!(first, ["a", "b", "c"]);
    let changed = [board("a", "1", "5"), board("b", "2", "20"), board("c", "4", "21")];
    rig.send(vec![Answer::Watch(vec![gone()]), list(&changed)]);
    let mut second = vec![rig.next().await, rig.next().await, rig.next().await];
    second.sort();
    assert_eq!(
        second,
        [event("b", "20", false), event("c", "21", false), event("c", "7", true)]
    );
    rig.send(vec![Answer::Watch(vec![line("ADDED", &board("last", "9", "30"))])]);
    assert_eq!(
        rig.next().await,
        event("last", "30", false),
        "and no second event for a"
    );
    assert!(rig.metric("leaderboard_watch_errors_total{kind=\"Leaderboard\"} 1"));
}

#[tokio::test(start_paused = true)]
async fn a_malformed_object_is_left_out_and_stops_nothing() {
    let lines = Lines::default();
    let _guard = lines.collect();
    let mut rig = rig(vec![
        list(&[malformed("bad", "1", "4"), board("a", "2", "5")]),
        Answer::Watch(vec![
            line("MODIFIED", &malformed("a", "2", "11")),
            line("DELETED", &malformed("bad", "1", "12")),
            line("ADDED", &board("b", "3", "13")),
            gone(),
        ]),
        list(&[malformed("a", "2", "11"), board("b", "3", "13")]),
    ]);
    assert_eq!(rig.next().await, event("a", "5", false));
    let unreadable = |number: u32| format!("leaderboard_watch_unreadable_objects{{kind=\"Leaderboard\"}} {number}");
    assert!(rig.metric(&unreadable(1)), "it was so in the first list");
    let logged = lines.take_json();
    let skipped = logged
        .iter()
        .find(|line| line["level"] == "ERROR")
        .expect("a line of it");
    assert_eq!(
        (&skipped["kind"], &skipped["name"]),
        (&json!("Leaderboard"), &json!("bad"))
    );
    assert_eq!(rig.next().await, event("b", "13", false));
    assert!(rig.metric(&unreadable(1)), "one is gone, and another was edited");
    rig.send(vec![Answer::Watch(vec![line("DELETED", &malformed("a", "2", "31"))])]);
    assert_eq!(
        rig.next().await,
        event("a", "5", true),
        "kept as it was last until it is deleted"
    );
    assert_eq!(rig.watch.store.len(), 1);
    assert!(rig.metric(&unreadable(0)));
}

#[tokio::test(start_paused = true)]
async fn a_refused_list_is_shown_by_readiness_and_retried() {
    let refused = json!({"kind": "Status", "status": "Failure", "reason": "Forbidden", "code": 403,
        "message": "leaderboards is forbidden"});
    let mut rig = rig(vec![Answer::Json(403, refused)]);
    tokio::time::sleep(Duration::from_secs(5)).await;
    assert!(rig.metric("leaderboard_watch_errors_total{kind=\"Leaderboard\"} 1"));
    let missing = rig.telemetry.readiness.missing().join("");
    assert!(missing.contains("403: leaderboards is forbidden"), "{missing}");
    rig.send(vec![list(&[board("a", "1", "5")])]);
    assert_eq!(rig.next().await, event("a", "5", false));
    assert!(rig.telemetry.readiness.missing().is_empty());
}

#[tokio::test(start_paused = true)]
async fn a_watch_that_is_refused_after_its_list_is_not_ready_until_it_is_listed_again() {
    let refused = || {
        let status = json!({"kind": "Status", "status": "Failure", "reason": "Forbidden", "code": 403,
            "message": "leaderboards is forbidden"});
        Answer::Json(403, status)
    };
    let mut rig = rig(vec![list(&[board("a", "1", "5")]), Answer::Watch(vec![])]);
    assert_eq!(rig.next().await, event("a", "5", false));
    assert!(rig.watch.synced.is_true() && rig.telemetry.readiness.missing().is_empty());
    rig.send(vec![refused(), refused()]);
    tokio::time::sleep(Duration::from_secs(15)).await;
    let missing = rig.telemetry.readiness.missing().join("");
    assert!(missing.contains("403: leaderboards is forbidden"), "{missing}");
    assert!(!rig.watch.synced.is_true(), "what it shows may be long gone");
    // Nothing has changed meanwhile, so that no event shows that the right is back.
    rig.send(vec![list(&[board("a", "1", "5")])]);
    tokio::time::sleep(Duration::from_secs(30)).await;
    assert!(rig.watch.synced.is_true() && rig.telemetry.readiness.missing().is_empty());
}

#[tokio::test(start_paused = true)]
async fn a_list_that_is_never_answered_fails_liveness_while_others_are() {
    let rig = rig(vec![]);
    tokio::time::sleep(Duration::from_mins(11)).await;
    assert!(rig.telemetry.liveness.problems().is_empty());
    rig.telemetry.liveness.answered();
    let problems = rig.telemetry.liveness.problems();
    assert!(
        problems.len() == 1 && problems[0].contains("watch of Leaderboard"),
        "{problems:?}"
    );
}

/// An API server that lists one Leaderboard; its watches bring nothing and never end, as on a half-open connection.
async fn silent_server(watches: mpsc::UnboundedSender<()>) -> kube::Config {
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    let router = axum::Router::new().fallback(move |request: axum::extract::Request| {
        let is_watch = request.uri().query().is_some_and(|query| query.contains("watch=true"));
        let watches = watches.clone();
        async move {
            if is_watch {
                watches.send(()).unwrap();
                let silence = futures::stream::pending::<Result<Vec<u8>, std::io::Error>>();
                return axum::body::Body::from_stream(silence);
            }
            let Answer::Json(_, list) = list(&[board("a", "1", "5")]) else {
                unreachable!()
            };
            axum::body::Body::from(list.to_string())
        }
    });
    tokio::spawn(async move { axum::serve(listener, router).await });
    kube::Config::new(format!("http://{address}").parse().unwrap())
}

#[tokio::test]
async fn a_watch_on_a_half_open_connection_ends_by_the_read_timeout_and_begins_again() {
    let (begun, mut watches) = mpsc::unbounded_channel();
    let config = silent_server(begun).await;
    let client = client_with(config, Duration::from_millis(200)).unwrap();
    let (_stop, receiver) = Stop::new();
    let telemetry = Observability::new(receiver);
    let watch = spawn_watch::<Leaderboard>(
        vec![guarded(client, Some("ns"))],
        Config::default(),
        |_| None,
        &telemetry,
    );
    for _ in 0..2 {
        timeout(LIMIT, watches.recv()).await.unwrap().unwrap();
    }
    let metrics = telemetry.metrics.text().unwrap();
    assert!(
        metrics.contains("leaderboard_watch_errors_total{kind=\"Leaderboard\"} 1"),
        "{metrics}"
    );
    assert_eq!(watch.store.len(), 1);
}

#[tokio::test(start_paused = true)]
async fn an_unreadable_object_leaves_the_cache_incomplete_until_it_can_be_read() {
    let mut rig = rig(vec![list(&[board("a", "1", "5")])]);
    assert!(!rig.watch.is_complete());
    assert_eq!(rig.next().await, event("a", "5", false));
    assert!(rig.watch.is_complete());
    rig.send(vec![Answer::Watch(vec![
        line("ADDED", &malformed("bad", "2", "11")),
        line("ADDED", &board("b", "3", "12")),
    ])]);
    assert_eq!(rig.next().await, event("b", "12", false));
    assert!(!rig.watch.is_complete());
    rig.send(vec![Answer::Watch(vec![line("MODIFIED", &board("bad", "2", "13"))])]);
    assert_eq!(rig.next().await, event("bad", "13", false));
    assert!(rig.watch.is_complete());
    rig.send(vec![
        Answer::Watch(vec![gone()]),
        list(&[malformed("bad", "2", "20"), board("b", "3", "21")]),
    ]);
    let mut listed = vec![rig.next().await, rig.next().await];
    listed.sort();
    assert_eq!(listed, [event("a", "5", true), event("b", "21", false)]);
    assert!(!rig.watch.is_complete());
    rig.send(vec![Answer::Watch(vec![
        line("DELETED", &malformed("bad", "2", "22")),
        line("MODIFIED", &board("b", "3", "23")),
    ])]);
    assert_eq!(rig.next().await, event("bad", "13", true));
    assert_eq!(rig.next().await, event("b", "23", false));
    assert!(rig.watch.is_complete());
}

#[tokio::test(start_paused = true)]
async fn a_late_subscriber_gets_what_is_there() {
    let mut rig = rig(vec![list(&[board("a", "1", "5")])]);
    assert_eq!(rig.next().await, event("a", "5", false));
    let mut late = rig.watch.clone().subscribe();
    assert_eq!(late.next().await.unwrap().object.name_any(), "a");
}

fn served(plurals: &[&str]) -> Answer {
    let resources: Vec<_> = plurals
        .iter()
        .map(|p| json!({"name": p, "singularName": "", "namespaced": true, "kind": p, "verbs": ["get", "list"]}))
        .collect();
    Answer::Json(
        200,
        json!({"kind": "APIResourceList", "apiVersion": "v1",
        "groupVersion": "leaderboard.carla.org/v1alpha1", "resources": resources}),
    )
}

#[tokio::test(start_paused = true)]
async fn the_preflight_waits_for_the_kinds_and_names_the_missing_one() {
    let none = json!("404 page not found");
    let (client, script) = scripted(vec![Answer::Json(404, none), served(&["leaderboards"])]);
    let (stop, receiver) = Stop::new();
    let telemetry = Observability::new(receiver);
    telemetry.readiness.registered();
    let waiting = tokio::spawn({
        let telemetry = telemetry.clone();
        async move { await_kinds(&client, &["leaderboards", "submissions"], &telemetry).await }
    });
    tokio::time::sleep(Duration::from_secs(3)).await;
    let missing = telemetry.readiness.missing().join("");
    assert!(
        missing.contains("does not serve submissions of leaderboard.carla.org/v1alpha1"),
        "{missing}"
    );
    send(&script, vec![served(&["leaderboards", "submissions"])]);
    assert!(timeout(LIMIT, waiting).await.unwrap().unwrap());
    assert!(telemetry.readiness.missing().is_empty());
    drop(stop);
    let (client, _script) = scripted(vec![served(&[])]);
    assert!(
        !await_kinds(&client, &["submissions"], &telemetry).await,
        "a stopping process waits for nothing"
    );
}

#[tokio::test(start_paused = true)]
async fn the_preflight_names_each_missing_verb() {
    let review = |allowed: bool| {
        Answer::Json(
            201,
            json!({"kind": "SelfSubjectAccessReview", "apiVersion": "authorization.k8s.io/v1",
            "metadata": {}, "spec": {}, "status": {"allowed": allowed}}),
        )
    };
    let (client, _script) = scripted(vec![review(true), review(false)]);
    let need = |verb: &str, group: &str, resource: &str| ResourceAttributes {
        group: Some(group.into()),
        resource: Some(resource.into()),
        verb: Some(verb.into()),
        ..ResourceAttributes::default()
    };
    let needs = [
        need("create", "batch", "jobs"),
        ResourceAttributes {
            subresource: Some("status".into()),
            namespace: Some("ns".into()),
            ..need("patch", "leaderboard.carla.org", "submissions")
        },
        need("list", "", "pods"),
    ];
    let missing = access_missing(&client, &needs).await;
    assert_eq!(
        missing[0],
        "may not patch submissions/status of leaderboard.carla.org in namespace ns; add the verb to the operator's role"
    );
    assert_eq!(
        missing[1],
        "can't ask whether it may list pods in all namespaces: the API server did not answer within 10 s"
    );
    assert_eq!(missing.len(), 2);
}
