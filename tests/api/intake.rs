//! Many messages at once, while the controller and a bridge are killed again and again. Some come twice, and some are of no use. Each
//! submission is made once, and each useless message is dead-lettered with its reason.
//!
//! The programs are the real ones, as child processes. The small size belongs to the tests, the full one measures:
//! `make measure-intake`.

mod letters;
mod messages;
pub(super) mod program;

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use evalai_stand_in::model::FileState;
use evalai_stand_in::submissions::{NewSubmission, create as push};
use evalai_stand_in::{Config, Handle, Knobs};
use futures::StreamExt;
use futures::stream::BoxStream;
use jiff::Timestamp;
use k8s_openapi::api::batch::v1::Job;
use kube::api::{Api, ListParams, PostParams};
use kube::runtime::{WatchStreamExt, watcher};
use kube::{Client, ResourceExt};
use leaderboard_api::{Attempt, Submission, conditions, names};
use serde_json::{Map, json};
use tokio::net::TcpListener;
use tokio::time::{Instant, timeout_at};

use super::bridge::StandIn;
use super::objects::{Kind, create};
use crate::support::apiserver::server;
use messages::{Messages, PHASE, TAKEN};
use program::Program;

const BOARD: &str = "board";
/// So many Jobs at once: the others wait in line.
const SLOTS: usize = 5;
/// SQS has no events: its counts are asked for this often.
const ASK_EVERY: Duration = Duration::from_millis(250);
/// A process that goes on keeps the same memory but for this, in KiB: what an allocator holds of a burst.
const GROWTH: u64 = 8 << 10;
/// Requests in flight when the API server alone is measured.
const RAW_CLIENTS: usize = 16;

/// How much of everything.
struct Size {
    /// Submissions that EvalAI sends a message of.
    submissions: usize,
    duplicates: usize,
    garbage: usize,
    /// How often a program is killed.
    kills: usize,
    /// How long the messages of a killed bridge stay hidden, in seconds.
    visibility: u32,
    /// Submissions that are made by hand first, to know what the API server can do.
    raw: usize,
    /// True if the test waits until the controller has accepted all.
    accepts: bool,
    /// Longest time for the intake, and for what follows.
    limit: Duration,
}

const SMALL: Size = Size {
    submissions: 284,
    duplicates: 15,
    garbage: 8,
    kills: 6,
    visibility: 5,
    raw: 0,
    accepts: true,
    limit: Duration::from_mins(3),
};

/// 10,000 messages.
const FULL: Size = Size {
    submissions: 9400,
    duplicates: 500,
    garbage: 100,
    kills: 50,
    visibility: 30,
    raw: 1000,
    accepts: false,
    limit: Duration::from_mins(20),
};

#[tokio::test(flavor = "multi_thread")]
async fn messages_are_neither_lost_nor_doubled_while_the_programs_are_killed() {
    measure(&SMALL).await;
}

#[tokio::test(flavor = "multi_thread")]
#[ignore = "it measures for some minutes: make measure-intake"]
async fn ten_thousand_messages_while_the_programs_are_killed_fifty_times() {
    measure(&FULL).await;
}

async fn measure(size: &Size) {
    let mut world = World::start(size).await;
    if size.raw > 0 {
        println!("the API server alone: {:.0} Submissions/s", world.raw(size.raw).await);
    }
    let began = Instant::now();
    let mut programs = Programs::start(&world).await;
    let samples = world.take_in(size, &mut programs).await;
    let made = began.elapsed();
    world.drained(size).await;
    let emptied = began.elapsed();
    let memory = [samples[0], samples[1], programs.steady.memory()];
    println!(
        "{} messages: {} submissions, {} twice, {} of no use; {} kills; all made after {:.1} s ({:.0}/s), the queue empty after {:.1} s",
        world.messages.bodies.len(),
        size.submissions,
        size.duplicates,
        size.garbage,
        size.kills,
        made.as_secs_f64(),
        f64::from(u32::try_from(size.submissions).unwrap()) / made.as_secs_f64(),
        emptied.as_secs_f64(),
    );
    println!("memory of the bridge that is not killed at the begin, in the middle and at the end: {memory:?} KiB");
    if size.accepts {
        world.accepted(size, &mut programs).await;
    }
    world.check(size).await;
    programs.end().await;
    assert!(memory[2] <= memory[1] + GROWTH, "the bridge grows: {memory:?} KiB");
}

/// The operator, with two bridges: one is killed, the other shows what a long life costs.
struct Programs {
    controller: Program,
    bridge: Program,
    steady: Program,
}

impl Programs {
    async fn start(world: &World) -> Self {
        let start = async |program, name| Program::start(program, name, &world.namespace).await;
        Self {
            controller: start("controller", "controller-0").await,
            bridge: start("bridge", "bridge-0").await,
            steady: start("bridge", "bridge-1").await,
        }
    }

    /// Kills controller and bridge in turn.
    async fn kill(&mut self, number: usize) {
        let victim = if number.is_multiple_of(2) {
            &mut self.bridge
        } else {
            &mut self.controller
        };
        victim.kill().await;
        victim.start_again();
    }

    /// Starts programs again that have ended by themselves, if that is allowed.
    fn keep(&mut self) {
        for program in [&mut self.controller, &mut self.bridge, &mut self.steady] {
            program.keep();
        }
    }

    async fn end(mut self) {
        self.controller.kill().await;
        self.bridge.kill().await;
        self.steady.kill().await;
    }
}

/// Everything around the operator.
struct World {
    stand_in: StandIn,
    /// It ends with the runtime of the test.
    evalai: Handle,
    client: Client,
    namespace: String,
    queue: String,
    dead: String,
    messages: Messages,
    made: BTreeSet<String>,
    accepted: BTreeSet<String>,
    changes: BoxStream<'static, Submission>,
}

impl World {
    async fn start(size: &Size) -> Self {
        let stand_in = StandIn::start().await;
        let client = server().await.client();
        let namespace = server().await.namespace("intake").await;
        let (queue, dead) = (stand_in.queue("intake").await, stand_in.queue("intake-dead").await);
        stand_in.set_visibility(&queue, size.visibility).await;
        let (config, _) = Config::in_memory().unwrap();
        let config = Config { throttle: 0, ..config };
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let evalai = evalai_stand_in::serve(config, vec![listener]);
        evalai.set_knobs(Knobs {
            list_row_ms: 0,
            ..Knobs::default()
        });
        let api: Api<Submission> = Api::namespaced(client.clone(), &namespace);
        let changes = watcher(api, watcher::Config::default())
            .default_backoff()
            .applied_objects();
        let world = Self {
            messages: Messages::default(),
            stand_in,
            client,
            namespace,
            queue,
            dead,
            made: BTreeSet::new(),
            accepted: BTreeSet::new(),
            changes: changes.filter_map(async |event| event.ok()).boxed(),
            evalai,
        };
        world.with_messages(size).await
    }

    /// The Leaderboard first: what EvalAI has had before it is not its own.
    async fn with_messages(mut self, size: &Size) -> Self {
        self.make_board().await;
        let new = || NewSubmission {
            team: 1,
            phase: PHASE,
            user: 11,
            input: b"{}".to_vec(),
            fields: Map::new(),
        };
        let ids: Vec<u64> = self.evalai.with_state(|state| {
            let ids = (0..size.submissions).map(|_| push(state, new(), FileState::Stored, Timestamp::now()));
            ids.collect()
        });
        self.messages = Messages::of(&ids, size.duplicates, size.garbage);
        self.messages.send(&self.stand_in, &self.queue).await;
        self
    }

    async fn make_board(&self) {
        let bucket = self.stand_in.name("intake");
        let (aws, endpoint) = (&self.stand_in.aws, &self.stand_in.endpoint);
        let s3 = aws.s3(None, Some(endpoint));
        s3.create_bucket().bucket(&bucket).send().await.unwrap();
        let secrets: Api<k8s_openapi::api::core::v1::Secret> = Api::namespaced(self.client.clone(), &self.namespace);
        let secret = json!({
            "apiVersion": "v1", "kind": "Secret", "metadata": {"name": "evalai"}, "stringData": {"token": "local-host-token"},
        });
        let secret = serde_json::from_value(secret).unwrap();
        secrets.create(&PostParams::default(), &secret).await.unwrap();
        let board = json!({"spec": {
            "evalai": {
                "apiServer": self.evalai.url(), "challenge": 1, "requestsPerMinute": 6000,
                "token": {"secretKeyRef": {"name": "evalai", "key": "token"}},
            },
            "tracks": [{"name": "sensors", "phase": PHASE}],
            "agent": {"images": []},
            "storage": {"s3": {"bucket": bucket, "endpoint": endpoint}},
            "queue": {"sqs": {"url": self.queue, "deadLetterURL": self.dead, "endpoint": endpoint, "unknownAfterSeconds": 0}},
            "concurrency": {"total": SLOTS},
        }});
        let boards = Kind::Leaderboard.api(&self.client, &self.namespace);
        create(&boards, Kind::Leaderboard.object(BOARD, &[&board]), false)
            .await
            .unwrap();
        // A message with this id names an object of somebody else.
        let taken = Kind::Submission.object(
            &names::submission(TAKEN),
            &[&json!({"spec": {"leaderboardName": "nobodys"}})],
        );
        create(&Kind::Submission.api(&self.client, &self.namespace), taken, false)
            .await
            .unwrap();
    }

    /// How many Submissions a second the API server makes while nothing else runs.
    async fn raw(&self, count: usize) -> f64 {
        let namespace = server().await.namespace("intake-raw").await;
        let api = Kind::Submission.api(&self.client, &namespace);
        let began = Instant::now();
        let creates = (0..count).map(|id| {
            let spec = json!({"spec": {
                "leaderboardName": BOARD, "track": null, "evalai": {"challenge": 1, "phase": PHASE, "submission": id + 1},
            }});
            let object = Kind::Submission.object(&format!("submission-{id}"), &[&spec]);
            create(&api, object, false)
        });
        let made = futures::stream::iter(creates).buffer_unordered(RAW_CLIENTS);
        made.for_each(async |made| _ = made.unwrap()).await;
        f64::from(u32::try_from(count).unwrap()) / began.elapsed().as_secs_f64()
    }

    /// Follows the Submissions until all are made, and kills a program whenever so many more are. Hands back the memory of the
    /// bridge that goes on, at the first kill and in the middle.
    async fn take_in(&mut self, size: &Size, programs: &mut Programs) -> [u64; 2] {
        let end = Instant::now() + size.limit;
        let (mut kills, mut samples) = (0, [0; 2]);
        while self.made.len() < size.submissions {
            self.change(end, "all are made", programs).await;
            let due = (self.made.len() * (size.kills + 1) / size.submissions).min(size.kills);
            if kills < due {
                if kills == 0 {
                    samples[0] = programs.steady.memory();
                }
                programs.kill(kills).await;
                kills += 1;
            }
            if samples[1] == 0 && self.made.len() * 2 >= size.submissions {
                samples[1] = programs.steady.memory();
            }
        }
        assert_eq!(kills, size.kills);
        samples
    }

    /// Waits until each Submission is accepted: the controller that is left knows all of them.
    async fn accepted(&mut self, size: &Size, programs: &mut Programs) {
        let end = Instant::now() + size.limit;
        while self.accepted.len() < size.submissions {
            self.change(end, "all are accepted", programs).await;
        }
    }

    /// The next change of a Submission, if there is one soon.
    async fn change(&mut self, end: Instant, what: &str, programs: &mut Programs) {
        programs.keep();
        let (made, accepted) = (self.made.len(), self.accepted.len());
        assert!(
            Instant::now() < end,
            "not in time: {what}; {made} are made, {accepted} accepted; the controller's log:\n{}",
            programs.controller.log()
        );
        let Ok(Some(submission)) = timeout_at(Instant::now() + ASK_EVERY, self.changes.next()).await else {
            return;
        };
        let name = submission.name_any();
        if name == names::submission(TAKEN) {
            return;
        }
        let status = submission.status.as_ref();
        if status.is_some_and(|status| conditions::is_true(&status.conditions, conditions::ACCEPTED)) {
            self.accepted.insert(name.clone());
        }
        self.made.insert(name);
    }

    /// Waits until no message is left, visible or in flight.
    async fn drained(&self, size: &Size) {
        let end = Instant::now() + size.limit;
        loop {
            let depth = self.stand_in.depth(&self.queue).await;
            if depth == (0, 0) {
                return;
            }
            assert!(Instant::now() < end, "the queue still has {depth:?} messages");
            tokio::time::sleep(ASK_EVERY).await;
        }
    }

    async fn check(&self, size: &Size) {
        let submissions: Api<Submission> = Api::namespaced(self.client.clone(), &self.namespace);
        let all = submissions.list(&ListParams::default()).await.unwrap().items;
        let found: BTreeMap<String, Attempt> = all
            .iter()
            .map(|submission| (submission.name_any(), submission.spec.attempt))
            .filter(|(name, _)| *name != names::submission(TAKEN))
            .collect();
        let lost: Vec<_> = self.messages.names().filter(|name| !found.contains_key(name)).collect();
        let doubled: Vec<_> = found
            .iter()
            .filter(|(_, attempt)| **attempt != Attempt::FIRST)
            .collect();
        let jobs: Api<Job> = Api::namespaced(self.client.clone(), &self.namespace);
        let jobs = jobs.list(&ListParams::default()).await.unwrap().items;
        let owners: BTreeSet<String> = jobs
            .iter()
            .flat_map(|job| job.owner_references().iter().map(|owner| owner.uid.clone()))
            .collect();
        let letters = letters::take_all(&self.stand_in, &self.dead).await;
        println!(
            "lost: {}; doubled: {}; Jobs: {} of {} submissions; dead-lettered: {:?}, {} of them twice",
            lost.len(),
            doubled.len(),
            jobs.len(),
            owners.len(),
            letters::by_reason(&letters),
            letters::copies(&letters),
        );
        assert!(lost.is_empty(), "lost: {lost:?}");
        assert!(doubled.is_empty(), "begun twice: {doubled:?}");
        assert_eq!(found.len(), size.submissions, "nothing else is made");
        assert_eq!((jobs.len(), owners.len()), (SLOTS, SLOTS), "one Job for each slot");
        assert_eq!(letters::reasons(&letters), self.messages.garbage);
    }
}
