//! The pipeline that a host moves away from: an EventBridge Pipe, a Step Function and a Job's scripts, as far as others see them.
//!
//! Its Pipe deletes each message that it receives, also one that its filter does not match. A submission that it takes gets its row as
//! `SUBMITTED`, and `RUNNING` once its Job runs. EvalAI shows `submitted` until the first partial results, however long a node takes to
//! come. Results are stored as the run goes on, in the places and formats of the original. Runs under way go on when the Pipe stops. No
//! route ends before the test lets it: see [`OldPipeline::drive`].

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use aws_sdk_dynamodb::types::AttributeValue;
use challenge_stand_in::checkpoint::Checkpoint;
use challenge_stand_in::flags::Format;
use challenge_stand_in::scenario::{Leg, Scenario};
use challenge_stand_in::statistics;
use leaderboard_results::{Files, Plan, metrics, offline};
use serde_json::{Value, json};
use tokio::sync::watch;
use tokio::task::{JoinHandle, JoinSet};
use tokio::time::timeout;

use super::aws::{BUCKET, Cloud};
use super::evalai::{Evalai, HOST_TOKEN};
use super::scene::Scene;

/// Pairs of simulator and agent of each run.
pub const PAIRS: usize = 2;
/// Routes of each pair.
pub const ROUTES_A_PAIR: usize = 2;
/// The only challenge.
const CHALLENGE: u64 = 1;
/// A Pipe asks for messages without end; this long at a time, so that it can be stopped.
const RECEIVE_SECONDS: i32 = 1;
const SCENARIO: &str = include_str!("../../local/challenge/contents/leaderboard/data/scenario.json");

/// How far a submission has come.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Stage {
    /// Its message has not been taken.
    Unknown,
    /// Its row has `SUBMITTED`.
    Accepted,
    /// The results of so many routes of each pair are stored and in EvalAI.
    Driven(usize),
    /// EvalAI and the row show its end.
    Ended,
}

/// The routes that its agents may drive, and if they then crash.
#[derive(Clone, Copy, Debug, Default)]
struct Allowed {
    routes: usize,
    crash: bool,
}

struct Run {
    allowed: watch::Sender<Allowed>,
    stage: watch::Sender<Stage>,
}

/// The running pipeline. It ends when this is dropped.
pub struct OldPipeline {
    shared: Arc<Shared>,
    pipe: Mutex<Option<(watch::Sender<bool>, JoinHandle<()>)>>,
}

struct Shared {
    cloud: Cloud,
    http: reqwest::Client,
    evalai: String,
    runs: Mutex<BTreeMap<u64, Arc<Run>>>,
    taken: Mutex<Vec<u64>>,
    deleted: watch::Sender<Vec<u64>>,
    executions: Mutex<JoinSet<()>>,
}

impl OldPipeline {
    /// The one of a scene, without a Pipe. It has the operator's token: there is only one.
    pub fn new(scene: &Scene, evalai: &Evalai) -> Self {
        let shared = Shared {
            cloud: scene.cloud.clone(),
            http: reqwest::Client::builder().no_proxy().build().unwrap(),
            evalai: evalai.url.clone(),
            runs: Mutex::default(),
            taken: Mutex::default(),
            deleted: watch::Sender::new(Vec::new()),
            executions: Mutex::default(),
        };
        Self {
            shared: Arc::new(shared),
            pipe: Mutex::new(None),
        }
    }

    /// Starts the Pipe with a filter of these phases.
    pub fn start_pipe(&self, phases: &[u64]) {
        let (stop, stopped) = watch::channel(false);
        let pipe = tokio::spawn(Arc::clone(&self.shared).pipe(phases.to_vec(), stopped));
        let earlier = self.pipe.lock().unwrap().replace((stop, pipe));
        assert!(earlier.is_none(), "the Pipe runs already");
    }

    /// Stops the Pipe, and waits until it has handled its received messages. Its runs go on.
    pub async fn stop_pipe(&self) {
        let running = self.pipe.lock().unwrap().take();
        let (stop, pipe) = running.expect("the Pipe does not run");
        stop.send_replace(true);
        pipe.await.unwrap();
    }

    /// The submissions that it has begun to run, in this order; one that it has begun twice is there twice.
    pub fn taken(&self) -> Vec<u64> {
        self.shared.taken.lock().unwrap().clone()
    }

    /// Waits until the Pipe has deleted the message of a submission that its filter does not match.
    pub async fn await_deleted(&self, pk: u64, limit: Duration) {
        let mut deleted = self.shared.deleted.subscribe();
        let seen = timeout(limit, deleted.wait_for(|all| all.contains(&pk))).await;
        assert!(seen.is_ok(), "the Pipe has not deleted the message of submission {pk}");
    }

    /// Lets the agents of a submission drive so many routes each. After all of them it finishes.
    pub fn drive(&self, pk: u64, routes: usize) {
        self.shared
            .run(pk)
            .allowed
            .send_modify(|allowed| allowed.routes = routes);
    }

    /// Lets its second agent crash for good, in the route that comes next.
    pub fn crash(&self, pk: u64) {
        self.shared.run(pk).allowed.send_modify(|allowed| allowed.crash = true);
    }

    /// Waits until a submission has come so far.
    pub async fn reached(&self, pk: u64, wanted: Stage, limit: Duration) {
        let mut stage = self.shared.run(pk).stage.subscribe();
        let reached = timeout(limit, stage.wait_for(|stage| *stage >= wanted)).await.is_ok();
        let found = *stage.borrow();
        assert!(
            reached,
            "the old pipeline has submission {pk} at {found:?}, not at {wanted:?}"
        );
    }
}

impl Drop for OldPipeline {
    fn drop(&mut self) {
        if let Some((_, pipe)) = self.pipe.lock().unwrap().take() {
            pipe.abort();
        }
        self.shared.executions.lock().unwrap().abort_all();
    }
}

/// The parts of EvalAI's row that the rest of an execution needs.
struct Submitted {
    pk: u64,
    phase: u64,
    team: String,
    team_name: String,
    image: String,
    time: String,
}

impl Shared {
    fn run(&self, pk: u64) -> Arc<Run> {
        let mut runs = self.runs.lock().unwrap();
        let new = || {
            Arc::new(Run {
                allowed: watch::Sender::new(Allowed::default()),
                stage: watch::Sender::new(Stage::Unknown),
            })
        };
        Arc::clone(runs.entry(pk).or_insert_with(new))
    }

    async fn pipe(self: Arc<Self>, phases: Vec<u64>, stopped: watch::Receiver<bool>) {
        let (sqs, queue) = (&self.cloud.sqs, &self.cloud.queue_url);
        while !*stopped.borrow() {
            let receive = sqs.receive_message().queue_url(queue).max_number_of_messages(10);
            let answer = receive.wait_time_seconds(RECEIVE_SECONDS).send().await.unwrap();
            for message in answer.messages.unwrap_or_default() {
                let body: Value = serde_json::from_str(&message.body.unwrap_or_default()).unwrap();
                let pk = number(&body["submission_pk"]);
                if phases.contains(&number(&body["phase_pk"])) {
                    self.taken.lock().unwrap().push(pk);
                    let execution = Arc::clone(&self).execute(pk, body["submitted_image_uri"].clone());
                    self.executions.lock().unwrap().spawn(execution);
                } else {
                    self.deleted.send_modify(|all| all.push(pk));
                }
                let delete = sqs.delete_message().queue_url(queue);
                delete
                    .receipt_handle(message.receipt_handle.unwrap())
                    .send()
                    .await
                    .unwrap();
            }
        }
    }

    /// The Step Function and the Job of one submission.
    async fn execute(self: Arc<Self>, pk: u64, image: Value) {
        let run = self.run(pk);
        let row = self
            .call(reqwest::Method::GET, &format!("jobs/submission/{pk}"), &Value::Null)
            .await;
        if !["submitted", "resuming"].contains(&row["status"].as_str().unwrap()) {
            return;
        }
        let submitted = Submitted {
            pk,
            phase: row["challenge_phase"].as_u64().unwrap(),
            team: row["participant_team"].to_string(),
            team_name: row["participant_team_name"].as_str().unwrap().to_owned(),
            image: image.as_str().unwrap_or_default().to_owned(),
            time: row["submitted_at"].as_str().unwrap().to_owned(),
        };
        self.record(&submitted, &first_columns(&submitted)).await;
        run.stage.send_replace(Stage::Accepted);
        let mut allowed = run.allowed.subscribe();
        let mut seen = Allowed::default();
        for routes in 1..=ROUTES_A_PAIR {
            seen = *allowed.wait_for(|now| now.crash || now.routes >= routes).await.unwrap();
            if seen.crash {
                break;
            }
            if routes == 1 {
                let (results, start) = (format!("s3://{BUCKET}/{}{pk}", self.cloud.prefix), now());
                let columns = [
                    ("submission_status", "RUNNING"),
                    ("results", results.as_str()),
                    ("start_time", start.as_str()),
                ];
                self.record(&submitted, &columns.map(owned)).await;
            }
            let files = self.store(pk, routes).await;
            self.put(&submitted, "PARTIALLY_EVALUATED", &files).await;
            run.stage.send_replace(Stage::Driven(routes));
        }
        self.end(&submitted, seen).await;
        run.stage.send_replace(Stage::Ended);
    }

    /// The Step Function after the Job.
    async fn end(&self, submitted: &Submitted, seen: Allowed) {
        let done = if seen.crash { seen.routes } else { ROUTES_A_PAIR };
        let status = if seen.crash { "FAILED" } else { "FINISHED" };
        for name in last_files(seen.crash) {
            self.object(submitted.pk, &format!("containers-status/{name}"), String::new())
                .await;
        }
        let files = self.store(submitted.pk, done).await;
        self.put(submitted, status, &files).await;
        let end = now();
        let mut columns = [("submission_status", status), ("end_time", end.as_str())]
            .map(owned)
            .to_vec();
        if !seen.crash {
            let results: Value = serde_json::from_str(&files.results_json).unwrap();
            let of = |name: &str| results[0]["accuracies"][name].to_string();
            let all = metrics(leaderboard_results::Format::V2).iter();
            columns.extend(all.map(|metric| (metric.column.to_owned(), of(metric.name))));
        }
        self.record(submitted, &columns).await;
    }

    /// Stores what logcopy stores once each pair has driven so many routes.
    async fn store(&self, pk: u64, routes: usize) -> Files {
        let checkpoints: Vec<String> = (0..PAIRS).map(|pair| checkpoint(pair, routes)).collect();
        let inputs: Vec<_> = checkpoints.iter().map(|text| Some(text.clone().into_bytes())).collect();
        let plan = Plan {
            as_original: true,
            ..Plan::lenient(leaderboard_results::Format::V2)
        };
        let (merged, files) = offline(&plan, &inputs).unwrap();
        for (pair, text) in checkpoints.into_iter().enumerate() {
            let (agent, port) = (pair + 1, 2000 + 100 * pair);
            let driven = (0..routes).map(|route| route_of(pair, route));
            let lines =
                |line: &str| -> Vec<String> { driven.clone().map(|route| format!("{line} {route}\n")).collect() };
            let log = |line: &str| lines(line).concat();
            self.object(pk, &format!("agent/agent{agent}/agent_results.json"), text)
                .await;
            self.object(
                pk,
                &format!("agent/agent{agent}/leaderboard.log"),
                log("> Running the route"),
            )
            .await;
            self.object(
                pk,
                &format!("simulator/Logs/CarlaUE4-{port}.log"),
                log("the old server drove route"),
            )
            .await;
        }
        let texts = [
            ("agent/agent_results.json", merged.text),
            ("logcopy/logcopy.log", format!("{routes} routes a pair\n")),
            ("evalai/results.json", files.results_json.clone()),
            ("evalai/stdout.txt", files.stdout_txt.clone()),
            ("evalai/metadata.json", files.metadata_json.clone().unwrap_or_default()),
        ];
        for (key, text) in texts {
            self.object(pk, key, text).await;
        }
        files
    }

    async fn object(&self, pk: u64, key: &str, text: String) {
        let put = self.cloud.s3.put_object().bucket(BUCKET);
        let put = put
            .key(format!("{}{pk}/{key}", self.cloud.prefix))
            .body(text.into_bytes().into());
        put.send().await.unwrap();
    }

    /// Sends results to EvalAI, as logcopy does before the end and the Step Function at it.
    async fn put(&self, submitted: &Submitted, status: &str, files: &Files) {
        let path = match status {
            "PARTIALLY_EVALUATED" => format!("jobs/challenges/{CHALLENGE}/update_partially_evaluated_submission/"),
            _ => format!("jobs/challenge/{CHALLENGE}/update_submission/"),
        };
        let body = json!({
            "submission": submitted.pk,
            "challenge_phase": submitted.phase,
            "submission_status": status,
            "result": files.results_json,
            "stdout": files.stdout_txt,
            "stderr": "",
            "environment_log": "",
            "metadata": files.metadata_json,
        });
        self.call(reqwest::Method::PUT, &path, &body).await;
    }

    async fn call(&self, method: reqwest::Method, path: &str, body: &Value) -> Value {
        let request = self.http.request(method, format!("{}/api/{path}", self.evalai));
        let answer = request.bearer_auth(HOST_TOKEN).json(body).send().await.unwrap();
        let (status, text) = (answer.status(), answer.text().await.unwrap());
        assert!(status.is_success(), "the old pipeline: {path}: {status} {text}");
        serde_json::from_str(&text).unwrap()
    }

    /// Writes columns of its row, texts all of them.
    async fn record(&self, submitted: &Submitted, columns: &[(String, String)]) {
        let text = |text: &str| AttributeValue::S(text.to_owned());
        let mut update = self.cloud.dynamodb.update_item().table_name(&self.cloud.table);
        update = update.key("team_id", text(&submitted.team));
        update = update.key("submission_id", text(&submitted.pk.to_string()));
        let mut sets = Vec::new();
        for (number, (column, value)) in columns.iter().enumerate() {
            update = update.expression_attribute_names(format!("#{number}"), column);
            update = update.expression_attribute_values(format!(":{number}"), text(value));
            sets.push(format!("#{number} = :{number}"));
        }
        update
            .update_expression(format!("SET {}", sets.join(", ")))
            .send()
            .await
            .unwrap();
    }
}

fn first_columns(submitted: &Submitted) -> Vec<(String, String)> {
    let phase = submitted.phase.to_string();
    let columns = [
        ("team_name", submitted.team_name.as_str()),
        ("submission_status", "SUBMITTED"),
        ("track_id", phase.as_str()),
        ("track_name", if submitted.phase == 1 { "SENSORS" } else { "MAP" }),
        ("submitted_image_uri", submitted.image.as_str()),
        ("submitted_time", submitted.time.as_str()),
        ("start_time", "-"),
        ("end_time", "-"),
    ];
    columns.map(owned).to_vec()
}

fn owned((name, value): (&str, &str)) -> (String, String) {
    (name.to_owned(), value.to_owned())
}

/// The files by which its containers show each other their ends.
fn last_files(crash: bool) -> Vec<String> {
    let sides = |pair: usize| [format!("simulator-{pair}"), format!("agent-{pair}")];
    let pairs = (1..=PAIRS).flat_map(sides);
    if crash {
        return pairs
            .filter(|side| side.ends_with("-2"))
            .map(|side| format!("{side}.crash3"))
            .collect();
    }
    pairs
        .map(|side| format!("{side}.done"))
        .chain(["logcopy.done".to_owned()])
        .collect()
}

fn route_of(pair: usize, number: usize) -> String {
    (pair * ROUTES_A_PAIR + number).to_string()
}

/// The checkpoint of a pair, from 0, after so many routes.
fn checkpoint(pair: usize, routes: usize) -> String {
    let scenario: Scenario = serde_json::from_str(SCENARIO).unwrap();
    let mut file = Checkpoint::new(Format::V2, ROUTES_A_PAIR);
    file.sensors.clone_from(&scenario.sensors);
    for index in 0..routes {
        let leg = Leg {
            index,
            route: route_of(pair, index),
            repetition: 0,
        };
        file.routes
            .records
            .push(scenario.routes[&leg.route].record(Format::V2, &leg));
    }
    file.routes.progress[0] = routes;
    if routes == ROUTES_A_PAIR {
        let global = statistics::global(Format::V2, &file.routes.records);
        file.values = statistics::values(Format::V2, &global);
        file.labels = statistics::labels(Format::V2);
        file.routes.global_record = Some(global);
        "Finished".clone_into(&mut file.entry_status);
        file.eligible = true.into();
    }
    file.text(Format::V2).unwrap()
}

/// Keys are texts in a first message and numbers in later ones.
fn number(value: &Value) -> u64 {
    let text = value.as_str().map_or_else(|| value.to_string(), str::to_owned);
    text.parse().unwrap()
}

fn now() -> String {
    jiff::Timestamp::now().strftime("%Y-%m-%d %H:%M:%S UTC").to_string()
}
