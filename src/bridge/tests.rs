//! The bridge's supervisor on a mock of the API server's client.

use std::time::Duration;

use http::{Request, Response};
use kube::Client;
use kube::client::Body;
use serde_json::{Value, json};
use tokio::sync::watch;
use tokio::task::JoinHandle;
use tokio::time::Instant;
use tower_test::mock::{Handle, pair};

use super::sqs::{PULSE_AGE, PULSE_LIMIT};
use super::*;
use crate::kubernetes::Namespaces;
use crate::metrics::Program;
use leaderboard_base::shutdown::Stop;
use leaderboard_policy::allowed::Allowed;
use leaderboard_policy::intake::fixtures::{board, with_queue};

type Server = Handle<Request<Body>, Response<Body>>;

const QUEUE: &str = "https://q/1";

fn client() -> (Clients, Server) {
    let (service, handle) = pair();
    let client = Client::new(service, "ns");
    let clients = Clients {
        api: client.clone(),
        watch: client,
    };
    (clients, handle)
}

fn everything() -> Scope {
    Scope {
        namespaces: Namespaces::All,
        allowed: Allowed::default(),
    }
}

fn telemetry() -> (Observability, watch::Sender<bool>) {
    let (stop, signal) = Stop::new();
    (Observability::of(Program::Bridge, signal), stop)
}

/// True if a request is the check that the API server answers.
fn is_pulse(request: &Request<Body>) -> bool {
    request.uri().query() == Some("&limit=1")
}

fn no_metadata() -> Response<Body> {
    let body =
        json!({"kind": "PartialObjectMetadataList", "apiVersion": "meta.k8s.io/v1", "metadata": {}, "items": []});
    Response::new(body.to_string().into_bytes().into())
}

fn list(items: &[Value]) -> Response<Body> {
    let list = json!({"apiVersion": "v1", "kind": "List", "metadata": {"resourceVersion": "1"}, "items": items});
    Response::new(list.to_string().into_bytes().into())
}

fn one_board() -> Response<Body> {
    list(&[json!(*with_queue(board("a", 1), QUEUE))])
}

fn is_list(request: &Request<Body>) -> bool {
    request.uri().query().is_some_and(|query| query.contains("limit=100"))
}

fn a_pulse() -> (Pulse, Server, watch::Sender<bool>) {
    let (clients, handle) = client();
    let (telemetry, stop) = telemetry();
    let shared = Arc::new(shared(clients, everything(), telemetry));
    (Pulse::of(shared), handle, stop)
}

#[tokio::test(start_paused = true)]
async fn an_answer_of_the_api_server_counts_for_five_seconds() {
    let (pulse, mut handle, _stop) = a_pulse();
    let server = tokio::spawn(async move {
        let mut held = Vec::new();
        let mut pulses = 0;
        while pulses < 2 {
            let (request, send) = handle.next_request().await.unwrap();
            if is_pulse(&request) {
                pulses += 1;
                send.send_response(no_metadata());
            } else {
                held.push(send);
            }
        }
        (handle, held)
    });
    assert_eq!(pulse.check().await, Ok(()));
    assert_eq!(pulse.check().await, Ok(()), "without a request");
    tokio::time::advance(PULSE_AGE).await;
    assert_eq!(pulse.check().await, Ok(()));
    server.await.unwrap();
}

#[tokio::test(start_paused = true)]
async fn a_silent_api_server_keeps_the_queue_unread() {
    let (pulse, _handle, _stop) = a_pulse();
    let begun = Instant::now();
    assert_eq!(
        pulse.check().await,
        Err("the API server did not answer within 5 s".to_owned())
    );
    assert_eq!(begun.elapsed(), PULSE_LIMIT);
}

/// Starts a bridge whose API server lists one Leaderboard and answers nothing else, so that no queue is asked.
async fn start(telemetry: Observability) -> JoinHandle<Result<(), TaskFailed>> {
    let (clients, mut handle) = client();
    tokio::spawn(async move {
        let mut held = Vec::new();
        while let Some((request, send)) = handle.next_request().await {
            if is_list(&request) {
                send.send_response(one_board());
            } else {
                held.push(send);
            }
        }
    });
    tokio::spawn(run(clients, Aws::load("bridge").await, everything(), telemetry))
}

#[tokio::test(start_paused = true)]
async fn the_end_of_a_task_ends_the_bridge_by_its_name() {
    for name in ["watch of leaderboards", "queue https://q/1"] {
        let (telemetry, _stop) = telemetry();
        let bridge = start(telemetry.clone()).await;
        // Tasks have no event for their start.
        while !telemetry.tasks.names().iter().any(|known| known == name) {
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
        telemetry.tasks.end(name);
        let ended = tokio::time::timeout(Duration::from_mins(1), bridge).await;
        let result = ended.unwrap_or_else(|_| panic!("the bridge continues without {name}"));
        assert_eq!(result.unwrap().unwrap_err().task, name);
    }
}

#[tokio::test(start_paused = true)]
async fn a_broken_watch_of_leaderboards_fails_liveness_while_the_api_server_answers() {
    let (clients, mut handle) = client();
    let (telemetry, _stop) = telemetry();
    tokio::spawn(async move {
        let mut lists = 0;
        while let Some((request, send)) = handle.next_request().await {
            let refused = Response::builder().status(500).body(Body::empty()).unwrap();
            send.send_response(match (is_pulse(&request), is_list(&request)) {
                (true, _) => no_metadata(),
                (_, true) if lists == 0 => {
                    lists += 1;
                    one_board()
                }
                _ => refused,
            });
        }
    });
    let shared = shared(clients, everything(), telemetry.clone());
    shared.leaderboards.store.wait_until_ready().await.unwrap();
    tokio::time::sleep(Duration::from_mins(12)).await;
    assert_eq!(
        telemetry.liveness.problems(),
        Vec::<String>::new(),
        "nothing else has answered"
    );
    assert_eq!(Pulse::of(Arc::new(shared)).check().await, Ok(()));
    let problems = telemetry.liveness.problems().join("");
    assert!(problems.contains("the watch of Leaderboard"), "{problems:?}");
}
