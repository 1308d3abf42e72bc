//! A controller's surroundings without a cluster, for the tests of this crate. They are caches that a test fills, an API server that
//! takes every request, and AWS at the test's endpoint.

use std::collections::HashMap;
use std::sync::Arc;

use aws_config::{BehaviorVersion, Region};
use aws_credential_types::Credentials;
use http::{Method, Request, Response, StatusCode};
use jiff::Timestamp;
use k8s_openapi::api::networking::v1::NetworkPolicy;
use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;
use kube::client::Body;
use kube::runtime::events::{Recorder as EventRecorder, Reporter};
use kube::runtime::reflector::ObjectRef;
use kube::{Client, Resource, ResourceExt};
use serde_json::{Value, json};
use tokio::sync::{mpsc, watch};
use tokio::time::Instant;
use tower_test::mock::{Handle, pair};

use crate::kubernetes::objects::{Job, Owner, Pod};
use crate::kubernetes::{Namespaces, Store, Synced, Writer};
use crate::leaderboards::probe::Asks;
use crate::leaderboards::state::LeaderboardState;
use crate::metrics::{Metrics, Program};
use crate::observability::traces::Traces;
use crate::runtime::context::Context;
use crate::runtime::objects::{Wake, by_key};
use crate::runtime::settings::Settings;
use crate::runtime::stores::{Stores, owner_uid};
use crate::slots::Slots;
use crate::submissions::external::ExternalSystems;
use crate::submissions::memory::Memory;
use crate::submissions::observe::causes::Causes;
use crate::submissions::observe::workers::Workers;
use crate::submissions::records;
use leaderboard_api::{Attempt, JobNumber, Leaderboard, State, Submission, SubmissionStatus, Times, effective, names};
use leaderboard_aws::clients::Aws;
use leaderboard_aws::table::Tables;
use leaderboard_base::clock::Clock;
use leaderboard_base::shutdown::Stop;
use leaderboard_base::tasks::Tasks;
use leaderboard_evalai::{Hub, Options};
use leaderboard_pod_spec::job::OwnImage;
use leaderboard_policy::allowed::Allowed;

/// Namespace of everything here.
pub const NAMESPACE: &str = "one";
/// The version of a Leaderboard here, before its status is written and after it.
const VERSION: &str = "2";
/// The installation that drives every Leaderboard here.
const OPERATOR: &str = "system/operator";

/// The objects in the caches.
#[derive(Default)]
pub struct Cluster {
    pub leaderboards: Vec<Leaderboard>,
    pub submissions: Vec<Submission>,
    pub jobs: Vec<Job>,
    pub pods: Vec<Pod>,
    pub policies: Vec<NetworkPolicy>,
    /// Why the API server makes no Job.
    pub no_jobs: Option<&'static str>,
}

/// A request that the API server got.
#[derive(Debug)]
pub struct Arrived {
    pub at: Instant,
    pub method: Method,
    pub path: String,
    pub body: Value,
}

/// The context, and the parts that must live as long as it is used.
pub struct Surroundings {
    pub context: Context,
    /// The requests that the API server gets.
    pub requests: mpsc::UnboundedReceiver<Arrived>,
    /// The Leaderboards that were woken.
    pub woken: mpsc::UnboundedReceiver<String>,
    /// The Submissions that were woken with an answer of their own.
    pub answered: mpsc::UnboundedReceiver<String>,
    /// A way to the endpoint.
    pub aws: Aws,
    _stop: watch::Sender<bool>,
}

/// A way to an endpoint on loopback, without TLS.
pub async fn aws(endpoint: &str) -> Aws {
    let config = aws_config::defaults(BehaviorVersion::latest())
        .http_client(aws_smithy_http_client::Builder::new().build_http())
        .region(Region::new("us-east-1"))
        .credentials_provider(Credentials::new("test", "test", None, None, "tests"))
        .endpoint_url(endpoint)
        .load()
        .await;
    Aws::from_config(config)
}

/// Everything that reconciles share.
pub async fn surroundings(cluster: Cluster, endpoint: &str) -> Surroundings {
    let aws = Box::pin(aws(endpoint)).await;
    let (arrived, requests) = mpsc::unbounded_channel();
    let (service, handle) = pair::<Request<Body>, Response<Body>>();
    let known = cluster.submissions.iter().map(|s| (s.name_any(), json!(s))).collect();
    tokio::spawn(serve(handle, known, cluster.no_jobs, arrived));
    let client = Client::new(service, NAMESPACE);
    let (stop, stopped) = Stop::new();
    let tasks = Tasks::new(stopped);
    let (answering, answered) = mpsc::unbounded_channel();
    let (waking, woken) = mpsc::unbounded_channel();
    let stores = stores(cluster);
    let (turning, _) = mpsc::unbounded_channel();
    let tables = Arc::new(Tables::new(aws.clone()));
    let external = external(Arc::clone(&tables), &tasks);
    let context = Context {
        clock: Clock::system(),
        writer: Writer::new(client.clone(), || true),
        settings: settings(),
        slots: Arc::new(Slots::new(stores.clone(), noting(&turning))),
        stores,
        memory: Memory::default(),
        workers: Workers::start(&aws, tables, &external.hub, &client, &tasks, || noting(&answering)),
        causes: Causes::default(),
        leaderboards: LeaderboardState::default(),
        asks: Asks::start(&client, &aws, &settings(), &tasks, || {
            by_key(noting::<Leaderboard>(&waking))
        }),
        external,
        recorder: EventRecorder::new(client.clone(), Reporter::from("test")),
        metrics: Arc::new(Metrics::new(Program::Controller)),
        traces: Traces::default(),
        wake: noting(&waking),
        client,
    };
    Surroundings {
        context,
        requests,
        woken,
        answered,
        aws,
        _stop: stop,
    }
}

/// Sends the names of those that are woken.
fn noting<K: Resource<DynamicType = ()> + 'static>(names: &mpsc::UnboundedSender<String>) -> Wake<K> {
    let names = names.clone();
    Box::new(move |object: ObjectRef<K>| {
        let _ = names.send(object.name);
    })
}

/// As the operator is started.
pub fn settings() -> Settings {
    Settings {
        own: OwnImage {
            image: "operator:1".into(),
            ..OwnImage::default()
        },
        operator: OPERATOR.into(),
        namespaces: Namespaces::All,
        has_cluster_rights: true,
        allowed: Allowed::default(),
        concurrency: 16,
    }
}

/// Caches that show this; a test may change what they show.
pub fn stores(cluster: Cluster) -> Stores {
    let policies_synced = Synced::default();
    policies_synced.set(true);
    Stores {
        leaderboards: Store::of(cluster.leaderboards, |_| None),
        submissions: Store::of(cluster.submissions, |_| None),
        jobs: Store::of(cluster.jobs, |_| None),
        pods: Store::of(cluster.pods, owner_uid),
        policies: Store::of(cluster.policies, |_| None),
        policies_synced,
        nodes: None,
    }
}

/// Services without a listener.
fn external(tables: Arc<Tables>, tasks: &Tasks) -> ExternalSystems {
    let hub = Hub::new(Options::unheard(tasks, || true));
    let records = records::start(tables, || true, tasks, Box::new(|_| {}));
    ExternalSystems::new(hub, records, Allowed::default())
}

async fn serve(
    mut handle: Handle<Request<Body>, Response<Body>>,
    known: HashMap<String, Value>,
    no_jobs: Option<&'static str>,
    arrived: mpsc::UnboundedSender<Arrived>,
) {
    while let Some((request, answer)) = handle.next_request().await {
        let (method, path) = (request.method().clone(), request.uri().path().to_owned());
        let body = request.into_body().collect_bytes().await.unwrap();
        let body: Value = serde_json::from_slice(&body).unwrap_or_default();
        let refusal = no_jobs.filter(|_| method == Method::POST && path.ends_with("/jobs"));
        let (status, reply) = match refusal {
            Some(why) => (StatusCode::FORBIDDEN, refused(why)),
            None => (StatusCode::OK, reply(&method, &path, body.clone(), &known)),
        };
        let at = Instant::now();
        let _ = arrived.send(Arrived { at, method, path, body });
        let mut response = Response::new(Body::from(reply.to_string().into_bytes()));
        *response.status_mut() = status;
        answer.send_response(response);
    }
}

fn refused(why: &str) -> Value {
    let code = StatusCode::FORBIDDEN.as_u16();
    json!({"apiVersion": "v1", "kind": "Status", "status": "Failure", "message": why, "reason": "Forbidden", "code": code})
}

/// A write of an object is answered with the object, and nothing is listed.
fn reply(method: &Method, path: &str, mut body: Value, known: &HashMap<String, Value>) -> Value {
    match *method {
        Method::GET => json!({"apiVersion": "v1", "kind": "List", "metadata": {}, "items": []}),
        Method::DELETE => json!({"apiVersion": "v1", "kind": "Status", "metadata": {}, "status": "Success"}),
        _ => {
            let name = path
                .split("/submissions/")
                .nth(1)
                .and_then(|rest| rest.split('/').next());
            let Some(mut object) = name.and_then(|name| known.get(name)).cloned() else {
                if path.ends_with("/status") {
                    body["metadata"]["resourceVersion"] = json!(VERSION);
                }
                return body;
            };
            if let Some(status) = body.get("status") {
                object["status"] = status.clone();
            }
            object
        }
    }
}

/// A Leaderboard whose results go to a bucket at this endpoint.
pub fn leaderboard(name: &str, endpoint: &str) -> Leaderboard {
    let spec = json!({
        "tracks": [{"name": "sensors"}],
        "evaluation": {"carla": {
            "version": "V2", "routes": 4, "pairs": 2, "contents": {"image": "c"}, "simulator": {"image": "s"},
        }},
        "storage": {"s3": {"bucket": format!("{name}-bucket"), "endpoint": endpoint}},
        "table": {"dynamoDB": {"name": "rows", "endpoint": endpoint, "partitionKey": "team_id", "sortKey": "submission_id"}},
    });
    let mut object = Leaderboard::new(name, serde_json::from_value(spec).unwrap());
    object.metadata.namespace = Some(NAMESPACE.into());
    object.metadata.uid = Some(format!("uid-of-{name}"));
    object.metadata.resource_version = Some(VERSION.into());
    object.status.get_or_insert_default().operator = Some(OPERATOR.into());
    object
}

/// A submission whose Job was made, and that Job. Nothing shows yet that it was scheduled.
pub fn with_job(name: &str, board: &Leaderboard) -> (Submission, Job) {
    let board_name = board.name_any();
    let spec = json!({"leaderboardName": board_name, "image": "agent:1", "track": "sensors", "team": {"id": "t1"}});
    let mut submission = Submission::new(name, serde_json::from_value(spec).unwrap());
    let uid = format!("uid-of-{name}");
    let now = Time(Timestamp::now());
    submission.metadata.namespace = Some(NAMESPACE.into());
    submission.metadata.uid = Some(uid.clone());
    submission.metadata.resource_version = Some("1".into());
    submission.metadata.generation = Some(1);
    submission.metadata.creation_timestamp = Some(now.clone());
    submission.metadata.finalizers = Some(vec![names::FINALIZER_SUBMISSION.into()]);
    let (track, image) = (&board.spec.tracks[0], Some("agent:1".to_owned()));
    let plan = effective::plan(&board.spec, track, name.parse().unwrap(), image, false).unwrap();
    let job_name = names::job(name, JobNumber::first(Attempt(1)));
    submission.status = Some(SubmissionStatus {
        state: Some(State::Pending),
        attempt: Some(Attempt(1)),
        team: submission.spec.team.clone().map(Into::into),
        plan: Some(plan),
        job_name: Some(job_name.clone()),
        times: Times {
            submitted: Some(now.clone()),
            accepted: Some(now.clone()),
            ..Times::default()
        },
        ..SubmissionStatus::default()
    });
    let mut job = Job::default();
    job.metadata.name = job_name.as_str().into();
    job.metadata.namespace = Some(NAMESPACE.into());
    job.metadata.uid = format!("uid-of-{job_name}").into();
    job.metadata.creation_timestamp = Some(now);
    job.metadata.owner_references = [Owner { uid: uid.into() }].into();
    (submission, job)
}
