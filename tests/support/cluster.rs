//! A scene: one test's namespace on the lab's cluster, with its own things in AWS; how it waits for what happens in it, and
//! what it tells of itself when the test fails.
//!
//! Knows the API server and the nodes' containers; the operator's programs are in `operator`, EvalAI is in `evalai`.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use std::fs;
use std::io::Write as _;
use std::panic::{AssertUnwindSafe, resume_unwind};
use std::path::PathBuf;
use std::time::{Duration, Instant};

use futures::FutureExt;
use k8s_openapi::api::admissionregistration::v1::{ValidatingAdmissionPolicy, ValidatingAdmissionPolicyBinding};
use k8s_openapi::api::batch::v1::Job;
use k8s_openapi::api::core::v1::{ContainerStatus, Namespace, Pod, Secret};
use k8s_openapi::api::events::v1::Event;
use k8s_openapi::apiextensions_apiserver::pkg::apis::apiextensions::v1::CustomResourceDefinition;
use kube::api::{Api, DeleteParams, ListParams, Patch, PatchParams, PostParams};
use kube::runtime::wait::{await_condition, conditions::is_crd_established};
use kube::{Client, Config, Resource, ResourceExt};
use leaderboard_api::{Leaderboard, State, Submission, conditions};
use leaderboard_operator::crds;
use serde_json::{Value, json};
use tokio::sync::Semaphore;
use tokio::time::{sleep, timeout};

use super::aws::{BUCKET, Cloud, REGION};
use super::evalai::{Evalai, HOST_TOKEN};
use super::gate::Gate;

/// Every wait of a test ends; this one ends what was forgotten.
const TEST_LIMIT: Duration = Duration::from_mins(20);
/// How many tests run at once, however many threads there are: more would only wait for the processors.
static SLOTS: Semaphore = Semaphore::const_new(4);
/// Names the tests' own requests in the API server's audit log.
pub const USER_AGENT: &str = "leaderboard-tests";
/// Marks the tests' namespaces.
const LABEL: &str = "leaderboard.carla.org/test";
/// Name of the policy that keeps other operators out of them.
const POLICY: &str = "leaderboard-tests";
/// Lines of each of the operator's logs that a failed test shows.
const LOG_LINES: usize = 40;

/// What the environment says about the cluster.
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
}

/// Runs one test in a scene of its own. If it fails, tells what the scene looked like; clears it away in any case, unless
/// `LEADERBOARD_TEST_KEEP` is set.
pub async fn scenario(name: &str, body: impl AsyncFnOnce(&Scene)) {
    let lab = Lab::from_environment();
    let _slot = SLOTS.acquire().await.unwrap();
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

/// Says something at once, also in a test that passes.
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
        install_definitions(&client).await;
        keep_others_out(&client).await;
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

    /// Waits until others are kept out: the API server takes a new policy in only after a moment.
    async fn await_policy(&self) {
        let mut config = Config::infer().await.unwrap();
        config.auth_info.impersonate = Some("system:serviceaccount:somewhere:operator".into());
        config.auth_info.impersonate_groups = Some(vec!["system:masters".into()]);
        let others = Client::try_from(config).unwrap();
        let others: Api<Secret> = Api::namespaced(others, &self.namespace);
        let (trial, params) = (
            json!({"metadata": {"name": "trial"}}),
            PostParams {
                dry_run: true,
                ..PostParams::default()
            },
        );
        let trial: Secret = serde_json::from_value(trial).unwrap();
        let kept_out = async {
            while others.create(&params, &trial).await.is_ok() {
                sleep(Duration::from_millis(200)).await;
            }
        };
        timeout(Duration::from_mins(1), kept_out)
            .await
            .expect("the policy has no effect");
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
        let spec = json!({
            "leaderboardVersion": "V2",
            "tracks": [{"name": "sensors", "codename": "SENSORS"}, {"name": "map", "codename": "MAP"}],
            "contents": {"image": self.lab.challenge("contents:1")},
            "simulator": {"image": self.lab.challenge("simulator:1")},
            "storage": {
                "bucket": BUCKET,
                "prefix": self.cloud.prefix,
                "region": REGION,
                "endpoint": self.cloud.endpoint,
            },
            "podIdentity": {"secretName": "aws"},
            // Nothing enforces policies here; only the test of that waits the minute until it is certain.
            "network": {
                "dns": false,
                "egress": [{"cidr": format!("{}/32", self.lab.host)}],
                "enforcement": "Off",
            },
            "syncPeriodSeconds": 1,
            "deadlines": {"readySeconds": 120, "idleSeconds": 60, "runSeconds": 1800},
        });
        self.apply_leaderboard(name, spec, change).await;
    }

    /// Applies the same as part of EvalAI's challenge 1, with queue and table; `change` is laid over its spec.
    pub async fn evalai_leaderboard(&self, name: &str, evalai: &Evalai, change: Value) {
        let mut spec = json!({
            // Each period costs a request, and a minute has 54.
            "syncPeriodSeconds": 2,
            "evalai": {
                "apiServer": evalai.url,
                "challenge": 1,
                "token": {"secretKeyRef": {"name": "evalai", "key": "auth_token"}},
            },
            "tracks": [
                {"name": "sensors", "codename": "SENSORS", "phase": 1},
                {"name": "map", "codename": "MAP", "phase": 2},
            ],
            "queue": {
                "url": self.cloud.queue_url,
                "deadLetterURL": self.cloud.dead_url,
                "region": REGION,
                "endpoint": self.gate.url,
            },
            "table": {"name": self.cloud.table, "region": REGION, "endpoint": self.gate.url},
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

    /// Waits until a Leaderboard is ready: EvalAI has been asked for phases and labels.
    pub async fn ready(&self, name: &str) {
        let ready = |found: Option<&Leaderboard>| {
            let status = found.and_then(|board| board.status.as_ref());
            status.is_some_and(|status| conditions::is_true(&status.conditions, conditions::READY))
        };
        self.wait(name, "it is ready", Duration::from_mins(1), ready).await;
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

    /// Waits until `condition` holds for an object; it is handed back unless it is gone.
    pub async fn wait<K>(
        &self,
        name: &str,
        what: &str,
        limit: Duration,
        condition: impl Fn(Option<&K>) -> bool,
    ) -> Option<K>
    where
        K: Resource<Scope = k8s_openapi::NamespaceResourceScope>
            + Clone
            + std::fmt::Debug
            + serde::de::DeserializeOwned
            + Send
            + 'static,
        K::DynamicType: Default,
    {
        let reached = async {
            loop {
                match await_condition(self.api::<K>(), name, &condition).await {
                    Ok(found) => return found,
                    // A watch may expire, and begins anew.
                    Err(error) => println!("{name}: {what}: {error}"),
                }
            }
        };
        let reached = timeout(limit, reached).await;
        reached.unwrap_or_else(|_| panic!("{name}: not after {} s: {what}", limit.as_secs()))
    }

    /// Waits until `condition` holds for a Submission.
    pub async fn submission(
        &self,
        name: &str,
        what: &str,
        limit: Duration,
        condition: impl Fn(&Submission) -> bool + 'static,
    ) -> Submission {
        let holds = move |found: Option<&Submission>| found.is_some_and(&condition);
        self.wait(name, what, limit, holds).await.unwrap()
    }

    /// Waits until a Submission's agents run.
    pub async fn running(&self, name: &str, limit: Duration) -> Submission {
        let runs = |s: &Submission| matches!(state(s), Some(State::Running | State::Resumed));
        self.submission(name, "its agents run", limit, runs).await
    }

    /// Waits until a Submission has come to its end, in Kubernetes, EvalAI and DynamoDB.
    pub async fn settled(&self, name: &str, limit: Duration) -> Submission {
        self.submission(name, "it has ended and everybody knows", limit, is_settled)
            .await
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

    /// The only Pod of a Submission that is not ending.
    pub async fn pod(&self, submission: &str) -> Pod {
        let selector = format!("leaderboard.carla.org/submission={submission}");
        let pods = self
            .api::<Pod>()
            .list(&ListParams::default().labels(&selector))
            .await
            .unwrap();
        let mut pods: Vec<_> = pods
            .into_iter()
            .filter(|pod| pod.metadata.deletion_timestamp.is_none())
            .collect();
        assert_eq!(pods.len(), 1, "{submission} has one Pod: {:?}", names(&pods));
        pods.remove(0)
    }

    /// Waits for the Pod of a Submission's first Job.
    pub async fn first_pod(&self, submission: &str, limit: Duration) -> Pod {
        let made = |job: Option<&Job>| job.is_some_and(|job| job.status.as_ref().is_some_and(|s| s.active == Some(1)));
        let job = format!("{submission}-1");
        self.wait(&job, "it has a Pod", limit, made).await;
        self.pod(submission).await
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

    /// The names of all Jobs that ever had a Pod here, deleted ones too, as the Job controller's events tell. A Job that was
    /// made twice is there twice.
    pub async fn jobs(&self) -> Vec<String> {
        let events = self.all::<Event>().await.into_iter();
        let jobs = events.filter_map(|event| event.regarding.filter(|object| object.kind.as_deref() == Some("Job")));
        let jobs: BTreeSet<_> = jobs.map(|job| (job.name.unwrap_or_default(), job.uid)).collect();
        jobs.into_iter().map(|(name, _)| name).collect()
    }

    /// Everything that helps to understand a failure.
    async fn describe(&self) -> String {
        let mut text = format!("\n===== {}\n", self.namespace);
        for submission in self.all::<Submission>().await {
            let status = serde_json::to_string_pretty(&submission.status).unwrap_or_default();
            let name = submission.name_any();
            let deleted = submission.metadata.deletion_timestamp.is_some();
            _ = writeln!(
                text,
                "--- submission {name} (deleted: {deleted}) {}\n{status}",
                json!(submission.spec)
            );
            for event in self.events(&name).await {
                _ = writeln!(
                    text,
                    "event {:?}: {:?}",
                    event.reason.unwrap_or_default(),
                    event.note.unwrap_or_default()
                );
            }
        }
        for board in self.all::<Leaderboard>().await {
            _ = writeln!(text, "--- leaderboard {} {}", board.name_any(), json!(board.status));
        }
        for job in self.all::<Job>().await {
            _ = writeln!(text, "--- job {} {}", job.name_any(), json!(job.status));
        }
        for pod in self.all::<Pod>().await {
            _ = writeln!(
                text,
                "--- pod {}, {:?}",
                pod.name_any(),
                pod.status.as_ref().and_then(|s| s.phase.clone())
            );
            for container in containers(&pod) {
                let (state, last) = (json!(container.state), json!(container.last_state));
                _ = writeln!(
                    text,
                    "{} (restarts {}): {state} before: {last}",
                    container.name, container.restart_count
                );
            }
        }
        let mut logs: Vec<_> = fs::read_dir(&self.logs)
            .into_iter()
            .flatten()
            .flatten()
            .map(|e| e.path())
            .collect();
        logs.sort();
        for path in logs {
            let log = fs::read_to_string(&path).unwrap_or_default();
            let lines: Vec<_> = log.lines().collect();
            let tail = lines[lines.len().saturating_sub(LOG_LINES)..].join("\n");
            _ = writeln!(text, "--- the end of {}\n{tail}", path.display());
        }
        text
    }

    /// Lets go of everything; the cluster removes the rest by itself.
    async fn clear_away(&self) {
        if std::env::var_os("LEADERBOARD_TEST_KEEP").is_some() {
            return;
        }
        let release = Patch::Merge(json!({"metadata": {"finalizers": null}}));
        let (at_once, all) = (DeleteParams::background().grace_period(1), ListParams::default());
        _ = self.api::<Submission>().delete_collection(&at_once, &all).await;
        for submission in self.all::<Submission>().await {
            _ = self
                .api::<Submission>()
                .patch(&submission.name_any(), &PatchParams::default(), &release)
                .await;
        }
        _ = self.api::<Leaderboard>().delete_collection(&at_once, &all).await;
        for board in self.all::<Leaderboard>().await {
            _ = self
                .api::<Leaderboard>()
                .patch(&board.name_any(), &PatchParams::default(), &release)
                .await;
        }
        _ = self.api::<Job>().delete_collection(&at_once, &all).await;
        _ = self.api::<Pod>().delete_collection(&at_once, &all).await;
        _ = Api::<Namespace>::all(self.client.clone())
            .delete(&self.namespace, &at_once)
            .await;
        self.cloud.remove().await;
    }
}

/// Installs the definitions, or brings them up to date.
async fn install_definitions(client: &Client) {
    let api: Api<CustomResourceDefinition> = Api::all(client.clone());
    for definition in crds::definitions().unwrap() {
        let object = definition.object().unwrap();
        let name = object.name_any();
        let params = PatchParams::apply(USER_AGENT).force();
        let applied = api.patch(&name, &params, &Patch::Apply(definition.json())).await;
        applied.unwrap_or_else(|error| panic!("the cluster takes no definition {name}: {error}; is it up?"));
        let established = timeout(
            Duration::from_mins(1),
            await_condition(api.clone(), &name, is_crd_established()),
        );
        established.await.expect("a definition is not served").unwrap();
    }
}

/// The cluster may have an operator that serves all namespaces, such as the demo's: it may write nothing here, and what it
/// would read and delete elsewhere is out of its reach, on loopback.
async fn keep_others_out(client: &Client) {
    let policy = json!({
        "apiVersion": "admissionregistration.k8s.io/v1",
        "kind": "ValidatingAdmissionPolicy",
        "metadata": {"name": POLICY},
        "spec": {
            "failurePolicy": "Fail",
            "matchConstraints": {
                "namespaceSelector": {"matchLabels": {LABEL: "true"}},
                "resourceRules": [{
                    "apiGroups": ["*"],
                    "apiVersions": ["*"],
                    "operations": ["CREATE", "UPDATE", "DELETE"],
                    "resources": ["*/*"],
                }],
            },
            "validations": [{
                "expression": "!request.userInfo.username.startsWith('system:serviceaccount:') || \
                    request.userInfo.username.startsWith('system:serviceaccount:kube-system:')",
                "message": "this namespace belongs to a test, which runs an operator of its own",
            }],
        },
    });
    let binding = json!({
        "apiVersion": "admissionregistration.k8s.io/v1",
        "kind": "ValidatingAdmissionPolicyBinding",
        "metadata": {"name": POLICY},
        "spec": {"policyName": POLICY, "validationActions": ["Deny"]},
    });
    let params = PatchParams::apply(USER_AGENT).force();
    let policies: Api<ValidatingAdmissionPolicy> = Api::all(client.clone());
    policies.patch(POLICY, &params, &Patch::Apply(&policy)).await.unwrap();
    let bindings: Api<ValidatingAdmissionPolicyBinding> = Api::all(client.clone());
    bindings.patch(POLICY, &params, &Patch::Apply(&binding)).await.unwrap();
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

/// The STATE column.
pub fn state(submission: &Submission) -> Option<State> {
    submission.status.as_ref().and_then(|status| status.state)
}

/// The REASON column.
pub fn reason(submission: &Submission) -> &str {
    submission
        .status
        .as_ref()
        .and_then(|status| status.reason.as_deref())
        .unwrap_or_default()
}

/// Its driving score.
pub fn score(submission: &Submission) -> &str {
    submission
        .status
        .as_ref()
        .and_then(|status| status.score.as_deref())
        .unwrap_or_default()
}

/// Routes that are done.
pub fn done(submission: &Submission) -> i32 {
    let progress = submission.status.as_ref().and_then(|status| status.progress.as_ref());
    progress.map_or(0, |progress| progress.done)
}

/// Whether a condition of a Submission is True.
pub fn is_true(submission: &Submission, condition: &str) -> bool {
    let status = submission.status.as_ref();
    status.is_some_and(|status| conditions::is_true(&status.conditions, condition))
}

fn is_settled(submission: &Submission) -> bool {
    let Some(status) = &submission.status else { return false };
    let known = |type_: &str| {
        let condition = conditions::get(&status.conditions, type_);
        condition.is_some_and(|c| c.status == "True" || c.reason == "NotRequired")
    };
    status.attempt == Some(submission.spec.attempt)
        && is_true(submission, conditions::FINISHED)
        && known(conditions::PUBLISHED)
        && known(conditions::RECORDED)
}

/// The names of objects, for messages.
pub fn names<K: Resource>(objects: &[K]) -> Vec<String> {
    objects.iter().map(ResourceExt::name_any).collect()
}

/// The statuses of all of a Pod's containers, init containers and sidecar first.
pub fn containers(pod: &Pod) -> Vec<ContainerStatus> {
    let status = pod.status.clone().unwrap_or_default();
    let lists = [status.init_container_statuses, status.container_statuses];
    lists.into_iter().flatten().flatten().collect()
}
