//! The bridge against a real API server and the AWS stand-in.
#![cfg(test)]

mod faults;
mod rest;

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Duration;

use aws_sdk_sqs::types::QueueAttributeName;
use futures::StreamExt;
use k8s_openapi::api::events::v1::Event;
use kube::api::{Api, ApiResource, DynamicObject, ListParams, Patch, PatchParams, PostParams};
use kube::runtime::wait::await_condition;
use kube::runtime::{WatchStreamExt, watcher};
use kube::{Client, ResourceExt};
use serde_json::{Value, json};
use tokio::sync::watch;

use super::objects::merge;
use crate::support::{apiserver, ministack};
use leaderboard_api::{Attempt, EvalaiRef, Ingested, Leaderboard, Submission, names};
use leaderboard_aws::clients::Aws;
use leaderboard_base::shutdown::Stop;
use leaderboard_base::tasks::TaskFailed;
use leaderboard_evalai::Swept;
use leaderboard_operator::bridge;
use leaderboard_operator::intake::ingest::{self, Incoming, Source};
use leaderboard_operator::intake::leaderboards::Scope;
use leaderboard_operator::kubernetes::{Clients, Namespaces};
use leaderboard_operator::metrics::Program;
use leaderboard_operator::observability::Observability;
use leaderboard_policy::allowed::Allowed;
use leaderboard_policy::intake::route::Outcome;

/// Far longer than anything here takes, so that a busy machine fails no test.
pub(super) const LIMIT: Duration = Duration::from_mins(2);
/// Queues, metrics and readiness report no changes: they are asked this often.
const POLL: Duration = Duration::from_millis(100);

/// The AWS stand-in, shared by all tests; queues and tables have names of their own.
pub(super) struct StandIn {
    pub(super) aws: Aws,
    pub(super) endpoint: String,
    number: u32,
}

impl StandIn {
    pub(super) async fn start() -> Self {
        static NUMBER: AtomicU32 = AtomicU32::new(1);
        let server = ministack::server().await;
        Self {
            aws: server.aws().await,
            endpoint: server.endpoint(),
            number: NUMBER.fetch_add(1, Ordering::Relaxed),
        }
    }

    /// A name that no other test uses.
    pub(super) fn name(&self, name: &str) -> String {
        format!("test-{}-{name}", self.number)
    }

    pub(super) fn sqs(&self) -> aws_sdk_sqs::Client {
        self.aws.sqs(None, Some(&self.endpoint))
    }

    pub(super) async fn queue(&self, name: &str) -> String {
        let mut request = self.sqs().create_queue().queue_name(self.name(name));
        if name.rsplit('.').next() == Some("fifo") {
            request = request.attributes(QueueAttributeName::FifoQueue, "true");
        }
        request.send().await.unwrap().queue_url.unwrap()
    }

    pub(super) async fn set_visibility(&self, url: &str, seconds: u32) {
        let set = self.sqs().set_queue_attributes().queue_url(url);
        let set = set.attributes(QueueAttributeName::VisibilityTimeout, seconds.to_string());
        set.send().await.unwrap();
    }

    pub(super) async fn send(&self, url: &str, body: &str) {
        self.sqs()
            .send_message()
            .queue_url(url)
            .message_body(body)
            .send()
            .await
            .unwrap();
    }

    /// Waits until nothing is left in a queue, visible or in flight.
    pub(super) async fn drained(&self, url: &str) {
        eventually("the queue is empty", async || self.depth(url).await == (0, 0)).await;
    }

    /// Messages that can be received, and messages in flight.
    pub(super) async fn depth(&self, url: &str) -> (u32, u32) {
        let all = self
            .sqs()
            .get_queue_attributes()
            .queue_url(url)
            .attribute_names(QueueAttributeName::All);
        let all = all.send().await.unwrap().attributes.unwrap();
        let number = |name: QueueAttributeName| all[&name].parse().unwrap();
        (
            number(QueueAttributeName::ApproximateNumberOfMessages),
            number(QueueAttributeName::ApproximateNumberOfMessagesNotVisible),
        )
    }

    /// Takes so many dead letters and gives their bodies and attributes.
    async fn dead_letters(&self, url: &str, count: usize) -> Vec<(String, BTreeMap<String, String>)> {
        let mut letters = Vec::new();
        let take = async {
            while letters.len() < count {
                let receive = self
                    .sqs()
                    .receive_message()
                    .queue_url(url)
                    .max_number_of_messages(10)
                    .wait_time_seconds(20);
                let receive = receive.message_attribute_names("All");
                for message in receive.send().await.unwrap().messages.unwrap_or_default() {
                    let attributes = message.message_attributes.unwrap_or_default().into_iter();
                    let attributes = attributes.map(|(name, value)| (name, value.string_value.unwrap()));
                    letters.push((message.body.unwrap(), attributes.collect()));
                }
            }
        };
        tokio::time::timeout(LIMIT, take).await.expect("dead letters arrive");
        letters.sort();
        letters
    }
}

pub(super) async fn eventually(what: &str, mut holds: impl AsyncFnMut() -> bool) {
    let wait = async {
        while !holds().await {
            tokio::time::sleep(POLL).await;
        }
    };
    assert!(tokio::time::timeout(LIMIT, wait).await.is_ok(), "{what}");
}

/// A bridge of one namespace that runs until it is dropped.
pub(super) struct Bridge {
    telemetry: Observability,
    stop: watch::Sender<bool>,
    task: tokio::task::JoinHandle<Result<(), TaskFailed>>,
}

impl Bridge {
    pub(super) fn start(clients: Clients, stand_in: &StandIn, namespace: &str) -> Self {
        let (stop, stopped) = Stop::new();
        let telemetry = Observability::of(Program::Bridge, stopped);
        let aws = stand_in.aws.clone();
        let scope = Scope {
            namespaces: Namespaces::of([namespace.to_owned()]),
            allowed: Allowed::default(),
        };
        let running = bridge::run(clients, aws, scope, telemetry.clone());
        Self {
            telemetry,
            stop,
            task: tokio::spawn(running),
        }
    }

    /// So many messages had this outcome.
    pub(super) fn count(&self, outcome: &str) -> u64 {
        let sample = format!("leaderboard_queue_messages_total{{outcome=\"{outcome}\"}} ");
        self.sample(&sample).map_or(0, |value| value.parse().unwrap())
    }

    /// When the oldest message of a queue was sent that is not deleted yet, in seconds since 1970.
    fn oldest(&self, url: &str) -> Option<f64> {
        let sample = format!("leaderboard_queue_oldest_message_timestamp_seconds{{queue=\"{url}\"}} ");
        self.sample(&sample).map(|value| value.parse().unwrap())
    }

    fn sample(&self, start: &str) -> Option<String> {
        let text = self.telemetry.metrics.text().unwrap();
        text.lines()
            .find_map(|line| line.strip_prefix(start).map(str::to_owned))
    }

    /// The text of /readyz.
    fn missing(&self) -> String {
        self.telemetry.readiness.missing().join("; ")
    }

    pub(super) async fn stop(self) {
        self.stop.send_replace(true);
        tokio::time::timeout(LIMIT, self.task)
            .await
            .expect("the bridge ends")
            .unwrap()
            .unwrap();
    }
}

/// A namespace of the API server, and a stand-in of AWS.
struct World {
    client: Client,
    clients: Clients,
    namespace: String,
    stand_in: StandIn,
}

impl World {
    async fn new(name: &str) -> Self {
        let server = apiserver::server().await;
        Self {
            client: server.client(),
            clients: Clients::new(server.config()).unwrap(),
            namespace: server.namespace(name).await,
            stand_in: StandIn::start().await,
        }
    }

    fn bridge(&self) -> Bridge {
        Bridge::start(self.clients.clone(), &self.stand_in, &self.namespace)
    }

    fn submissions(&self) -> Api<Submission> {
        Api::namespaced(self.client.clone(), &self.namespace)
    }

    /// A Leaderboard of challenge 1 with this phase, and its queue.
    async fn leaderboard(&self, name: &str, phase: i64, queue: Value) {
        self.leaderboard_with(name, phase, queue, &json!({})).await;
    }

    /// The same with more of its spec.
    async fn leaderboard_with(&self, name: &str, phase: i64, mut queue: Value, more: &Value) {
        if queue["endpoint"].is_null() {
            queue["endpoint"] = json!(self.stand_in.endpoint);
        }
        let mut leaderboard = json!({
            "apiVersion": "leaderboard.carla.org/v1alpha1",
            "kind": "Leaderboard",
            "metadata": {"name": name},
            "spec": {
                "evalai": {
                    "apiServer": "https://evalai.example",
                    "challenge": 1,
                    "token": {"secretKeyRef": {"name": "evalai", "key": "token"}}
                },
                "tracks": [{"name": "sensors", "phase": phase}],
                "evaluation": {"carla": {
                    "version": "V2", "contents": {"image": "contents:1"}, "simulator": {"image": "simulator:1"},
                }},
                "storage": {"s3": {"bucket": "results"}},
                "queue": {"sqs": queue}
            }
        });
        merge(&mut leaderboard, &json!({ "spec": more }));
        let leaderboard = serde_json::from_value(leaderboard);
        // As a person writes it: the API server fills in the rest.
        let kind = ApiResource::erase::<Leaderboard>(&());
        let api: Api<DynamicObject> = Api::namespaced_with(self.client.clone(), &self.namespace, &kind);
        api.create(&PostParams::default(), &leaderboard.unwrap()).await.unwrap();
    }

    async fn submission(&self, name: &str, holds: impl Fn(&Submission) -> bool + Send) -> Submission {
        let found = await_condition(self.submissions(), name, |object: Option<&Submission>| {
            object.is_some_and(&holds)
        });
        let found = tokio::time::timeout(LIMIT, found).await;
        found.unwrap_or_else(|_| panic!("{name} gets there")).unwrap().unwrap()
    }

    /// Ends the present attempt, as the controller would.
    async fn end(&self, name: &str, state: &str) {
        let attempt = self.submissions().get(name).await.unwrap().spec.attempt;
        let condition = json!({
            "type": "Finished", "status": "True", "reason": state, "message": "", "lastTransitionTime": "2026-11-20T10:00:00Z"
        });
        let failure = json!({"class": "Participant", "reason": "Test", "message": "It failed."});
        let failure = (state == "Failed").then_some(failure);
        let status =
            json!({"status": {"state": state, "attempt": attempt, "failure": failure, "conditions": [condition]}});
        let patched = self
            .submissions()
            .patch_status(name, &PatchParams::default(), &Patch::Merge(status))
            .await;
        patched.unwrap();
    }
}

fn body(phase: i64, submission: i64) -> String {
    json!({"challenge_pk": "1", "phase_pk": phase.to_string(), "submission_pk": submission, "submitted_image_uri": "registry.example/a:1"})
        .to_string()
}

#[tokio::test]
async fn two_bridges_make_each_submission_once() {
    let world = World::new("bridge-twice").await;
    let url = world.stand_in.queue("q").await;
    for round in 0..3 {
        for id in 1..=20 {
            world.stand_in.send(&url, &body(2, 100 + (id + round) % 20)).await;
        }
    }
    world.leaderboard("lb", 2, json!({"url": url})).await;
    let bridges = [world.bridge(), world.bridge()];
    world.stand_in.drained(&url).await;
    let made = world.submissions().list(&ListParams::default()).await.unwrap().items;
    assert_eq!(made.len(), 20);
    assert!(made.iter().all(|submission| submission.spec.attempt == Attempt(1)));
    let one = world.submissions().get("submission-107").await.unwrap();
    assert_eq!(one.labels()[names::LABEL_LEADERBOARD], "lb");
    assert_eq!(one.labels()[names::LABEL_PHASE], "2");
    assert_eq!(one.finalizers(), [names::FINALIZER_SUBMISSION]);
    let count = |outcome| bridges.iter().map(|bridge| bridge.count(outcome)).sum::<u64>();
    assert_eq!((count("created"), count("repeat")), (20, 40));
    for bridge in bridges {
        assert_eq!(bridge.missing(), "");
        let metrics = bridge.telemetry.metrics.text().unwrap();
        let receives = "leaderboard_cloud_call_duration_seconds_sum{service=\"sqs\",op=\"ReceiveMessage\"} ";
        let seconds = metrics.lines().find_map(|line| line.strip_prefix(receives));
        assert!(
            seconds.unwrap().parse::<f64>().unwrap() > 0.0,
            "calls take time: {metrics}"
        );
        bridge.stop().await;
    }
}

#[tokio::test]
async fn a_resume_bumps_once_and_undoes_a_cancel() {
    let world = World::new("bridge-resume").await;
    let url = world.stand_in.queue("q").await;
    world.leaderboard("lb", 2, json!({"url": url})).await;
    let bridge = world.bridge();
    world.stand_in.send(&url, &body(2, 7)).await;
    world.submission("submission-7", |_| true).await;
    world.stand_in.send(&url, &body(2, 7)).await;
    eventually("the repeat is counted", async || bridge.count("repeat") == 1).await;
    let cancel = Patch::Merge(json!({"spec": {"cancel": true}}));
    world
        .submissions()
        .patch("submission-7", &PatchParams::default(), &cancel)
        .await
        .unwrap();
    world.end("submission-7", "Cancelled").await;
    world.stand_in.send(&url, &body(2, 7)).await;
    let resumed = world
        .submission("submission-7", |submission| submission.spec.attempt == Attempt(2))
        .await;
    assert!(!resumed.spec.cancel);
    world.stand_in.send(&url, &body(2, 7)).await;
    eventually("the next is a repeat", async || bridge.count("repeat") == 2).await;
    world.end("submission-7", "Finished").await;
    world.stand_in.send(&url, &body(2, 7)).await;
    eventually("a finished one is not resumed", async || bridge.count("repeat") == 3).await;
    assert_eq!(
        world.submissions().get("submission-7").await.unwrap().spec.attempt,
        Attempt(2)
    );
    world.stand_in.drained(&url).await;
    bridge.stop().await;
}

#[tokio::test]
async fn the_sweep_begins_one_attempt_and_a_message_any() {
    let world = World::new("sweep").await;
    let api = world.submissions();
    let now = jiff::Timestamp::now().as_millisecond();
    let take = async |source: Source, minute: i64| {
        let incoming = Incoming {
            evalai: EvalaiRef {
                challenge: 1,
                phase: 2,
                submission: 7,
            },
            image: None,
            source,
            sent_ms: now + minute * 60_000,
        };
        ingest::apply(&api, "lb", &incoming).await.unwrap()
    };
    let message = |id: &str| Source::Message(id.to_owned());
    let sweep = Source::Sweep;
    let failed = async || world.end("submission-7", "Failed").await;
    assert_eq!(take(message("a"), 0).await, Outcome::Created);
    failed().await;
    assert_eq!(take(sweep(Swept::Edited), 10).await, Outcome::Refused);
    assert_eq!(take(sweep(Swept::Resuming), 20).await, Outcome::Bumped(Attempt(2)));
    failed().await;
    assert_eq!(take(sweep(Swept::Resuming), 30).await, Outcome::Refused);
    assert_eq!(take(sweep(Swept::Resuming), 40).await, Outcome::Repeat, "noted once");
    let found = api.get("submission-7").await.unwrap();
    let record = Ingested::of(&found).unwrap();
    assert_eq!(
        (found.spec.attempt, record.without_message),
        (Attempt(2), vec![Attempt(2)])
    );
    assert_eq!(record.refused.map(|refused| refused.attempt), Some(Attempt(3)));
    assert_eq!(take(message("b"), 50).await, Outcome::Bumped(Attempt(3)));
    let record = Ingested::of(&api.get("submission-7").await.unwrap()).unwrap();
    assert_eq!((record.without_message, record.refused), (vec![], None));
}
