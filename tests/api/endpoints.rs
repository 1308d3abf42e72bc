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
use k8s_openapi::apimachinery::pkg::apis::meta::v1::Condition;
use kube::api::{Api, Patch, PatchParams};
use kube::runtime::wait::await_condition;
use leaderboard_api::{Leaderboard, Submission, conditions};
use serde_json::json;
use tokio::net::TcpListener;
use tokio::process::{Child, Command};
use tokio::time::timeout;

use super::bridge::{LIMIT, StandIn};
use super::objects::{Kind, create};
use crate::support::apiserver::server;

/// An AWS that nobody should ask: it notes each request and refuses it.
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

    /// What was asked here.
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

#[tokio::test(flavor = "multi_thread")]
async fn a_leaderboards_places_go_before_those_of_the_environment() {
    let (aws, elsewhere) = (StandIn::start().await, Elsewhere::start().await);
    let client = server().await.client();
    let namespace = server().await.namespace("endpoints").await;
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

    let folder = tempfile::tempdir().unwrap();
    let arguments = [
        "--image",
        "operator:1",
        "--lease",
        "operator",
        "--lease-namespace",
        &namespace,
    ];
    let _controller = start(&elsewhere, folder.path(), &namespace, "controller", &arguments).await;
    let _bridge = start(&elsewhere, folder.path(), &namespace, "bridge", &[]).await;
    let logs = || {
        let read = |program: &str| std::fs::read_to_string(folder.path().join(program)).unwrap_or_default();
        format!("controller:\n{}\nbridge:\n{}", read("controller"), read("bridge"))
    };

    let spec = json!({"spec": {
        // Nothing runs here, so that an end needs no Job.
        "paused": true,
        "evalai": {"apiServer": evalai.url(), "challenge": 1,
                   "token": {"secretsManager": {"id": token, "endpoint": endpoint}}},
        "tracks": [{"name": "sensors", "codename": "SENSORS", "phase": 1}],
        "agent": {"images": []},
        "storage": {"bucket": bucket, "endpoint": endpoint},
        "table": {"name": table, "endpoint": endpoint},
        "queue": {"url": queue, "deadLetterURL": dead, "endpoint": endpoint},
    }});
    let boards = Kind::Leaderboard.api(&client, &namespace);
    create(&boards, Kind::Leaderboard.object("board", &[&spec]), false)
        .await
        .unwrap();
    // Bucket, table, both queues and the token answer.
    let boards: Api<Leaderboard> = Api::namespaced(client.clone(), &namespace);
    let is_ready = |board: Option<&Leaderboard>| {
        board.is_some_and(|board| is_true(board.status.as_ref().map(|s| &s.conditions), conditions::READY))
    };
    let ready = timeout(LIMIT, await_condition(boards.clone(), "board", is_ready)).await;
    if ready.is_err() {
        let status = boards.get("board").await.unwrap().status;
        panic!("not ready: {status:?}\n{:?}\n{}", elsewhere.asked(), logs());
    }

    // A message.
    let body = json!({"challenge_pk": "1", "phase_pk": "1", "submission_pk": 77, "submitted_image_uri": "r/a:1"});
    aws.send(&queue, &body.to_string()).await;
    let submissions: Api<Submission> = Api::namespaced(client.clone(), &namespace);
    let is_there = |object: Option<&Submission>| object.is_some();
    let made = await_condition(submissions.clone(), "submission-77", is_there);
    let made = timeout(LIMIT, made).await;
    made.unwrap_or_else(|_| panic!("no submission of the message\n{}", logs()))
        .unwrap();

    // A row.
    let object = Kind::Submission.object(
        "one",
        &[&json!({"spec": {"leaderboardName": "board", "team": {"id": "t1"}}})],
    );
    create(&Kind::Submission.api(&client, &namespace), object, false)
        .await
        .unwrap();
    // A row needs its team, which is taken over when it is accepted.
    let is_accepted = |object: Option<&Submission>| {
        object
            .and_then(|object| object.status.as_ref()?.team.as_ref())
            .is_some()
    };
    let accepted = timeout(LIMIT, await_condition(submissions.clone(), "one", is_accepted)).await;
    accepted.unwrap_or_else(|_| panic!("not accepted\n{}", logs())).unwrap();
    let cancel = Patch::Merge(json!({"spec": {"cancel": true}}));
    submissions
        .patch("one", &PatchParams::default(), &cancel)
        .await
        .unwrap();
    let is_recorded = |object: Option<&Submission>| {
        object.is_some_and(|object| is_true(object.status.as_ref().map(|s| &s.conditions), conditions::RECORDED))
    };
    let recorded = await_condition(submissions.clone(), "one", is_recorded);
    if timeout(LIMIT, recorded).await.is_err() {
        let status = submissions.get("one").await.unwrap().status;
        panic!("no row: {status:?}\n{}", logs());
    }
    let rows = aws
        .aws
        .dynamodb(None, Some(&endpoint))
        .scan()
        .table_name(&table)
        .send()
        .await
        .unwrap();
    assert_eq!(rows.count(), 1);
    assert_eq!(elsewhere.asked(), Vec::<String>::new());
}
