//! Two operators, each with a namespace and Leaderboards of its own, that read one queue and have one token of EvalAI.
#![cfg(test)]

use std::collections::BTreeSet;

use evalai_stand_in::log::Entry;
use k8s_openapi::api::batch::v1::Job;
use kube::ResourceExt;
use kube::api::ListParams;
use leaderboard_api::{Attempt, Leaderboard, Submission, names};
use leaderboard_operator::kubernetes::Clients;
use serde_json::json;
use tokio::sync::watch;

use super::bridge::{Bridge, StandIn, eventually};
use super::world::World;
use crate::support::apiserver;

/// EvalAI's limit of a token, a minute.
const LIMIT: usize = 60;
/// Requests a minute of each of the two operators.
const HALF: u32 = 27;

/// An operator: its namespace, its phase, and its controller, which runs until this is dropped.
struct Operator {
    world: World,
    phase: u64,
    _controller: watch::Sender<bool>,
}

impl Operator {
    async fn start(world: World, phase: u64, queue: &str, dead: &str) -> Self {
        let endpoint = &world.aws.endpoint;
        let more = json!({
            "queue": {"sqs": {"url": queue, "deadLetterURL": dead, "endpoint": endpoint, "foreign": "Leave", "unknownAfterSeconds": 1}},
            "evalai": {"requestsPerMinute": HALF},
        });
        let name = format!("lb-{phase}");
        world
            .leaderboard_with(&name, i64::try_from(phase).unwrap(), "Hosts", &more)
            .await;
        let controller = world.controller();
        Self {
            world,
            phase,
            _controller: controller,
        }
    }

    async fn bridge(&self) -> Bridge {
        let clients = Clients::new(apiserver::server().await.config()).unwrap();
        Bridge::start(clients, &self.world.aws, &self.world.namespace)
    }

    /// Submissions of its phase, each with its message; hands back the names that they are to have.
    async fn submit(&self, count: usize, queue: &str) -> BTreeSet<String> {
        let mut sent = BTreeSet::new();
        for _ in 0..count {
            let image = json!("r/team-a:1");
            let pk = self.world.push(self.phase, &image);
            let body = json!({"challenge_pk": "1", "phase_pk": self.phase.to_string(), "submission_pk": pk, "submitted_image_uri": image});
            self.world.aws.send(queue, &body.to_string()).await;
            sent.insert(names::submission(i64::try_from(pk).unwrap()));
        }
        sent
    }

    /// The Submissions that it has.
    async fn made(&self) -> BTreeSet<String> {
        let all = self
            .world
            .api::<Submission>()
            .list(&ListParams::default())
            .await
            .unwrap();
        assert!(all.iter().all(|submission| submission.spec.attempt == Attempt(1)));
        all.iter().map(ResourceExt::name_any).collect()
    }

    /// Waits until each of them has its Job; there is no other.
    async fn assert_runs(&self, wanted: &BTreeSet<String>) {
        assert_eq!(self.made().await, *wanted);
        for name in wanted {
            self.world.job(name, 0).await;
        }
        let jobs = self.world.api::<Job>().list(&ListParams::default()).await.unwrap();
        assert_eq!(jobs.items.len(), wanted.len(), "each is run once");
        let board = self.world.api::<Leaderboard>().get(&format!("lb-{}", self.phase)).await;
        let operator = board.unwrap().status.unwrap().operator;
        assert_eq!(operator, Some(format!("{}/operator", self.world.namespace)));
    }
}

/// No minute holds more requests than EvalAI's limit, and none was refused.
fn assert_within_limit(requests: &[Entry]) {
    assert!(!requests.is_empty());
    for first in requests {
        let is_within = |other: &&Entry| other.id >= first.id && other.time.duration_since(first.time).as_secs() < 60;
        let minute = requests.iter().filter(is_within).count();
        assert!(minute <= LIMIT, "{minute} requests a minute from {}", first.time);
    }
    let throttled = requests.iter().filter(|entry| entry.status == Some(429)).count();
    assert_eq!(throttled, 0);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn of_two_operators_on_one_queue_each_runs_its_own_and_leaves_the_others() {
    let first = World::new().await;
    let second = first.neighbor().await;
    let stand_in = StandIn::start().await;
    let (queue, dead) = (stand_in.queue("shared").await, stand_in.queue("shared-dead").await);
    first.evalai.set_knobs(evalai_stand_in::Knobs {
        throttle: Some(LIMIT),
        ..evalai_stand_in::Knobs::default()
    });
    let sensors = Operator::start(first, 1, &queue, &dead).await;
    let map = Operator::start(second, 2, &queue, &dead).await;

    // Alone at first, so that it is certain to receive what it has to leave.
    let bridge = map.bridge().await;
    let mut of_sensors = sensors.submit(2, &queue).await;
    let mut of_map = map.submit(2, &queue).await;
    eventually("each message is taken or left", async || {
        bridge.count("created") == 2 && bridge.count("foreign") >= 2
    })
    .await;
    assert_eq!(
        (map.made().await, sensors.made().await),
        (of_map.clone(), BTreeSet::new())
    );

    // Both at once: a message gets to its own, no matter which of them receives it.
    let other = sensors.bridge().await;
    of_sensors.extend(sensors.submit(1, &queue).await);
    of_map.extend(map.submit(1, &queue).await);
    eventually("each new message is taken or left", async || {
        stand_in.depth(&queue).await.0 == 0
    })
    .await;
    // A message that is left comes back after a minute at most, to the quicker of the two. Each in turn has the queue alone.
    bridge.stop().await;
    eventually("all of the first are made", async || sensors.made().await == of_sensors).await;
    other.stop().await;
    let bridge = map.bridge().await;
    stand_in.drained(&queue).await;
    bridge.stop().await;

    sensors.assert_runs(&of_sensors).await;
    map.assert_runs(&of_map).await;
    assert_eq!(stand_in.depth(&dead).await, (0, 0), "nothing is dead-lettered");
    assert_within_limit(&sensors.world.evalai.requests());
}
