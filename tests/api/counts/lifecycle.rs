//! One submission's whole life with a controller on a thread of its own, whose allocations are counted there.

use std::thread::JoinHandle;
use std::time::Duration;

use allocation_counter::AllocationInfo;
use evalai_stand_in::model::FileState;
use evalai_stand_in::submissions::{NewSubmission, create as push};
use evalai_stand_in::{Config, Handle};
use jiff::Timestamp;
use k8s_openapi::api::core::v1::Secret;
use kube::api::{Api, PostParams};
use kube::core::NamespaceResourceScope;
use kube::runtime::wait::await_condition;
use kube::{Client, Resource};
use leaderboard_api::{Leaderboard, State, Submission, SubmissionStatus, conditions, names};
use leaderboard_base::shutdown::Stop;
use leaderboard_operator::observability::Observability;
use leaderboard_operator::observability::traces::Traces;
use serde_json::{Map, Value, json};
use tokio::net::TcpListener;
use tokio::sync::oneshot;
use tokio::time::{Instant, sleep, timeout};
use tracing::Dispatch;

use super::super::boards::make_table;
use super::super::bridge::StandIn;
use super::super::objects::{Kind, create};
use super::super::operator;
use super::Cost;
use crate::support::apiserver::{Request, server};
use crate::support::ministack;
use crate::support::player::{Cluster, Player, ROUTES, reports};

const BOARD: &str = "carla";
/// Far longer than anything here takes.
const LIMIT: Duration = Duration::from_mins(3);
/// A controller that has written nothing for so long has nothing more to write. No event announces that.
const QUIET: Duration = Duration::from_secs(7);
/// The audit log of the API server is read this often.
const LOOK: Duration = Duration::from_millis(200);
/// The process's own requests.
const OF_THE_PROCESS: [&str; 1] = ["leases"];
const OF_THE_LEADERBOARD: &str = "leaderboards/status";
const READS: [&str; 2] = ["get", "list"];
/// No report comes before the last one: how many there are would depend on the machine.
const NO_REPORT: Duration = Duration::from_hours(1);
const BATCH: &str = "Batch";
const PREDICTIONS: &str = "Predictions";
/// So often a controller comes to rest in a submission's life.
const STAGES: usize = 3;

/// A kind of Leaderboard.
#[derive(Clone, Copy)]
pub struct Scenario {
    pub name: &'static str,
    has_evalai: bool,
    has_limits: bool,
    /// Mode of the host's container that evaluates it, in place of CARLA.
    mode: Option<&'static str>,
}

impl Scenario {
    pub const ALL: [Self; 7] = [
        Self::of("local", false, false),
        Self::of("local, limited", false, true),
        Self::of("EvalAI and table", true, false),
        Self::of("EvalAI and table, limited", true, true),
        Self::EVALUATED[0],
        Self::EVALUATED[1],
        Self::EVALUATED[2],
    ];

    /// One that EvalAI and a table get.
    pub const PUBLISHED: Self = Self::ALL[2];

    /// Published ones with a host's own evaluator, in each of its modes.
    pub const EVALUATED: [Self; 3] = [
        Self::by_container("EvalAI and table, a host's evaluator", "Interactive"),
        Self::by_container("EvalAI and table, an agent before the evaluator", BATCH),
        Self::by_container("EvalAI and table, an uploaded file", PREDICTIONS),
    ];

    const fn of(name: &'static str, has_evalai: bool, has_limits: bool) -> Self {
        Self {
            name,
            has_evalai,
            has_limits,
            mode: None,
        }
    }

    const fn by_container(name: &'static str, mode: &'static str) -> Self {
        Self {
            mode: Some(mode),
            ..Self::of(name, true, false)
        }
    }

    /// Cost of a submission, without the allocations of an idle controller.
    pub async fn cost(self) -> Cost {
        let (idle, one) = tokio::join!(self.run(false), self.run(true));
        Cost {
            allocations: one.allocations.saturating_sub(idle.allocations),
            allocated_kilobytes: one.allocated_kilobytes.saturating_sub(idle.allocated_kilobytes),
            ..one
        }
    }

    async fn run(self, has_submission: bool) -> Cost {
        let world = World::new(self).await;
        let controller = Controller::start(&world, Watched::default()).await;
        world.ready().await;
        controller.quiet().await;
        let before = (
            controller.requests().await.len(),
            controller.reconciles(),
            world.s3.counts().requests,
            world.evalai_requests(),
            world.table.counts().requests,
        );
        if has_submission {
            world.live(&controller).await;
        } else {
            // As long as a life takes: the process's own work is not the submission's.
            for _ in 0..STAGES {
                controller.quiet().await;
            }
        }
        let requests = controller.requests().await.split_off(before.0);
        let reconciles = controller.reconciles() - before.1;
        let s3_requests = world.s3.counts().requests - before.2;
        let evalai_requests = world.evalai_requests() - before.3;
        let table_requests = world.table.counts().requests - before.4;
        let memory = controller.end().await;
        let mut cost = Cost {
            s3_requests,
            evalai_requests,
            table_requests,
            reconciles,
            allocations: memory.count_total,
            allocated_kilobytes: memory.bytes_total >> 10,
            ..Cost::default()
        };
        for request in requests {
            let of = if is_read(&request) {
                &mut cost.reads
            } else if request.resource() == OF_THE_LEADERBOARD {
                // However many submissions there are, they share one in some seconds.
                &mut cost.leaderboard_writes
            } else {
                &mut cost.writes
            };
            *of.entry(format!("{} {}", request.verb, request.resource()))
                .or_insert(0) += 1;
        }
        cost
    }
}

/// Where a controller's spans and log lines go.
#[derive(Clone, Default)]
pub struct Watched {
    pub traces: Traces,
    pub log: Option<Dispatch>,
}

/// The surroundings of a controller.
pub struct World {
    pub client: Client,
    pub namespace: String,
    aws: StandIn,
    /// Between the controller and S3.
    pub(super) s3: ministack::Proxy,
    /// Between the controller and DynamoDB.
    table: ministack::Proxy,
    evalai: Option<Handle>,
    bucket: String,
}

impl World {
    pub async fn new(scenario: Scenario) -> Self {
        // No look at the report in between: how many there are would depend on the machine.
        Self::reading_every(60, scenario).await
    }

    /// One whose reports are read once in so many seconds.
    pub(super) async fn reading_every(seconds: u32, scenario: Scenario) -> Self {
        let _ = rustls::crypto::ring::default_provider().install_default();
        let aws = StandIn::start().await;
        let client = server().await.client();
        let namespace = server().await.namespace("counts").await;
        let (config, _) = Config::in_memory().unwrap();
        let evalai = if scenario.has_evalai {
            let config = of_mode(config, scenario.mode);
            let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
            let config = Config { throttle: 0, ..config };
            Some(evalai_stand_in::serve(config, vec![listener]))
        } else {
            None
        };
        let bucket = aws.name("counts");
        let s3 = aws.aws.s3(None, Some(&aws.endpoint));
        s3.create_bucket().bucket(&bucket).send().await.unwrap();
        let world = Self {
            s3: ministack::server().await.proxy().await,
            table: ministack::server().await.proxy().await,
            client,
            namespace,
            aws,
            evalai,
            bucket,
        };
        world.make_board(scenario, seconds).await;
        world
    }

    async fn make_board(&self, scenario: Scenario, period: u32) {
        let mut spec = json!({
            "storage": {"s3": {"bucket": self.bucket, "endpoint": self.s3.endpoint()}},
            "syncPeriodSeconds": period,
            "evaluation": {"carla": {"pairs": 1, "routes": ROUTES}},
        });
        if scenario.has_limits {
            spec["concurrency"] = json!({"total": 2, "perTeam": 1});
        }
        if let Some(evalai) = &self.evalai {
            let secret = json!({"metadata": {"name": "evalai"}, "stringData": {"token": "local-host-token"}});
            let secret: Secret = serde_json::from_value(secret).unwrap();
            let secrets = self.api::<Secret>();
            secrets.create(&PostParams::default(), &secret).await.unwrap();
            spec["evalai"] = json!({
                "apiServer": evalai.url(), "challenge": 1, "requestsPerMinute": 6000,
                "token": {"secretKeyRef": {"name": "evalai", "key": "token"}},
            });
            spec["agent"] = json!({"images": []});
            spec["tracks"] = json!([{"name": "sensors", "phase": 1}]);
            let table = self.aws.name("counts");
            make_table(&self.aws, &table).await;
            spec["table"] = json!({"dynamoDB": {"name": table, "endpoint": self.table.endpoint()}});
        }
        if let Some(mode) = scenario.mode {
            let container = json!({"mode": mode, "image": "evaluator:1", "command": ["evaluate"]});
            spec["evaluation"] = json!({"carla": null, "container": container});
            if mode != PREDICTIONS {
                spec["agent"]["command"] = json!(["play"]);
            }
            spec["tracks"][0]["container"] = json!({"score": {"metric": "Driving score"}});
        }
        let api = Kind::Leaderboard.api(&self.client, &self.namespace);
        let board = Kind::Leaderboard.object(BOARD, &[&json!({ "spec": spec })]);
        create(&api, board, false).await.unwrap();
    }

    pub(super) fn api<K>(&self) -> Api<K>
    where
        K: Resource<Scope = NamespaceResourceScope, DynamicType = ()>,
    {
        Api::namespaced(self.client.clone(), &self.namespace)
    }

    pub async fn ready(&self) {
        let ready = |found: Option<&Leaderboard>| {
            let status = found.and_then(|board| board.status.as_ref());
            status.is_some_and(|status| conditions::is_true(&status.conditions, conditions::READY))
        };
        let reached = timeout(LIMIT, await_condition(self.api(), BOARD, ready)).await;
        reached.expect("the Leaderboard is ready").unwrap();
    }

    /// A submission from its creation until every system has its end. The controller comes to rest in between: with a Job, with a running
    /// Pod, and with an end. So the result does not depend on the machine's speed.
    pub async fn live(&self, controller: &Controller) {
        self.submit("one").await;
        self.until("one", "it has a Job", has_job).await;
        controller.quiet().await;
        let player = self.play();
        self.until("one", "it runs", is_running).await;
        controller.quiet().await;
        player.fall_the_curtain();
        self.until("one", "every system has its end", is_settled).await;
        controller.quiet().await;
    }

    /// Requests to EvalAI about submissions, lists left out.
    fn evalai_requests(&self) -> u64 {
        let all = self.evalai.as_ref().map(Handle::requests).unwrap_or_default();
        let of_one = |path: &str| path.contains("/submission/") || path.contains("update_submission");
        all.iter().map(|entry| u64::from(of_one(&entry.path))).sum()
    }

    /// Creates a Submission.
    pub(super) async fn submit(&self, name: &str) {
        let mut spec = json!({"leaderboardName": BOARD});
        let mut metadata = json!({});
        if let Some(evalai) = &self.evalai {
            let new = NewSubmission {
                team: 1,
                phase: 1,
                user: 11,
                input: br#"{"submitted_image_uri": "registry.example/team-a:1"}"#.to_vec(),
                fields: Map::new(),
            };
            let pk = evalai.with_state(|state| push(state, new, FileState::Stored, Timestamp::now()));
            spec["evalai"] = json!({"challenge": 1, "phase": 1, "submission": pk});
            spec["track"] = Value::Null;
            if evalai.with_state(|state| !state.seed.challenges[0].is_docker_based) {
                spec["image"] = Value::Null;
            }
            // As the bridge creates it.
            metadata["finalizers"] = json!([names::FINALIZER_SUBMISSION]);
        }
        let api = Kind::Submission.api(&self.client, &self.namespace);
        let submission = Kind::Submission.object(name, &[&json!({ "metadata": metadata, "spec": spec })]);
        create(&api, submission, false).await.unwrap();
    }

    /// Plays the rest of the cluster. No report comes before the last one.
    pub(super) fn play(&self) -> Player {
        let s3 = self.aws.aws.s3(None, Some(&self.aws.endpoint));
        let cluster = Cluster::new(&self.client, &self.namespace);
        Player::start(cluster, reports(NO_REPORT, s3, &self.bucket))
    }

    pub(super) async fn until(&self, name: &str, what: &str, holds: impl Fn(&Submission) -> bool) {
        let holds = |found: Option<&Submission>| found.is_some_and(&holds);
        let reached = timeout(LIMIT, await_condition(self.api(), name, holds)).await;
        reached
            .unwrap_or_else(|_| panic!("{name}: not after {LIMIT:?}: {what}"))
            .unwrap();
    }
}

/// EvalAI whose challenge takes what the mode evaluates.
fn of_mode(mut config: Config, mode: Option<&str>) -> Config {
    let challenge = &mut config.seed.challenges[0];
    challenge.is_docker_based = mode != Some(PREDICTIONS);
    challenge.is_static_dataset_code_upload = mode == Some(BATCH);
    config
}

/// The Job is made.
pub(super) fn has_job(submission: &Submission) -> bool {
    submission.status.as_ref().is_some_and(|s| s.job_name.is_some())
}

/// It runs, and the image of its agents, if it has any, is pinned with the same write.
pub(super) fn is_running(submission: &Submission) -> bool {
    let status = submission.status.as_ref();
    let is_known = |s: &SubmissionStatus| s.image.is_some() || s.input.is_some();
    status.is_some_and(|s| s.state_of_conditions() == State::Running && is_known(s))
}

pub(super) fn is_read(request: &Request) -> bool {
    READS.contains(&request.verb.as_str())
}

fn is_settled(submission: &Submission) -> bool {
    submission.status.as_ref().is_some_and(super::super::world::is_settled)
}

/// A controller on a thread of its own.
pub struct Controller {
    user: String,
    telemetry: Observability,
    measured: oneshot::Sender<()>,
    thread: JoinHandle<AllocationInfo>,
}

impl Controller {
    pub async fn start(world: &World, watched: Watched) -> Self {
        let (config, user) = server().await.counted();
        let (stop, signal) = Stop::new();
        let telemetry = Observability {
            traces: watched.traces,
            ..Observability::new(signal)
        };
        let (measured, until) = oneshot::channel::<()>();
        let (namespace, endpoint, of_thread) = (world.namespace.clone(), world.aws.endpoint.clone(), telemetry.clone());
        let log = watched.log.unwrap_or_else(Dispatch::none);
        let thread = std::thread::spawn(move || {
            let _log = tracing::dispatcher::set_default(&log);
            let mut running = None;
            let memory = allocation_counter::measure(|| {
                let runtime = tokio::runtime::Builder::new_current_thread()
                    .enable_all()
                    .build()
                    .unwrap();
                let task = runtime.spawn(async move {
                    let aws = ministack::aws(&endpoint).await;
                    Box::pin(operator::run(&namespace, aws, config, of_thread)).await
                });
                // Its end is no part of a submission's life.
                let _ = runtime.block_on(until);
                running = Some((runtime, task));
            });
            let (runtime, task) = running.unwrap();
            stop.send_replace(true);
            runtime.block_on(task).unwrap().unwrap();
            memory
        });
        Self {
            user,
            telemetry,
            measured,
            thread,
        }
    }

    /// Requests of the controller to the API server, without watches and without the process's own.
    pub(super) async fn requests(&self) -> Vec<Request> {
        let all = server().await.requests(&self.user).into_iter();
        let counts =
            |request: &Request| request.verb != "watch" && !OF_THE_PROCESS.contains(&request.resource().as_str());
        all.filter(counts).collect()
    }

    pub(super) fn reconciles(&self) -> u64 {
        let text = self.telemetry.metrics.text().unwrap();
        let lines = text
            .lines()
            .filter(|line| line.starts_with("leaderboard_reconciles_total{"));
        let numbers = lines.filter_map(|line| line.rsplit(' ').next()?.parse::<u64>().ok());
        numbers.sum()
    }

    async fn writes(&self) -> usize {
        let all = self.requests().await;
        all.iter().filter(|request| !is_read(request)).count()
    }

    /// Waits until it has nothing more to write.
    pub async fn quiet(&self) {
        let quiet = async {
            let mut known = self.writes().await;
            let mut since = Instant::now();
            while since.elapsed() < QUIET {
                sleep(LOOK).await;
                let now = self.writes().await;
                if now != known {
                    (known, since) = (now, Instant::now());
                }
            }
        };
        timeout(LIMIT, quiet).await.expect("the controller comes to rest");
    }

    /// Ends it, and gives what it has allocated until now.
    pub async fn end(self) -> AllocationInfo {
        self.measured.send(()).expect("the controller had ended by itself");
        let ended = tokio::task::spawn_blocking(|| self.thread.join().unwrap());
        timeout(LIMIT, ended)
            .await
            .expect("it ends at the stop signal")
            .unwrap()
    }
}
