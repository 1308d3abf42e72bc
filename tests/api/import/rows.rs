//! Rows of the original pipeline's table become Submissions.

use std::collections::BTreeMap;
use std::time::Duration;

use aws_sdk_dynamodb::types::AttributeValue;
use k8s_openapi::api::admissionregistration::v1::{ValidatingAdmissionPolicy, ValidatingAdmissionPolicyBinding};
use k8s_openapi::api::batch::v1::Job;
use kube::api::{ListParams, Patch, PatchParams, PostParams};
use kube::runtime::wait::await_condition;
use kube::{Api, ResourceExt};
use leaderboard_api::{Leaderboard, State, Submission, names};
use serde_json::{Value, json};
use tokio::time::{sleep, timeout};

use super::{import, texts};
use crate::api::bridge::LIMIT;
use crate::api::table::table;
use crate::api::world::World;
use crate::support::apiserver::server;

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
        table(&world.aws, "leaderboard-20", &keys).await;
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
        let (code, notes) = self.import_to_its_end(more).await;
        assert_eq!(code, Some(0), "{notes}");
        notes
    }

    /// The exit code, and all that it prints.
    async fn import_to_its_end(&self, more: &[&str]) -> (Option<i32>, String) {
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
        (output.status.code(), format!("{out}{err}"))
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

    /// The API server refuses to make one Submission, and to take the status of another.
    async fn refuse(&self, made: &str, status: &str) {
        let (client, namespace) = (&self.world.client, self.world.namespace.as_str());
        let policy = json!({
            "metadata": {"name": namespace},
            "spec": {
                "matchConstraints": {
                    "namespaceSelector": {"matchLabels": {"kubernetes.io/metadata.name": namespace}},
                    "resourceRules": [{
                        "apiGroups": ["leaderboard.carla.org"],
                        "apiVersions": ["*"],
                        "operations": ["CREATE", "UPDATE"],
                        "resources": ["submissions", "submissions/status"],
                    }],
                },
                "validations": [{
                    "expression": format!("object.metadata.name != (has(object.status) ? '{status}' : '{made}')"),
                    "message": "a rule of this cluster",
                }],
            },
        });
        let binding = json!({
            "metadata": {"name": namespace},
            "spec": {"policyName": namespace, "validationActions": ["Deny"]},
        });
        let policies: Api<ValidatingAdmissionPolicy> = Api::all(client.clone());
        let policy = serde_json::from_value(policy).unwrap();
        policies.create(&PostParams::default(), &policy).await.unwrap();
        let bindings: Api<ValidatingAdmissionPolicyBinding> = Api::all(client.clone());
        let binding = serde_json::from_value(binding).unwrap();
        bindings.create(&PostParams::default(), &binding).await.unwrap();
        self.await_refusal(made).await;
    }

    /// The API server takes a new policy in only after a moment.
    async fn await_refusal(&self, name: &str) {
        let dry_run = PostParams {
            dry_run: true,
            ..PostParams::default()
        };
        let spec = json!({"leaderboardName": "lb", "evalai": {"challenge": 1, "phase": 1, "submission": 1}});
        let trial = Submission::new(name, serde_json::from_value(spec).unwrap());
        let api = self.world.api::<Submission>();
        let refused = async {
            while api.create(&dry_run, &trial).await.is_ok() {
                sleep(Duration::from_millis(100)).await;
            }
        };
        timeout(LIMIT, refused).await.expect("the policy has no effect");
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
    api.create(&PostParams::default(), &half).await.unwrap();
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

#[tokio::test]
async fn one_that_the_api_server_refuses_keeps_no_other_from_being_imported() {
    let table = Table::new(World::new().await).await;
    let world = &table.world;
    let spec = json!({"table": {"name": table.name, "endpoint": world.aws.endpoint}});
    world.leaderboard_with("lb", 1, "Hosts", &spec).await;
    // The rows are imported in the order of their ids, which have as many digits.
    let ids = [101, 102, 103];
    for id in ids {
        table.put(id, "FINISHED", None, &[("driving_score", "1.5")]).await;
    }
    let names = ids.map(|id| format!("submission-{id}"));
    table.refuse(&names[0], &names[1]).await;
    let (code, notes) = table.import_to_its_end(&[]).await;
    assert_eq!(code, Some(1), "{notes}");
    let refused: Vec<&str> = notes.lines().filter(|line| line.starts_with("refused: ")).collect();
    for (name, what) in [(&names[0], "creation"), (&names[1], "status")] {
        let begin = format!("refused: {name}: the {what} of Submission {name} failed: the API server answered ");
        let is_named = |line: &&str| line.starts_with(&begin) && line.contains("a rule of this cluster");
        assert!(refused.iter().any(is_named), "{begin}: {notes}");
    }
    assert_eq!(refused.len(), 2, "{notes}");
    let imported = format!("{}: imported as Finished, score 1.50\n", names[2]);
    assert!(notes.contains(&imported), "{notes}");
    let last = "3 rows: made 1 that have ended, 0 that go on; 0 were there already; 0 undecided; \
        2 refused by the API server: correct what it names and repeat the command\n";
    assert!(notes.ends_with(last), "{notes}");
    let found = table.submissions().await;
    assert_eq!(found.keys().collect::<Vec<_>>(), [&names[1], &names[2]]);
    assert!(found[&names[1]].status.is_none() && found[&names[1]].awaits_import());
}
