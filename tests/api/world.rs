//! A world for the whole controller: a real API server, both stand-ins, and a test that plays the Job controller, the kubelet and
//! logcopy.
#![cfg(test)]

use std::sync::Arc;
use std::time::Duration;

use evalai_stand_in::model::{FileState, User};
use evalai_stand_in::submissions::{NewSubmission, create, rerun};
use evalai_stand_in::{Config, Handle, MemoryQueues};
use jiff::{SignedDuration, Timestamp};
use k8s_openapi::api::batch::v1::Job;
use k8s_openapi::api::core::v1::{Pod, Secret};
use k8s_openapi::api::events::v1::Event;
use kube::api::{ApiResource, DynamicObject, ListParams, Patch, PatchParams, PostParams};
use kube::runtime::wait::await_condition;
use kube::{Api, Client, ResourceExt};
use leaderboard_api::{
    Attempt, JobNumber, Leaderboard, Reason, S3Bucket, Submission, SubmissionStatus, conditions, names,
};
use leaderboard_aws::archive::Archive;
use leaderboard_base::shutdown::Stop;
use leaderboard_contract::report::Report;
use leaderboard_operator::kubernetes::Namespaces;
use leaderboard_operator::observability::Observability;
use leaderboard_operator::page::Page;
use leaderboard_operator::runtime as run;
use leaderboard_operator::runtime::Clients;
use leaderboard_operator::runtime::leader::{self, Identity};
use leaderboard_operator::runtime::settings::Settings;
use leaderboard_pod::workspace::WorkspaceError;
use leaderboard_pod_spec::job::OwnImage;
use leaderboard_policy::allowed::Allowed;
use leaderboard_protocol::verdict::{Verdict, What};
use serde_json::{Map, Value, json};
use tokio::net::TcpListener;
use tokio::time::timeout;

use super::bridge::{LIMIT, StandIn};
use super::objects::merge;
use crate::support::player::{Cluster, Player, reports_as, running};
use crate::support::{apiserver, played};

/// A line of the routes file.
pub(super) const ROUTE: &str = r#"<waypoint x="4711.25" y="-815.5" z="1.0"/>"#;
pub(super) const HOST: &str = "local-host-token";
pub(super) const PARTICIPANT: &str = "local-team-a-token";

/// The whole controller between a real API server and both stand-ins.
pub(super) struct World {
    pub(super) client: Client,
    pub(super) namespace: String,
    pub(super) aws: StandIn,
    pub(super) bucket: String,
    pub(super) evalai: Arc<Handle>,
    /// The queues of EvalAI's challenges.
    pub(super) queues: Arc<MemoryQueues>,
    pub(super) http: reqwest::Client,
}

impl World {
    pub(super) async fn new() -> Self {
        // Somebody else may have installed it.
        let _ = rustls::crypto::ring::default_provider().install_default();
        let server = apiserver::server().await;
        let aws = StandIn::start().await;
        let bucket = aws.name("failure-log");
        let s3 = aws.aws.s3(None, Some(&aws.endpoint));
        s3.create_bucket().bucket(&bucket).send().await.unwrap();
        let (config, queues) = Config::in_memory().unwrap();
        let config = Config { throttle: 0, ..config };
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let world = Self {
            client: server.client(),
            namespace: server.namespace("failure-log").await,
            aws,
            bucket,
            evalai: Arc::new(evalai_stand_in::serve(config, vec![listener])),
            queues,
            http: reqwest::Client::builder().no_proxy().build().unwrap(),
        };
        world.token().await;
        world
    }

    /// Another namespace, for another operator, with the same EvalAI and the same AWS.
    pub(super) async fn neighbor(&self) -> Self {
        let world = Self {
            client: self.client.clone(),
            namespace: apiserver::server().await.namespace("neighbor").await,
            aws: StandIn::start().await,
            bucket: self.bucket.clone(),
            evalai: Arc::clone(&self.evalai),
            queues: Arc::clone(&self.queues),
            http: self.http.clone(),
        };
        world.token().await;
        world
    }

    /// Stores EvalAI's token.
    async fn token(&self) {
        let secret = json!({"metadata": {"name": "evalai"}, "stringData": {"token": HOST}});
        let secret: Secret = serde_json::from_value(secret).unwrap();
        self.api().create(&PostParams::default(), &secret).await.unwrap();
    }

    pub(super) fn api<K>(&self) -> Api<K>
    where
        K: kube::Resource<Scope = kube::core::NamespaceResourceScope>,
        K::DynamicType: Default,
    {
        Api::namespaced(self.client.clone(), &self.namespace)
    }

    /// The parts of the cluster around the controller, for a test to play.
    pub(super) fn cluster(&self) -> Cluster {
        Cluster::new(&self.client, &self.namespace)
    }

    /// Plays runs that go well, with so long between two reports.
    pub(super) fn play(&self, period: Duration) -> Player {
        self.play_as(period, |report| report)
    }

    /// The same with each report changed.
    pub(super) fn play_as(&self, period: Duration, change: fn(Report) -> Report) -> Player {
        let s3 = self.aws.aws.s3(None, Some(&self.aws.endpoint));
        Player::start(self.cluster(), reports_as(period, s3, &self.bucket, change))
    }

    /// Starts a controller that stops when the sender goes.
    pub(super) fn controller(&self) -> tokio::sync::watch::Sender<bool> {
        self.installation("operator", "operator:1")
    }

    /// A controller that also watches the nodes.
    pub(super) fn controller_with_nodes(&self) -> tokio::sync::watch::Sender<bool> {
        let settings = Settings {
            has_cluster_rights: true,
            ..self.settings("operator", "operator:1")
        };
        self.start("operator", settings, None)
    }

    /// A controller with this Lease and this image.
    pub(super) fn installation(&self, lease: &str, image: &str) -> tokio::sync::watch::Sender<bool> {
        self.replica(lease, image, None)
    }

    /// A replica of it, with a page or without.
    pub(super) fn replica(&self, lease: &str, image: &str, page: Option<Page>) -> tokio::sync::watch::Sender<bool> {
        self.start(lease, self.settings(lease, image), page)
    }

    fn settings(&self, lease: &str, image: &str) -> Settings {
        Settings {
            own: OwnImage {
                image: image.into(),
                ..OwnImage::default()
            },
            operator: self.lease(lease).installation(),
            namespaces: Namespaces::of([self.namespace.clone()]),
            has_cluster_rights: false,
            allowed: Allowed::default(),
            concurrency: 4,
        }
    }

    fn lease(&self, name: &str) -> leader::Settings {
        leader::Settings::new(&self.namespace, name, Identity::random("test"))
    }

    fn start(&self, lease: &str, settings: Settings, page: Option<Page>) -> tokio::sync::watch::Sender<bool> {
        let (sender, stop) = Stop::new();
        let clients = Clients {
            api: self.client.clone(),
            watch: self.client.clone(),
            lease: self.client.clone(),
        };
        let lease = self.lease(lease);
        let aws = self.aws.aws.clone();
        tokio::spawn(run::run(clients, lease, settings, aws, page, Observability::new(stop)));
        sender
    }

    /// A Leaderboard of one phase, made as a person writes it.
    pub(super) async fn leaderboard(&self, name: &str, phase: i64, log_tail: &str) {
        self.leaderboard_with(name, phase, log_tail, &json!({})).await;
    }

    /// Makes a Leaderboard with more of its spec.
    pub(super) async fn leaderboard_with(&self, name: &str, phase: i64, log_tail: &str, more: &Value) {
        let mut leaderboard = json!({
            "apiVersion": "leaderboard.carla.org/v1alpha1", "kind": "Leaderboard", "metadata": {"name": name},
            "spec": {
                "evalai": {
                    "apiServer": self.evalai.url(), "challenge": 1, "requestsPerMinute": 6000, "logTail": log_tail,
                    "token": {"secretKeyRef": {"name": "evalai", "key": "token"}},
                },
                "tracks": [{"name": "sensors", "phase": phase}],
                "evaluation": {"carla": {
                    "version": "V2", "contents": {"image": "contents:1"}, "simulator": {"image": "simulator:1"},
                    "pairs": 1, "routes": 1,
                }},
                "agent": {"images": []}, "retries": {"perWorker": 0}, "syncPeriodSeconds": 1,
                "storage": {"s3": {"bucket": self.bucket, "endpoint": self.aws.endpoint}},
            },
        });
        merge(&mut leaderboard, &json!({ "spec": more }));
        let kind = ApiResource::erase::<Leaderboard>(&());
        let api: Api<DynamicObject> = Api::namespaced_with(self.client.clone(), &self.namespace, &kind);
        let object = serde_json::from_value(leaderboard).unwrap();
        api.create(&PostParams::default(), &object).await.unwrap();
    }

    /// Team a pushes to a phase; hands back EvalAI's key and the object's name.
    pub(super) async fn submit(&self, leaderboard: &str, phase: u64) -> (u64, String) {
        let image = json!("r/team-a:1");
        self.submit_image(leaderboard, phase, &image, &image).await
    }

    /// Submits with these images in the uploaded file and in the object.
    pub(super) async fn submit_image(
        &self,
        leaderboard: &str,
        phase: u64,
        uploaded: &Value,
        image: &Value,
    ) -> (u64, String) {
        let pk = self.push(phase, uploaded);
        let name = self.object(leaderboard, phase, pk, image).await;
        (pk, name)
    }

    /// Team a pushes this image to a phase, and no message comes of it; hands back EvalAI's key.
    pub(super) fn push(&self, phase: u64, image: &Value) -> u64 {
        self.upload(phase, json!({ "submitted_image_uri": image }).to_string().into_bytes())
    }

    /// Team a uploads this file to a phase, and no message comes of it; hands back EvalAI's key.
    pub(super) fn upload(&self, phase: u64, input: Vec<u8>) -> u64 {
        let new = NewSubmission {
            team: 1,
            phase,
            user: 11,
            input,
            fields: Map::new(),
        };
        self.evalai
            .with_state(|state| create(state, new, FileState::Stored, Timestamp::now()))
    }

    /// A host re-runs a submission; hands back the new key and the new object's name.
    pub(super) async fn rerun(&self, leaderboard: &str, phase: u64, pk: u64) -> (u64, String) {
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
    pub(super) async fn object(&self, leaderboard: &str, phase: u64, pk: u64, image: &Value) -> String {
        let name = names::submission(i64::try_from(pk).unwrap());
        let spec = json!({"leaderboardName": leaderboard, "image": image,
                          "evalai": {"challenge": 1, "phase": phase, "submission": pk}});
        let submission = Submission::new(&name, serde_json::from_value(spec).unwrap());
        self.api().create(&PostParams::default(), &submission).await.unwrap();
        name
    }

    pub(super) fn archive(&self, run: u64) -> Archive {
        let storage = json!({"bucket": self.bucket, "endpoint": self.aws.endpoint});
        let storage: S3Bucket = serde_json::from_value(storage).unwrap();
        Archive::of_run(&self.aws.aws, &storage, &run.to_string().parse().unwrap())
    }

    /// The Job runs, its agent prints the routes and crashes, logcopy stores the log, and the Job ends as requested.
    pub(super) async fn run_that_crashes(&self, pk: u64, name: &str) {
        let job = self.job(name, 0).await;
        let log = format!("\u{1b}[32mloading routes\u{1b}[0m\n{ROUTE}\nTraceback: boom\n");
        let archive = self.archive(pk);
        let stored = archive.put("agent/agent1/leaderboard.log", log.into_bytes());
        stored.await.unwrap();
        let cluster = self.cluster();
        let pod = cluster.pod(&job).await;
        cluster.set_pod(&pod.name_any(), &crashed(&pod)).await;
        cluster.stops(&job).await;
    }

    /// Waits for the Job of the first attempt that follows so many failures of the infrastructure.
    pub(super) async fn job(&self, name: &str, retry: i32) -> Job {
        let number = JobNumber {
            attempt: Attempt(1),
            retry,
        };
        self.cluster().job(&names::job(name, number)).await
    }

    /// The Pod of this submission's first Job finds results of something else below the prefix. Returns once the submission is held back and
    /// the Job is gone.
    pub(super) async fn finds_its_prefix_in_use(&self, name: &str) {
        let job = self.job(name, 0).await;
        let cluster = self.cluster();
        let pod = cluster.pod(&job).await;
        cluster.set_pod(&pod.name_any(), &prefix_in_use()).await;
        let is_held = |status: &SubmissionStatus| status.shows(Reason::Foreign);
        self.until(name, "it is held back", is_held).await;
        let (jobs, name) = (self.api::<Job>(), job.name_any());
        let goes = |job: Option<&Job>| job.is_some_and(|job| job.metadata.deletion_timestamp.is_some());
        let goes = timeout(LIMIT, await_condition(jobs.clone(), &name, goes)).await;
        goes.expect("its Job is deleted").unwrap();
        // There is no garbage collector that would end its Pod first.
        let bare = Patch::Merge(json!({"metadata": {"finalizers": null}}));
        jobs.patch(&name, &PatchParams::default(), &bare).await.unwrap();
    }

    pub(super) async fn until(&self, name: &str, what: &str, holds: impl Fn(&SubmissionStatus) -> bool) {
        let holds = |found: Option<&Submission>| found.and_then(|s| s.status.as_ref()).is_some_and(&holds);
        let seen = timeout(LIMIT, await_condition(self.api::<Submission>(), name, holds)).await;
        seen.expect(what).unwrap();
    }

    /// All that EvalAI hands this user of a submission: the row, and the text behind each of its links.
    pub(super) async fn fetched(&self, pk: u64, token: &str) -> (Value, String) {
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
    pub(super) async fn shown(&self, name: &str) -> String {
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

/// True if every system has its end.
pub(super) fn is_settled(status: &SubmissionStatus) -> bool {
    let is_known = |type_: &str| {
        let found = conditions::get(&status.conditions, type_);
        found.is_some_and(|c| c.status == "True" || c.reason == Reason::NotRequired)
    };
    conditions::is_true(&status.conditions, conditions::FINISHED)
        && is_known(conditions::PUBLISHED)
        && is_known(conditions::RECORDED)
}

/// Some seconds ago, as Kubernetes writes it.
pub(super) fn ago(seconds: i64) -> String {
    let at = Timestamp::now() - SignedDuration::from_secs(seconds);
    at.strftime("%Y-%m-%dT%H:%M:%SZ").to_string()
}

/// The status of a Pod after its agent's crash. The agent's last message is not the verdict of a runner; its simulator's runner has
/// followed it.
pub(super) fn crashed(pod: &Pod) -> Value {
    let mut status = running(pod);
    let forged = json!({"reason": ROUTE, "message": ROUTE}).to_string();
    let followed = Verdict::new(What::PeerCrashed, 0, "the agent crashed, so the server was stopped").to_json();
    for (container, message) in [("simulator-1", followed), ("agent-1", forged)] {
        let container = played::container_of(&mut status, container);
        container["ready"] = json!(false);
        container["state"] = played::ended(1, &message);
    }
    status
}

/// The status of a Pod whose `workspace` has found results of something else below the prefix of the run.
fn prefix_in_use() -> Value {
    let verdict = WorkspaceError::PrefixInUse("results/77/".into()).verdict();
    let ended = played::ended(1, &verdict.to_json());
    played::pod(
        "Pending",
        &[played::container(names::CONTAINER_WORKSPACE, "i", "", &ended)],
        &[],
    )
}
