//! `leaderboard-operator import` as a person runs it: against the AWS stand-in, with what it prints applied to the API server.

use std::collections::BTreeMap;
use std::io::Write as _;
use std::process::{Output, Stdio};

use aws_sdk_dynamodb::types::AttributeValue;
use k8s_openapi::api::batch::v1::Job;
use kube::api::{ListParams, Patch, PatchParams};
use kube::runtime::wait::await_condition;
use kube::{Api, ResourceExt};
use leaderboard_api::{Leaderboard, State, Submission, names};
use serde_json::{Value, json};
use tokio::process::Command;
use tokio::time::timeout;

use super::bridge::{LIMIT, StandIn};
use super::world::World;
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

/// What kubectl says of a stream of manifests.
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

/// A table with rows of both pipelines, and what becomes of them.
struct Table {
    world: World,
    name: String,
}

impl Table {
    /// The submissions are EvalAI's own, so that a resume finds them.
    async fn new(world: World) -> Self {
        let name = world.aws.name("leaderboard-20");
        let keys = [
            ("team_id", aws_sdk_dynamodb::types::ScalarAttributeType::S),
            ("submission_id", aws_sdk_dynamodb::types::ScalarAttributeType::S),
        ];
        super::table::table(&world.aws, "leaderboard-20", &keys).await;
        Self { world, name }
    }

    fn client(&self) -> aws_sdk_dynamodb::Client {
        self.world.aws.aws.dynamodb(None, Some(&self.world.aws.endpoint))
    }

    async fn put(&self, id: u64, status: &str, attempt: Option<i64>, more: &[(&str, &str)]) {
        let text = |text: &str| AttributeValue::S(text.to_owned());
        let mut request = self.client().put_item().table_name(&self.name);
        for (column, value) in [
            ("team_id", "1"),
            ("team_name", "team-a"),
            ("submission_status", status),
            ("track_id", "1"),
            ("track_name", "SENSORS"),
            ("submitted_image_uri", "r/team-a:1"),
            ("submitted_time", "2026-11-20 10:00:00 UTC"),
            ("start_time", "2026-11-20 10:05:00 UTC"),
            ("end_time", "2026-11-20 12:00:00 UTC"),
        ] {
            request = request.item(column, text(value));
        }
        request = request.item("submission_id", text(&id.to_string()));
        for (column, value) in more {
            request = request.item(*column, text(value));
        }
        if let Some(attempt) = attempt {
            request = request.item("attempt", AttributeValue::N(attempt.to_string()));
        }
        request.send().await.unwrap();
    }

    async fn rows(&self) -> BTreeMap<String, Value> {
        let answer = self.client().scan().table_name(&self.name).send().await.unwrap();
        let items = answer.items.unwrap().into_iter();
        let text = |value: AttributeValue| match value {
            AttributeValue::S(text) | AttributeValue::N(text) => text,
            other => panic!("{other:?}"),
        };
        let rows = items.map(|item| item.into_iter().map(|(name, value)| (name, text(value))).collect());
        rows.map(|row: BTreeMap<String, String>| (row["submission_id"].clone(), json!(row)))
            .collect()
    }

    async fn import(&self, more: &[&str]) -> String {
        let namespace = &self.world.namespace;
        let always = [
            "--from-table",
            &self.name,
            "--namespace",
            namespace,
            "--region",
            "us-east-1",
        ];
        let output = import(&[always.as_slice(), more].concat()).await;
        let (out, err) = texts(&output);
        assert!(output.status.success(), "{err}");
        format!("{out}{err}")
    }

    async fn submissions(&self) -> BTreeMap<String, Submission> {
        let all = self
            .world
            .api::<Submission>()
            .list(&ListParams::default())
            .await
            .unwrap();
        all.items
            .into_iter()
            .map(|object| (object.name_any(), object))
            .collect()
    }

    /// A row of EvalAI's own, so that a later resume finds it.
    fn in_evalai(&self) -> u64 {
        let new = evalai_stand_in::submissions::NewSubmission {
            team: 1,
            phase: 1,
            user: 11,
            input: json!({"submitted_image_uri": "r/team-a:1"}).to_string().into_bytes(),
            fields: serde_json::Map::new(),
        };
        let stored = evalai_stand_in::model::FileState::Stored;
        let now = jiff::Timestamp::now();
        self.world
            .evalai
            .with_state(|state| evalai_stand_in::submissions::create(state, new, stored, now))
    }

    fn updates(&self) -> Vec<String> {
        let all = self.world.evalai.requests().into_iter();
        let writes = all.filter(|entry| entry.method != "GET");
        writes
            .map(|entry| format!("{} {} {}", entry.method, entry.path, entry.body))
            .collect()
    }
}

async fn has_job(api: &Api<Job>, name: &str) {
    let made = timeout(
        LIMIT,
        await_condition(api.clone(), name, |job: Option<&Job>| job.is_some()),
    )
    .await;
    made.unwrap_or_else(|_| panic!("no Job {name}")).unwrap();
}

/// The ids of a row of each kind: three that have ended, one that goes on, one that another pipeline may run, one of another phase.
async fn rows_of_each_kind(table: &Table) -> [u64; 6] {
    let score = [
        ("driving_score", "43.129"),
        ("route_completion", "80"),
        ("infraction_penalty", "0.5151"),
    ];
    let ids = [(); 6].map(|()| table.in_evalai());
    table.put(ids[0], "FINISHED", None, &score).await;
    table.put(ids[1], "FAILED", Some(1), &[("progress", "1/2")]).await;
    table.put(ids[2], "CANCELLED", None, &[]).await;
    table.put(ids[3], "RUNNING", Some(1), &[]).await;
    table.put(ids[4], "RUNNING", None, &[]).await;
    table.put(ids[5], "FINISHED", None, &[("track_id", "9")]).await;
    ids
}

/// The controller leads while they are made, and must run none of the ended ones.
async fn are_made(table: &Table) {
    let notes = table.import(&[]).await;
    let undecided: Vec<&str> = notes.lines().filter(|line| line.starts_with("undecided")).collect();
    assert_eq!(undecided.len(), 2, "{notes}");
    assert!(notes.contains("another pipeline may still run it") && notes.contains("track_id 9 is the phase"));
    let last = "6 rows: made 3 that have ended, 1 that goes on; 0 were there already; 2 undecided\n";
    assert!(notes.ends_with(last), "{notes}");
}

async fn are_counted(world: &World) {
    let has_counted = |board: Option<&Leaderboard>| {
        let counts = board
            .and_then(|board| board.status.as_ref())
            .and_then(|status| status.counts);
        counts.is_some_and(|counts| (counts.finished, counts.failed, counts.cancelled) == (1, 1, 1))
    };
    let counted = timeout(LIMIT, await_condition(world.api(), "lb", has_counted)).await;
    counted.expect("the controller has read all three").unwrap();
}

fn was_never_accepted(submission: &Submission, state: State) {
    let status = submission.status.as_ref().unwrap();
    assert_eq!(status.state, Some(state));
    assert_eq!((&status.job_name, &status.plan), (&None, &None));
    assert_eq!(submission.finalizers().len(), 0);
    assert_eq!(submission.metadata.generation, Some(1));
}

fn has_no_update(table: &Table, id: &str) {
    let (text, number) = (format!("\"submission\":\"{id}\""), format!("\"submission\":{id},"));
    let names_it = |update: &String| update.contains(&text) || update.contains(&number);
    let updates = table.updates();
    assert!(!updates.iter().any(names_it), "{updates:?}");
}

#[tokio::test]
async fn rows_become_submissions_for_which_nothing_is_published_or_recorded_again() {
    let table = Table::new(World::new().await).await;
    let world = &table.world;
    let ids = rows_of_each_kind(&table).await;
    let name = |index: usize| format!("submission-{}", ids[index]);
    let before = table.rows().await;

    let none = import(&["--from-table", &table.name, "--namespace", &world.namespace]).await;
    assert!(texts(&none).1.contains("no Leaderboard of the namespace"));
    let spec = json!({"table": {"name": table.name, "endpoint": world.aws.endpoint}});
    world.leaderboard_with("lb", 1, "Hosts", &spec).await;
    let shown = table.import(&["--dry-run"]).await;
    let [object, count] = [
        "driving: \"43.13\"",
        "6 rows: would make 3 that have ended, 1 that goes on;",
    ];
    assert!(shown.contains("kind: Submission") && shown.contains(object), "{shown}");
    assert!(shown.contains(count), "{shown}");
    assert_eq!(table.submissions().await.len(), 0, "nothing was made");

    let _controller = world.controller();
    are_made(&table).await;
    has_job(&world.api(), &format!("{}-2", name(3))).await;
    are_counted(world).await;
    let found = table.submissions().await;
    assert_eq!(found.len(), 4);
    for (index, state) in [(0, State::Finished), (1, State::Failed), (2, State::Cancelled)] {
        was_never_accepted(&found[&name(index)], state);
    }
    let score = found[&name(0)].status.as_ref().unwrap().score.as_ref().unwrap();
    assert_eq!((score.text.as_str(), score.is_final), ("43.13", true));
    let after = table.rows().await;
    for id in [0, 1, 2, 4, 5].map(|index: usize| ids[index].to_string()) {
        assert_eq!(after[&id], before[&id], "the row is as it was");
        has_no_update(&table, &id);
    }

    let again = table.import(&[]).await;
    let none = "6 rows: made 0 that have ended, 0 that go on; 4 were there already; 2 undecided\n";
    assert!(again.ends_with(none), "{again}");
    let now = table.submissions().await;
    for name in [0, 1, 2].map(name) {
        let versions = [&now, &found].map(|all| all[&name].resource_version());
        assert_eq!(versions[0], versions[1], "nobody writes {name}");
    }
    shown_by_kubectl(&world.namespace).await;

    let resume = Patch::Merge(json!({"spec": {"attempt": 2}}));
    let api = world.api::<Submission>();
    api.patch(&name(1), &PatchParams::default(), &resume).await.unwrap();
    has_job(&world.api(), &format!("{}-2", name(1))).await;
}

async fn shown_by_kubectl(namespace: &str) {
    let mut kubectl = server().await.kubectl();
    kubectl.args(["get", "submissions", "--namespace", namespace, "--no-headers"]);
    let (shown, _) = texts(&kubectl.output().unwrap());
    let line = |state: &str| {
        let found = shown.lines().find(|line| line.contains(state));
        found.unwrap_or_else(|| panic!("{state}: {shown}")).to_owned()
    };
    assert!(
        line("Finished").contains("43.13") && line("Finished").contains("sensors"),
        "{shown}"
    );
    assert!(
        line("Failed").contains("ImportedFailure") && line("Failed").contains("1/2"),
        "{shown}"
    );
    assert!(line("Cancelled").contains("Cancelled"), "{shown}");
}

#[tokio::test]
async fn one_whose_status_was_not_written_is_completed_by_the_next_import() {
    let table = Table::new(World::new().await).await;
    let world = &table.world;
    world
        .leaderboard_with(
            "lb",
            1,
            "Hosts",
            &json!({"table": {"name": table.name, "endpoint": world.aws.endpoint}}),
        )
        .await;
    let id = table.in_evalai();
    table.put(id, "FINISHED", None, &[("driving_score", "1.5")]).await;
    // As the command leaves it when it is stopped between its two writes.
    let name = format!("submission-{id}");
    let spec = json!({"leaderboardName": "lb", "evalai": {"challenge": 1, "phase": 1, "submission": id}});
    let mut half = Submission::new(&name, serde_json::from_value(spec).unwrap());
    half.annotations_mut()
        .insert(names::ANNOTATION_IMPORTED.into(), table.name.clone());
    let api = world.api::<Submission>();
    api.create(&kube::api::PostParams::default(), &half).await.unwrap();
    let _controller = world.controller();
    // One that is no import shows that the controller has had its turn.
    let (_, other) = world.submit("lb", 1).await;
    world.job(&other, 0).await;
    let left = api.get(&name).await.unwrap();
    assert!(left.status.is_none() && left.finalizers().is_empty(), "{left:?}");
    let notes = table.import(&[]).await;
    assert!(
        notes.contains(&format!("{name}: imported as Finished, score 1.50")),
        "{notes}"
    );
    world
        .until(&name, "it has ended", |status| status.state == Some(State::Finished))
        .await;
}
