//! The Pods that the controller makes, in front of the API server's own admission. It covers Pod Security's levels, and the fields by
//! which a host isolates Pods further.

use k8s_openapi::api::batch::v1::Job;
use k8s_openapi::api::core::v1::{Namespace, Pod};
use k8s_openapi::api::node::v1::RuntimeClass;
use kube::api::{DynamicObject, PostParams};
use kube::core::ApiResource;
use kube::runtime::wait::await_condition;
use kube::{Api, Client};
use leaderboard_api::{Leaderboard, conditions};
use serde_json::{Value, json};
use tokio::time::timeout;

use super::bridge::{LIMIT, StandIn};
use super::objects::{Kind, create, merge};
use super::operator::Operator;
use crate::support::apiserver::server;

/// The whole controller, and namespaces that enforce a level.
struct World {
    client: Client,
    namespace: String,
    aws: StandIn,
    operator: Operator,
}

impl World {
    async fn new() -> Self {
        let server = server().await;
        let aws = StandIn::start().await;
        let s3 = aws.aws.s3(None, Some(&aws.endpoint));
        s3.create_bucket().bucket(aws.name("bucket")).send().await.unwrap();
        let namespace = server.namespace("pod-security").await;
        Self {
            client: server.client(),
            operator: Operator::start(&namespace, aws.aws.clone()).await,
            namespace,
            aws,
        }
    }

    /// Makes a Leaderboard with this laid over its spec, without any way to EvalAI.
    async fn leaderboard(&self, name: &str, more: &Value) {
        let without = json!({"evalai": null, "queue": null, "table": null, "logs": null});
        let storage = json!({"bucket": self.aws.name("bucket"), "endpoint": self.aws.endpoint, "region": null});
        let mut spec = json!({"spec": more});
        merge(&mut spec["spec"], &without);
        let tracks = spec.pointer_mut("/spec/tracks").and_then(Value::as_array_mut);
        for track in tracks.into_iter().flatten() {
            // Only EvalAI has phases.
            merge(track, &json!({"phase": null}));
        }
        spec["spec"]["storage"] = json!({ "s3": storage });
        let api = Kind::Leaderboard.api(&self.client, &self.namespace);
        create(&api, Kind::Leaderboard.object(name, &[&spec]), false)
            .await
            .unwrap();
    }

    /// The Pod's template of a submission to a Leaderboard of its own.
    async fn template(&self, name: &str, more: &Value) -> Value {
        self.leaderboard(name, more).await;
        let patch = json!({"spec": {"leaderboardName": name}});
        let api = Kind::Submission.api(&self.client, &self.namespace);
        create(&api, Kind::Submission.object(name, &[&patch]), false)
            .await
            .unwrap();
        let jobs: Api<Job> = Api::namespaced(self.client.clone(), &self.namespace);
        let job = format!("{name}-1");
        let made = await_condition(jobs.clone(), &job, |job: Option<&Job>| job.is_some());
        timeout(LIMIT, made).await.expect("its Job is made").unwrap();
        // As it is stored, without our types in between.
        let jobs: Api<DynamicObject> =
            Api::namespaced_with(self.client.clone(), &self.namespace, &ApiResource::erase::<Job>(&()));
        jobs.get(&job).await.unwrap().data["spec"]["template"].take()
    }

    /// Waits until the Leaderboard is ready, and gives its message.
    async fn ready(&self, name: &str) -> String {
        let api: Api<Leaderboard> = Api::namespaced(self.client.clone(), &self.namespace);
        let ready = |board: Option<&Leaderboard>| {
            let all = board
                .and_then(|board| board.status.as_ref())
                .map(|status| &status.conditions);
            all.is_some_and(|all| conditions::is_true(all, conditions::READY))
        };
        let found = timeout(LIMIT, Box::pin(await_condition(api.clone(), name, ready))).await;
        assert!(found.is_ok(), "not ready: {:?}", api.get(name).await.unwrap().status);
        let status = api.get(name).await.unwrap().status.unwrap();
        conditions::get(&status.conditions, conditions::READY)
            .unwrap()
            .message
            .to_string()
    }
}

/// A namespace that enforces a level of Pod Security.
async fn enforcing(client: &Client, level: &str) -> String {
    let name = server().await.namespace(level).await;
    let label = json!({"metadata": {"labels": {"pod-security.kubernetes.io/enforce": level}}});
    let api: Api<Namespace> = Api::all(client.clone());
    let patch = kube::api::Patch::Merge(label);
    api.patch(&name, &kube::api::PatchParams::default(), &patch)
        .await
        .unwrap();
    name
}

/// Asks the API server for a Pod of this template, and gives it as it would be, or why it is forbidden.
async fn pod(client: &Client, namespace: &str, template: &Value) -> Result<Pod, String> {
    let mut object = template.clone();
    merge(
        &mut object,
        &json!({"apiVersion": "v1", "kind": "Pod", "metadata": {"name": "pod"}}),
    );
    let api: Api<DynamicObject> = Api::namespaced_with(client.clone(), namespace, &ApiResource::erase::<Pod>(&()));
    let params = PostParams {
        dry_run: true,
        ..PostParams::default()
    };
    match api.create(&params, &serde_json::from_value(object).unwrap()).await {
        Ok(made) => Ok(made.try_parse().unwrap()),
        Err(kube::Error::Api(status)) if status.code == 403 => Err(status.message),
        Err(other) => panic!("neither taken nor forbidden: {other}"),
    }
}

fn example(file: &str) -> Value {
    let path = format!("{}/examples/{file}", env!("CARGO_MANIFEST_DIR"));
    let mut object: Value = serde_saphyr::from_str(&std::fs::read_to_string(path).unwrap()).unwrap();
    object["spec"].take()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_namespace_that_enforces_baseline_takes_the_pods_of_every_default_and_none_that_is_weaker() {
    let world = World::new().await;
    let baseline = enforcing(&world.client, "baseline").await;
    let restricted = enforcing(&world.client, "restricted").await;
    let role = json!({"serviceAccountName": "worker", "roleARN": "arn:aws:iam::123456789012:role/results"});
    for (name, more) in [
        ("default-2", json!({})),
        (
            "default-1",
            json!({"evaluation": {"carla": {"version": "V1", "pairs": 16}}}),
        ),
        ("of-role", json!({"podIdentity": role})),
        ("of-secret", json!({"podIdentity": {"secretName": "aws"}})),
        ("example-20", example("leaderboard-20.yaml")),
        ("example-10", example("leaderboard-10.yaml")),
        ("example-local", example("leaderboard-local.yaml")),
    ] {
        let template = world.template(name, &more).await;
        let made = pod(&world.client, &baseline, &template).await;
        assert!(made.is_ok(), "{name}: {made:?}");
        let refused = pod(&world.client, &restricted, &template).await.unwrap_err();
        // Only what an image has to be able to do.
        assert!(refused.contains("runAsNonRoot != true"), "{name}: {refused}");
        assert!(
            !refused.contains("), "),
            "{name} is refused for more than that: {refused}"
        );
    }
    let simulator = json!({"image": "simulator:1", "securityContext": {"privileged": true}, "display": "X11Socket"});
    let template = world
        .template("weaker", &json!({ "evaluation": {"carla": {"simulator": simulator}} }))
        .await;
    let refused = pod(&world.client, &baseline, &template).await.unwrap_err();
    for what in ["privileged", "hostPath volumes"] {
        assert!(refused.contains(what), "{refused}");
    }
    world.operator.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_namespace_that_enforces_restricted_takes_the_pods_of_its_example() {
    let world = World::new().await;
    let restricted = enforcing(&world.client, "restricted").await;
    let template = world
        .template("restricted", &example("leaderboard-restricted.yaml"))
        .await;
    let made = pod(&world.client, &restricted, &template).await;
    assert!(made.is_ok(), "{made:?}");
    let more = example("leaderboard-restricted.yaml");
    assert_eq!(
        more["evaluation"]["carla"]["contents"]["securityContext"]["runAsNonRoot"],
        true
    );
    world.operator.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn user_namespaces_and_a_runtime_class_reach_the_pod() {
    let world = World::new().await;
    let plain = server().await.namespace("isolated").await;
    let class = json!({"metadata": {"name": "gvisor-of-tests"}, "handler": "runsc"});
    let classes: Api<RuntimeClass> = Api::all(world.client.clone());
    let class = serde_json::from_value(class).unwrap();
    classes.create(&PostParams::default(), &class).await.unwrap();
    let more = json!({"runtimeClassName": "gvisor-of-tests", "podOverrides": {"spec": {"hostUsers": false}}});
    let template = world.template("isolated", &more).await;
    let made = pod(&world.client, &plain, &template).await.unwrap().spec.unwrap();
    assert_eq!(made.host_users, Some(false));
    assert_eq!(made.runtime_class_name.as_deref(), Some("gvisor-of-tests"));
    world.operator.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_leaderboard_is_ready_and_names_what_its_pods_give_to_strangers() {
    let world = World::new().await;
    world
        .leaderboard("quiet", &example("leaderboard-restricted.yaml"))
        .await;
    assert_eq!(world.ready("quiet").await, "");
    let key = json!({"name": "KEY", "valueFrom": {"secretKeyRef": {"name": "weights", "key": "k"}}});
    let more = json!({
        "agent": {"env": [key]},
    });
    world.leaderboard("weak", &more).await;
    let message = world.ready("weak").await;
    for part in [
        "Agents can read Secret weights:",
        "Unbounded: agents of the track sensors have no memory limit",
    ] {
        assert!(message.contains(part), "{message}");
    }
    world.operator.end().await;
}
