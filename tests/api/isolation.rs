//! The NetworkPolicy of a Leaderboard, as the whole controller keeps it. It is there before any Job, and comes back when it is edited or
//! deleted. A refusal is shown, and Pods measure its effect. The test plays the kubelet.

use std::time::{Duration, Instant};

use k8s_openapi::api::batch::v1::Job;
use k8s_openapi::api::networking::v1::NetworkPolicy;
use k8s_openapi::api::rbac::v1::{Role, RoleBinding};
use kube::api::{DeleteParams, Patch, PatchParams, PostParams};
use kube::runtime::wait::await_condition;
use kube::{Api, Client, ResourceExt};
use leaderboard_api::{Condition, Leaderboard, Reason, Submission, conditions, names};
use serde_json::{Value, json};
use tokio::net::TcpListener;
use tokio::time::timeout;

use super::bridge::{LIMIT, StandIn};
use super::objects::{Kind, create};
use super::operator::Operator;
use crate::support::apiserver::server;
use crate::support::played;
use crate::support::player::Cluster;

const NAME: &str = "carla";
const POLICY: &str = "leaderboard-carla";
/// A right applies a moment after it was given, and the API server reports nothing then: it is asked this often.
const POLL: Duration = Duration::from_millis(50);

/// A namespace and a place in S3, before there is a Leaderboard or a controller.
pub(super) struct World {
    pub(super) client: Client,
    pub(super) namespace: String,
    pub(super) aws: StandIn,
}

impl World {
    pub(super) async fn new() -> Self {
        let server = server().await;
        Self {
            client: server.client(),
            namespace: server.namespace("isolation").await,
            aws: StandIn::start().await,
        }
    }

    pub(super) fn api<K>(&self) -> Api<K>
    where
        K: kube::Resource<Scope = kube::core::NamespaceResourceScope>,
        K::DynamicType: Default,
    {
        Api::namespaced(self.client.clone(), &self.namespace)
    }

    async fn operator(&self) -> Operator {
        Operator::start(&self.namespace, self.aws.aws.clone()).await
    }

    async fn leaderboard(&self, network: &Value) {
        self.leaderboard_at(&self.aws.endpoint, network).await;
    }

    /// A Leaderboard whose bucket is at this endpoint.
    pub(super) async fn leaderboard_at(&self, endpoint: &str, network: &Value) {
        let storage = json!({"bucket": self.aws.name("bucket"), "endpoint": endpoint});
        let patch = json!({"spec": {"storage": {"s3": storage}, "network": network}});
        let api = Kind::Leaderboard.api(&self.client, &self.namespace);
        create(&api, Kind::Leaderboard.object(NAME, &[&patch]), false)
            .await
            .unwrap();
    }

    /// Sets the verbs that the operator with few rights has on policies from now on.
    async fn set_rights(&self, policies: &[&str]) {
        let patch = Patch::Merge(role(policies));
        let roles = self.api::<Role>();
        roles.patch("operator", &PatchParams::default(), &patch).await.unwrap();
    }

    pub(super) async fn change(&self, network: &Value) {
        let patch = Patch::Merge(json!({"spec": {"network": network}}));
        let api = self.api::<Leaderboard>();
        api.patch(NAME, &PatchParams::default(), &patch).await.unwrap();
    }

    pub(super) async fn submit(&self, name: &str) {
        let api = Kind::Submission.api(&self.client, &self.namespace);
        let patch = json!({"spec": {"leaderboardName": NAME}});
        create(&api, Kind::Submission.object(name, &[&patch]), false)
            .await
            .unwrap();
    }

    /// Waits until an object is so.
    pub(super) async fn until<K>(&self, name: &str, what: &str, holds: impl Fn(&K) -> bool) -> K
    where
        K: kube::Resource<Scope = kube::core::NamespaceResourceScope>
            + Clone
            + std::fmt::Debug
            + serde::de::DeserializeOwned
            + Send
            + 'static,
        K::DynamicType: Default,
    {
        let reached = await_condition(self.api::<K>(), name, |found: Option<&K>| found.is_some_and(&holds));
        let Ok(found) = timeout(LIMIT, reached).await else {
            panic!("{what}: {:?}", self.api::<K>().get_opt(name).await);
        };
        found.unwrap().unwrap()
    }

    pub(super) async fn job(&self, submission: &str) -> Job {
        let name = format!("{submission}-1");
        self.until(&name, "its Job is made", |_: &Job| true).await
    }

    /// Waits until the Leaderboard's condition `Isolated` shows it.
    async fn says(&self, status: &str, reason: Reason) -> Condition {
        let holds = |board: &Leaderboard| isolated(board).is_some_and(|c| c.status == status && c.reason == reason);
        let board = self.until(NAME, reason.as_str(), holds).await;
        isolated(&board).unwrap()
    }

    /// Waits until a submission is held back, and gives its message.
    async fn held_back(&self, name: &str) -> String {
        let holds = |submission: &Submission| {
            let status = submission.status.as_ref();
            status.is_some_and(|s| s.shows(Reason::NotIsolated))
        };
        let found = self.until(name, "it waits for the policy", holds).await;
        found.status.unwrap().message.unwrap().into()
    }

    /// A Pod of this Job whose `workspace` has ended with this message.
    async fn pod(&self, job: &Job, message: &Value) {
        let cluster = Cluster::new(&self.client, &self.namespace);
        let pod = cluster.pod(job).await.name_any();
        let ended = played::ended(0, &message.to_string());
        let workspace = played::container(names::CONTAINER_WORKSPACE, "i", "", &ended);
        cluster.set_pod(&pod, &played::pod("Pending", &[workspace], &[])).await;
    }
}

fn isolated(board: &Leaderboard) -> Option<Condition> {
    let status = board.status.as_ref()?;
    conditions::get(&status.conditions, conditions::ISOLATED).cloned()
}

/// Versions of all kinds come from one count.
fn version(object: &impl ResourceExt) -> u64 {
    object.resource_version().unwrap().parse().unwrap()
}

fn egress(policy: &NetworkPolicy) -> Value {
    serde_json::to_value(&policy.spec.as_ref().unwrap().egress).unwrap()
}

/// The isolation in the run of a Pod's `workspace`.
fn told(job: &Job) -> Value {
    run(job, "workspace").unwrap()["isolation"].clone()
}

/// The run that a container gets, as JSON; None if it gets none.
pub(super) fn run(job: &Job, container: &str) -> Option<Value> {
    let pod = job.spec.as_ref().unwrap().template.spec.as_ref().unwrap();
    let mut all = pod.init_containers.iter().flatten().chain(&pod.containers);
    let found = all.find(|found| found.name == container).unwrap();
    let run = found
        .env
        .iter()
        .flatten()
        .find(|variable| variable.name == "LEADERBOARD_RUN")?;
    Some(serde_json::from_str(run.value.as_deref().unwrap()).unwrap())
}

#[tokio::test(flavor = "multi_thread")]
async fn no_job_is_made_before_the_policy_of_the_present_spec() {
    let world = World::new().await;
    let operator = world.operator().await;
    let to = |cidr: &str| json!({"egress": [{"cidr": cidr, "ports": [443]}], "dns": "None"});
    // The submission first: it starts in the moment in which its Leaderboard is seen.
    world.submit("first").await;
    world.leaderboard(&to("192.0.2.1/32")).await;
    let job = world.job("first").await;
    let policy = world.api::<NetworkPolicy>().get(POLICY).await.unwrap();
    assert!(version(&policy) < version(&job), "{policy:?}\n{job:?}");

    world.change(&to("192.0.2.2/32")).await;
    world.submit("second").await;
    let job = world.job("second").await;
    let policy = world.api::<NetworkPolicy>().get(POLICY).await.unwrap();
    assert_eq!(egress(&policy)[0]["to"][0]["ipBlock"]["cidr"], "192.0.2.2/32");
    assert!(version(&policy) < version(&job), "{policy:?}\n{job:?}");
    operator.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_policy_that_is_edited_or_deleted_is_restored() {
    let world = World::new().await;
    let operator = world.operator().await;
    world.leaderboard(&json!({})).await;
    let first: NetworkPolicy = world.until(POLICY, "it is applied", |_| true).await;
    let policies = world.api::<NetworkPolicy>();
    for edit in [
        json!({"spec": {"egress": [{}]}}),
        json!({"spec": {"ingress": [{}]}}),
        json!({"spec": {"policyTypes": ["Ingress"]}}),
        json!({"metadata": {"labels": {"app.kubernetes.io/managed-by": "somebody"}}}),
    ] {
        let patch = Patch::Merge(&edit);
        let edited = policies.patch(POLICY, &PatchParams::default(), &patch).await.unwrap();
        let restored = |found: &NetworkPolicy| {
            version(found) > version(&edited) && found.spec == first.spec && found.labels() == first.labels()
        };
        world.until(POLICY, &edit.to_string(), restored).await;
    }
    policies.delete(POLICY, &DeleteParams::default()).await.unwrap();
    let uid = first.uid();
    let back = |found: &NetworkPolicy| found.uid() != uid && found.spec == first.spec;
    world.until(POLICY, "it comes back", back).await;
    operator.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_policy_is_restored_while_the_leaderboards_bucket_hangs() {
    let world = World::new().await;
    let operator = world.operator().await;
    // Takes connections and says nothing: the reconcile of the Leaderboard waits ten seconds for it.
    let silent = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let endpoint = format!("http://{}", silent.local_addr().unwrap());
    world.leaderboard_at(&endpoint, &json!({})).await;
    let first: NetworkPolicy = world.until(POLICY, "it is applied", |_| true).await;
    silent.accept().await.unwrap();
    let policies = world.api::<NetworkPolicy>();
    policies.delete(POLICY, &DeleteParams::default()).await.unwrap();
    let began = Instant::now();
    let uid = first.uid();
    world
        .until(POLICY, "it comes back", |found: &NetworkPolicy| found.uid() != uid)
        .await;
    assert!(began.elapsed() < Duration::from_secs(6), "{:?}", began.elapsed());
    operator.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn an_edited_egress_is_applied_while_the_leaderboards_bucket_hangs() {
    let world = World::new().await;
    let operator = world.operator().await;
    let silent = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let endpoint = format!("http://{}", silent.local_addr().unwrap());
    world.leaderboard_at(&endpoint, &json!({})).await;
    world.until(POLICY, "it is applied", |_: &NetworkPolicy| true).await;
    silent.accept().await.unwrap();
    let began = Instant::now();
    world
        .change(&json!({"egress": [{"cidr": "192.0.2.7/32"}], "dns": "None"}))
        .await;
    let follows = |found: &NetworkPolicy| {
        let rules = egress(found);
        rules[0]["to"][0]["ipBlock"]["cidr"] == "192.0.2.7/32"
    };
    world.until(POLICY, "it follows the edit", follows).await;
    assert!(began.elapsed() < Duration::from_secs(6), "{:?}", began.elapsed());
    operator.end().await;
}

/// Everything that the controller does in a namespace, but for what it may do to policies.
fn role(policies: &[&str]) -> Value {
    let groups = [
        "leaderboard.carla.org",
        "batch",
        "",
        "events.k8s.io",
        "coordination.k8s.io",
    ];
    json!({
        "apiVersion": "rbac.authorization.k8s.io/v1", "kind": "Role", "metadata": {"name": "operator"},
        "rules": [
            {"apiGroups": groups, "resources": ["*"], "verbs": ["*"]},
            {"apiGroups": ["networking.k8s.io"], "resources": ["networkpolicies"], "verbs": policies},
        ],
    })
}

async fn operator_with_few_rights(world: &World, policies: &[&str]) -> Operator {
    let user = format!("operator-of-{}", world.namespace);
    let role: Role = serde_json::from_value(role(policies)).unwrap();
    world.api().create(&PostParams::default(), &role).await.unwrap();
    let binding: RoleBinding = serde_json::from_value(json!({
        "metadata": {"name": "operator"},
        "roleRef": {"apiGroup": "rbac.authorization.k8s.io", "kind": "Role", "name": "operator"},
        "subjects": [{"kind": "User", "apiGroup": "rbac.authorization.k8s.io", "name": user}],
    }))
    .unwrap();
    world.api().create(&PostParams::default(), &binding).await.unwrap();
    let mut config = server().await.config();
    config.auth_info.impersonate = Some(user);
    config.auth_info.impersonate_groups = Some(vec!["system:authenticated".into()]);
    let own: Api<Leaderboard> = Api::namespaced(Client::try_from(config.clone()).unwrap(), &world.namespace);
    let has_rights = async {
        while own.list(&kube::api::ListParams::default()).await.is_err() {
            tokio::time::sleep(POLL).await;
        }
    };
    timeout(LIMIT, has_rights).await.expect("it has its rights");
    Operator::start_as(&world.namespace, world.aws.aws.clone(), config)
}

#[tokio::test(flavor = "multi_thread")]
async fn without_a_right_to_policies_no_job_is_made_and_both_objects_show_what_to_do() {
    let world = World::new().await;
    let operator = operator_with_few_rights(&world, &["get", "list", "watch"]).await;
    world.leaderboard(&json!({})).await;
    world.submit("one").await;
    let said = world.says("False", Reason::Forbidden).await;
    for part in [
        POLICY,
        "create and patch of networkpolicies",
        "network.policy to External",
    ] {
        assert!(said.message.contains(part), "{part}: {}", said.message);
    }
    let message = world.held_back("one").await;
    assert!(
        message.starts_with("The NetworkPolicy of Leaderboard carla is"),
        "{message}"
    );
    assert!(world.api::<Job>().get_opt("one-1").await.unwrap().is_none());
    let mut kubectl = server().await.kubectl();
    let shown = kubectl
        .args(["describe", "leaderboard", NAME, "-n", &world.namespace])
        .output()
        .unwrap();
    let shown = String::from_utf8(shown.stdout).unwrap();
    assert!(shown.contains("Isolated") && shown.contains("Forbidden"), "{shown}");
    world.set_rights(&["get", "list", "watch", "create", "patch"]).await;
    world.job("one").await;
    operator.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn without_a_right_to_observe_policies_no_job_is_made_and_it_is_shown() {
    let world = World::new().await;
    let operator = operator_with_few_rights(&world, &["get", "create", "patch"]).await;
    world.leaderboard(&json!({})).await;
    world.submit("one").await;
    let said = world.says("False", Reason::NotApplied).await;
    assert!(
        said.message.contains("list and watch of networkpolicies"),
        "{}",
        said.message
    );
    world.held_back("one").await;
    assert!(world.api::<Job>().get_opt("one-1").await.unwrap().is_none());
    world.set_rights(&["get", "list", "watch", "create", "patch"]).await;
    world.job("one").await;
    world.says("Unknown", Reason::NotMeasured).await;
    operator.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_job_that_was_deleted_with_the_policy_comes_back_with_it() {
    let world = World::new().await;
    let all = ["get", "list", "watch", "create", "patch"];
    let operator = operator_with_few_rights(&world, &all).await;
    world.leaderboard(&json!({})).await;
    world.submit("one").await;
    let first = world.job("one").await.uid();
    world.set_rights(&all[..3]).await;
    // The API server takes a moment to know; until then the policy comes back.
    let policies = world.api::<NetworkPolicy>();
    let is_refused = async {
        loop {
            let _ = policies.delete(POLICY, &DeleteParams::default()).await;
            let board = world.api::<Leaderboard>().get(NAME).await.unwrap();
            if isolated(&board).is_some_and(|c| c.reason == Reason::Forbidden) {
                return;
            }
            tokio::time::sleep(POLL * 10).await;
        }
    };
    timeout(LIMIT, is_refused).await.expect("the apply is refused");
    let jobs = world.api::<Job>();
    jobs.delete("one-1", &DeleteParams::background()).await.unwrap();
    world.held_back("one").await;
    world.set_rights(&all).await;
    let back = |job: &Job| job.uid() != first;
    world.until("one-1", "its Job comes back", back).await;
    operator.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn with_policies_of_the_clusters_own_none_is_applied_and_no_right_is_needed() {
    let world = World::new().await;
    let operator = operator_with_few_rights(&world, &["get"]).await;
    world.leaderboard(&json!({"policy": "External"})).await;
    world.submit("one").await;
    let job = world.job("one").await;
    assert_eq!(told(&job), Value::Null);
    world.says("Unknown", Reason::External).await;
    assert!(world.api::<NetworkPolicy>().get_opt(POLICY).await.unwrap().is_none());
    operator.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn what_a_pod_has_measured_is_the_leaderboards_condition_and_known_to_the_next_pod() {
    let world = World::new().await;
    let operator = world.operator().await;
    world.leaderboard(&json!({"egress": [{"cidr": "192.0.2.1/32"}]})).await;
    world.says("Unknown", Reason::NotMeasured).await;
    world.submit("first").await;
    let job = world.job("first").await;
    let first = json!({"enforcement": "Warn", "egress": ["192.0.2.1/32"], "isKnownOpen": false});
    assert_eq!(told(&job), first);
    let message = "The Pod could connect to 10.96.0.1:443.";
    world
        .pod(&job, &json!({"schema": 1, "reason": "NotEnforced", "message": message}))
        .await;
    let said = world.says("False", Reason::NotEnforced).await;
    assert_eq!(said.message, message);
    world.submit("second").await;
    assert_eq!(told(&world.job("second").await)["isKnownOpen"], true);

    // Another spec has not been measured.
    world.change(&json!({"egress": [{"cidr": "192.0.2.2/32"}]})).await;
    world.says("Unknown", Reason::NotMeasured).await;
    world.submit("third").await;
    let job = world.job("third").await;
    assert_eq!(told(&job)["isKnownOpen"], false);
    world
        .pod(
            &job,
            &json!({"schema": 1, "reason": "Enforced", "message": "It could not."}),
        )
        .await;
    world.says("True", Reason::Enforced).await;
    operator.end().await;
}
