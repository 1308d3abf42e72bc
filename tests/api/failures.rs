//! Failures as the whole controller meets them: an agent that prints the private routes and crashes, whose log hosts find and
//! participants don't; and a node that falls silent.
//!
//! The real controller against a real API server and both stand-ins; the test plays the Job controller, the kubelet and
//! logcopy.
#![cfg(test)]

use evalai_stand_in::model::{FileState, Status, User};
use evalai_stand_in::submissions::{NewSubmission, create, rerun};
use evalai_stand_in::{Config, Handle};
use jiff::{SignedDuration, Timestamp};
use k8s_openapi::api::batch::v1::Job;
use k8s_openapi::api::coordination::v1::Lease;
use k8s_openapi::api::core::v1::{Node, Pod, Secret};
use k8s_openapi::api::events::v1::Event;
use kube::api::{ApiResource, DeleteParams, DynamicObject, ListParams, Patch, PatchParams, PostParams};
use kube::runtime::wait::await_condition;
use kube::{Api, Client, ResourceExt};
use leaderboard_api::names::FAILURE_LOG_KEY;
use leaderboard_api::{Leaderboard, State, Storage, Submission, SubmissionStatus, conditions, names};
use leaderboard_operator::controller::runtime::leader::{self, Identity};
use leaderboard_operator::controller::runtime::{self as run, Clients};
use leaderboard_operator::controller::settings::Settings;
use leaderboard_operator::observability::Observability;
use leaderboard_operator::observability::shutdown::Stop;
use leaderboard_operator::pod::report::{OWNER_KEY, Owner};
use leaderboard_operator::services::archive::Archive;
use leaderboard_runner::verdict::{Verdict, What};
use serde_json::{Map, Value, json};
use tokio::net::TcpListener;
use tokio::time::timeout;

use super::bridge::{LIMIT, StandIn};
use crate::support::apiserver;

/// A line of the routes file.
const ROUTE: &str = r#"<waypoint x="4711.25" y="-815.5" z="1.0"/>"#;
/// Where all Pods are.
const NODE: &str = "node-of-failures";
const HOST: &str = "local-host-token";
const PARTICIPANT: &str = "local-team-a-token";

struct World {
    client: Client,
    namespace: String,
    aws: StandIn,
    bucket: String,
    evalai: Handle,
    http: reqwest::Client,
}

impl World {
    async fn new() -> Self {
        // Somebody else may have installed it.
        let _ = rustls::crypto::ring::default_provider().install_default();
        let server = apiserver::server().await;
        let aws = StandIn::start().await;
        let bucket = aws.name("failure-log");
        let s3 = aws.aws.s3(None, Some(&aws.endpoint));
        s3.create_bucket().bucket(&bucket).send().await.unwrap();
        let (config, _) = Config::in_memory().unwrap();
        let config = Config { throttle: 0, ..config };
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let world = Self {
            client: server.client(),
            namespace: server.namespace("failure-log").await,
            aws,
            bucket,
            evalai: evalai_stand_in::serve(config, vec![listener]),
            http: reqwest::Client::builder().no_proxy().build().unwrap(),
        };
        let secret = json!({"metadata": {"name": "evalai"}, "stringData": {"token": HOST}});
        let secret: Secret = serde_json::from_value(secret).unwrap();
        world.api().create(&PostParams::default(), &secret).await.unwrap();
        world
    }

    fn api<K>(&self) -> Api<K>
    where
        K: kube::Resource<Scope = kube::core::NamespaceResourceScope>,
        K::DynamicType: Default,
    {
        Api::namespaced(self.client.clone(), &self.namespace)
    }

    /// Starts a controller that stops when the sender goes.
    fn controller(&self) -> tokio::sync::watch::Sender<bool> {
        let (sender, stop) = Stop::new();
        let clients = Clients {
            api: self.client.clone(),
            watch: self.client.clone(),
            lease: self.client.clone(),
        };
        let lease = leader::Settings::new(&self.namespace, "operator", Identity::random("test"));
        let settings = Settings {
            image: "operator:1".into(),
            image_pull_policy: None,
            region: None,
            namespace: Some(self.namespace.clone()),
            concurrency: 4,
        };
        let aws = self.aws.aws.clone();
        tokio::spawn(run::run(clients, lease, settings, aws, Observability::new(stop)));
        sender
    }

    /// A Leaderboard of one phase, made as a person writes it.
    async fn leaderboard(&self, name: &str, phase: i64, log_tail: &str) {
        let leaderboard = json!({
            "apiVersion": "leaderboard.carla.org/v1alpha1", "kind": "Leaderboard", "metadata": {"name": name},
            "spec": {
                "evalai": {
                    "apiServer": self.evalai.url(), "challenge": 1, "requestsPerMinute": 6000, "logTail": log_tail,
                    "token": {"secretKeyRef": {"name": "evalai", "key": "token"}},
                },
                "tracks": [{"name": "sensors", "codename": "SENSORS", "phase": phase}],
                "leaderboardVersion": "V2",
                "contents": {"image": "contents:1"}, "simulator": {"image": "simulator:1"},
                "pairs": 1, "routes": 1, "retries": {"perPair": 0}, "syncPeriodSeconds": 1,
                "storage": {"bucket": self.bucket, "endpoint": self.aws.endpoint},
            },
        });
        let kind = ApiResource::erase::<Leaderboard>(&());
        let api: Api<DynamicObject> = Api::namespaced_with(self.client.clone(), &self.namespace, &kind);
        let object = serde_json::from_value(leaderboard).unwrap();
        api.create(&PostParams::default(), &object).await.unwrap();
    }

    /// Team a pushes to a phase; hands back EvalAI's key and the object's name.
    async fn submit(&self, leaderboard: &str, phase: u64) -> (u64, String) {
        let image = json!("r/team-a:1");
        self.submit_image(leaderboard, phase, &image, &image).await
    }

    /// The same with these images in the uploaded file and in the object.
    async fn submit_image(&self, leaderboard: &str, phase: u64, uploaded: &Value, image: &Value) -> (u64, String) {
        let new = NewSubmission {
            team: 1,
            phase,
            user: 11,
            input: json!({ "submitted_image_uri": uploaded }).to_string().into_bytes(),
            fields: Map::new(),
        };
        let pk = self
            .evalai
            .with_state(|state| create(state, new, FileState::Stored, Timestamp::now()));
        let name = self.object(leaderboard, phase, pk, image).await;
        (pk, name)
    }

    /// A host re-runs a submission; hands back the new key and the new object's name.
    async fn rerun(&self, leaderboard: &str, phase: u64, pk: u64) -> (u64, String) {
        let again = self.evalai.with_state(|state| {
            let host = User {
                staff: true,
                ..state.user(11).unwrap().clone()
            };
            rerun(state, &host, pk, Timestamp::now())
        });
        let new = again.unwrap_or_else(|_| panic!("EvalAI re-runs {pk}"));
        let image = json!("r/team-a:1");
        (new, self.object(leaderboard, phase, new, &image).await)
    }

    /// The object of a submission, as the bridge makes it.
    async fn object(&self, leaderboard: &str, phase: u64, pk: u64, image: &Value) -> String {
        let name = names::submission(i64::try_from(pk).unwrap());
        let spec = json!({"leaderboardName": leaderboard, "image": image,
                          "evalai": {"challenge": 1, "phase": phase, "submission": pk}});
        let submission = Submission::new(&name, serde_json::from_value(spec).unwrap());
        self.api().create(&PostParams::default(), &submission).await.unwrap();
        name
    }

    fn archive(&self, run: u64) -> Archive {
        let storage = json!({"bucket": self.bucket, "endpoint": self.aws.endpoint});
        let storage: Storage = serde_json::from_value(storage).unwrap();
        Archive::of_run(&self.aws.aws, &storage, &run.to_string())
    }

    /// The Job runs, its agent prints the routes and crashes, logcopy stores the log, and the Job ends as requested.
    async fn run_that_crashes(&self, pk: u64, name: &str) {
        let job = self.job(name, 0).await;
        let log = format!("\u{1b}[32mloading routes\u{1b}[0m\n{ROUTE}\nTraceback: boom\n");
        let archive = self.archive(pk);
        let stored = archive.put("agent/agent1/leaderboard.log", log.into_bytes());
        stored.await.unwrap();
        let pod = self.pod(&job, &crashed()).await;
        let is_told = |pod: Option<&Pod>| pod.is_some_and(|p| p.annotations().contains_key(names::ANNOTATION_STOP));
        let told = timeout(LIMIT, await_condition(self.api(), &pod, is_told)).await;
        told.expect("the Pod is asked to stop").unwrap();
        let jobs = self.api::<Job>();
        jobs.delete(&job.name_any(), &DeleteParams::background()).await.unwrap();
    }

    /// Waits for the Job of the first attempt that follows so many failures of the infrastructure.
    async fn job(&self, name: &str, retry: i32) -> Job {
        let is_there = |job: Option<&Job>| job.is_some();
        let job_name = names::job(name, 1, retry);
        let job = timeout(LIMIT, await_condition(self.api(), &job_name, is_there)).await;
        job.expect("a Job is made").unwrap().unwrap()
    }

    /// Makes the Pod of a Job, with this status; hands back its name.
    async fn pod(&self, job: &Job, status: &Value) -> String {
        let template = job.spec.as_ref().unwrap().template.metadata.as_ref().unwrap();
        let pod = json!({
            "metadata": {
                "name": format!("{}-x", job.name_any()), "namespace": self.namespace, "labels": template.labels,
                "ownerReferences": [{"apiVersion": "batch/v1", "kind": "Job", "name": job.name_any(),
                                     "uid": job.metadata.uid, "controller": true}],
            },
            "spec": {
                "nodeName": NODE, "terminationGracePeriodSeconds": 600, "restartPolicy": "OnFailure",
                "automountServiceAccountToken": false,
                "initContainers": [{"name": "logcopy", "image": "i", "restartPolicy": "Always"}],
                "containers": [{"name": "simulator-1", "image": "i"}, {"name": "agent-1", "image": "i"}],
            },
        });
        let pod: Pod = serde_json::from_value(pod).unwrap();
        let (pods, name) = (self.api::<Pod>(), pod.name_any());
        pods.create(&PostParams::default(), &pod).await.unwrap();
        let status = Patch::Merge(json!({"status": status}));
        let patched = pods.patch_status(&name, &PatchParams::default(), &status).await;
        patched.unwrap();
        name
    }

    async fn until(&self, name: &str, what: &str, holds: impl Fn(&SubmissionStatus) -> bool) {
        let holds = |found: Option<&Submission>| found.and_then(|s| s.status.as_ref()).is_some_and(&holds);
        let seen = timeout(LIMIT, await_condition(self.api::<Submission>(), name, holds)).await;
        seen.expect(what).unwrap();
    }

    /// All that EvalAI hands this user of a submission: the row, and the text behind each of its links.
    async fn fetched(&self, pk: u64, token: &str) -> (Value, String) {
        let get = async |url: String| {
            let answer = self.http.get(&url).bearer_auth(token).send().await.unwrap();
            assert!(answer.status().is_success(), "{url}: {}", answer.status());
            answer.text().await.unwrap()
        };
        let row = get(format!("{}/api/jobs/submission/{pk}", self.evalai.url())).await;
        let row: Value = serde_json::from_str(&row).unwrap();
        let mut all = row.to_string();
        for (field, value) in row.as_object().unwrap() {
            if let Some(url) = value.as_str().filter(|_| field.ends_with("_file")) {
                all += &get(url.to_owned()).await;
            }
        }
        (row, all)
    }

    /// Everything that Kubernetes shows of a submission.
    async fn shown(&self, name: &str) -> String {
        let object = self.api::<Submission>().get(name).await.unwrap();
        let events = self.api::<Event>().list(&ListParams::default()).await.unwrap();
        let events: Vec<_> = events
            .items
            .iter()
            .map(|e| e.note.clone().unwrap_or_default())
            .collect();
        assert!(!events.is_empty());
        format!("{} {events:?}", serde_json::to_string(&object).unwrap())
    }
}

/// Some seconds ago, as Kubernetes writes it.
fn ago(seconds: i64) -> String {
    let at = Timestamp::now() - SignedDuration::from_secs(seconds);
    at.strftime("%Y-%m-%dT%H:%M:%SZ").to_string()
}

/// The Pod's status after the crash. What the agent leaves as its last message is no verdict of a runner; its simulator's runner
/// has followed it.
fn crashed() -> Value {
    let now = ago(0);
    let mut status = running();
    let forged = json!({"reason": ROUTE, "message": ROUTE}).to_string();
    let followed = Verdict::new(What::PeerCrashed, 0, "the agent crashed, so the server was stopped").to_json();
    for (container, message) in [(0, followed), (1, forged)] {
        let container = &mut status["containerStatuses"][container];
        container["ready"] = json!(false);
        container["state"] = json!({"terminated": {
            "exitCode": 1, "reason": "Error", "message": message, "startedAt": now, "finishedAt": now,
        }});
    }
    status
}

/// The status of a Pod all of whose containers run.
fn running() -> Value {
    let now = ago(0);
    let running = |name: &str| json!({"name": name, "image": "i", "imageID": "", "ready": true, "restartCount": 0, "state": {"running": {"startedAt": now}}});
    json!({
        "phase": "Running",
        "conditions": [{"type": "PodScheduled", "status": "True", "lastTransitionTime": now}],
        "initContainerStatuses": [running("logcopy")],
        "containerStatuses": [running("simulator-1"), running("agent-1")],
    })
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn routes_that_an_agent_prints_are_for_hosts_unless_they_say_otherwise() {
    let world = World::new().await;
    world.leaderboard("closed", 1, "Hosts").await;
    world.leaderboard("open", 2, "Participants").await;
    let _controller = world.controller();

    for (leaderboard, phase, is_open) in [("closed", 1, false), ("open", 2, true)] {
        let (pk, name) = world.submit(leaderboard, phase).await;
        world.run_that_crashes(pk, &name).await;
        let failed = world
            .evalai
            .wait_until(|state, _| state.submissions[&pk].status == Status::Failed);
        timeout(LIMIT, failed).await.expect("EvalAI hears of the failure");

        let (own, fetched) = world.fetched(pk, PARTICIPANT).await;
        assert!(own.get("environment_log_file").is_none());
        assert!(
            fetched.contains("AgentCrashed (participant): Agent 1 crashed once."),
            "{fetched}"
        );
        assert_eq!(fetched.contains("4711"), is_open, "{leaderboard}: {fetched}");
        assert!(
            !fetched.contains("leaderboard.log"),
            "only hosts can read it: {fetched}"
        );
        assert_eq!(own["stdout_file"].as_str().map(|_| ()), Some(()));

        let (row, all) = world.fetched(pk, HOST).await;
        assert!(row["environment_log_file"].is_string());
        let kept = world.archive(pk).get(FAILURE_LOG_KEY, 1 << 20).await.unwrap().unwrap();
        let kept = String::from_utf8(kept.bytes).unwrap();
        let text = format!("loading routes\n{ROUTE}\nTraceback: boom");
        assert!(
            kept.starts_with("The end of agent-1's log in attempt 1;") && kept.ends_with(&text),
            "{kept}"
        );
        assert!(all.contains(&kept), "{all}");
        let shown = world.shown(&name).await;
        assert!(
            shown.contains("Agent 1 crashed once") && !shown.contains("4711"),
            "{shown}"
        );
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_rerun_in_evalai_is_named_by_the_submission_whose_result_it_cancels() {
    let world = World::new().await;
    world.leaderboard("lb", 1, "Hosts").await;
    let _controller = world.controller();
    let (old, name) = world.submit("lb", 1).await;
    world.run_that_crashes(old, &name).await;
    let is_published = |s: &SubmissionStatus| s.times.published.is_some();
    world.until(&name, "EvalAI has the end", is_published).await;

    let (new, rerun) = world.rerun("lb", 1, old).await;
    let statuses = [old, new].map(|pk| world.evalai.with_state(|state| state.submissions[&pk].status));
    assert_eq!(statuses, [Status::Cancelled, Status::Submitted]);
    let of = |s: &SubmissionStatus| s.rerun_of.as_ref().is_some_and(|of| of.submission_name == name);
    world.until(&rerun, "it names what it re-runs", of).await;
    let again = |s: &SubmissionStatus| s.rerun_as.as_ref().is_some_and(|again| again.submission_name == rerun);
    world.until(&name, "it names its re-run", again).await;
    let status = world.api::<Submission>().get(&name).await.unwrap().status.unwrap();
    assert_eq!(status.state, Some(State::Failed), "its result stays");
    let message = status.message.unwrap();
    let told = format!(
        "A host re-ran this submission in EvalAI as {rerun}; EvalAI cancelled this one's result. Its state and score stay, in the table too."
    );
    assert!(
        message.starts_with("Agent 1 crashed") && message.ends_with(&told),
        "{message}"
    );
    assert!(world.shown(&name).await.contains("re-ran this submission in EvalAI as"));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn after_a_controller_that_did_not_confirm_its_requests_everybody_reads_until_when_nothing_is_written() {
    let world = World::new().await;
    world.leaderboard("lb", 1, "Hosts").await;
    // Handed over in order, but without an answer to the last requests.
    let lease = json!({
        "metadata": {"name": "operator", "annotations": {leader::ANNOTATION_RELEASED: "1"}},
        "spec": {"leaseTransitions": 1},
    });
    let lease: Lease = serde_json::from_value(lease).unwrap();
    world.api().create(&PostParams::default(), &lease).await.unwrap();
    let _controller = world.controller();

    let text = "Nothing is written to EvalAI before ";
    let says = |board: Option<&Leaderboard>| {
        let status = board.and_then(|board| board.status.as_ref());
        let ready = status.and_then(|s| conditions::get(&s.conditions, conditions::READY));
        ready.is_some_and(|c| c.status == "True" && c.message.starts_with(text))
    };
    let seen = timeout(LIMIT, await_condition(world.api::<Leaderboard>(), "lb", says)).await;
    seen.expect("Ready stays True and has a note").unwrap();

    let (pk, name) = world.submit("lb", 1).await;
    world.run_that_crashes(pk, &name).await;
    let waits = |s: &SubmissionStatus| {
        let published = conditions::get(&s.conditions, conditions::PUBLISHED);
        published.is_some_and(|c| {
            c.status == "False" && c.reason == "WaitingForPreviousController" && c.message.starts_with(text)
        })
    };
    world.until(&name, "Published says until when", waits).await;
    let writes = world.evalai.requests().into_iter().filter(|r| r.method != "GET");
    assert_eq!(writes.count(), 0);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_silent_node_is_replaced_before_the_grace_and_costs_no_attempt() {
    let world = World::new().await;
    world.leaderboard("lb", 1, "Hosts").await;
    let _controller = world.controller();
    let nodes: Api<Node> = Api::all(world.client.clone());
    let node = serde_json::from_value(json!({"metadata": {"name": NODE}})).unwrap();
    nodes.create(&PostParams::default(), &node).await.unwrap();
    let silent = json!({"status": {"conditions": [{
        "type": "Ready", "status": "Unknown", "reason": "NodeStatusUnknown", "lastTransitionTime": ago(100),
    }]}});
    let patch = Patch::Merge(&silent);
    nodes.patch_status(NODE, &PatchParams::default(), &patch).await.unwrap();

    let (pk, name) = world.submit("lb", 1).await;
    let job = world.job(&name, 0).await;
    let pod = world.pod(&job, &running()).await;
    let runs = |s: &SubmissionStatus| s.state == Some(State::Running);
    world.until(&name, "it runs", runs).await;
    let is_told = |status: &'static str| {
        world
            .evalai
            .wait_until(move |state, _| state.submissions[&pk].status.as_str() == status)
    };
    timeout(LIMIT, is_told("running"))
        .await
        .expect("EvalAI hears of the run");
    // As the eviction by the node's taint does it. Nobody is there to end the Pod; its grace is ten minutes.
    let deleted = world.api::<Pod>().delete(&pod, &DeleteParams::default()).await.unwrap();
    assert!(deleted.left().unwrap().metadata.deletion_timestamp.is_some());
    let next = world.job(&name, 1).await;

    let gone = world.api::<Pod>().get_opt(&pod).await.unwrap();
    assert_eq!(gone, None, "removed by force");
    let mark = world.archive(pk).get(OWNER_KEY, 1024).await.unwrap().unwrap();
    let mark = Owner::parse(&mark.bytes).unwrap();
    assert!(
        mark.owner.starts_with("controller-"),
        "what it may still write counts for nobody"
    );
    world.pod(&next, &running()).await;
    let job = next.name_any();
    let is_back = |s: &SubmissionStatus| runs(s) && s.job_name.as_ref() == Some(&job);
    world.until(&name, "it runs again", is_back).await;
    let status = world.api::<Submission>().get(&name).await.unwrap().status.unwrap();
    assert_eq!((status.attempt, status.retry, status.failure), (Some(1), 1, None));
    assert!(status.pairs.iter().all(|pair| pair.crashes == 0));
    let patches = world.evalai.requests().into_iter().filter(|r| r.method == "PATCH");
    let told = patches.filter(|r| r.body["submission_status"] == json!("running"));
    assert_eq!(told.count(), 1, "EvalAI keeps saying running");
}

#[tokio::test]
async fn of_a_stored_log_only_the_end_is_read() {
    let stand_in = StandIn::start().await;
    let bucket = stand_in.name("tails");
    let s3 = stand_in.aws.s3(None, Some(&stand_in.endpoint));
    s3.create_bucket().bucket(&bucket).send().await.unwrap();
    let archive = Archive::new(s3, bucket, "runs/77/");
    let log: Vec<u8> = (0..100_000u32)
        .flat_map(|n| format!("line {n}\n").into_bytes())
        .collect();
    archive.put("long", log.clone()).await.unwrap();
    archive.put("short", b"one\n".to_vec()).await.unwrap();
    archive.put("empty", Vec::new()).await.unwrap();
    for (key, tail) in [
        ("long", Some(log[log.len() - 65_536..].to_vec())),
        ("short", Some(b"one\n".to_vec())),
        ("empty", Some(Vec::new())),
        ("missing", None),
    ] {
        assert_eq!(archive.tail(key, 65_536).await.unwrap(), tail, "{key}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_can_never_be_an_image_fails_at_once_and_the_participant_reads_why() {
    let world = World::new().await;
    world.leaderboard("lb", 1, "Hosts").await;
    let _controller = world.controller();
    let uploaded = [
        json!(null),
        json!(""),
        json!(5),
        json!({"a": 1}),
        json!("  "),
        json!("x".repeat(513)),
        json!("r/Team:1"),
        json!("r/té:1"),
        json!("two words"),
    ];
    let mut submitted = Vec::new();
    for uploaded in &uploaded {
        submitted.push(world.submit_image("lb", 1, uploaded, &json!(null)).await);
    }
    let (good, bad) = (json!("r/team-a:1"), json!("r/Team:1"));
    submitted.push(world.submit_image("lb", 1, &good, &bad).await);
    for (pk, name) in submitted {
        let failed = world
            .evalai
            .wait_until(|state, _| state.submissions[&pk].status == Status::Failed);
        timeout(LIMIT, failed).await.expect("EvalAI hears of the failure");
        let (_, fetched) = world.fetched(pk, PARTICIPANT).await;
        assert!(fetched.contains("ImageInvalid (participant): The subm"), "{fetched}");
        let is_published = |s: &SubmissionStatus| conditions::is_true(&s.conditions, conditions::PUBLISHED);
        world.until(&name, "it is published", is_published).await;
        let job = world.api::<Job>().get_opt(&names::job(&name, 1, 0)).await.unwrap();
        assert_eq!(job, None);
    }
}
