//! The ResourceClaimTemplate of a Leaderboard that claims its GPUs. The whole controller runs on an API server that serves
//! `resource.k8s.io/v1`, and on one that does not.

use k8s_openapi::api::batch::v1::Job;
use kube::api::{DeleteParams, DynamicObject, ListParams, Patch, PatchParams, PostParams};
use kube::runtime::wait::await_condition;
use kube::{Api, Client, ResourceExt};
use serde_json::{Value, json};
use tokio::time::timeout;

use super::bridge::{LIMIT, StandIn};
use super::objects::{Kind, create};
use super::operator::Operator;
use crate::support::apiserver::server;
use leaderboard_api::{Leaderboard, Reason, Submission, conditions};
use leaderboard_operator::leaderboards::claims::{keep, remove_others};
use leaderboard_pod_spec::gpu_claims::{resource, template};
use leaderboard_policy::leaderboards::view::Claims;

const NAME: &str = "carla";

struct World {
    client: Client,
    namespace: String,
    aws: StandIn,
}

impl World {
    /// A namespace with a Leaderboard that claims this.
    async fn new(claim: &Value) -> Self {
        let server = server().await;
        let world = Self {
            client: server.client(),
            namespace: server.namespace("claims").await,
            aws: StandIn::start().await,
        };
        let storage = json!({"bucket": world.aws.name("bucket"), "endpoint": world.aws.endpoint});
        let gpu = json!({"mode": "Claim", "claim": claim});
        let network = json!({"enforcement": "Disabled"});
        let patch =
            json!({"spec": {"storage": {"s3": storage}, "gpu": gpu, "network": network, "agent": {"images": []}}});
        let api = Kind::Leaderboard.api(&world.client, &world.namespace);
        let object = Kind::Leaderboard.object(NAME, &[&patch]);
        create(&api, object, false).await.unwrap();
        world
    }

    fn templates(&self) -> Api<DynamicObject> {
        Api::namespaced_with(self.client.clone(), &self.namespace, &resource())
    }

    fn jobs(&self) -> Api<Job> {
        Api::namespaced(self.client.clone(), &self.namespace)
    }

    fn leaderboards(&self) -> Api<Leaderboard> {
        Api::namespaced(self.client.clone(), &self.namespace)
    }

    async fn submit(&self) {
        let submissions = Kind::Submission.api(&self.client, &self.namespace);
        let patch = json!({"spec": {"leaderboardName": NAME}});
        let object = Kind::Submission.object("sub", &[&patch]);
        create(&submissions, object, false).await.unwrap();
    }

    /// Another class; the Leaderboard as it is then.
    async fn change(&self, class: &str) -> Leaderboard {
        let patch = Patch::Merge(json!({"spec": {"gpu": {"claim": {"deviceClassName": class}}}}));
        let params = PatchParams::default();
        self.leaderboards().patch(NAME, &params, &patch).await.unwrap()
    }

    /// The template of this Leaderboard, once it is there.
    async fn template_of(&self, leaderboard: &Leaderboard) -> DynamicObject {
        let name = template(leaderboard).unwrap().name_any();
        let there = await_condition(self.templates(), &name, |found: Option<&DynamicObject>| found.is_some());
        let found = timeout(LIMIT, there).await.expect("the template is applied");
        found.unwrap().unwrap()
    }

    async fn names(&self) -> Vec<String> {
        let found = self.templates().list(&ListParams::default()).await.unwrap();
        found.items.iter().map(ResourceExt::name_any).collect()
    }

    /// The message of `Ready`, once it is False with this reason.
    async fn not_ready(&self, reason: Reason) -> String {
        let ready = |found: &Leaderboard| {
            let conditions = found.status.as_ref()?.conditions.as_slice();
            let ready = conditions::get(conditions, conditions::READY)?.clone();
            (ready.status == "False" && ready.reason == reason).then_some(ready.message)
        };
        let is_so = await_condition(self.leaderboards(), NAME, |found: Option<&Leaderboard>| {
            found.is_some_and(|found| ready(found).is_some())
        });
        let found = timeout(LIMIT, Box::pin(is_so)).await.expect("it is not ready");
        ready(&found.unwrap().unwrap()).unwrap().into()
    }
}

/// The templates that the Pods of a Job claim by.
fn claimed(job: &Job) -> Vec<String> {
    let pod = job.spec.as_ref().unwrap().template.spec.as_ref().unwrap();
    let claims = pod.resource_claims.iter().flatten();
    claims
        .filter_map(|claim| claim.resource_claim_template_name.clone())
        .collect()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_template_is_applied_named_by_jobs_and_kept_as_long_as_one_needs_it() {
    let world = World::new(&json!({"deviceClassName": "gpu.nvidia.com"})).await;
    let operator = Operator::start(&world.namespace, world.aws.aws.clone()).await;
    let first = world.leaderboards().get(NAME).await.unwrap();
    let old = world.template_of(&first).await;
    let exactly = &old.data["spec"]["spec"]["devices"]["requests"][0]["exactly"];
    assert_eq!(exactly["deviceClassName"], "gpu.nvidia.com");
    assert_eq!(old.owner_references()[0].name, NAME);

    world.submit().await;
    let made = await_condition(world.jobs(), "sub-1", |job: Option<&Job>| job.is_some());
    let job = timeout(LIMIT, made).await.expect("the Job is made").unwrap().unwrap();
    assert_eq!(claimed(&job), vec![old.name_any(); 4]);

    let second = world.change("mig.nvidia.com").await;
    let new = world.template_of(&second).await;
    remove_others(&world.client, &second).await.unwrap();
    assert!(world.names().await.contains(&old.name_any()), "the Job needs it");
    operator.end().await;

    let params = DeleteParams::background();
    world.jobs().delete("sub-1", &params).await.unwrap();
    let gone = await_condition(world.jobs(), "sub-1", |job: Option<&Job>| job.is_none());
    timeout(LIMIT, gone).await.expect("the Job is gone").unwrap();
    // A template of another Leaderboard, or of a person.
    let stranger = DynamicObject {
        metadata: k8s_openapi::apimachinery::pkg::apis::meta::v1::ObjectMeta {
            name: Some("stranger".into()),
            labels: old.metadata.labels.clone(),
            ..Default::default()
        },
        ..DynamicObject::new("stranger", &resource()).data(old.data.clone())
    };
    world
        .templates()
        .create(&PostParams::default(), &stranger)
        .await
        .unwrap();
    remove_others(&world.client, &second).await.unwrap();
    let mut left = world.names().await;
    left.sort();
    let mut expected = [new.name_any(), "stranger".to_owned()];
    expected.sort();
    assert_eq!(left, expected);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_template_of_the_hosts_that_is_missing_is_named_and_no_job_is_made() {
    let world = World::new(&json!({"resourceClaimTemplateName": "mine"})).await;
    let operator = Operator::start(&world.namespace, world.aws.aws.clone()).await;
    let message = world.not_ready(Reason::ClaimTemplateMissing).await;
    let submissions: Api<Submission> = Api::namespaced(world.client.clone(), &world.namespace);
    world.submit().await;
    let is_held = await_condition(submissions, "sub", |found: Option<&Submission>| {
        let status = found.and_then(|found| found.status.as_ref());
        status.is_some_and(|status| status.shows(Reason::LeaderboardNotReady))
    });
    timeout(LIMIT, Box::pin(is_held)).await.expect("it waits").unwrap();
    assert!(
        world
            .jobs()
            .list(&ListParams::default())
            .await
            .unwrap()
            .items
            .is_empty()
    );
    assert!(
        message.starts_with("There is no ResourceClaimTemplate mine in this namespace"),
        "{message}"
    );
    operator.end().await;
    let leaderboard = world.leaderboards().get(NAME).await.unwrap();
    let data = json!({"spec": {"spec": {"devices": {"requests": [
        {"name": "gpu", "exactly": {"deviceClassName": "gpu.nvidia.com"}},
    ]}}}});
    let mine = DynamicObject::new("mine", &resource()).data(data);
    world.templates().create(&PostParams::default(), &mine).await.unwrap();
    assert_eq!(keep(&world.client, &leaderboard).await, Claims::InPlace);
}

/// Paths that it does not serve are answered by every API server in the same way.
#[tokio::test(flavor = "multi_thread")]
async fn an_api_server_that_does_not_serve_claims_is_known_by_its_answer() {
    let mut config = server().await.config();
    config.cluster_url = format!("{}nothing/", config.cluster_url).parse().unwrap();
    let client = Client::try_from(config).unwrap();
    for claim in [
        json!({"deviceClassName": "c"}),
        json!({"resourceClaimTemplateName": "t"}),
    ] {
        let gpu = json!({"spec": {"gpu": {"mode": "Claim", "claim": claim}}});
        let leaderboard: Leaderboard = serde_json::from_value(Kind::Leaderboard.object(NAME, &[&gpu])).unwrap();
        assert_eq!(keep(&client, &leaderboard).await, Claims::NotServed, "{claim}");
    }
}
