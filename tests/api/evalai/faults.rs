//! A server that throttles, breaks, hangs, answers late or not at all, and what each of its errors reads like.

use evalai_stand_in::errors;
use futures::future::join_all;
use leaderboard_evalai::answer::{Answer, classify};
use serde_json::Value;
use tokio::io::{AsyncReadExt, AsyncWriteExt};

use super::ends::Kept;
use super::*;

#[test]
fn every_error_of_the_server_becomes_one_readable_sentence() {
    for error in errors::all() {
        let body = error.body(&["7", "8"]);
        let retry_after = (error.status == 429).then_some("56");
        let answer = classify(error.status, retry_after, body.as_bytes());
        match (error.status, &answer) {
            (429, Answer::Throttled(wait)) => assert_eq!(wait.as_secs(), 56),
            (500, Answer::Broken(_)) | (400..=499, Answer::Refused(_)) => {}
            _ => panic!("{}: {answer:?}", error.name),
        }
        let sentence = answer.error().unwrap();
        let rest = sentence.trim_start_matches(&format!("EvalAI answered {}: ", error.status));
        let plain = !rest.contains(['<', '>', '\n', '\t']) && !rest.contains("\":") && !rest.contains("  ");
        assert!(
            plain && rest.len() > 8 && sentence.len() < 600,
            "{}: {sentence}",
            error.name
        );
    }
}

#[tokio::test]
async fn an_unanswered_end_leaves_one_row_on_the_leaderboard() {
    let timeouts = Timeouts {
        write: Duration::from_millis(300),
        ..timeouts()
    };
    let mut world = World::with(timing(), timeouts).await;
    let pk = world.submit();
    world.server.set_knobs(Knobs {
        put_delay_ms: 1000,
        ..Knobs::default()
    });
    world.finish(pk);
    let view = world.until(pk, |view| view.last_error.is_some()).await;
    assert!(
        view.last_error
            .is_some_and(|why| why.contains("did not answer in time"))
    );
    assert!(!world.sent("PUT").is_empty());
    world.server.wait_until(|state, _| !state.rows.is_empty()).await;
    world.server.set_knobs(Knobs::default());
    assert!(matches!(world.ended(pk).await, Ended::Published { .. }));
    assert_eq!(world.rows(pk), 1);
    let puts = world.sent("PUT");
    let answered = |entry: &Entry| entry.answered.unwrap();
    assert!(
        puts.len() == 2 && answered(&puts[0]) < puts[1].time,
        "the second came after the first was worked on"
    );
    let reads = world
        .server
        .requests()
        .into_iter()
        .filter(|entry| entry.method == "GET" && entry.time > answered(&puts[0]));
    assert!(reads.count() >= 1, "read before it was written again");
}

#[tokio::test]
async fn faults_of_the_server_are_survived() {
    let cases = [
        (Failure::Html500, "Error 500"),
        (Failure::Hang, "did not answer in time"),
        (Failure::Close, "answer broke off"),
        (Failure::Status(503), "answered 503"),
    ];
    let survive = |(answer, words)| async move {
        let mut world = World::new().await;
        let pk = world.submit();
        world.fail("GET", "/api/jobs/submission/", answer, When::Before);
        world.ask(pk, false);
        let view = world.until(pk, |view| view.last_error.is_some()).await;
        let why = view.last_error.unwrap();
        assert!(why.contains(words), "{words}: {why}");
        let view = world.until(pk, |view| view.answered == Some(Attempt(1))).await;
        assert_eq!(view.last_error, None);
    };
    join_all(cases.map(survive)).await;
}

#[tokio::test]
async fn a_write_that_was_done_without_an_answer_is_settled_by_a_read() {
    let settle = |answer| async move {
        let mut world = World::new().await;
        let pk = world.submit();
        world.fail("PUT", "/api/jobs/", answer, When::After);
        world.update(pk, DesiredUpdate::Final(Outcome::Failed, results(&world.target, 0.0)));
        world.until(pk, |view| view.last_error.is_some()).await;
        assert_eq!(Kept::of(&world.ended(pk).await), Some(Kept::Agreed(Status::Failed)));
        assert_eq!(world.sent("PUT").len(), 1);
    };
    join_all([Failure::Close, Failure::Status(502), Failure::Status(504)].map(settle)).await;
}

#[tokio::test]
async fn a_broken_page_in_place_of_an_end_is_an_answer() {
    let mut world = World::new().await;
    let pk = world.submit();
    world.fail("PUT", "/api/jobs/", Failure::Html500, When::Before);
    world.update(pk, DesiredUpdate::Final(Outcome::Failed, results(&world.target, 0.0)));
    let view = world.until(pk, |view| view.last_error.is_some()).await;
    assert_eq!(view.end, None);
}

#[tokio::test]
async fn a_refused_end_shows_why() {
    let mut world = World::new().await;
    let pk = world.submit();
    let mut target = world.target.clone();
    target.metrics = Metrics::Fixed(["Bogus".to_owned()].into());
    world.target = target;
    world.finish(pk);
    let Ended::Refused(why) = world.ended(pk).await else {
        panic!("it was not refused")
    };
    assert!(why.contains("'Bogus'") && why.contains("labels"), "{why}");
    assert_eq!(world.rows(pk), 0);
}

#[tokio::test]
async fn the_end_of_the_process_waits_for_what_is_on_its_way() {
    let mut world = World::new().await;
    let pk = world.submit();
    world.server.set_knobs(Knobs {
        put_delay_ms: 500,
        ..Knobs::default()
    });
    world.finish(pk);
    world.until_put().await;
    assert!(world.hub.drain().await, "the write was answered");
    assert!(matches!(world.ended(pk).await, Ended::Published { .. }));

    let timeouts = Timeouts {
        write: Duration::from_millis(200),
        ..timeouts()
    };
    let world = World::with(timing(), timeouts).await;
    let pk = world.submit();
    world.fail("PUT", "/api/jobs/", Failure::Hang, When::After);
    world.finish(pk);
    world.until_put().await;
    assert!(!world.hub.drain().await, "the server may still be working on it");
}

/// A server that gives the same texts to one connection after the other, and returns when each came.
async fn scripted(answers: Vec<String>) -> (String, mpsc::UnboundedReceiver<Instant>) {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let url = format!("http://{}", listener.local_addr().unwrap());
    let (said, came) = mpsc::unbounded_channel();
    tokio::spawn(async move {
        for answer in answers {
            let (mut stream, _) = listener.accept().await.unwrap();
            let mut head = Vec::new();
            while !head.ends_with(b"\r\n\r\n") {
                head.push(stream.read_u8().await.unwrap());
            }
            said.send(Instant::now()).unwrap();
            stream.write_all(answer.as_bytes()).await.unwrap();
        }
    });
    (url, came)
}

fn response(status: &str, header: &str, body: &Value) -> String {
    let body = body.to_string();
    format!(
        "HTTP/1.1 {status}\r\n{header}Connection: close\r\nContent-Length: {}\r\n\r\n{body}",
        body.len()
    )
}

#[tokio::test]
async fn retry_after_is_obeyed_and_a_torn_answer_is_none() {
    let row = json!({"id": 7, "status": "submitted"});
    let torn = response("200 OK", "", &row).replace("submitted\"}", "");
    let (url, mut came) = scripted(vec![
        response(
            "429 Too Many Requests",
            "Retry-After: 2\r\n",
            &json!({"detail": "Request was throttled."}),
        ),
        torn,
        response("200 OK", "", &row),
    ])
    .await;
    let mut world = World::new().await;
    world.target = target(&url, "local-host-token");
    world.ask(7, false);
    let first = came.recv().await.unwrap();
    let view = world.until(7, |view| view.last_error.is_some()).await;
    assert!(view.last_error.is_some_and(|why| why.contains("answer broke off")));
    let second = came.recv().await.unwrap();
    assert!(
        second - first >= Duration::from_millis(1990),
        "{:?} after the 429",
        second - first
    );
    world.until(7, |view| view.answered == Some(Attempt(1))).await;
}

#[tokio::test]
async fn writes_that_wait_for_the_process_before_are_named_and_their_start_wakes() {
    let opens = Instant::now() + Duration::from_secs(1);
    let mut world = World::opened_at(opens).await;
    let pk = world.submit();
    world.update(pk, DesiredUpdate::Final(Outcome::Failed, results(&world.target, 0.0)));
    let from = world.hub.writes_from().unwrap();
    assert!(from > Timestamp::now() && from < Timestamp::now() + SignedDuration::from_secs(2));
    loop {
        let Changed::Submission(_) = world.changed.recv().await.unwrap() else {
            continue;
        };
        if world.hub.writes_from().is_none() {
            break;
        }
    }
    assert!(matches!(world.ended(pk).await, Ended::Published { .. }));
}
