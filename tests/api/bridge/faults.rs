//! Messages that cannot be used, and queues that cannot be read.

use super::*;
use crate::api::rule_cases::container::by_container;

#[tokio::test]
async fn what_cannot_be_used_becomes_a_dead_letter_with_its_reason() {
    let world = World::new("bridge-dead").await;
    let (url, dead) = (world.stand_in.queue("q").await, world.stand_in.queue("dead").await);
    let queue = json!({"url": url, "deadLetterURL": dead, "unknownAfterSeconds": 0});
    world.leaderboard("a", 2, queue.clone()).await;
    world.leaderboard("b", 3, queue).await;
    let bridge = world.bridge();
    world.stand_in.send(&url, &body(2, 7)).await;
    world.submission("submission-7", |_| true).await;
    let bodies = [body(3, 7), body(9, 8), "no json".to_owned()];
    for body in &bodies {
        world.stand_in.send(&url, body).await;
    }
    let letters = world.stand_in.dead_letters(&dead, 3).await;
    let reason = |body: &str| letters.iter().find(|(text, _)| text == body).unwrap().1["reason"].clone();
    assert_eq!(
        bodies.each_ref().map(|body| reason(body)),
        ["IdTaken", "UnknownPhase", "Malformed"]
    );
    let (_, taken) = letters.iter().find(|(text, _)| *text == bodies[0]).unwrap();
    assert_eq!(
        taken["detail"],
        "submission-7 belongs to leaderboard a, challenge 1, phase 2, submission 7"
    );
    world.stand_in.drained(&url).await;
    eventually("no message is left to be old", async || bridge.oldest(&url).is_none()).await;
    bridge.stop().await;
}

#[tokio::test]
async fn a_static_code_upload_becomes_a_submission_in_batch_and_a_dead_letter_elsewhere() {
    let world = World::new("bridge-static").await;
    let (url, dead) = (world.stand_in.queue("q").await, world.stand_in.queue("dead").await);
    let queue = json!({"url": url, "deadLetterURL": dead});
    let in_mode = |mode: &str, phase: i64| {
        by_container(&json!({
            "evaluation": {"container": {"mode": mode}},
            "tracks": [{"name": "test", "phase": phase, "container": {"score": {"metric": "accuracy"}}}],
        }))
    };
    for (name, phase, mode) in [("batch", 2, "Batch"), ("interactive", 3, "Interactive")] {
        let spec = in_mode(mode, phase);
        world.leaderboard_with(name, phase, queue.clone(), &spec).await;
    }
    world.leaderboard("carla", 4, queue).await;
    let bridge = world.bridge();
    let upload = |phase: i64, submission: i64| {
        let mut message: Value = serde_json::from_str(&body(phase, submission)).unwrap();
        message["is_static_dataset_code_upload_submission"] = json!(true);
        message.to_string()
    };
    let bodies = [upload(3, 8), upload(4, 9)];
    for body in [&upload(2, 7), &bodies[0], &bodies[1]] {
        world.stand_in.send(&url, body).await;
    }
    let made = world.submission("submission-7", |_| true).await;
    assert_eq!(made.spec.image.as_deref(), Some("registry.example/a:1"));
    let letters = world.stand_in.dead_letters(&dead, 2).await;
    for (body, named) in bodies.iter().zip([
        "the Leaderboard interactive has the mode Interactive",
        "the Leaderboard carla has evaluation.carla",
    ]) {
        let (_, attributes) = letters.iter().find(|(text, _)| text == body).unwrap();
        assert_eq!(attributes["reason"], "Malformed");
        assert!(attributes["detail"].contains(named), "{attributes:?}");
    }
    world.stand_in.drained(&url).await;
    let made = world.submissions().list(&ListParams::default()).await.unwrap();
    assert_eq!(made.items.len(), 1);
    bridge.stop().await;
}

#[tokio::test]
async fn without_a_dead_letter_queue_a_bad_message_stays_and_the_leaderboard_shows_it() {
    let world = World::new("bridge-blocked").await;
    let url = world.stand_in.queue("q").await;
    world.leaderboard("lb", 2, json!({"url": url})).await;
    let bridge = world.bridge();
    world.stand_in.send(&url, "no json").await;
    let events: Api<Event> = Api::namespaced(world.client.clone(), &world.namespace);
    let mut written = std::pin::pin!(watcher(events, watcher::Config::default()).touched_objects());
    let search = async {
        loop {
            let event = written.next().await.unwrap();
            match event {
                Ok(event) if event.reason.as_deref() == Some("QueueBlocked") => return event.note,
                _ => {}
            }
        }
    };
    let note = tokio::time::timeout(LIMIT, search).await.expect("an event is written");
    let note = note.unwrap();
    assert!(
        note.contains("(Malformed): the body is not JSON (line 1, column 2)"),
        "{note}"
    );
    assert!(
        note.ends_with("no Leaderboard of this queue has queue.sqs.deadLetterURL"),
        "{note}"
    );
    eventually("it is counted", async || bridge.count("blocked") == 1).await;
    assert_eq!(world.stand_in.depth(&url).await, (0, 1));
    let now = jiff::Timestamp::now()
        .duration_since(jiff::Timestamp::UNIX_EPOCH)
        .as_secs_f64();
    let sent = bridge.oldest(&url).expect("it is the oldest, and the only one");
    assert!((now - 120.0..now + 5.0).contains(&sent), "{sent} at {now}");
    bridge.stop().await;
}

#[tokio::test]
async fn one_bad_queue_among_several_is_named_and_the_others_are_read() {
    let world = World::new("bridge-bad-queue").await;
    let url = world.stand_in.queue("q").await;
    let missing = format!("{}/000000000000/nowhere", world.stand_in.endpoint);
    world.leaderboard("bad", 3, json!({"url": missing})).await;
    let bridge = world.bridge();
    let named = format!("queue {missing}: GetQueueAttributes failed");
    eventually("a bridge that can read nothing is not ready", async || {
        bridge.missing().contains(&named)
    })
    .await;
    // Its poller is started when the Leaderboard is applied.
    world.leaderboard("good", 2, json!({"url": url})).await;
    world.stand_in.send(&url, &body(2, 7)).await;
    world.submission("submission-7", |_| true).await;
    eventually("the other one makes it ready", async || bridge.missing().is_empty()).await;
    // Without it, the bridge can read nothing again.
    let api: Api<Leaderboard> = Api::namespaced(world.client.clone(), &world.namespace);
    let delete = async |name| api.delete(name, &kube::api::DeleteParams::default()).await.unwrap();
    delete("good").await;
    eventually("a bridge that can read nothing is not ready", async || {
        bridge.missing().contains(&named)
    })
    .await;
    delete("bad").await;
    eventually("a queue that no Leaderboard names is forgotten", async || {
        bridge.missing().is_empty()
    })
    .await;
    bridge.stop().await;
}

#[tokio::test]
async fn a_queue_that_goes_away_for_a_while_loses_no_message() {
    let world = World::new("bridge-away").await;
    let url = world.stand_in.queue("q").await;
    // Messages that the broken receive may have taken come back soon.
    world.stand_in.set_visibility(&url, 2).await;
    let proxy = ministack::server().await.proxy().await;
    let queue = json!({"url": url, "endpoint": proxy.endpoint()});
    world.leaderboard("lb", 2, queue).await;
    let bridge = world.bridge();
    world.stand_in.send(&url, &body(2, 7)).await;
    world.submission("submission-7", |_| true).await;
    proxy.set_away(true);
    eventually("it is not ready", async || !bridge.missing().is_empty()).await;
    assert!(bridge.missing().ends_with("it is retried"), "{}", bridge.missing());
    for id in 8..=20 {
        world.stand_in.send(&url, &body(2, id)).await;
    }
    proxy.set_away(false);
    for id in 8..=20 {
        world.submission(&names::submission(id), |_| true).await;
    }
    eventually("it is ready again", async || bridge.missing().is_empty()).await;
    world.stand_in.drained(&url).await;
    bridge.stop().await;
}
