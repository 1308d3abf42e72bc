//! What a participant's agent tries against a host's evaluator, and what an evaluator itself does wrong, each with the end that follows: state,
//! reason, class, charge and what else is seen.
//!
//! local/games/README.md says what each agent and each evaluator does.

use std::time::Duration;

use futures::FutureExt;
use leaderboard_api::Submission;
use serde_json::{Value, json};

use super::containers::{assert_own_words, game, submit};
use super::matrix::{Case, together};
use crate::operator::controller;
use crate::scene::{Scene, lay_over, scenario, score};

/// Runs at once: each has three or five containers.
const WIDTH: usize = 5;
/// The longest of them takes a quarter of it on an idle machine.
const LIMIT: Duration = Duration::from_mins(4);

/// One submission, with a Leaderboard of its own.
struct Row {
    id: &'static str,
    name: &'static str,
    agent: &'static str,
    /// Laid over eight games for one worker, of which nothing is tried again.
    change: Value,
    expected: &'static str,
    also: Also,
}

/// What is looked at beside the end and the score.
enum Also {
    Nothing,
    /// How many Jobs it had.
    Jobs,
    /// How many games were over.
    Units,
    /// The line of an agent's log that begins so.
    Printed(u16, &'static str),
    /// Whether the host reads these words.
    Says(&'static str),
    /// The score's name, and EvalAI's splits with their guesses.
    Splits,
}

fn hostile(id: &'static str, name: &'static str, kind: &str, expected: &'static str) -> Row {
    Row {
        id,
        name,
        agent: "agent:hostile",
        change: json!({"agent": {"env": [{"name": "KIND", "value": kind}]}}),
        expected,
        also: Also::Nothing,
    }
}

fn faulty(id: &'static str, name: &'static str, fault: &str, expected: &'static str) -> Row {
    Row {
        id,
        name,
        agent: "agent:1",
        change: evaluator(fault),
        expected,
        also: Also::Nothing,
    }
}

/// An evaluator with this fault in the place of the example's. The scene puts its image in.
fn evaluator(fault: &str) -> Value {
    let variables = [("FAULT", fault), ("GAMES", "8"), ("SEED", "window")];
    let env: Vec<Value> = variables
        .iter()
        .map(|(name, value)| json!({"name": name, "value": value}))
        .collect();
    json!({"evaluation": {"container": {"image": "evaluator:faulty", "env": env}}})
}

impl Row {
    fn with(mut self, change: Value) -> Self {
        lay_over(&mut self.change, change);
        self
    }

    fn also(self, also: Also) -> Self {
        Self { also, ..self }
    }
}

fn two_workers() -> Value {
    json!({"evaluation": {"container": {"workers": 2}}})
}

/// Agents that lie, look around and disturb, whose games are those that they have played.
fn without_gain() -> Vec<Row> {
    vec![
        hostile(
            "forge",
            "agent forges marks of the end and results, then guesses blindly",
            "forge",
            // A game ends with the 21st guess.
            "Finished; 21.0; forged",
        )
        .with(two_workers())
        .also(Also::Printed(1, "forged")),
        hostile(
            "steal",
            "agent looks for the evaluator's memory and files",
            "steal",
            "Finished; 8.25; found: nothing",
        )
        .with(evaluator("labels"))
        .also(Also::Printed(1, "found: ")),
        hostile(
            "other-worker",
            "agent plays the games of another worker's evaluator",
            "other-worker",
            "Finished; 8.25; a second session: 400",
        )
        .with(two_workers())
        .also(Also::Printed(2, "a second session: ")),
        hostile(
            "provoke",
            "agent sends what a careless evaluator raises at",
            "provoke",
            "Finished; 8.25",
        ),
    ]
}

/// Agents that end their run.
fn without_score() -> Vec<Row> {
    let evaluators = "Failed EvaluatorFailed (infrastructure, not charged); 2 Jobs";
    vec![
        hostile(
            "raise",
            "agent makes its evaluator raise, again and again",
            "raise",
            evaluators,
        )
        .with(evaluator("none"))
        .with(json!({"retries": {"infrastructure": 3}}))
        .also(Also::Jobs),
        hostile(
            "exit-early",
            "agent exits with 0 after the first game",
            "exit-early",
            "Failed EvaluatorFailed (infrastructure, not charged); 1/8",
        )
        .with(json!({"evaluation": {"container": {"answerSeconds": 2}}}))
        .also(Also::Units),
        hostile(
            "never",
            "agent of a game is idle",
            "never",
            "Failed Idle (participant, charged)",
        )
        .with(json!({"deadlines": {"idleSeconds": 5}})),
        hostile(
            "take-port",
            "agent takes the port of another worker's evaluator",
            "take-port",
            "Failed AgentCrashed (participant, charged)",
        )
        .with(evaluator("none"))
        .with(two_workers())
        // The other one has a moment for it after each of the first crashes.
        .with(json!({"retries": {"perWorker": 2}})),
    ]
}

/// Evaluators whose only game is over with the first guess.
fn of_evaluators() -> Vec<Row> {
    let failed = "Failed EvaluatorFailed (infrastructure, not charged)";
    let splits = json!({"tracks": [{"name": "test", "container": {"score": {"split": "hard", "metric": "guesses"}}}]});
    vec![
        faulty(
            "late",
            "evaluator computes on when its agent has exited with 0",
            "late",
            "Finished; 3.5",
        ),
        faulty("nan", "evaluator writes a number that is not finite", "nan", failed),
        faulty(
            "no-score",
            "evaluator's final result lacks the score",
            "no-score",
            failed,
        ),
        faulty(
            "no-split",
            "evaluator writes two splits, and the score names none",
            "two-splits",
            "Failed EvaluatorFailed (infrastructure, not charged); says: score.split",
        )
        .also(Also::Says("score.split")),
        faulty(
            "two-splits",
            "evaluator writes two splits",
            "two-splits",
            "Finished; 7.25; hard_guesses; easy 3.5, hard 7.25",
        )
        .with(splits)
        .also(Also::Splits),
        faulty(
            "not-eligible",
            "evaluator's result does not count",
            "not-eligible",
            "Failed NotEligible (participant, charged)",
        ),
        faulty(
            "refuse",
            "evaluator refuses the submission in a sentence",
            "refuse",
            "Failed InvalidResults (participant, charged); says: not in the game",
        )
        .also(Also::Says("not in the game")),
        faulty(
            "exit-65",
            "evaluator refuses the submission by its exit code",
            "exit-65",
            "Failed InvalidResults (participant, charged); says: refused the submission",
        )
        .also(Also::Says("refused the submission")),
    ]
}

#[tokio::test]
async fn a_hostile_agent_gains_nothing_and_a_broken_evaluator_charges_nobody() {
    scenario("game-hostile", async |scene: &Scene| {
        let _controller = controller(scene);
        let rows = without_score().into_iter().chain(without_gain()).chain(of_evaluators());
        let cases = rows.map(|row| run(scene, row).boxed_local());
        together(WIDTH, cases.collect()).await;
    })
    .await;
}

async fn run(scene: &Scene, row: Row) {
    let mut case = Case::open(row.name, row.expected);
    let mut change = json!({
        "evaluation": {"container": {"workers": 1}},
        "retries": {"perWorker": 0},
    });
    lay_over(&mut change, row.change);
    if let Some(image) = change["evaluation"]["container"].get_mut("image") {
        *image = scene.lab.game(image.as_str().unwrap()).into();
    }
    scene.leaderboard(row.id, game(&scene.lab, change)).await;
    submit(scene, row.id, row.id, row.agent).await;
    let ended = case.ends(scene, row.id, LIMIT).await;
    if row.expected.starts_with("Finished") {
        case.also(score(&ended));
    }
    see(&mut case, scene, row.id, row.also, &ended).await;
    assert_own_words(scene, row.id, row.id).await;
    case.close();
}

async fn see(case: &mut Case, scene: &Scene, id: &str, also: Also, ended: &Submission) {
    let status = ended.status.as_ref().unwrap();
    match also {
        Also::Nothing => {}
        Also::Jobs => {
            let jobs = scene.jobs().await;
            let own = jobs.iter().filter(|job| job.starts_with(&format!("{id}-1")));
            case.also(&format!("{} Jobs", own.count()));
        }
        Also::Units => case.also(
            status
                .progress
                .as_ref()
                .map_or("none", |progress| progress.text.as_str()),
        ),
        Also::Printed(worker, begins) => {
            let key = format!("agent/agent{worker}/leaderboard.log");
            let log = scene.cloud.text(id, &key).await;
            let line = log.lines().find(|line| line.starts_with(begins));
            let line = line.unwrap_or_else(|| panic!("{id}: no line of {key} begins with {begins}: {log}"));
            // How many files it could write is the image's matter.
            case.also(if begins == "forged" { begins } else { line });
        }
        Also::Says(words) => {
            let message = status.failure.as_ref().map_or("", |failure| failure.message.as_str());
            let says = message.contains(words).then(|| format!("says: {words}"));
            case.also(says.as_deref().unwrap_or(message));
        }
        Also::Splits => {
            case.also(status.score.as_ref().map_or("none", |score| score.name.as_str()));
            let results = scene.cloud.text(id, "evalai/results.json").await;
            let results: Vec<Value> = serde_json::from_str(&results).unwrap();
            let split = |entry: &Value| {
                let name = entry["split"].as_str().unwrap_or_default();
                format!("{name} {}", entry["accuracies"]["guesses"])
            };
            case.also(&results.iter().map(split).collect::<Vec<_>>().join(", "));
        }
    }
}
