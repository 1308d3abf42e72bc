//! Evaluations of files: the examples `classification`, whose agent runs first and leaves them, and `predictions`, to which participants
//! upload them. From a message or a Submission to the exact score, whatever is killed meanwhile.
//!
//! local/games/README.md works the numbers out, and local/tests/test_games.py has them without a cluster.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;
use std::time::Duration;

use futures::FutureExt;
use k8s_openapi::api::core::v1::Pod;
use kube::ResourceExt;
use kube::api::{DeleteParams, EvictParams};
use leaderboard_api::{State, Submission, SubmittedFile};
use serde_json::{Value, json};
use sha2::{Digest, Sha256};

use super::containers::{FOREIGN_WORDS, assert_own_words, assert_published, assert_without, one_job};
use super::matrix::{Case, together};
use crate::aws::BUCKET;
use crate::evalai::{Evalai, FIRST_PHASE};
use crate::operator::{bridge, controller};
use crate::scene::{Lab, Scene, done, lay_over, scenario, state};

const WIDTH: usize = 4;
/// Patience with a busy machine; each wait ends with its event.
pub(super) const LIMIT: Duration = Duration::from_mins(4);
/// Share of the 200 rows that the example's agent has right: (34 + 41 + 39 + 44) / 200.
pub(super) const ACCURACY: &str = "0.79";
/// The same of the first half of each worker's rows, (34 + 39) / 100, and of the second, (41 + 44) / 100.
const EASY: &str = "0.73";
const HARD: &str = "0.85";
/// The median of the halves, (39 + 41) / 2 of 50 rows.
const MEDIAN: &str = "0.8";
const ALL_ROWS: &str = "200/200";
/// Rows that are counted when both evaluators wait half-way.
const HELD: i32 = 100;
/// Printed by the example's agent in each of its lives.
const PREDICTED: &str = "200 predictions from 800 names";

/// The spec of an example's Leaderboard, as far as a scene has no own one; `change` is laid over it.
pub(super) fn example(lab: &Lab, name: &str, change: Value) -> Value {
    let path = challenges().join(name).join("leaderboard.yaml");
    let text = fs::read_to_string(path).unwrap().replace("REGISTRY", &lab.registry);
    let mut board: Value = serde_saphyr::from_str(&text).unwrap();
    let mut spec = board["spec"].take();
    for of_scene in ["storage", "podIdentity", "syncPeriodSeconds"] {
        spec.as_object_mut().unwrap().remove(of_scene).unwrap();
    }
    let retries = json!({"retries": {"perWorker": 2, "infrastructure": 0}, "deadlines": {"cancelSeconds": 20}});
    lay_over(&mut spec, retries);
    lay_over(&mut spec, change);
    spec["evaluation"]["carla"] = Value::Null;
    spec
}

fn challenges() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("examples/challenges")
}

/// An image of the examples, such as `classification/agent:1`.
pub(super) fn image(lab: &Lab, name: &str) -> String {
    format!("{}/{name}", lab.registry)
}

/// An evaluator that can go on half-way, with these variables.
fn going_on(lab: &Lab, variable: &str, value: &str) -> Value {
    json!({
        "image": image(lab, "classification/evaluator:faulty"),
        "command": ["python3", "-u", "/evaluator.py"],
        "env": [{"name": variable, "value": value}],
        "workers": 2,
    })
}

/// Tracks with these names, which agents and evaluators take for what they are to do.
pub(super) fn tracks(names: &[&str], score: &Value) -> Value {
    let track = |name: &&str| json!({"name": name, "container": {"score": score}});
    names.iter().map(track).collect()
}

/// The track of EvalAI's phase.
pub(super) fn phase() -> Value {
    json!([{"name": "test", "phase": FIRST_PHASE, "container": {"score": {"metric": "accuracy"}}}])
}

/// The file that the example's agent leaves, for participants who upload it.
pub(super) fn predictions() -> &'static [u8] {
    static FILE: OnceLock<Vec<u8>> = OnceLock::new();
    FILE.get_or_init(|| {
        let folder = tempfile::tempdir().unwrap();
        for program in ["data.py", "agent.py"] {
            let mut python = Command::new("python3");
            python
                .arg(challenges().join("classification").join(program))
                .arg(folder.path());
            python.env("DATASET", folder.path().join("dataset"));
            python.env("SUBMISSION_PATH", folder.path());
            assert!(python.status().unwrap().success(), "{program} fails");
        }
        fs::read(folder.path().join("predictions.csv")).unwrap()
    })
}

/// Size and digest of a file.
pub(super) fn submitted(content: &[u8]) -> SubmittedFile {
    SubmittedFile {
        sha256: hex::encode(Sha256::digest(content)),
        size: i64::try_from(content.len()).unwrap(),
    }
}

/// Applies a Submission of a local Leaderboard; `what` has its image or its input.
pub(super) async fn submit(scene: &Scene, name: &str, board: &str, track: &str, what: Value) {
    let mut spec = json!({"leaderboardName": board, "track": track, "team": {"id": "7", "name": "Team Seven"}});
    lay_over(&mut spec, what);
    scene.apply_submission(name, spec).await;
}

/// Applies one of a file, which is put into the bucket first.
async fn submit_file(scene: &Scene, name: &str, track: &str) {
    let key = format!("{}{name}/input/file", scene.cloud.prefix);
    let put = scene.cloud.s3.put_object().bucket(BUCKET).key(key);
    put.body(predictions().to_vec().into()).send().await.unwrap();
    let what = json!({"input": submitted(predictions())});
    submit(scene, name, "files", track, what).await;
}

/// What EvalAI gets for these splits.
fn results(splits: &[(&str, &str)]) -> Value {
    let split = |(name, accuracy): &(&str, &str)| {
        let accuracy: f64 = accuracy.parse().unwrap();
        json!({"split": name, "show_to_participant": true, "accuracies": {"accuracy": accuracy}})
    };
    splits.iter().map(split).collect()
}

/// It has ended with this score after so many units.
pub(super) fn assert_exact(submission: &Submission, (name, score): (&str, &str), units: &str) {
    let status = submission.status.as_ref().unwrap();
    assert_eq!(state(submission), Some(State::Finished));
    let progress = status.progress.as_ref().unwrap();
    assert_eq!((progress.text.as_str(), progress.unit.as_str()), (units, "units"));
    let found = status.score.as_ref().unwrap();
    assert_eq!((found.name.as_str(), found.text.as_str()), (name, score));
    assert!(found.is_final);
}

/// Waits until both evaluators of a run have counted half of their rows.
async fn held(scene: &Scene, name: &str) {
    let is_held = |s: &Submission| done(s) == HELD;
    scene
        .submission(name, "half of the rows are counted", LIMIT, is_held)
        .await;
}

/// Each evaluator has gone on where its life before was ended.
async fn assert_went_on(scene: &Scene, run: &str) {
    for worker in 1..=2 {
        let log = scene.cloud.text(run, &format!("evaluators/{worker}/console.log")).await;
        let lives: Vec<&str> = log.lines().filter(|line| line.starts_with("goes on after")).collect();
        assert_eq!(
            lives,
            ["goes on after 0 rows", "goes on after 50 rows"],
            "{worker}: {log}"
        );
    }
}

/// The submission is this file: in its status, and in the bucket. Nobody reads of an agent.
async fn assert_of_file(scene: &Scene, submission: &Submission, run: &str) {
    let status = submission.status.as_ref().unwrap();
    assert_eq!((&status.input, &status.image), (&Some(submitted(predictions())), &None));
    let stored = scene.cloud.text(run, "input/file").await;
    assert!(
        stored.as_bytes() == predictions(),
        "{run}: another file is in the bucket"
    );
    let keys = scene.cloud.keys(run).await;
    for other in ["agent/", "logcopy/collected.json"] {
        assert!(!keys.keys().any(|key| key.starts_with(other)), "{other}: {keys:?}");
    }
    let words = [&FOREIGN_WORDS[..], &["agent"]].concat();
    assert_without(scene, &submission.name_any(), run, &words).await;
}

#[tokio::test]
async fn a_static_code_upload_has_its_exact_score_though_its_pod_is_deleted_half_way() {
    scenario("modes-batch", async |scene: &Scene| {
        let evalai = Evalai::start_for_files(scene, true).await;
        let container = going_on(&scene.lab, "FAULT", "hold");
        let change = json!({"evaluation": {"container": container}, "tracks": phase()});
        let spec = example(&scene.lab, "classification", change);
        scene.evalai_leaderboard("lb", &evalai, spec).await;
        let _operator = (controller(scene), bridge(scene));
        scene.ready("lb").await;
        let mut case = Case::open(
            "static code upload, its Pod deleted while evaluators run",
            "Finished; EvalAI finished; its agent had one life",
        );
        let pk = evalai
            .submit(&image(&scene.lab, "classification/agent:1"), FIRST_PHASE)
            .await;
        let (name, run) = (format!("submission-{pk}"), pk.to_string());
        held(scene, &name).await;
        let pod = scene.pod(&name).await.name_any();
        let deleted = scene.api::<Pod>().delete(&pod, &DeleteParams::default()).await;
        deleted.unwrap();

        let submission = case.ends(scene, &name, LIMIT).await;
        case.evalai(evalai.submission(pk).status);
        let score = ("accuracy", ACCURACY);
        assert_exact(&submission, score, ALL_ROWS);
        assert_published(scene, &evalai, pk, &results(&[("test", ACCURACY)]), score, ALL_ROWS).await;
        assert_went_on(scene, &run).await;
        let log = scene.cloud.text(&run, "agent/agent1/leaderboard.log").await;
        case.also(match log.matches(PREDICTED).count() {
            1 => "its agent had one life",
            _ => log.as_str(),
        });
        let collected = scene.cloud.text(&run, "input/predictions.csv").await;
        assert!(collected.as_bytes() == predictions(), "the evaluators had another file");
        assert_own_words(scene, &name, &run).await;
        assert_eq!(scene.jobs().await, [format!("{name}-1")], "the Job makes the next Pod");
        case.close();
    })
    .await;
}

#[tokio::test]
async fn an_uploaded_file_has_its_exact_score() {
    scenario("modes-predictions", async |scene: &Scene| {
        let evalai = Evalai::start_for_files(scene, false).await;
        let spec = example(&scene.lab, "predictions", json!({"tracks": phase()}));
        scene.evalai_leaderboard("lb", &evalai, spec).await;
        let _operator = (controller(scene), bridge(scene));
        scene.ready("lb").await;
        let mut case = Case::open("file that a participant uploads", "Finished; EvalAI finished");
        let pk = evalai.upload(predictions(), FIRST_PHASE).await;
        let submission = case.ends(scene, &format!("submission-{pk}"), LIMIT).await;
        case.evalai(evalai.submission(pk).status);
        let score = ("accuracy", ACCURACY);
        assert_exact(&submission, score, "1/1");
        assert_published(scene, &evalai, pk, &results(&[("test", ACCURACY)]), score, "1/1").await;
        assert_of_file(scene, &submission, &pk.to_string()).await;
        case.close();
    })
    .await;
}

#[tokio::test]
async fn files_have_their_exact_score_whatever_crashes_and_a_cancel_ends_an_agent() {
    scenario("modes-local", async |scene: &Scene| {
        let _controller = controller(scene);
        let lab = &scene.lab;
        let batch = json!({
            "tracks": tracks(&["crash-once", "hang"], &json!({"metric": "accuracy"})),
            "deadlines": {"idleSeconds": 500},
        });
        scene.leaderboard("batch", example(lab, "classification", batch)).await;
        let files = json!({
            "evaluation": {"container": going_on(lab, "SPLITS", "easy,hard")},
            "tracks": tracks(&["hold", "crash-once"], &json!({"metric": "accuracy", "split": "hard"})),
        });
        scene.leaderboard("files", example(lab, "predictions", files)).await;
        let mut merging = going_on(lab, "SPLITS", "test");
        merging["merge"] = "Command".into();
        let merged = json!({
            "evaluation": {"container": merging},
            "tracks": tracks(&["crash-once"], &json!({"metric": "median"})),
        });
        scene
            .leaderboard("merged", example(lab, "classification", merged))
            .await;
        let cases = vec![
            merged_by_a_command(scene).boxed_local(),
            evicted(scene).boxed_local(),
            evaluators_crash(scene).boxed_local(),
            agent_crashes(scene).boxed_local(),
            cancelled(scene).boxed_local(),
        ];
        together(WIDTH, cases).await;
    })
    .await;
}

async fn agent_crashes(scene: &Scene) {
    let mut case = Case::open("agent that runs first crashes once", "Finished; one Job");
    let agent = json!({"image": image(&scene.lab, "classification/agent:hostile")});
    submit(scene, "agent-crashes", "batch", "crash-once", agent).await;
    let submission = case.ends(scene, "agent-crashes", LIMIT).await;
    assert_exact(&submission, ("accuracy", ACCURACY), ALL_ROWS);
    let workers = submission.status.unwrap().workers;
    let crashes: Vec<i32> = workers.iter().map(|worker| worker.crashes).collect();
    assert_eq!(crashes, [1, 0], "{workers:?}");
    let log = scene.cloud.text("agent-crashes", "agent/agent1/leaderboard.log").await;
    assert_eq!(log.matches(PREDICTED).count(), 1, "{log}");
    assert_own_words(scene, "agent-crashes", "agent-crashes").await;
    one_job(&mut case, scene, "agent-crashes").await;
    case.close();
}

async fn merged_by_a_command(scene: &Scene) {
    let mut case = Case::open(
        "results that a command merges, which crashes once as each evaluator does",
        "Finished; one Job",
    );
    let agent = json!({"image": image(&scene.lab, "classification/agent:1")});
    submit(scene, "merged", "merged", "crash-once", agent).await;
    let submission = case.ends(scene, "merged", LIMIT).await;
    assert_exact(&submission, ("median", MEDIAN), ALL_ROWS);
    let workers = submission.status.unwrap().workers;
    let crashes: Vec<(i32, i32)> = workers.iter().map(|worker| (worker.id, worker.crashes)).collect();
    assert_eq!(crashes, [(1, 1), (2, 1), (3, 1)], "{workers:?}");
    assert_went_on(scene, "merged").await;
    let stored: Value = serde_json::from_str(&scene.cloud.text("merged", "evalai/results.json").await).unwrap();
    let split = json!({"split": "test", "show_to_participant": true, "accuracies": {"median": 0.8}});
    assert_eq!(stored, json!([split]));
    assert_own_words(scene, "merged", "merged").await;
    one_job(&mut case, scene, "merged").await;
    case.close();
}

async fn cancelled(scene: &Scene) {
    let mut case = Case::open("cancel while an agent that runs first is at work", "Cancelled");
    let agent = json!({"image": image(&scene.lab, "classification/agent:hostile")});
    submit(scene, "stopped", "batch", "hang", agent).await;
    scene.running("stopped", LIMIT).await;
    case.cause();
    scene.change_submission("stopped", &json!({"cancel": true})).await;
    case.ends(scene, "stopped", LIMIT).await;
    let keys = scene.cloud.keys("stopped").await;
    let is_result = |key: &String| key.ends_with("/result.json") || key.starts_with("input/");
    assert!(!keys.keys().any(is_result), "nothing was evaluated: {keys:?}");
    assert_own_words(scene, "stopped", "stopped").await;
    case.close();
}

/// As a drain does it, and what takes Spot instances away.
async fn evicted(scene: &Scene) {
    let mut case = Case::open(
        "file in the bucket, its Pod evicted while evaluators run",
        "Finished; one interruption",
    );
    submit_file(scene, "evicted", "hold").await;
    held(scene, "evicted").await;
    let pod = scene.pod("evicted").await.name_any();
    let evicted = scene.api::<Pod>().evict(&pod, &EvictParams::default()).await;
    evicted.unwrap();
    let submission = case.ends(scene, "evicted", LIMIT).await;
    assert_exact(&submission, ("hard_accuracy", HARD), ALL_ROWS);
    let status = submission.status.as_ref().unwrap();
    let interruptions = status.interruptions.as_ref().map(|found| found.number);
    case.also(match interruptions {
        Some(1) => "one interruption",
        _ => "none, or several interruptions",
    });
    let easy = status.metrics.iter().find(|metric| metric.name == "easy_accuracy");
    assert_eq!(easy.map(|metric| metric.value.as_str()), Some(EASY));
    let stored: Value = serde_json::from_str(&scene.cloud.text("evicted", "evalai/results.json").await).unwrap();
    assert_eq!(stored, results(&[("easy", EASY), ("hard", HARD)]));
    assert_went_on(scene, "evicted").await;
    assert_of_file(scene, &submission, "evicted").await;
    case.close();
}

async fn evaluators_crash(scene: &Scene) {
    let mut case = Case::open("evaluators of a file crash once", "Finished; one Job");
    submit_file(scene, "crashing", "crash-once").await;
    let submission = case.ends(scene, "crashing", LIMIT).await;
    assert_exact(&submission, ("hard_accuracy", HARD), ALL_ROWS);
    let workers = &submission.status.as_ref().unwrap().workers;
    let crashes: Vec<i32> = workers.iter().map(|worker| worker.crashes).collect();
    assert_eq!(crashes, [1, 1], "{workers:?}");
    assert_went_on(scene, "crashing").await;
    assert_of_file(scene, &submission, "crashing").await;
    one_job(&mut case, scene, "crashing").await;
    case.close();
}
