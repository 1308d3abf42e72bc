//! Two AWS at once: the environment of the operator's programs names one, the Leaderboard another. Everything belongs into the
//! Leaderboard's.
//!
//! The programs are the real ones, as child processes, since only a process has an environment.

use std::fs::File;
use std::path::Path;
use std::process::Stdio;
use std::sync::{Arc, Mutex};

use axum::http::{Request, StatusCode};
use evalai_stand_in::Config;
use kube::Client;
use kube::api::{Api, Patch, PatchParams};
use kube::runtime::wait::await_condition;
use leaderboard_api::{Condition, Leaderboard, Submission, conditions};
use serde_json::{Value, json};
use tokio::net::TcpListener;
use tokio::process::{Child, Command};
use tokio::time::timeout;

use super::bridge::{LIMIT, StandIn};
use super::objects::{Kind, create};
use crate::support::apiserver::server;

/// An AWS that no program should ask: it notes each request and refuses it.
pub(super) struct Elsewhere {
    pub(super) endpoint: String,
    asked: Arc<Mutex<Vec<String>>>,
}

impl Elsewhere {
    pub(super) async fn start() -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let endpoint = format!("http://{}", listener.local_addr().unwrap());
        let asked = Arc::new(Mutex::new(Vec::new()));
        let note = Arc::clone(&asked);
        let router = axum::Router::new().fallback(move |request: Request<axum::body::Body>| async move {
            let target = request.headers().get("x-amz-target").cloned();
            let line = format!("{} {} {target:?}", request.method(), request.uri());
            note.lock().unwrap().push(line);
            StatusCode::FORBIDDEN
        });
        tokio::spawn(async move { axum::serve(listener, router).await });
        Self { endpoint, asked }
    }

    /// The requests that came here.
    pub(super) fn asked(&self) -> Vec<String> {
        self.asked.lock().unwrap().clone()
    }

    /// One of the operator's programs, whose environment names this.
    pub(super) fn program(&self, log: &Path) -> Command {
        let log = File::create(log).unwrap();
        let mut command = Command::new(env!("CARGO_BIN_EXE_leaderboard-operator"));
        command
            .env("AWS_ENDPOINT_URL", &self.endpoint)
            .env("AWS_ACCESS_KEY_ID", "test")
            .env("AWS_SECRET_ACCESS_KEY", "test")
            .env("AWS_REGION", "us-east-1")
            .env("AWS_EC2_METADATA_DISABLED", "true")
            .stdin(Stdio::null())
            .stdout(log.try_clone().unwrap())
            .stderr(log)
            .kill_on_drop(true);
        command
    }
}

async fn start(elsewhere: &Elsewhere, folder: &Path, namespace: &str, program: &str, arguments: &[&str]) -> Child {
    let mut command = elsewhere.program(&folder.join(program));
    command
        .arg(program)
        .args(["--namespace", namespace, "--http", "127.0.0.1:0"])
        .args(arguments)
        .env("KUBECONFIG", server().await.kubeconfig());
    command.spawn().unwrap()
}

fn is_true(conditions: Option<&Vec<Condition>>, kind: &str) -> bool {
    conditions
        .and_then(|conditions| conditions::get(conditions, kind))
        .is_some_and(|condition| condition.status == "True")
}

/// Everything that a Leaderboard names, and the programs that use it.
struct Scene {
    aws: StandIn,
    elsewhere: Elsewhere,
    client: Client,
    namespace: String,
    folder: tempfile::TempDir,
    table: String,
    queue: String,
    /// The spec that names all of them.
    spec: Value,
    _evalai: evalai_stand_in::Handle,
}

impl Scene {
    async fn new() -> Self {
        let (aws, elsewhere) = (StandIn::start().await, Elsewhere::start().await);
        let (config, _) = Config::in_memory().unwrap();
        let evalai = evalai_stand_in::serve(config, vec![TcpListener::bind("127.0.0.1:0").await.unwrap()]);
        let (bucket, table, token) = (aws.name("bucket"), aws.name("table"), aws.name("token"));
        let endpoint = aws.endpoint.clone();
        let s3 = aws.aws.s3(None, Some(&endpoint));
        s3.create_bucket().bucket(&bucket).send().await.unwrap();
        super::boards::make_table(&aws, &table).await;
        let (queue, dead) = (aws.queue("queue").await, aws.queue("dead").await);
        let secret = json!({"auth_token": "local-host-token"}).to_string();
        let secrets = aws.aws.secrets(None, Some(&endpoint));
        let made = secrets.create_secret().name(&token).secret_string(secret).send().await;
        made.unwrap();
        let spec = json!({"spec": {
            // Nothing runs here, so that an end needs no Job.
            "paused": true,
            "evalai": {"apiServer": evalai.url(), "challenge": 1,
                       "token": {"secretsManager": {"id": token, "endpoint": endpoint}}},
            "tracks": [{"name": "sensors", "phase": 1}],
            "agent": {"images": []},
            "storage": {"s3": {"bucket": bucket, "endpoint": endpoint}},
            "table": {"dynamoDB": {"name": table, "endpoint": endpoint}},
            "queue": {"sqs": {"url": queue, "deadLetterURL": dead, "endpoint": endpoint}},
        }});
        Self {
            aws,
            elsewhere,
            client: server().await.client(),
            namespace: server().await.namespace("endpoints").await,
            folder: tempfile::tempdir().unwrap(),
            table,
            queue,
            spec,
            _evalai: evalai,
        }
    }

    /// The logs of both programs.
    fn logs(&self) -> String {
        let read = |program: &str| std::fs::read_to_string(self.folder.path().join(program)).unwrap_or_default();
        format!("controller:\n{}\nbridge:\n{}", read("controller"), read("bridge"))
    }

    /// Bucket, table, both queues and the token answer.
    async fn is_ready(&self) {
        let boards: Api<Leaderboard> = Api::namespaced(self.client.clone(), &self.namespace);
        let is_ready = |board: Option<&Leaderboard>| {
            board.is_some_and(|board| is_true(board.status.as_ref().map(|s| &s.conditions), conditions::READY))
        };
        let ready = timeout(LIMIT, Box::pin(await_condition(boards.clone(), "board", is_ready))).await;
        if ready.is_err() {
            let status = boards.get("board").await.unwrap().status;
            panic!("not ready: {status:?}\n{:?}\n{}", self.elsewhere.asked(), self.logs());
        }
    }

    /// A message is made a Submission.
    async fn takes_a_message(&self) {
        let body = json!({"challenge_pk": "1", "phase_pk": "1", "submission_pk": 77, "submitted_image_uri": "r/a:1"});
        self.aws.send(&self.queue, &body.to_string()).await;
        let is_there = |object: Option<&Submission>| object.is_some();
        let made = await_condition(self.submissions(), "submission-77", is_there);
        let made = timeout(LIMIT, made).await;
        made.unwrap_or_else(|_| panic!("no submission of the message\n{}", self.logs()))
            .unwrap();
    }

    /// The end of a submission is in the table.
    async fn writes_a_row(&self) {
        let submissions = self.submissions();
        let object = Kind::Submission.object(
            "one",
            &[&json!({"spec": {"leaderboardName": "board", "team": {"id": "t1"}}})],
        );
        let api = Kind::Submission.api(&self.client, &self.namespace);
        create(&api, object, false).await.unwrap();
        // A row needs its team, which is taken over when it is accepted.
        let is_accepted = |object: Option<&Submission>| {
            object
                .and_then(|object| object.status.as_ref()?.team.as_ref())
                .is_some()
        };
        let accepted = timeout(LIMIT, await_condition(submissions.clone(), "one", is_accepted)).await;
        accepted
            .unwrap_or_else(|_| panic!("not accepted\n{}", self.logs()))
            .unwrap();
        let cancel = Patch::Merge(json!({"spec": {"cancel": true}}));
        let cancelled = submissions.patch("one", &PatchParams::default(), &cancel).await;
        cancelled.unwrap();
        let is_recorded = |object: Option<&Submission>| {
            object.is_some_and(|object| is_true(object.status.as_ref().map(|s| &s.conditions), conditions::RECORDED))
        };
        let recorded = await_condition(submissions.clone(), "one", is_recorded);
        if timeout(LIMIT, recorded).await.is_err() {
            let status = submissions.get("one").await.unwrap().status;
            panic!("no row: {status:?}\n{}", self.logs());
        }
        let dynamodb = self.aws.aws.dynamodb(None, Some(&self.aws.endpoint));
        let rows = dynamodb.scan().table_name(&self.table).send().await.unwrap();
        assert_eq!(rows.count(), 1);
    }

    fn submissions(&self) -> Api<Submission> {
        Api::namespaced(self.client.clone(), &self.namespace)
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_leaderboards_places_go_before_those_of_the_environment() {
    let scene = Scene::new().await;
    let (elsewhere, folder, namespace) = (&scene.elsewhere, scene.folder.path(), &scene.namespace);
    let lease = ["--lease", "operator", "--lease-namespace", namespace];
    let arguments = [&["--image", "operator:1"][..], &lease].concat();
    let _controller = start(elsewhere, folder, namespace, "controller", &arguments).await;
    let _bridge = start(elsewhere, folder, namespace, "bridge", &[]).await;

    let board = Kind::Leaderboard.object("board", &[&scene.spec]);
    let boards = Kind::Leaderboard.api(&scene.client, namespace);
    create(&boards, board, false).await.unwrap();
    scene.is_ready().await;
    scene.takes_a_message().await;
    scene.writes_a_row().await;
    assert_eq!(elsewhere.asked(), Vec::<String>::new());
}
