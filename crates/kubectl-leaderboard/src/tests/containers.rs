//! Submissions of a host's own evaluator: no command shows a word of CARLA for them.

use clap::Parser;
use serde_json::{Value, json};

use super::{condition, frame, with};
use crate::board::Observed;
use crate::change::{Request, plan};
use crate::check::{self, Check};
use crate::{get, resume, status, top, why};
use leaderboard_api::{Leaderboard, Submission};

/// Words that a host without CARLA does not know.
const OF_CARLA: [&str; 4] = ["carla", "simulator", "route", "pair"];

#[derive(Parser)]
struct Line {
    #[command(flatten)]
    check: Check,
}

fn leaderboard() -> Leaderboard {
    let container = json!({"mode": "Interactive", "image": "evaluator:1", "command": ["evaluate"]});
    let object = json!({
        "apiVersion": "leaderboard.carla.org/v1alpha1", "kind": "Leaderboard",
        "metadata": {"name": "games", "namespace": "arena"},
        "spec": {
            "tracks": [{"name": "test", "container": {"score": {"metric": "accuracy"}}}], "evaluation": {"container": container},
            "agent": {"command": ["play"]}, "storage": {"s3": {"bucket": "results"}},
        },
        "status": {"conditions": [condition("Ready", "True", "Ready", "")]},
    });
    serde_json::from_value(object).unwrap()
}

fn submission(status: &Value) -> Submission {
    let object = json!({
        "apiVersion": "leaderboard.carla.org/v1alpha1", "kind": "Submission",
        "metadata": {"name": "mine", "namespace": "arena", "creationTimestamp": "2026-11-01T10:00:00Z", "resourceVersion": "1"},
        "spec": {"leaderboardName": "games", "track": "test", "image": "agent:1"}, "status": status,
    });
    serde_json::from_value(object).unwrap()
}

fn running() -> Value {
    let score = json!({"metric": "accuracy"});
    let container =
        json!({"mode": "Interactive", "workers": 2, "merge": "Mean", "score": score, "image": "registry/evaluator:1"});
    json!({
        "state": "Running", "attempt": 1, "message": "", "track": "test", "jobName": "mine-1", "resultsURL": "s3://results/mine",
        "progress": {"done": 12, "total": 20, "unit": "units", "text": "12/20"}, "nodeName": "node-3",
        "score": {"name": "accuracy", "value": "0.5", "final": false, "text": "~0.5"}, "metrics": [{"name": "games", "value": "12"}],
        "plan": {"runId": "mine", "container": container, "track": "test", "storage": {"s3": {"bucket": "results"}}, "image": "agent:1"},
        "workers": [{"id": 1, "done": 9, "total": 10, "crashes": 1, "state": "Running",
                     "last": {"reason": "EvaluatorNotReady", "time": "2026-11-01T11:40:00Z"}}],
        "times": {"started": "2026-11-01T11:00:00Z"},
        "conditions": [condition("Finished", "False", "Preparing", ""), condition("Running", "True", "Running", "")],
    })
}

fn ended(state: &str, reason: &str, class: Option<&str>) -> Value {
    let failure = class.map(|class| json!({"class": class, "reason": reason, "message": "It was so.", "worker": 1}));
    let ended = json!({
        "state": state, "reason": reason, "message": "It was so.", "failure": failure, "times": {"finished": "2026-11-01T11:57:00Z"},
        "conditions": [condition("Finished", "True", reason, ""), condition("Archived", "True", "Stored", "")],
    });
    with(running(), &ended)
}

#[test]
fn no_command_shows_a_word_of_carla_for_a_hosts_own_evaluator() {
    let board = leaderboard();
    let states = [
        running(),
        ended("Finished", "Finished", None),
        ended("Cancelled", "Cancelled", None),
        ended("Failed", "EvaluatorFailed", Some("Infrastructure")),
        ended("Failed", "AgentCrashed", Some("Participant")),
        ended("Failed", "TimeLimit", Some("Participant")),
    ];
    for state in states {
        let one = submission(&state);
        let (board, chosen) = (Observed::Found(&board), [&one]);
        let changes = [Request::Cancel, Request::Resume, Request::Restart].map(|request| {
            let planned = plan(request, &one, board, frame());
            planned.map_or_else(|why| vec![why], |planned| planned.lines)
        });
        let shown = [
            why::explain(&one, board, frame()),
            status::screen(&one, board, frame()),
            check::lines(&one, board, frame()),
            resume::lines(&chosen, frame()),
            get::done(&one, frame()),
            top::lines(std::slice::from_ref(&one), &[leaderboard()], frame()),
        ];
        for line in shown.iter().chain(&changes).flatten() {
            let found = OF_CARLA.into_iter().find(|word| line.to_lowercase().contains(word));
            assert_eq!(found, None, "{line}");
        }
    }
    let check = Line::parse_from(["check", "games"]).check;
    let why = check::object(&leaderboard(), &check).unwrap_err();
    assert!(why.ends_with("set spec.check.image"), "{why}");
}

#[test]
fn the_images_of_a_hosts_evaluator_stand_in_a_column_of_their_own() {
    let lines = resume::lines(
        &[&submission(&ended("Failed", "EvaluatorFailed", Some("Infrastructure")))],
        frame(),
    );
    assert!(
        lines[0].ends_with("EVALUATOR") && lines[1].ends_with("evaluator:1"),
        "{lines:?}"
    );
}
