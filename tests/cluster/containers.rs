//! An evaluation by a host's container: the guessing game of examples/challenges, from a message or a Submission to its exact score,
//! whatever is killed meanwhile.
//!
//! local/games/README.md works the numbers out game by game, and local/tests/test_games.py plays them without a cluster.

use std::collections::BTreeMap;
use std::time::Duration;

use evalai_stand_in::model::Status;
use futures::FutureExt;
use k8s_openapi::api::core::v1::Pod;
use kube::ResourceExt;
use kube::api::DeleteParams;
use leaderboard_api::{State, Submission, SubmissionStatus};
use serde_json::{Value, json};
use tokio::time::timeout;

use super::matrix::{Case, together};
use crate::evalai::{Evalai, FIRST_PHASE};
use crate::operator::{bridge, controller};
use crate::processes::kill_container;
use crate::scene::{Lab, Scene, done, lay_over, scenario, state};

const WIDTH: usize = 4;
/// Patience with a busy machine; each wait ends with its event.
const LIMIT: Duration = Duration::from_mins(4);
/// Guesses of a game that halves the range, over all eight: (30 + 36) / 8.
pub(super) const GUESSES: &str = "8.25";
/// The same over the first game of worker 1 and the first three of worker 2: (7 + 10 + 10 + 7) / 4. The plain mean of 7 and 9 is 8.
const HELD_GUESSES: &str = "8.5";
/// So many games are over then.
const HELD: i32 = 4;
/// Words of the other kind of evaluation.
pub(super) const FOREIGN_WORDS: [&str; 5] = ["carla", "route", "simulat", "pair ", "driving"];
/// What the evaluator of each worker keeps of its games at the end.
const GAMES: [&str; 2] = ["[7, 9, 4, 10]", "[10, 10, 7, 9]"];

/// Fields of a Leaderboard of eight games for two workers; `change` is laid over them.
pub(super) fn game(lab: &Lab, change: Value) -> Value {
    let disk = json!({"requests": {"ephemeral-storage": "16Mi"}, "limits": {"ephemeral-storage": "1Gi"}});
    let mut spec = json!({
        "evaluation": {"carla": null, "container": {
            "mode": "Interactive",
            "image": lab.game("evaluator:1"),
            "command": ["python3", "-u", "/evaluator.py"],
            "env": [{"name": "GAMES", "value": "8"}, {"name": "SEED", "value": "window"}],
            "port": 7000,
            "workers": 2,
            "answerSeconds": 20,
            "resources": disk,
        }},
        "tracks": [{"name": "test", "container": {"score": {"metric": "guesses", "order": "Ascending"}}}],
        "agent": {"command": ["python3", "-u", "/agent.py"], "resources": disk},
        "retries": {"perWorker": 2, "infrastructure": 0},
        "deadlines": {"readySeconds": 60, "cancelSeconds": 20},
    });
    lay_over(&mut spec, change);
    spec
}

/// The same with agents of this kind, which may print nothing for as long as it takes.
fn with_agents(lab: &Lab, kind: &str, change: Value) -> Value {
    let mut base = json!({
        "agent": {"env": [{"name": "KIND", "value": kind}]},
        "deadlines": {"idleSeconds": 600},
    });
    lay_over(&mut base, change);
    game(lab, base)
}

/// Applies a Submission of a local Leaderboard of the game.
pub(super) async fn submit(scene: &Scene, board: &str, name: &str, agent: &str) {
    let spec = json!({
        "leaderboardName": board,
        "track": "test",
        "image": scene.lab.game(agent),
        "team": {"id": "7", "name": "Team Seven"},
    });
    scene.apply_submission(name, spec).await;
}

#[tokio::test]
async fn a_message_becomes_the_exact_score_though_its_pod_is_deleted_half_way() {
    scenario("game-message", async |scene: &Scene| {
        let evalai = Evalai::start_for(scene, "test", &["guesses", "found"]).await;
        let score = json!({"metric": "guesses", "order": "Ascending"});
        let phase = json!({"tracks": [{"name": "test", "phase": FIRST_PHASE, "container": {"score": score}}]});
        let spec = with_agents(&scene.lab, "hold", phase);
        scene.evalai_leaderboard("lb", &evalai, spec).await;
        let _operator = (controller(scene), bridge(scene));
        scene.ready("lb").await;
        let mut case = Case::open(
            "guessing game from a message, its Pod deleted by hand",
            "Finished; EvalAI finished",
        );
        let pk = evalai.submit(&scene.lab.game("agent:hostile"), FIRST_PHASE).await;
        let name = format!("submission-{pk}");
        await_partial(&evalai).await;
        let pod = scene.pod(&name).await.name_any();
        let deleted = scene.api::<Pod>().delete(&pod, &DeleteParams::default()).await;
        deleted.unwrap();

        let submission = case.ends(scene, &name, LIMIT).await;
        case.evalai(evalai.submission(pk).status);
        assert_exact(&submission);
        let score = ("guesses", GUESSES);
        assert_published(scene, &evalai, pk, &results(GUESSES), score, "8/8").await;
        assert_kept(scene, &pk.to_string()).await;
        assert_own_words(scene, &name, &pk.to_string()).await;
        assert_eq!(
            scene.jobs().await,
            [format!("{name}-1")],
            "the Job makes the next Pod, and its evaluators go on from S3"
        );
        case.close();
    })
    .await;
}

/// What EvalAI gets for the split of the game.
fn results(guesses: &str) -> Value {
    let guesses: f64 = guesses.parse().unwrap();
    json!([{"split": "test", "show_to_participant": true, "accuracies": {"guesses": guesses, "found": 1.0}}])
}

/// Waits until EvalAI has the metrics over the games so far.
async fn await_partial(evalai: &Evalai) {
    let expected = results(HELD_GUESSES);
    let mut last = Value::Null;
    let seen = evalai.handle.wait_until(|_, log| {
        let partial = log.entries().filter(|entry| {
            entry.method == "PUT" && entry.path.contains("partially_evaluated") && entry.answered.is_some()
        });
        let text = partial.last().and_then(|entry| entry.body["result"].as_str());
        last = text.map_or(Value::Null, |text| serde_json::from_str(text).unwrap());
        last == expected
    });
    let seen = timeout(LIMIT, seen).await.is_ok();
    assert!(seen, "the last partial result is {last}, not {expected}");
}

/// It has ended with the score that was worked out by hand.
pub(super) fn assert_exact(submission: &Submission) {
    let status = submission.status.as_ref().unwrap();
    assert_eq!(state(submission), Some(State::Finished));
    let progress = status.progress.as_ref().unwrap();
    assert_eq!((progress.text.as_str(), progress.unit.as_str()), ("8/8", "units"));
    let score = status.score.as_ref().unwrap();
    assert_eq!((score.name.as_str(), score.text.as_str()), ("guesses", GUESSES));
    assert!(score.is_final);
    let found = status.metrics.iter().find(|metric| metric.name == "found").unwrap();
    assert_eq!(found.value.parse(), Ok(1.0), "every number was found");
}

/// EvalAI's row, its leaderboard, its files, S3 and the table show the same results, of which the first split has the score.
pub(super) async fn assert_published(
    scene: &Scene,
    evalai: &Evalai,
    pk: u64,
    expected: &Value,
    (label, score): (&str, &str),
    progress: &str,
) {
    let run = pk.to_string();
    let stored: Value = serde_json::from_str(&scene.cloud.text(&run, "evalai/results.json").await).unwrap();
    assert_eq!(&stored, expected);
    let row = evalai.submission(pk);
    assert_eq!(row.status, Status::Finished);
    let rows = evalai.rows(pk);
    assert_eq!(rows.len(), 1, "{rows:?}");
    assert_eq!(json!(rows[0].result), stored[0]["accuracies"]);
    let shown = evalai.leaderboard(FIRST_PHASE).await;
    assert_eq!(shown[0]["submission__id"], json!(pk));
    assert_eq!(shown[0]["filtering_score"], stored[0]["accuracies"][label]);
    let text = scene.cloud.text(&run, "evalai/stdout.txt").await;
    assert_eq!(evalai.file(row.stdout_file.as_ref()), text);
    assert_eq!(evalai.file(row.stderr_file.as_ref()).trim(), "", "nothing went wrong");
    let row = scene.cloud.row(&scene.cloud.table).await;
    for (column, text) in [
        (label, score),
        ("submission_status", "FINISHED"),
        ("progress", progress),
    ] {
        assert_eq!(row.get(column).map(String::as_str), Some(text), "{column} of {row:?}");
    }
}

/// What the evaluators have left in S3: their results, and what they go on with.
async fn assert_kept(scene: &Scene, run: &str) {
    let keys = scene.cloud.keys(run).await;
    for (worker, games) in (1..).zip(GAMES) {
        assert_eq!(
            scene.cloud.text(run, &format!("evaluators/{worker}/games.json")).await,
            games
        );
        assert_eq!(result(scene, run, worker).await["final"], true);
        for key in [
            format!("evaluators/{worker}/console.log"),
            format!("agent/agent{worker}/leaderboard.log"),
            format!("containers-status/evaluator-{worker}.done"),
        ] {
            assert!(keys.contains_key(&key), "{key}: {keys:?}");
        }
    }
    for other in ["simulator/", "agent/agent_results.json", "contents/"] {
        assert!(!keys.keys().any(|key| key.starts_with(other)), "{other}: {keys:?}");
    }
}

/// The last result of an evaluator.
async fn result(scene: &Scene, run: &str, worker: u16) -> Value {
    let text = scene.cloud.text(run, &format!("evaluators/{worker}/result.json")).await;
    serde_json::from_str(&text).unwrap()
}

/// No person reads of another kind of evaluation.
pub(super) async fn assert_own_words(scene: &Scene, name: &str, run: &str) {
    assert_without(scene, name, run, &FOREIGN_WORDS).await;
}

/// No person reads one of these words.
pub(super) async fn assert_without(scene: &Scene, name: &str, run: &str, words: &[&str]) {
    let submission = scene.api::<Submission>().get(name).await.unwrap();
    let status = submission.status.unwrap_or_default();
    let events = scene.events(name).await.into_iter().filter_map(|event| event.note);
    let mut texts: BTreeMap<String, String> = (1..).map(|n| format!("event {n}")).zip(events).collect();
    texts.extend(texts_of(&status));
    texts.insert("stdout".to_owned(), scene.cloud.text(run, "evalai/stdout.txt").await);
    for (place, text) in texts {
        let lower = text.to_lowercase();
        for word in words {
            assert!(!lower.contains(word), "{name}: {place} has the word {word}: {text}");
        }
    }
}

/// The sentences of a status.
fn texts_of(status: &SubmissionStatus) -> impl Iterator<Item = (String, String)> {
    let failure = status.failure.iter().flat_map(|failure| {
        let others = [failure.next_step.clone(), failure.participant_message.clone()];
        others.into_iter().flatten().chain([failure.message.clone()])
    });
    let conditions = status.conditions.iter().map(|condition| condition.message.to_string());
    let message = status.message.iter().map(ToString::to_string);
    let all: Vec<String> = failure.chain(conditions).chain(message).collect();
    (1..).map(|number| format!("sentence {number}")).zip(all)
}

#[tokio::test]
async fn a_game_of_a_local_submission_has_its_exact_score_whatever_is_killed() {
    scenario("game-local", async |scene: &Scene| {
        let _controller = controller(scene);
        let lab = &scene.lab;
        scene.leaderboard("plain", game(lab, json!({}))).await;
        scene.leaderboard("held", with_agents(lab, "hold", json!({}))).await;
        scene
            .leaderboard("crashing", with_agents(lab, "crash-once", json!({})))
            .await;
        let cases = vec![
            undisturbed(scene).boxed_local(),
            agents_crash(scene).boxed_local(),
            evaluators_die(scene).boxed_local(),
            cancelled(scene).boxed_local(),
        ];
        together(WIDTH, cases).await;
    })
    .await;
}

async fn undisturbed(scene: &Scene) {
    let mut case = Case::open("guessing game by kubectl", "Finished");
    submit(scene, "plain", "plain", "agent:1").await;
    assert_exact(&case.ends(scene, "plain", LIMIT).await);
    let stored: Value = serde_json::from_str(&scene.cloud.text("plain", "evalai/results.json").await).unwrap();
    assert_eq!(stored, results(GUESSES));
    assert_kept(scene, "plain").await;
    assert_own_words(scene, "plain", "plain").await;
    case.close();
}

async fn agents_crash(scene: &Scene) {
    let mut case = Case::open("agents of a game crash once", "Finished; one Job");
    submit(scene, "crashing", "crashing", "agent:hostile").await;
    let submission = case.ends(scene, "crashing", LIMIT).await;
    assert_exact(&submission);
    let workers = submission.status.unwrap().workers;
    assert!(workers.iter().all(|worker| worker.crashes >= 1), "{workers:?}");
    assert_kept(scene, "crashing").await;
    one_job(&mut case, scene, "crashing").await;
    case.close();
}

/// Waits until the agents of a run have played what they play before they wait.
async fn held(scene: &Scene, name: &str) -> Submission {
    let is_held = |s: &Submission| done(s) == HELD;
    scene.submission(name, "four games are over", LIMIT, is_held).await
}

async fn evaluators_die(scene: &Scene) {
    let mut case = Case::open("evaluators killed in mid-game", "Finished; one Job");
    submit(scene, "held", "killed", "agent:hostile").await;
    held(scene, "killed").await;
    let pod = scene.pod("killed").await;
    for worker in 1..=2 {
        kill_container(&pod, &format!("evaluator-{worker}"));
    }
    assert_exact(&case.ends(scene, "killed", LIMIT).await);
    assert_kept(scene, "killed").await;
    assert_own_words(scene, "killed", "killed").await;
    one_job(&mut case, scene, "killed").await;
    case.close();
}

pub(super) async fn one_job(case: &mut Case, scene: &Scene, name: &str) {
    let jobs = scene.jobs().await;
    let own = jobs.iter().filter(|job| job.starts_with(&format!("{name}-1"))).count();
    case.also(if own == 1 { "one Job" } else { "several Jobs" });
}

async fn cancelled(scene: &Scene) {
    let mut case = Case::open("guessing game cancelled in mid-game", "Cancelled");
    submit(scene, "held", "stopped", "agent:hostile").await;
    let submission = held(scene, "stopped").await;
    let score = submission.status.unwrap().score.unwrap();
    assert_eq!((score.value.as_str(), score.is_final), (HELD_GUESSES, false));
    case.cause();
    scene.change_submission("stopped", &json!({"cancel": true})).await;
    let submission = case.ends(scene, "stopped", LIMIT).await;
    assert_eq!(done(&submission), HELD);
    for (worker, games) in [(1, 1), (2, 3)] {
        let result = result(scene, "stopped", worker).await;
        assert_eq!((&result["done"], &result["final"]), (&json!(games), &json!(false)));
    }
    assert_own_words(scene, "stopped", "stopped").await;
    case.close();
}
