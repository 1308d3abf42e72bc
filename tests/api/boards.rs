//! The status of a Leaderboard while its places in AWS and its token are missing, silent or there. The controller's metrics show the
//! calls.

use std::time::Duration;

use aws_sdk_dynamodb::types::{AttributeDefinition, BillingMode, KeySchemaElement, KeyType, ScalarAttributeType};
use base64::Engine;
use base64::engine::general_purpose::URL_SAFE_NO_PAD;
use evalai_stand_in::{Config, Handle};
use jiff::{SignedDuration, Timestamp};
use k8s_openapi::api::batch::v1::Job;
use k8s_openapi::api::scheduling::v1::PriorityClass;
use kube::api::{Api, Patch, PatchParams, PostParams};
use kube::runtime::wait::await_condition;
use leaderboard_api::{Condition, Leaderboard, Reason, conditions};
use serde_json::{Value, json};
use tokio::net::TcpListener;
use tokio::time::timeout;

use super::bridge::{LIMIT, StandIn};
use super::objects::{Kind, create};
use super::operator::Operator;
use crate::support::apiserver::server;
use crate::support::ministack;

const NAME: &str = "carla";
/// A metric has no event.
const ASK_EVERY: Duration = Duration::from_millis(100);

/// A controller with everything around it, before there is a Leaderboard.
struct World {
    operator: Operator,
    aws: StandIn,
    evalai: Handle,
    namespace: String,
    token: String,
}

impl World {
    async fn new() -> Self {
        let aws = StandIn::start().await;
        let namespace = server().await.namespace("boards").await;
        let ends = Timestamp::now() + SignedDuration::from_hours(20 * 24);
        let token = jwt(&json!({"token_type": "refresh", "user_id": 1, "exp": ends.as_second()}));
        let (mut config, _) = Config::in_memory().unwrap();
        config.seed.users[0].tokens[0].value.clone_from(&token);
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let evalai = evalai_stand_in::serve(config, vec![listener]);
        let operator = Operator::start(&namespace, aws.aws.clone()).await;
        Self {
            operator,
            aws,
            evalai,
            namespace,
            token,
        }
    }

    /// Stores the token in Secrets Manager, and gives the place.
    async fn store_token(&self) -> Value {
        let id = self.aws.name("evalai");
        let text = json!({ "auth_token": self.token }).to_string();
        let client = self.aws.aws.secrets(None, Some(&self.aws.endpoint));
        client
            .create_secret()
            .name(&id)
            .secret_string(text)
            .send()
            .await
            .unwrap();
        json!({"secretsManager": {"id": id, "endpoint": self.aws.endpoint}})
    }

    fn bucket(&self) -> String {
        self.aws.name("bucket")
    }

    fn table(&self) -> String {
        self.aws.name("table")
    }

    /// The spec of a Leaderboard that reports to EvalAI; queues that do not exist have URLs all the same.
    fn spec(&self, token: &Value) -> Value {
        let endpoint = &self.aws.endpoint;
        let url = |name| format!("{endpoint}/000000000000/{}", self.aws.name(name));
        json!({"spec": {
            "evalai": {"apiServer": self.evalai.url(), "challenge": 1, "token": token},
            "tracks": [{"name": "sensors", "phase": 1}],
            "storage": {"s3": {"bucket": self.bucket(), "endpoint": endpoint}},
            "table": {"dynamoDB": {"name": self.table(), "endpoint": endpoint}},
            "queue": {"sqs": {"url": url("queue"), "deadLetterURL": url("dead"), "endpoint": endpoint}},
        }})
    }

    async fn apply(&self, spec: &Value) {
        let api = Kind::Leaderboard.api(&server().await.client(), &self.namespace);
        let object = Kind::Leaderboard.object(NAME, &[spec]);
        create(&api, object, false).await.unwrap();
    }

    /// An edit, as a person makes it after a fix: everything is asked again.
    async fn edit(&self, ttl: i32) {
        let patch = Patch::Merge(json!({"spec": {"ttlSecondsAfterFinished": ttl}}));
        let api = self.boards().await;
        api.patch(NAME, &PatchParams::default(), &patch).await.unwrap();
    }

    async fn boards(&self) -> Api<Leaderboard> {
        Api::namespaced(server().await.client(), &self.namespace)
    }

    /// Waits until the Leaderboard shows this.
    async fn says(&self, status: &str, reason: Reason) -> Condition {
        let api = self.boards().await;
        let found =
            |board: Option<&Leaderboard>| ready(board).is_some_and(|c| c.status == status && c.reason == reason);
        let Ok(board) = timeout(LIMIT, await_condition(api.clone(), NAME, found)).await else {
            let now = api.get(NAME).await.unwrap();
            panic!("not {status} {reason} but {:?}", ready(Some(&now)));
        };
        ready(board.unwrap().as_ref()).unwrap()
    }

    /// Waits until the metrics have a line of this beginning.
    async fn counted(&self, beginning: &str) -> String {
        let found = async {
            loop {
                let text = self.operator.metrics();
                if let Some(line) = text.lines().find(|line| line.starts_with(beginning)) {
                    return line.to_owned();
                }
                tokio::time::sleep(ASK_EVERY).await;
            }
        };
        let found = timeout(LIMIT, found).await;
        found.unwrap_or_else(|_| panic!("no {beginning} in\n{}", self.operator.metrics()))
    }

    async fn make_bucket(&self) {
        let client = self.aws.aws.s3(None, Some(&self.aws.endpoint));
        client.create_bucket().bucket(self.bucket()).send().await.unwrap();
    }

    async fn make_table(&self) {
        make_table(&self.aws, &self.table()).await;
    }
}

/// Makes a table as a Leaderboard expects it.
pub(super) async fn make_table(aws: &StandIn, name: &str) {
    let client = aws.aws.dynamodb(None, Some(&aws.endpoint));
    let mut request = client.create_table().table_name(name);
    for (key, role) in [("team_id", KeyType::Hash), ("submission_id", KeyType::Range)] {
        let definition = AttributeDefinition::builder()
            .attribute_name(key)
            .attribute_type(ScalarAttributeType::S);
        let element = KeySchemaElement::builder().attribute_name(key).key_type(role);
        request = request
            .attribute_definitions(definition.build().unwrap())
            .key_schema(element.build().unwrap());
    }
    request.billing_mode(BillingMode::PayPerRequest).send().await.unwrap();
}

fn ready(board: Option<&Leaderboard>) -> Option<Condition> {
    conditions::get(&board?.status.as_ref()?.conditions, conditions::READY).cloned()
}

fn jwt(claims: &Value) -> String {
    let part = |value: &Value| URL_SAFE_NO_PAD.encode(value.to_string());
    format!("{}.{}.c2lnbmF0dXJl", part(&json!({"alg": "HS256"})), part(claims))
}

#[tokio::test(flavor = "multi_thread")]
async fn what_is_missing_is_named_until_it_is_there() {
    let world = World::new().await;
    let token = world.store_token().await;
    world.apply(&world.spec(&token)).await;
    let said = world.says("False", Reason::BucketUnreachable).await;
    let all = [
        world.bucket(),
        world.table(),
        world.aws.name("queue"),
        world.aws.name("dead"),
    ];
    for name in &all {
        assert!(said.message.contains(name), "{name} is missing too: {}", said.message);
    }
    assert!(said.message.contains("Create the bucket"), "{}", said.message);
    world.make_bucket().await;
    // Without an edit here the controller asks again by itself.
    let said = world.says("False", Reason::TableUnreachable).await;
    assert!(said.message.contains("check table.dynamoDB.name"), "{}", said.message);
    world.make_table().await;
    world.edit(1).await;
    let said = world.says("False", Reason::QueueUnreachable).await;
    assert!(
        said.message.contains("create it, or correct queue.sqs.url"),
        "{}",
        said.message
    );
    world.aws.queue("queue").await;
    world.edit(2).await;
    let said = world.says("False", Reason::DeadLetterQueueUnreachable).await;
    assert!(!said.message.contains(&world.bucket()), "{}", said.message);
    world.aws.queue("dead").await;
    world.edit(3).await;
    let said = world.says("True", Reason::Ready).await;
    let ends = Timestamp::now() + SignedDuration::from_hours(20 * 24);
    let ends = ends.strftime("%Y-%m-%d").to_string();
    assert!(
        said.message.contains(&format!("ends on {ends}")) && said.message.contains("evalai.token"),
        "the token ends within 30 days: {}",
        said.message
    );
    what_was_asked_is_counted(&world).await;
    world.operator.end().await;
}

async fn what_was_asked_is_counted(world: &World) {
    for line in [
        "leaderboard_cloud_calls_total{service=\"s3\",op=\"ListObjectsV2\",outcome=\"ok\"}",
        "leaderboard_cloud_calls_total{service=\"s3\",op=\"ListObjectsV2\",outcome=\"missing\"}",
        "leaderboard_cloud_calls_total{service=\"dynamodb\",op=\"DescribeTable\",outcome=\"missing\"}",
        "leaderboard_cloud_calls_total{service=\"sqs\",op=\"GetQueueAttributes\",outcome=\"missing\"}",
        "leaderboard_cloud_calls_total{service=\"secretsmanager\",op=\"GetSecretValue\",outcome=\"ok\"}",
        "leaderboard_evalai_requests_total{op=\"get_phases\",outcome=\"ok\"}",
        "leaderboard_evalai_requests_total{op=\"sweep_submitted\",outcome=\"ok\"}",
        "leaderboard_evalai_request_duration_seconds_count{op=\"get_splits\"}",
        "leaderboard_submissions{state=\"Running\"} 0",
        &format!("leaderboard_ready{{leaderboard=\"{}/{NAME}\"}} 1", world.namespace),
    ] {
        world.counted(line).await;
    }
    let text = world.operator.metrics();
    for private in [world.token.as_str(), &world.token[..20], &world.bucket(), "127.0.0.1"] {
        assert!(!text.contains(private), "{private} is in the metrics:\n{text}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_bucket_that_is_away_for_a_moment_changes_nothing() {
    let world = World::new().await;
    world.make_bucket().await;
    let proxy = ministack::server().await.proxy().await;
    world
        .apply(&json!({"spec": {"storage": {"s3": {"bucket": world.bucket(), "endpoint": proxy.endpoint()}}}}))
        .await;
    let before = world.says("True", Reason::Ready).await;
    proxy.set_away(true);
    world.edit(1).await;
    let silent = "leaderboard_cloud_calls_total{service=\"s3\",op=\"ListObjectsV2\",outcome=\"unavailable\"}";
    world.counted(silent).await;
    // The reconcile that has seen it is over when the status speaks of the edit.
    let api = world.boards().await;
    let observed = |board: Option<&Leaderboard>| {
        board.is_some_and(|b| b.status.as_ref().and_then(|s| s.observed_generation) == b.metadata.generation)
    };
    timeout(LIMIT, await_condition(api.clone(), NAME, observed))
        .await
        .unwrap()
        .unwrap();
    let after = ready(Some(&api.get(NAME).await.unwrap())).unwrap();
    assert_eq!((after.status, after.reason), (before.status, before.reason));
    assert_eq!(after.last_transition_time, before.last_transition_time);
    world.operator.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_bucket_that_has_never_answered_is_not_known() {
    let world = World::new().await;
    // Takes connections and says nothing.
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let endpoint = format!("http://{}", listener.local_addr().unwrap());
    world
        .apply(&json!({"spec": {"storage": {"s3": {"bucket": world.bucket(), "endpoint": endpoint}}}}))
        .await;
    let said = world.says("Unknown", Reason::BucketUnreachable).await;
    assert!(said.message.contains("did not answer within 10 s"), "{}", said.message);
    world
        .counted("leaderboard_cloud_calls_total{service=\"s3\",op=\"ListObjectsV2\",outcome=\"abandoned\"}")
        .await;
    world.operator.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_missing_table_stops_no_submission() {
    let world = World::new().await;
    world.make_bucket().await;
    let endpoint = &world.aws.endpoint;
    let spec = json!({"spec": {
        "storage": {"s3": {"bucket": world.bucket(), "endpoint": endpoint}},
        "table": {"dynamoDB": {"name": world.table(), "endpoint": endpoint}},
    }});
    world.apply(&spec).await;
    world.says("False", Reason::TableUnreachable).await;
    let client = server().await.client();
    let api = Kind::Submission.api(&client, &world.namespace);
    let patch = json!({"spec": {"leaderboardName": NAME}});
    create(&api, Kind::Submission.object("one", &[&patch]), false)
        .await
        .unwrap();
    let jobs: Api<Job> = Api::namespaced(client, &world.namespace);
    let made = await_condition(jobs, "one-1", |job: Option<&Job>| job.is_some());
    timeout(LIMIT, made).await.expect("its Job is made").unwrap();
    world.says("False", Reason::TableUnreachable).await;
    world.operator.end().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn the_priority_class_of_a_track_has_to_be_there_and_must_not_preempt() {
    let world = World::new().await;
    world.make_bucket().await;
    let class = |name: &str| format!("{}-{name}", world.namespace);
    let tracks = |class: String| json!([{"name": "sensors", "priorityClassName": class}]);
    let storage = json!({"bucket": world.bucket(), "endpoint": world.aws.endpoint});
    let spec = json!({"spec": {"tracks": tracks(class("waits")), "storage": {"s3": storage}}});
    world.apply(&spec).await;
    let said = world.says("False", Reason::InvalidPod).await;
    let expected = format!("PriorityClass {} of the track sensors does not exist.", class("waits"));
    assert!(said.message.starts_with(&expected), "{}", said.message);

    let classes: Api<PriorityClass> = Api::all(server().await.client());
    for (name, policy) in [("waits", "Never"), ("preempts", "PreemptLowerPriority")] {
        let class = json!({"metadata": {"name": class(name)}, "value": 1, "preemptionPolicy": policy});
        let class: PriorityClass = serde_json::from_value(class).unwrap();
        classes.create(&PostParams::default(), &class).await.unwrap();
    }
    // Without an edit the controller asks again by itself.
    world.says("True", Reason::Ready).await;
    let patch = Patch::Merge(json!({"spec": {"tracks": tracks(class("preempts"))}}));
    let boards = world.boards().await;
    boards.patch(NAME, &PatchParams::default(), &patch).await.unwrap();
    let said = world.says("False", Reason::InvalidPod).await;
    assert!(said.message.contains("preemptionPolicy: Never"), "{}", said.message);
    world.operator.end().await;
}
