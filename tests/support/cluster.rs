//! A scene: one test's namespace on the lab's cluster, with its own things in AWS. It waits for events, and shows its objects when the
//! test fails.
//!
//! Knows the API server and the nodes' containers; the operator's programs are in `operator`, EvalAI is in `evalai`.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::io::Write as _;
use std::panic::{AssertUnwindSafe, resume_unwind};
use std::path::PathBuf;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use futures::FutureExt;
use k8s_openapi::api::core::v1::{Namespace, Pod, Secret};
use k8s_openapi::api::events::v1::Event;
use kube::api::{Api, ListParams, Patch, PatchParams, PostParams};
use kube::{Client, Config, Resource, ResourceExt};
use leaderboard_api::names::LABEL_SUBMISSION;
use leaderboard_api::{Leaderboard, Submission};
use serde_json::{Value, json};
use tokio::sync::OnceCell;
use tokio::time::timeout;

pub use self::reads::{containers, done, is_settled, is_true, names, reason, score, state};
use self::turns::Turn;
use super::aws::{BUCKET, Cloud, REGION};
use super::evalai::{Evalai, HOST_TOKEN};
use super::gate::Gate;

#[path = "cluster/borders.rs"]
mod borders;
#[path = "cluster/ending.rs"]
mod ending;
#[path = "cluster/reads.rs"]
mod reads;
#[path = "cluster/turns.rs"]
mod turns;
#[path = "cluster/waits.rs"]
mod waits;

/// Every wait of a test ends; this one ends what was forgotten.
const TEST_LIMIT: Duration = Duration::from_mins(20);
/// Names the tests' own requests in the API server's audit log.
pub const USER_AGENT: &str = "leaderboard-tests";
/// Marks the tests' namespaces, where no service account may write.
pub const LABEL: &str = "leaderboard.carla.org/test";
/// Drawn once for all tests: the API server compiles each rule of a definition that is applied.
static BORDERS: OnceCell<()> = OnceCell::const_new();

/// The cluster, as the environment describes it.
pub struct Lab {
    /// The machine's address, from Pods too.
    pub host: String,
    /// Where the challenge's images are.
    pub registry: String,
    /// The operator's image.
    pub image: String,
}

impl Lab {
    fn from_environment() -> Self {
        let variable = |name: &str| {
            std::env::var(name).ok().filter(|text| !text.is_empty()).unwrap_or_else(|| {
                panic!(
                    "{name} is not set: run through `make test`, or `make cluster`, eval \"$(local/lab env)\" and set \
                     LEADERBOARD_OPERATOR_IMAGE to what `make image` prints"
                )
            })
        };
        variable("KUBECONFIG");
        Self {
            host: variable("LAB_HOST"),
            registry: variable("LAB_REGISTRY"),
            image: variable("LEADERBOARD_OPERATOR_IMAGE"),
        }
    }

    /// An image of the challenge, such as `agent:standard`.
    pub fn challenge(&self, image: &str) -> String {
        format!("{}/challenge/{image}", self.registry)
    }

    /// An image of the guessing game, such as `agent:1`.
    pub fn game(&self, image: &str) -> String {
        format!("{}/guessing-game/{image}", self.registry)
    }
}

/// One test's part of the cluster.
pub struct Scene {
    pub lab: Lab,
    pub client: Client,
    pub namespace: String,
    pub cloud: Cloud,
    /// Between the operator and what AWS has for it alone. It is on loopback, where no Pod can be.
    pub gate: Gate,
    /// Folder of the operator's logs.
    pub logs: PathBuf,
    /// Lines about the operator's programs that ended by themselves.
    pub ended: Arc<Mutex<Vec<String>>>,
}

/// Runs one test in a scene of its own. If it fails, shows what the scene looked like; clears it away in any case, unless
/// `LEADERBOARD_TEST_KEEP` is set.
pub async fn scenario(name: &str, body: impl AsyncFnOnce(&Scene)) {
    let lab = Lab::from_environment();
    let _turn = Turn::take().await;
    let scene = Scene::set_up(lab, name).await;
    let begun = Instant::now();
    let outcome = AssertUnwindSafe(timeout(TEST_LIMIT, body(&scene))).catch_unwind().await;
    let seconds = begun.elapsed().as_secs_f64();
    let failure: Option<Box<dyn std::any::Any + Send>> = match outcome {
        Ok(Ok(())) => None,
        Ok(Err(_)) => Some(Box::new(format!("{name} takes more than {} s", TEST_LIMIT.as_secs()))),
        Err(panic) => Some(panic),
    };
    say(&format!(
        "{name}: {} in {seconds:.1} s",
        if failure.is_some() { "failed" } else { "passed" }
    ));
    if failure.is_some() {
        println!("{}", scene.describe().await);
    }
    scene.clear_away().await;
    if let Some(panic) = failure {
        resume_unwind(panic);
    }
}

/// Prints something at once, also in a test that passes.
pub fn say(line: &str) {
    _ = writeln!(std::io::stderr(), "{line}");
}

/// A client of the cluster. It belongs to the runtime of the test that calls this.
async fn client() -> Client {
    _ = rustls::crypto::ring::default_provider().install_default();
    let mut config = Config::infer().await.expect("KUBECONFIG names no cluster");
    let agent = (http::header::USER_AGENT, http::HeaderValue::from_static(USER_AGENT));
    config.headers.push(agent);
    Client::try_from(config).unwrap()
}

impl Scene {
    async fn set_up(lab: Lab, name: &str) -> Self {
        let client = client().await;
        BORDERS.get_or_init(|| borders::draw(&client)).await;
        let namespace = format!("{name}-{:05x}", fastrand::u32(..1 << 20));
        let endpoint = std::env::var("AWS_ENDPOINT_URL").unwrap_or_else(|_| format!("http://{}", lab.registry));
        let logs = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join(&namespace);
        fs::create_dir_all(&logs).unwrap();
        let scene = Self {
            cloud: Cloud::make(&endpoint, &namespace).await,
            gate: Gate::open("127.0.0.1", &endpoint).await,
            lab,
            client,
            namespace,
            logs,
            ended: Arc::default(),
        };
        let namespace = json!({"metadata": {"name": scene.namespace, "labels": {LABEL: "true"}}});
        let namespaces: Api<Namespace> = Api::all(scene.client.clone());
        let params = PostParams::default();
        namespaces
            .create(&params, &serde_json::from_value(namespace).unwrap())
            .await
            .unwrap();
        let keys = ["AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"];
        let keys = keys.map(|key| (key, std::env::var(key).unwrap_or_else(|_| "test".into())));
        scene.secret("aws", &json!(BTreeMap::from(keys))).await;
        scene.secret("evalai", &json!({"auth_token": HOST_TOKEN})).await;
        scene.await_policy().await;
        scene
    }

    /// Words for a failed wait about ended programs: without the operator nothing happens.
    fn ended_programs(&self) -> String {
        let ended = self.ended.lock().unwrap();
        ended.iter().flat_map(|line| ["; ", line]).collect()
    }

    /// Makes a Secret.
    pub async fn secret(&self, name: &str, data: &Value) {
        let secret = json!({"metadata": {"name": name}, "stringData": data});
        let secret: Secret = serde_json::from_value(secret).unwrap();
        self.api().create(&PostParams::default(), &secret).await.unwrap();
    }

    /// The objects of a kind in the scene's namespace.
    pub fn api<K>(&self) -> Api<K>
    where
        K: Resource<Scope = k8s_openapi::NamespaceResourceScope>,
        K::DynamicType: Default,
    {
        Api::namespaced(self.client.clone(), &self.namespace)
    }

    /// Applies a local Leaderboard with 20 routes for 4 pairs; `change` is laid over its spec.
    pub async fn leaderboard(&self, name: &str, change: Value) {
        let disk = json!({"requests": {"ephemeral-storage": "16Mi"}, "limits": {"ephemeral-storage": "4Gi"}});
        let spec = json!({
            "evaluation": {"carla": {
                "version": "V2", "contents": {"image": self.lab.challenge("contents:1")},
                "simulator": {"image": self.lab.challenge("simulator:1"), "resources": disk},
            }},
            "tracks": [{"name": "sensors", "carla": {"codename": "SENSORS"}}, {"name": "map", "carla": {"codename": "MAP"}}],
            "agent": {"resources": disk, "images": []},
            "storage": {"s3": {
                "bucket": BUCKET,
                "prefix": self.cloud.prefix,
                "region": REGION,
                "endpoint": self.cloud.endpoint,
            }},
            "podIdentity": {"secretName": "aws"},
            // Nothing enforces policies here; only the test of that waits the minute until it is certain.
            "network": {
                "dns": "None",
                "egress": [{"cidr": format!("{}/32", self.lab.host)}],
                "enforcement": "Disabled",
            },
            // Each period costs a request to EvalAI, of which a minute has 54, and several to the stand-in for S3.
            "syncPeriodSeconds": 2,
            "deadlines": {"readySeconds": 120, "idleSeconds": 60, "runSeconds": 1800},
        });
        self.apply_leaderboard(name, spec, change).await;
    }

    /// Applies the same as part of EvalAI's challenge 1, with queue and table; `change` is laid over its spec.
    pub async fn evalai_leaderboard(&self, name: &str, evalai: &Evalai, change: Value) {
        let mut spec = json!({
            "evalai": {
                "apiServer": evalai.url,
                "challenge": 1,
                "token": {"secretKeyRef": {"name": "evalai", "key": "auth_token"}},
            },
            "tracks": [
                {"name": "sensors", "carla": {"codename": "SENSORS"}, "phase": 1},
                {"name": "map", "carla": {"codename": "MAP"}, "phase": 2},
            ],
            "queue": {"sqs": {
                "url": self.cloud.queue_url,
                "deadLetterURL": self.cloud.dead_url,
                "region": REGION,
                "endpoint": self.gate.url,
            }},
            "table": {"dynamoDB": {"name": self.cloud.table, "region": REGION, "endpoint": self.gate.url}},
        });
        lay_over(&mut spec, change);
        self.leaderboard(name, spec).await;
    }

    async fn apply_leaderboard(&self, name: &str, mut spec: Value, change: Value) {
        lay_over(&mut spec, change);
        let board = json!({
            "apiVersion": Leaderboard::api_version(&()),
            "kind": Leaderboard::kind(&()),
            "metadata": {"name": name},
            "spec": spec,
        });
        let params = PatchParams::apply(USER_AGENT);
        self.api::<Leaderboard>()
            .patch(name, &params, &Patch::Apply(&board))
            .await
            .unwrap();
    }

    /// Changes fields of a Leaderboard's spec.
    pub async fn change_leaderboard(&self, name: &str, change: &Value) {
        let patch = Patch::Merge(json!({"spec": change}));
        self.api::<Leaderboard>()
            .patch(name, &PatchParams::default(), &patch)
            .await
            .unwrap();
    }

    /// Applies a Submission of the local Leaderboard `lb`, track sensors.
    pub async fn submit(&self, name: &str, agent: &str) {
        self.submit_to("lb", name, agent).await;
    }

    /// Applies a Submission of a local Leaderboard, track sensors.
    pub async fn submit_to(&self, board: &str, name: &str, agent: &str) {
        let spec = json!({
            "leaderboardName": board,
            "track": "sensors",
            "image": self.lab.challenge(agent),
            "team": {"id": "7", "name": "Team Seven"},
        });
        self.apply_submission(name, spec).await;
    }

    /// Applies any Submission.
    pub async fn apply_submission(&self, name: &str, spec: Value) {
        let submission = json!({"metadata": {"name": name}, "spec": spec});
        let submission: Submission = serde_json::from_value(submission).unwrap();
        self.api().create(&PostParams::default(), &submission).await.unwrap();
    }

    /// Changes fields of a Submission's spec.
    pub async fn change_submission(&self, name: &str, change: &Value) {
        let patch = Patch::Merge(json!({"spec": change}));
        self.api::<Submission>()
            .patch(name, &PatchParams::default(), &patch)
            .await
            .unwrap();
    }

    /// All objects of a kind.
    pub async fn all<K>(&self) -> Vec<K>
    where
        K: Resource<Scope = k8s_openapi::NamespaceResourceScope>
            + Clone
            + std::fmt::Debug
            + serde::de::DeserializeOwned,
        K::DynamicType: Default,
    {
        self.api::<K>().list(&ListParams::default()).await.unwrap().items
    }

    /// The names of a Submission's Pods.
    pub async fn pods_of(&self, submission: &str) -> Vec<String> {
        let pods = self.all::<Pod>().await.into_iter();
        let ours = |pod: &Pod| {
            pod.labels()
                .get(LABEL_SUBMISSION)
                .is_some_and(|name| name == submission)
        };
        pods.filter(ours).map(|pod| pod.name_any()).collect()
    }

    /// The events about an object, oldest first.
    pub async fn events(&self, name: &str) -> Vec<Event> {
        let all = self.all::<Event>().await.into_iter();
        let about = |event: &Event| event.regarding.as_ref().and_then(|object| object.name.clone());
        let mut found: Vec<_> = all.filter(|event| about(event).as_deref() == Some(name)).collect();
        found.sort_by_key(|event| {
            (
                event.event_time.as_ref().map(|time| time.0),
                event.metadata.resource_version.clone(),
            )
        });
        found
    }

    /// The names of all Jobs that ever had a Pod here, deleted ones too, as the Job controller's events show. A Job that was
    /// made twice is there twice.
    pub async fn jobs(&self) -> Vec<String> {
        let events = self.all::<Event>().await.into_iter();
        let jobs = events.filter_map(|event| event.regarding.filter(|object| object.kind.as_deref() == Some("Job")));
        let jobs: BTreeSet<_> = jobs.map(|job| (job.name.unwrap_or_default(), job.uid)).collect();
        jobs.into_iter().map(|(name, _)| name).collect()
    }
}

/// Lays `change` over `base`: objects deep, all else whole; null removes.
pub fn lay_over(base: &mut Value, change: Value) {
    match (base, change) {
        (Value::Object(base), Value::Object(change)) => {
            for (key, value) in change {
                if value.is_null() {
                    base.remove(&key);
                    continue;
                }
                lay_over(base.entry(key).or_insert(Value::Null), value);
            }
        }
        (base, change) => *base = change,
    }
}
