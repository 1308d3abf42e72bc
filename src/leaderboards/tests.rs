//! Reconciles and the answers that they ask for, under a paused clock.

use std::net::TcpListener;

use serde_json::{Value, json};
use tokio::time::Instant;

use super::*;
use crate::fixtures::{self, Cluster, Surroundings, surroundings};
use leaderboard_api::Reason;
use leaderboard_pod_spec::network_policy::network_policy;

/// A closed port: each request is refused.
const NOBODY: &str = "http://127.0.0.1:1";

/// Where no request is ever answered, for as long as the listener lives.
fn silent() -> (TcpListener, String) {
    let silent = TcpListener::bind("127.0.0.1:0").unwrap();
    let endpoint = format!("http://{}", silent.local_addr().unwrap());
    (silent, endpoint)
}

fn leaderboard(endpoint: &str) -> Leaderboard {
    let mut board = fixtures::leaderboard("carla", endpoint);
    board.metadata.generation = Some(1);
    board.metadata.finalizers = Some(vec![names::FINALIZER_LEADERBOARD.into()]);
    board
}

/// A cluster whose cache shows the policy.
async fn around(board: &Leaderboard, endpoint: &str) -> Surroundings {
    let cluster = Cluster {
        policies: vec![network_policy(board)],
        ..Cluster::default()
    };
    surroundings(cluster, endpoint).await
}

/// One reconcile. Returns when the next one is due, and what was written: kinds, and the status.
async fn reconciled(around: &mut Surroundings, board: &Leaderboard) -> (Duration, Vec<String>, Value) {
    let board = Arc::new(board.clone());
    let Reconciled::Done(wait) = reconcile(board, around.context.for_leaderboards()).await.unwrap() else {
        panic!("it is ours");
    };
    let (mut kinds, mut status) = (Vec::new(), Value::Null);
    while let Ok(request) = around.requests.try_recv() {
        // The dry run of a Job belongs to the questions.
        if request.path.ends_with("/jobs") {
            continue;
        }
        let is_status = request.path.ends_with("/leaderboards/carla/status");
        kinds.push(if is_status { "status".into() } else { request.path });
        status = if is_status {
            request.body["status"].clone()
        } else {
            status
        };
    }
    (wait, kinds, status)
}

/// Waits until all that was asked for is answered, and a reconcile is woken.
async fn answered(around: &mut Surroundings, board: &Leaderboard) {
    let board = Arc::new(board.clone());
    while around.context.asks.known(&board).waits().is_some() {
        assert_eq!(around.woken.recv().await.unwrap(), "carla");
    }
    while around.woken.try_recv().is_ok() || around.requests.try_recv().is_ok() {}
}

fn ready(status: &Value) -> (&str, &str, Option<i64>) {
    let all = status["conditions"].as_array().unwrap();
    let ready = all.iter().find(|condition| condition["type"] == "Ready").unwrap();
    let text = |field: &str| ready[field].as_str().unwrap();
    (text("status"), text("reason"), ready["observedGeneration"].as_i64())
}

#[tokio::test(start_paused = true)]
async fn a_bucket_that_never_answers_holds_up_no_reconcile_and_its_silence_wakes_the_next() {
    let (_silent, endpoint) = silent();
    let board = leaderboard(&endpoint);
    let mut around = around(&board, &endpoint).await;
    let began = Instant::now();

    let (wait, written, _) = reconciled(&mut around, &board).await;
    assert!(
        written.len() == 1 && written[0].contains("/networkpolicies/"),
        "{written:?}"
    );
    assert_eq!(
        (wait, began.elapsed()),
        (FIRST_LOOK, Duration::ZERO),
        "most looks take less, and cost no write more"
    );
    tokio::time::advance(FIRST_LOOK).await;
    let (wait, written, status) = reconciled(&mut around, &board).await;
    assert_eq!((wait, written), (RESYNC, vec!["status".to_owned()]));
    assert_eq!(ready(&status), ("Unknown", Reason::Checking.as_str(), Some(1)));
    assert_eq!(status["observedGeneration"], Value::Null);
    assert_eq!(began.elapsed(), FIRST_LOOK);

    answered(&mut around, &board).await;
    let (_, written, status) = reconciled(&mut around, &board).await;
    assert_eq!(written, ["status"]);
    assert_eq!(ready(&status), ("Unknown", Reason::BucketUnreachable.as_str(), Some(1)));
    assert_eq!(status["observedGeneration"], 1);
}

/// A second write would begin with the status before the first one, and date its conditions later.
#[tokio::test(start_paused = true)]
async fn no_status_is_written_on_top_of_one_that_the_cache_does_not_show_yet() {
    let mut shown = leaderboard(NOBODY);
    let mut behind = shown.clone();
    behind.metadata.resource_version = Some("1".into());
    let mut around = around(&behind, NOBODY).await;
    reconciled(&mut around, &behind).await;
    answered(&mut around, &behind).await;
    let (_, written, first) = reconciled(&mut around, &behind).await;
    assert_eq!(written, ["status"]);
    let (wait, written, _) = reconciled(&mut around, &behind).await;
    assert_eq!((wait, written), (SOONEST, Vec::new()), "the cache is behind");

    shown.status = serde_json::from_value(first).unwrap();
    let (_, written, _) = reconciled(&mut around, &shown).await;
    assert_eq!(written, Vec::<String>::new(), "nothing has changed");
    shown.status.as_mut().unwrap().conditions.clear();
    let (_, written, _) = reconciled(&mut around, &shown).await;
    assert_eq!(written, ["status"], "what is missing is written");
}

#[tokio::test(start_paused = true)]
async fn an_edit_changes_nothing_that_is_shown_before_it_was_looked_at() {
    let (_silent, endpoint) = silent();
    let mut board = leaderboard(&endpoint);
    let mut around = around(&board, &endpoint).await;
    reconciled(&mut around, &board).await;
    answered(&mut around, &board).await;
    let (_, _, first) = reconciled(&mut around, &board).await;
    assert_eq!(ready(&first), ("Unknown", Reason::BucketUnreachable.as_str(), Some(1)));
    board.status = serde_json::from_value(first).unwrap();
    board.status.as_mut().unwrap().operator = fixtures::leaderboard("any", NOBODY).status.unwrap().operator;

    board.metadata.generation = Some(2);
    let (wait, written, _) = reconciled(&mut around, &board).await;
    assert_eq!(wait, FIRST_LOOK);
    assert!(
        written.iter().all(|kind| kind.contains("/networkpolicies/")),
        "{written:?}"
    );
    tokio::time::advance(FIRST_LOOK).await;
    let (_, _, status) = reconciled(&mut around, &board).await;
    assert_eq!(
        ready(&status),
        ("Unknown", Reason::BucketUnreachable.as_str(), Some(1)),
        "as it was"
    );
    assert_eq!(status["observedGeneration"], 1);
    answered(&mut around, &board).await;
    let (_, _, status) = reconciled(&mut around, &board).await;
    assert_eq!((ready(&status).2, &status["observedGeneration"]), (Some(2), &json!(2)));
}

#[tokio::test(start_paused = true)]
async fn what_was_found_of_a_leaderboard_that_is_gone_is_dropped() {
    let board = leaderboard(NOBODY);
    let mut around = around(&board, NOBODY).await;
    reconciled(&mut around, &board).await;
    answered(&mut around, &board).await;
    let known = |around: &Surroundings| {
        let looked = around.context.asks.known(&Arc::new(board.clone()));
        looked
            .reach
            .0
            .iter()
            .filter(|(_, lookup)| lookup.last.is_some())
            .count()
    };
    assert_eq!(known(&around), 3, "bucket, table and rows");
    around.context.forget(&key_of(&board));
    assert_eq!(known(&around), 0);
}

#[tokio::test(start_paused = true)]
async fn nothing_is_asked_of_a_leaderboard_that_names_what_it_may_not() {
    let mut board = leaderboard(NOBODY);
    let evalai = json!({"apiServer": "http://evalai.example.com", "challenge": 1, "token": {"secretKeyRef": {"name": "t", "key": "k"}}});
    board.spec.evalai = serde_json::from_value(evalai).unwrap();
    let mut around = around(&board, NOBODY).await;
    let (_, written, status) = reconciled(&mut around, &board).await;
    assert_eq!(written.len(), 2, "the policy, and at once the status: {written:?}");
    assert_eq!(ready(&status), ("False", Reason::InsecureServer.as_str(), Some(1)));
    let looked = around.context.asks.known(&Arc::new(board));
    assert!(looked.reach.0.iter().all(|(_, lookup)| lookup.asked.is_none()));
}
