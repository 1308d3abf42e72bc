//! A challenge's queue in EvalAI's own account, read over REST by the whole controller, which makes Submissions of its messages.
//!
//! The real controller against a real API server and both stand-ins.
#![cfg(test)]

use evalai_stand_in::log::Entry;
use evalai_stand_in::model::Status;
use evalai_stand_in::{Knobs, Message, Queues};
use futures::StreamExt;
use jiff::Timestamp;
use k8s_openapi::api::events::v1::Event;
use kube::Api;
use kube::runtime::wait::await_condition;
use kube::runtime::{WatchStreamExt, watcher};
use leaderboard_api::{Attempt, Ingested, Leaderboard, Reason, Submission, SubmissionStatus, conditions, names};
use serde_json::{Value, json};
use tokio::time::timeout;

use super::bridge::LIMIT;
use super::objects::merge;
use super::rule_cases::container::by_container;
use super::world::{HOST, World};

/// The queue of all of the stand-in's challenges.
const QUEUE: &str = "submissions";

impl World {
    async fn leaderboard_with_inbox(&self, queue: &str) {
        let more = json!({"queue": {"evalai": {"name": queue, "unknownAfterSeconds": 0}}});
        self.leaderboard_with("lb", 1, "Hosts", &more).await;
    }

    /// A Leaderboard with an evaluation by a container in this mode, which reads the same queue.
    async fn leaderboard_in_mode(&self, name: &str, phase: i64, mode: &str) {
        let spec = by_container(&json!({
            "evaluation": {"container": {"mode": mode}},
            "tracks": [{"name": "test", "phase": phase, "container": {"score": {"metric": "Driving score"}}}],
            "queue": {"evalai": {"name": QUEUE, "unknownAfterSeconds": 0}},
        }));
        self.leaderboard_with(name, phase, "Hosts", &spec).await;
    }

    async fn post(&self, path: &str, body: &Value) -> Value {
        let request = self.http.post(format!("{}{path}", self.evalai.url()));
        let answer = request.bearer_auth("local-organizer-token").json(body).send();
        let answer = answer.await.unwrap();
        assert!(answer.status().is_success(), "{path}: {}", answer.status());
        answer.json().await.unwrap()
    }

    /// Team a pushes, and EvalAI sends the message.
    async fn push_and_send(&self) -> u64 {
        self.push_to(1, &json!({"image": "r/team-a:1"})).await
    }

    /// Team a pushes this to a phase, and EvalAI sends the message.
    async fn push_to(&self, phase: u64, what: &Value) -> u64 {
        let mut body = json!({"team": "team-a", "phase": phase});
        merge(&mut body, what);
        let pushed = self.post("/_stand-in/submit", &body).await;
        pushed["submission"].as_u64().unwrap()
    }

    async fn send(&self, body: Value) {
        let message = Message {
            body,
            group: None,
            dedup: None,
        };
        self.queues.send(QUEUE, &message).await.unwrap();
    }

    fn down(&self, queue_down: bool) {
        self.evalai.set_knobs(Knobs {
            queue_down,
            ..Knobs::default()
        });
    }

    /// Waits until the operator drives a Leaderboard.
    async fn driven(&self, name: &str) {
        let is_driven = |found: Option<&Leaderboard>| {
            let status = found.and_then(|board| board.status.as_ref());
            status.is_some_and(|status| status.operator.is_some())
        };
        let driven = timeout(LIMIT, Box::pin(await_condition(self.api(), name, is_driven))).await;
        driven.expect("the operator drives it").unwrap();
    }

    /// Waits until so many messages are left in the queue.
    async fn left(&self, count: usize) {
        let is_left = self
            .evalai
            .wait_until(|_, _| self.queues.messages(QUEUE).len() == count);
        let found = timeout(LIMIT, is_left).await;
        found.unwrap_or_else(|_| panic!("left: {:?}", self.queues.messages(QUEUE)));
    }

    /// The operator's requests whose paths hold `part`, as a method and a path each.
    fn asked(&self, part: &str) -> Vec<String> {
        let all = self.evalai.requests().into_iter();
        let of_us = all.filter(|entry: &Entry| entry.token.as_deref() == Some(HOST) && entry.path.contains(part));
        of_us.map(|entry| format!("{} {}", entry.method, entry.path)).collect()
    }

    async fn made(&self, pk: u64) -> Submission {
        let name = names::submission(i64::try_from(pk).unwrap());
        let is_there = |found: Option<&Submission>| found.is_some();
        let made = timeout(LIMIT, Box::pin(await_condition(self.api(), &name, is_there))).await;
        made.expect("a Submission is made").unwrap().unwrap()
    }

    /// Waits for an event about the Leaderboard, and hands back its note.
    async fn event(&self, reason: &str) -> String {
        let events: Api<Event> = self.api();
        let mut written = std::pin::pin!(watcher(events, watcher::Config::default()).touched_objects());
        let search = async {
            loop {
                match written.next().await.unwrap() {
                    Ok(event) if event.reason.as_deref() == Some(reason) => return event.note.unwrap(),
                    _ => {}
                }
            }
        };
        timeout(LIMIT, search).await.expect("an event is written")
    }

    /// Waits until the Leaderboard's `Ready` is this, and hands back its message.
    async fn ready(&self, status: &str, reason: Reason) -> String {
        let of = |found: Option<&Leaderboard>| {
            let conditions = &found?.status.as_ref()?.conditions;
            conditions::get(conditions, conditions::READY).cloned()
        };
        let holds = |found: Option<&Leaderboard>| of(found).is_some_and(|c| c.status == status && c.reason == reason);
        let found = timeout(LIMIT, Box::pin(await_condition(self.api(), "lb", holds))).await;
        of(found.expect("Ready says so").unwrap().as_ref())
            .unwrap()
            .message
            .into()
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_message_becomes_a_submission_once_and_a_resume_raises_its_attempt() {
    let world = World::new().await;
    let _controller = world.controller();
    world.leaderboard_with_inbox(QUEUE).await;
    let pk = world.push_and_send().await;
    let made = world.made(pk).await;
    world.left(0).await;
    let row = world.evalai.with_state(|state| state.submissions[&pk].clone());
    let sent = Ingested::of(&made).unwrap();
    assert_eq!(sent.sent, row.submitted_at.as_millisecond(), "EvalAI's time, not ours");
    assert_eq!(made.spec.image.as_deref(), Some("r/team-a:1"));
    // Three requests, and the last of them only once the object is there.
    let asked = world.asked("/jobs/queues/");
    assert_eq!(asked, [format!("POST /api/jobs/queues/{QUEUE}/")]);

    // A repeat of the message, as after a lost deletion.
    let body = json!({"challenge_pk": "1", "phase_pk": "1", "submission_pk": pk, "submitted_image_uri": "r/team-a:1"});
    world.send(body.clone()).await;
    world.left(0).await;
    let name = names::submission(i64::try_from(pk).unwrap());
    world.run_that_crashes(pk, &name).await;
    let is_published = |s: &SubmissionStatus| s.times.published.is_some();
    world.until(&name, "EvalAI has the end", is_published).await;
    // Also after the end it begins no run.
    world.send(body).await;
    world.left(0).await;
    let failed: Submission = world.api().get(&name).await.unwrap();
    assert_eq!(failed.spec.attempt, Attempt(1));

    world
        .post(&format!("/api/jobs/submissions/{pk}/resume/"), &json!({}))
        .await;
    world.left(0).await;
    let resumed: Submission = world.api().get(&name).await.unwrap();
    assert_eq!(resumed.spec.attempt, Attempt(2));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_message_of_no_use_is_named_and_deleted_and_another_challenges_stays() {
    let world = World::new().await;
    let _controller = world.controller();
    world.leaderboard_with_inbox(QUEUE).await;
    world
        .send(json!({"challenge_pk": 2, "phase_pk": 3, "submission_pk": 99}))
        .await;
    world.send(json!({"challenge_pk": 1, "what": "a \u{1b}[31mtext"})).await;
    let note = world.event("MessageDropped").await;
    assert!(note.contains("(Malformed): phase_pk is missing"), "{note}");
    assert!(
        note.contains(r#""challenge_pk":1"#) && !note.contains('\u{1b}'),
        "{note}"
    );
    world.left(1).await;
    // Later messages are read all the same.
    let pk = world.push_and_send().await;
    world.made(pk).await;
    world.left(1).await;
    assert_eq!(world.queues.messages(QUEUE)[0].body["challenge_pk"], json!(2));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_message_waits_while_evalai_cannot_be_asked() {
    let world = World::new().await;
    world.leaderboard_with_inbox(QUEUE).await;
    let pk = world.push_and_send().await;
    world.down(true);
    let _controller = world.controller();
    let failed = world.evalai.wait_until(|_, log| {
        let failures = log
            .entries()
            .filter(|entry| entry.path.contains("/challenge/queues/") && entry.status == Some(500));
        failures.count() >= 2
    });
    timeout(LIMIT, failed).await.expect("it is tried again");
    assert_eq!(world.queues.messages(QUEUE).len(), 1);
    let found: Option<Submission> = world
        .api()
        .get_opt(&names::submission(i64::try_from(pk).unwrap()))
        .await
        .unwrap();
    assert!(found.is_none());
    world.down(false);
    world.made(pk).await;
    world.left(0).await;
    let before = Timestamp::now();
    assert!(world.evalai.with_state(|state| state.submissions[&pk].submitted_at) < before);
    assert_eq!(
        world.evalai.with_state(|state| state.submissions[&pk].status),
        Status::Submitted
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_queue_that_evalai_does_not_know_is_named() {
    let world = World::new().await;
    let _controller = world.controller();
    world.leaderboard_with_inbox("another-queue").await;
    let message = world.ready("False", Reason::QueueUnreachable).await;
    assert!(
        message.contains("Challenge with queue name another-queue does not exist"),
        "{message}"
    );
    assert!(message.contains("check queue.evalai.name"), "{message}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_file_of_predictions_becomes_a_submission_without_an_image() {
    let world = World::new().await;
    world.evalai.with_state(|state| {
        let challenge = &mut state.seed.challenges[0];
        (challenge.is_docker_based, challenge.remote_evaluation) = (false, false);
    });
    let _controller = world.controller();
    world.leaderboard_in_mode("lb", 1, "Predictions").await;
    let message = world.ready("True", Reason::Ready).await;
    assert!(
        message.contains("remote_evaluation: false in EvalAI") && message.contains("set it to true there"),
        "{message}"
    );
    let pk = world.push_to(1, &json!({"content": "id,label\n1,cat\n"})).await;
    let made = world.made(pk).await;
    assert_eq!((made.spec.image, made.spec.input), (None, None));
    assert_eq!(made.spec.evalai.map(|evalai| evalai.phase), Some(1));
    world.left(0).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_static_code_upload_runs_in_batch_and_is_dropped_where_another_mode_serves_its_phase() {
    let world = World::new().await;
    world.evalai.with_state(|state| {
        state.seed.challenges[0].is_static_dataset_code_upload = true;
    });
    let _controller = world.controller();
    world.leaderboard_in_mode("lb", 1, "Batch").await;
    world.leaderboard_in_mode("other", 2, "Interactive").await;
    world.driven("other").await;
    let pk = world.push_and_send().await;
    let made = world.made(pk).await;
    assert_eq!(made.spec.image.as_deref(), Some("r/team-a:1"));
    let dropped = world.push_to(2, &json!({"image": "r/team-a:1"})).await;
    let note = world.event("MessageDropped").await;
    assert!(
        note.contains("the Leaderboard other has the mode Interactive"),
        "{note}"
    );
    world.left(0).await;
    let name = names::submission(i64::try_from(dropped).unwrap());
    let found: Option<Submission> = world.api().get_opt(&name).await.unwrap();
    assert!(found.is_none());
}
