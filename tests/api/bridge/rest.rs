//! Cost of a queue without messages, counted by a server in SQS's place.

use std::sync::{Arc, Mutex};

use axum::extract::State;
use axum::http::HeaderMap;
use axum::http::header::CONTENT_TYPE;
use axum::response::IntoResponse;
use serde_json::{Value, json};
use tokio::net::TcpListener;
use tokio::sync::watch;

use super::*;

/// So many receives are answered, each at once: a real queue takes the time that it is given.
const RECEIVES: usize = 30;

/// The requests in order, and the most receives that were under way at the same time.
#[derive(Default)]
struct Log {
    asked: Vec<(String, Value)>,
    under_way: usize,
    most: usize,
}

#[derive(Clone)]
struct EmptyQueue {
    log: Arc<Mutex<Log>>,
    receives: watch::Sender<usize>,
}

impl EmptyQueue {
    async fn start() -> (Self, String) {
        let queue = Self {
            log: Arc::default(),
            receives: watch::Sender::new(0),
        };
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let endpoint = format!("http://{}", listener.local_addr().unwrap());
        let router = axum::Router::new().fallback(answer).with_state(queue.clone());
        tokio::spawn(async move { axum::serve(listener, router).await });
        (queue, endpoint)
    }
}

async fn answer(State(queue): State<EmptyQueue>, headers: HeaderMap, body: String) -> impl IntoResponse {
    let target = headers["x-amz-target"].to_str().unwrap().to_owned();
    let is_receive = target.ends_with(".ReceiveMessage");
    {
        let mut log = queue.log.lock().unwrap();
        log.asked.push((target, serde_json::from_str(&body).unwrap()));
        log.under_way += usize::from(is_receive);
        log.most = log.most.max(log.under_way);
    }
    if is_receive {
        queue.receives.send_modify(|count| *count += 1);
        if *queue.receives.borrow() == RECEIVES {
            std::future::pending::<()>().await;
        }
        tokio::task::yield_now().await;
        queue.log.lock().unwrap().under_way -= 1;
    }
    let answer = json!({"Attributes": {"VisibilityTimeout": "30"}, "Messages": []});
    ([(CONTENT_TYPE, "application/x-amz-json-1.0")], answer.to_string())
}

#[tokio::test]
async fn a_queue_at_rest_is_asked_one_long_question_after_the_other() {
    let world = World::new("bridge-rest").await;
    let (queue, endpoint) = EmptyQueue::start().await;
    let url = format!("{endpoint}/000000000000/q");
    world
        .leaderboard("lb", 2, json!({"url": url, "endpoint": endpoint}))
        .await;
    let bridge = world.bridge();
    let mut receives = queue.receives.subscribe();
    let all = tokio::time::timeout(LIMIT, receives.wait_for(|count| *count == RECEIVES));
    all.await.expect("the queue is read").unwrap();
    bridge.stop().await;
    let log = queue.log.lock().unwrap();
    let is_receive = |asked: &&(String, Value)| asked.0.ends_with(".ReceiveMessage");
    // Twenty seconds each, so three a minute.
    for (_, body) in log.asked.iter().filter(is_receive) {
        assert_eq!(
            (&body["WaitTimeSeconds"], &body["MaxNumberOfMessages"]),
            (&json!(20), &json!(10))
        );
    }
    assert_eq!(log.most, 1, "one receive at a time");
    let others: Vec<_> = log.asked.iter().filter(|asked| !is_receive(asked)).collect();
    assert_eq!(others.len(), 1, "{others:?}");
    assert_eq!(others[0].0, "AmazonSQS.GetQueueAttributes");
}
