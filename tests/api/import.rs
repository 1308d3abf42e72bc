//! `leaderboard-operator import` as a person runs it: against the AWS stand-in, with what it prints applied to the API server.

mod rows;

use std::io::Write as _;
use std::process::{Output, Stdio};

use serde_json::{Value, json};
use tokio::process::Command;

use super::bridge::StandIn;
use crate::support::apiserver::server;

const REGION: &str = "us-west-2";
const TOKEN: &str = "local-host-token";

/// The four entries, as the original has them.
fn entries() -> [(&'static str, Value); 4] {
    let board = |number: u32| {
        let image = |name: &str| format!("123456789012.dkr.ecr.us-west-2.amazonaws.com/{name}-{number}:latest");
        let name = format!("leaderboard-{number}");
        json!({
            "name": name, "endpoint": "https://0123.gr7.us-west-2.eks.amazonaws.com", "certificate_authority": "LS0tLS1=",
            "simulator_image": image("simulator"), "leaderboard_image": image("leaderboard"), "logcopy_image": image("logcopy"),
            "s3_bucket": name, "dynamodb_submissions_table": name, "cloudwatch_log_group": name,
        })
    };
    let tracks = json!({
        "4170": "leaderboard-10-sensors", "4171": "leaderboard-10-map",
        "4172": "leaderboard-20-sensors", "4173": "leaderboard-20-map",
    });
    [
        ("evalai", json!({"auth_token": TOKEN, "api_server": "https://eval.ai"})),
        ("evalai-tracks", tracks),
        ("leaderboard-10", board(10)),
        ("leaderboard-20", board(20)),
    ]
}

async fn import(arguments: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_leaderboard-operator"));
    command
        .env_clear()
        .env("AWS_ACCESS_KEY_ID", "test")
        .env("AWS_SECRET_ACCESS_KEY", "test")
        .env("AWS_EC2_METADATA_DISABLED", "true")
        .env("KUBECONFIG", server().await.kubeconfig())
        .arg("import")
        .args(arguments)
        .stdin(Stdio::null());
    command.output().await.unwrap()
}

fn texts(output: &Output) -> (String, String) {
    let text = |bytes: &[u8]| String::from_utf8(bytes.to_vec()).unwrap();
    (text(&output.stdout), text(&output.stderr))
}

/// What kubectl answers to a stream of manifests.
async fn dry_run(manifests: &str) -> (bool, String) {
    let mut command = server().await.kubectl();
    command.args([
        "apply",
        "--server-side",
        "--validate=strict",
        "--dry-run=server",
        "--output",
        "name",
        "--filename",
        "-",
    ]);
    let mut kubectl = command
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    kubectl.stdin.take().unwrap().write_all(manifests.as_bytes()).unwrap();
    let output = kubectl.wait_with_output().unwrap();
    let (out, err) = texts(&output);
    (output.status.success(), format!("{out}{err}"))
}

#[tokio::test]
async fn what_is_printed_from_secrets_manager_is_accepted_by_the_api_server() {
    let aws = StandIn::start().await;
    let secrets = aws.aws.secrets(Some(REGION), Some(&aws.endpoint));
    for (name, entry) in entries() {
        let request = secrets.create_secret().name(name).secret_string(entry.to_string());
        request.send().await.unwrap();
    }
    let namespace = server().await.namespace("import").await;
    let queue = "https://sqs.us-west-2.amazonaws.com/123456789012/leaderboard";
    let role = "arn:aws:iam::123456789012:role/leaderboard-submission-worker";
    let always = [
        "--region",
        REGION,
        "--endpoint",
        &aws.endpoint,
        "--challenge",
        "2098",
        "--namespace",
        &namespace,
    ];
    let dead = format!("{queue}-dead");
    for more in [
        vec![],
        vec!["--two-operators", "--queue", queue],
        vec![
            "--queue",
            queue,
            "--dead-letter",
            &dead,
            "--role-arn",
            role,
            "--egress",
            "10.0.1.10/32",
            "--taint",
            "nvidia.com/gpu:NoSchedule",
        ],
        vec!["--only", "leaderboard-20"],
    ] {
        let output = import(&[always.as_slice(), more.as_slice()].concat()).await;
        let (manifests, notes) = texts(&output);
        assert!(output.status.success(), "{notes}");
        assert!(!manifests.contains(TOKEN) && !notes.contains(TOKEN));
        let (accepted, shown) = dry_run(&manifests).await;
        assert!(accepted && !shown.contains("Warning"), "{shown}\n{manifests}");
        let boards = if more.contains(&"--only") { 1 } else { 2 };
        assert_eq!(shown.lines().count(), 2 + boards, "{shown}");
        assert!(
            shown.contains("leaderboard.leaderboard.carla.org/leaderboard-20\n"),
            "{shown}"
        );
        for note in ["leaderboard-20: certificate_authority", "evalai.challenge: is 2098"] {
            assert!(notes.contains(note) && manifests.contains(note), "{note}: {notes}");
        }
    }
}

#[tokio::test]
async fn entries_that_cannot_be_used_are_refused_and_nothing_is_printed() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().to_str().unwrap();
    let run = async |more: &[&str]| {
        let arguments = ["--from-files", path, "--region", REGION];
        let output = import(&[arguments.as_slice(), more].concat()).await;
        let (out, err) = texts(&output);
        assert_eq!(out, "");
        (output.status.code(), err)
    };
    let (code, text) = run(&[]).await;
    assert!(code == Some(2) && text.contains("--challenge"), "{text}");
    let (code, text) = run(&["--challenge", "1"]).await;
    assert!(code == Some(1) && text.contains("evalai.json"), "{text}");
    for (name, mut entry) in entries() {
        if name == "leaderboard-10" {
            entry.as_object_mut().unwrap().remove("s3_bucket");
        }
        std::fs::write(folder.path().join(format!("{name}.json")), entry.to_string()).unwrap();
    }
    let (code, text) = run(&["--challenge", "1"]).await;
    assert_eq!(code, Some(2));
    let why = "leaderboard-operator import: the entry leaderboard-10 lacks s3_bucket; add what is missing\n";
    assert_eq!(text, why);
    let only = import(&[
        "--from-files",
        path,
        "--region",
        REGION,
        "--challenge",
        "1",
        "--only",
        "leaderboard-20",
    ])
    .await;
    assert!(only.status.success(), "the other entry is not read");
}

/// The file of decisions that a page has its reader write, with addresses in place of the shell's.
fn decisions_of(page: &str) -> String {
    let page = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("docs").join(page);
    let page = std::fs::read_to_string(page).unwrap();
    let (_, rest) = page.split_once("> decisions.yaml <<END\n").unwrap();
    let (file, _) = rest.split_once("\nEND\n").unwrap();
    let file = file.replace("$egress", "    - {cidr: 192.168.255.5/32, ports: [443]}");
    let lines = file.lines().map(|line| match line.split_once("$(aws sqs") {
        Some((field, _)) => format!("{field}https://sqs.us-west-2.amazonaws.com/123456789012/dead"),
        None => line
            .replace("$s3", "https://bucket.example")
            .replace("$account", "123456789012")
            .replace("$challenge", "2098"),
    });
    lines.collect::<Vec<_>>().join("\n")
}

#[tokio::test]
async fn the_decisions_of_the_documents_leave_no_question_and_the_api_server_accepts_what_comes_of_them() {
    let namespace = server().await.namespace("decisions").await;
    let folder = tempfile::tempdir().unwrap();
    for (name, entry) in entries() {
        std::fs::write(folder.path().join(format!("{name}.json")), entry.to_string()).unwrap();
    }
    let (path, file) = (folder.path().to_str().unwrap(), folder.path().join("decisions.yaml"));
    let file = file.to_str().unwrap();
    // Nobody answers there, who would list other readers of the queue.
    let always = [
        "--from-files",
        path,
        "--region",
        REGION,
        "--endpoint",
        "http://127.0.0.1:9",
        "--decisions",
        file,
    ];
    let queue = "https://sqs.us-west-2.amazonaws.com/123456789012/leaderboard";
    let more = ["--namespace", &namespace, "--queue", queue];
    for page in ["import.md", "migrate.md"] {
        std::fs::write(file, decisions_of(page)).unwrap();
        let (manifests, notes) = texts(&import(&[always.as_slice(), more.as_slice()].concat()).await);
        assert!(!notes.contains("to decide:"), "{page}: {notes}");
        // What the cluster has of them belongs to other tests.
        let has_group = page == "migrate.md";
        assert_eq!(notes.contains("\nlog collectors: "), has_group, "{page}: {notes}");
        assert!(!notes.contains("log collectors: not known"), "{page}: {notes}");
        let (accepted, shown) = dry_run(&manifests).await;
        assert!(accepted && !shown.contains("Warning"), "{page}: {shown}\n{manifests}");
        assert_eq!(shown.lines().count(), 4, "{page}: {shown}");
    }
    std::fs::write(file, "all: {concurency: {total: 1}}").unwrap();
    let refused = import(&[always.as_slice(), more.as_slice()].concat()).await;
    let (out, err) = texts(&refused);
    assert_eq!((refused.status.code(), out.as_str()), (Some(2), ""));
    let why = "leaderboard-operator import: decisions.yaml: all.concurency is no field of a Leaderboard; there are ";
    assert!(err.starts_with(why), "{err}");
}
