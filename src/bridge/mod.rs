//! Turns EvalAI's messages into Submissions: watches the Leaderboards and reads each queue that they name.
//!
//! Started by `leaderboard-operator bridge`. Several replicas may run at once: `ingest` is safe twice and SQS hands
//! a message to one of them. `route` holds the policy, `ingest` is also the controller's, for its sweep.

mod health;
pub mod ingest;
pub mod message;
mod poller;
pub mod queue;
pub mod route;
mod world;

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use kube::Client;
use kube::runtime::events::{Recorder, Reporter};
use tokio::sync::watch;
use tokio::task::JoinHandle;
use tokio::time::Instant;

pub use health::{Health, Readiness};

use crate::observability::tasks::{TaskFailed, Tasks};
use crate::services::aws::Aws;
use poller::Poller;
use world::World;

/// How long messages in hand may take to be finished when the program stops.
const DRAIN: Duration = Duration::from_secs(20);
/// An answer of the API server that is younger than this is taken for granted.
const PULSE_AGE: Duration = Duration::from_secs(5);
/// How soon the API server must answer before messages are received.
const PULSE_LIMIT: Duration = Duration::from_secs(5);

/// What the bridge counts. All texts come from small closed sets.
pub trait Observer: Send + Sync + 'static {
    /// So many messages met this fate: `created`, `bumped`, `repeat`, `dead_letter`, `unknown`, `foreign`, `deleting`,
    /// `refused`, `blocked`, `retried`.
    fn messages(&self, _fate: &'static str, _count: u64) {}
    /// A call of an AWS service ended: `ok` or a kind of failure.
    fn call(&self, _service: &'static str, _operation: &'static str, _outcome: &'static str) {}
    /// The watch of Leaderboards failed once.
    fn watch_failed(&self) {}
    /// The watch of Leaderboards brought something.
    fn watch_moved(&self) {}
}

/// Counts nothing.
impl Observer for () {}

/// What `run` needs beside its clients.
#[derive(Clone)]
pub struct Settings {
    /// The one namespace whose Leaderboards are served; None: all.
    pub namespace: Option<String>,
    /// Is told what is missing.
    pub health: Arc<Health>,
    /// Counts.
    pub observer: Arc<dyn Observer>,
}

/// What all pollers share.
struct Shared {
    client: Client,
    aws: Aws,
    settings: Settings,
    recorder: Recorder,
    last_pulse: Mutex<Option<Instant>>,
}

impl Shared {
    /// Makes sure that the API server answers: a message received in vain is a step towards its dead letter.
    async fn check_pulse(&self) -> Result<(), String> {
        let last = *self.last_pulse.lock().unwrap_or_else(PoisonError::into_inner);
        if last.is_some_and(|at| at.elapsed() < PULSE_AGE) {
            return Ok(());
        }
        let api = world::api(self.client.clone(), self.settings.namespace.as_deref());
        let first = kube::api::ListParams::default().limit(1);
        match tokio::time::timeout(PULSE_LIMIT, api.list_metadata(&first)).await {
            Ok(Ok(_)) => {
                *self.last_pulse.lock().unwrap_or_else(PoisonError::into_inner) = Some(Instant::now());
                Ok(())
            }
            Ok(Err(error)) => Err(world::chain(&error)),
            Err(_) => Err(format!("no answer within {} s", PULSE_LIMIT.as_secs())),
        }
    }
}

/// A poller that runs.
struct Running {
    connection: Connection,
    stop: watch::Sender<bool>,
}

/// How to reach a queue.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Connection {
    region: Option<String>,
    endpoint: Option<String>,
}

/// Runs the bridge until the stop of `tasks`; then finishes what is in hand, within 20 s.
///
/// # Errors
/// If one of its tasks has ended before.
pub async fn run(client: Client, aws: Aws, tasks: Tasks, settings: Settings) -> Result<(), TaskFailed> {
    let (sender, mut world) = watch::channel(World::default());
    let api = world::api(client.clone(), settings.namespace.as_deref());
    let (health, observer) = (settings.health.clone(), settings.observer.clone());
    let watch_task = tasks.stay("watch of leaderboards", world::follow(api, sender, health, observer));
    let reporter = Reporter {
        controller: "leaderboard.carla.org/bridge".to_owned(),
        instance: std::env::var("POD_NAME").ok(),
    };
    let shared = Arc::new(Shared {
        recorder: Recorder::new(client.clone(), reporter),
        client,
        aws,
        settings,
        last_pulse: Mutex::default(),
    });
    let mut pollers = Pollers {
        shared,
        world: world.clone(),
        running: BTreeMap::new(),
        tasks: tasks.clone(),
        started: Vec::new(),
    };
    loop {
        tokio::select! {
            biased;
            failed = tasks.failed() => return Err(failed),
            () = tasks.stop().wait() => break,
            () = changed(&mut world) => {}
        }
        let wished = wished(&world.borrow_and_update());
        pollers.adjust(&wished);
    }
    pollers.drain().await;
    watch_task.abort();
    Ok(())
}

/// Waits for another world. The watch's task holds the sender: when that is gone, the task has failed.
async fn changed(world: &mut watch::Receiver<World>) {
    if world.changed().await.is_err() {
        std::future::pending::<()>().await;
    }
}

/// The queues that Leaderboards name, each reached as the oldest of them says.
fn wished(world: &World) -> BTreeMap<String, Connection> {
    let leaderboards = world.leaderboards();
    let urls: std::collections::BTreeSet<&String> = leaderboards
        .iter()
        .filter_map(|lb| route::queue_of(lb))
        .map(|queue| &queue.url)
        .collect();
    let mut wished = BTreeMap::new();
    for url in urls {
        let readers = route::readers(url, &leaderboards);
        if let Some(queue) = readers.first().and_then(|lb| route::queue_of(lb)) {
            let (region, endpoint) = (queue.region.clone(), queue.endpoint.clone());
            wished.insert(url.clone(), Connection { region, endpoint });
        }
    }
    wished
}

/// The pollers, one for each queue.
struct Pollers {
    shared: Arc<Shared>,
    world: watch::Receiver<World>,
    running: BTreeMap<String, Running>,
    tasks: Tasks,
    /// All that have begun, those whose queue is no longer read until they have finished what is in hand.
    started: Vec<JoinHandle<Option<()>>>,
}

impl Pollers {
    /// Stops what is no longer wished for, starts what is missing.
    fn adjust(&mut self, wished: &BTreeMap<String, Connection>) {
        let health = self.shared.settings.health.clone();
        self.running.retain(|url, running| {
            let keep = wished.get(url) == Some(&running.connection);
            if !keep {
                tracing::info!(queue = url, "the queue is no longer read in this way");
                running.stop.send_replace(true);
                health.forget(url);
            }
            keep
        });
        for (url, connection) in wished {
            if !self.running.contains_key(url) {
                self.start(url, connection);
            }
        }
        self.started.retain(|task| !task.is_finished());
    }

    fn start(&mut self, url: &str, connection: &Connection) {
        tracing::info!(queue = url, "the queue is read");
        let (stop, stopped) = watch::channel(false);
        let sqs = self
            .shared
            .aws
            .sqs(connection.region.as_deref(), connection.endpoint.as_deref());
        let poller = Poller::new(url.to_owned(), sqs, self.shared.clone(), self.world.clone(), stopped);
        let running = Running {
            connection: connection.clone(),
            stop,
        };
        // It may end before the process does: its queue may be taken out of the Leaderboards.
        let task = self.tasks.may_end(format!("queue {url}"), poller.run());
        self.started.push(task);
        self.running.insert(url.to_owned(), running);
    }

    /// Lets each poller finish what it has in hand.
    async fn drain(self) {
        for running in self.running.values() {
            running.stop.send_replace(true);
        }
        let all = futures::future::join_all(self.started);
        if tokio::time::timeout(DRAIN, all).await.is_err() {
            tracing::warn!("messages in hand were not finished in time and will come back");
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    type Handle = tower_test::mock::Handle<http::Request<kube::client::Body>, http::Response<kube::client::Body>>;

    async fn shared() -> (Shared, Handle) {
        let (service, handle) = tower_test::mock::pair();
        let client = Client::new(service, "ns");
        let settings = Settings {
            namespace: None,
            health: Arc::default(),
            observer: Arc::new(()),
        };
        let reporter = Reporter {
            controller: "test".into(),
            instance: None,
        };
        let shared = Shared {
            recorder: Recorder::new(client.clone(), reporter),
            client,
            aws: Aws::load().await,
            settings,
            last_pulse: Mutex::default(),
        };
        (shared, handle)
    }

    #[tokio::test(start_paused = true)]
    async fn an_answer_of_the_api_server_counts_for_five_seconds() {
        let (shared, mut handle) = shared().await;
        let server = tokio::spawn(async move {
            for _ in 0..2 {
                let (request, send) = handle.next_request().await.unwrap();
                assert_eq!(request.uri().query(), Some("&limit=1"));
                let body =
                    br#"{"kind":"PartialObjectMetadataList","apiVersion":"meta.k8s.io/v1","metadata":{},"items":[]}"#;
                send.send_response(http::Response::new(body.to_vec().into()));
            }
            handle
        });
        assert_eq!(shared.check_pulse().await, Ok(()));
        assert_eq!(shared.check_pulse().await, Ok(()), "without a request");
        tokio::time::advance(PULSE_AGE).await;
        assert_eq!(shared.check_pulse().await, Ok(()));
        server.await.unwrap();
    }

    #[tokio::test(start_paused = true)]
    async fn a_silent_api_server_keeps_the_queue_unread() {
        let (shared, _handle) = shared().await;
        let begun = Instant::now();
        assert_eq!(shared.check_pulse().await, Err("no answer within 5 s".to_owned()));
        assert_eq!(begun.elapsed(), PULSE_LIMIT);
    }

    /// Lists one Leaderboard to the watch; answers nothing else, so that no queue is asked.
    async fn list_one(mut handle: Handle) {
        let board = crate::bridge::route::tests::board("a", 1);
        let board = crate::bridge::route::tests::with_queue(board, QUEUE);
        let list = serde_json::json!({"apiVersion": "v1", "kind": "List", "metadata": {"resourceVersion": "1"},
            "items": [&*board]});
        let mut held = Vec::new();
        while let Some((request, send)) = handle.next_request().await {
            if request.uri().query().is_some_and(|query| query.contains("limit=500")) {
                send.send_response(http::Response::new(list.to_string().into_bytes().into()));
            } else {
                held.push(send);
            }
        }
    }

    const QUEUE: &str = "https://q/1";

    #[tokio::test(start_paused = true)]
    async fn the_end_of_a_task_ends_the_bridge_by_its_name() {
        for name in ["watch of leaderboards", "queue https://q/1"] {
            let (service, handle) = tower_test::mock::pair();
            tokio::spawn(list_one(handle));
            let (_stop, signal) = crate::observability::shutdown::Stop::new();
            let tasks = Tasks::new(signal);
            let settings = Settings {
                namespace: None,
                health: Arc::default(),
                observer: Arc::new(()),
            };
            let aws = Aws::load().await;
            let bridge = tokio::spawn(run(Client::new(service, "ns"), aws, tasks.clone(), settings));
            // Tasks have no event for their start.
            while !tasks.names().iter().any(|known| known == name) {
                tokio::time::sleep(Duration::from_millis(10)).await;
            }
            tasks.end(name);
            let ended = tokio::time::timeout(Duration::from_mins(1), bridge).await;
            let result = ended.unwrap_or_else(|_| panic!("the bridge goes on without {name}"));
            assert_eq!(result.unwrap().unwrap_err().task, name);
        }
    }
}
