//! Submissions of a host's own evaluator: no command shows a word of CARLA for them, nor one of an agent where none runs.

use clap::Parser;
use serde_json::{Value, json};

use super::golden::assert_shown;
use super::{condition, frame, with};
use crate::board::Observed;
use crate::change::{Request, plan};
use crate::check::{self, Check};
use crate::logs::{Whose, in_bucket};
use crate::submit::fits;
use crate::{get, overview, resume, scores, status, submit, top, why};
use leaderboard_api::{Leaderboard, Submission};

/// Words that a host without CARLA does not know.
const OF_CARLA: [&str; 4] = ["carla", "simulator", "route", "pair"];

#[derive(Parser)]
struct Line {
    #[command(flatten)]
    check: Check,
}

fn leaderboard(mode: &str) -> Leaderboard {
    let container = json!({"mode": mode, "image": "evaluator:1", "command": ["evaluate"]});
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

/// What was submitted: a file, or an image.
fn with_submitted(mode: &str, mut of: Value) -> Value {
    if mode == "Predictions" {
        of["input"] = json!({"sha256": "0".repeat(64), "size": 12_800});
    } else {
        of["image"] = json!("agent:1");
    }
    of
}

fn submission(mode: &str, status: &Value) -> Submission {
    let object = json!({
        "apiVersion": "leaderboard.carla.org/v1alpha1", "kind": "Submission",
        "metadata": {"name": "mine", "namespace": "arena", "creationTimestamp": "2026-11-01T10:00:00Z", "resourceVersion": "1"},
        "spec": with_submitted(mode, json!({"leaderboardName": "games", "track": "test"})), "status": status,
    });
    serde_json::from_value(object).unwrap()
}

fn running(mode: &str) -> Value {
    let score = json!({"metric": "accuracy"});
    let container =
        json!({"mode": mode, "workers": 2, "merge": "Mean", "score": score, "image": "registry/evaluator:1"});
    let mut plan =
        json!({"runId": "mine", "container": container, "track": "test", "storage": {"s3": {"bucket": "results"}}});
    if mode != "Predictions" {
        plan["image"] = json!("agent:1");
    }
    json!({
        "state": "Running", "attempt": 1, "message": "", "track": "test", "jobName": "mine-1", "resultsURL": "s3://results/mine",
        "progress": {"done": 12, "total": 20, "unit": "units", "text": "12/20"}, "nodeName": "node-3",
        "score": {"name": "accuracy", "value": "0.5", "final": false, "text": "~0.5"}, "metrics": [{"name": "games", "value": "12"}],
        "plan": plan,
        "workers": [{"id": 1, "done": 9, "total": 10, "crashes": 1, "state": "Running",
                     "last": {"reason": "EvaluatorNotReady", "time": "2026-11-01T11:40:00Z"}}],
        "times": {"started": "2026-11-01T11:00:00Z"},
        "conditions": [condition("Finished", "False", "Preparing", ""), condition("Running", "True", "Running", "")],
    })
}

fn ended(mode: &str, state: &str, reason: &str, class: Option<&str>) -> Value {
    let failure = class.map(|class| json!({"class": class, "reason": reason, "message": "It was so.", "worker": 1}));
    let ended = json!({
        "state": state, "reason": reason, "message": "It was so.", "failure": failure, "times": {"finished": "2026-11-01T11:57:00Z"},
        "conditions": [condition("Finished", "True", reason, ""), condition("Archived", "True", "Stored", "")],
    });
    with(running(mode), &ended)
}

fn states(mode: &str) -> Vec<Value> {
    let waiting = json!({"state": "Pending", "attempt": 1, "reason": "FetchingInput", "message": "",
        "conditions": [condition("Finished", "False", "Preparing", "")]});
    let prepared = with(waiting.clone(), &json!({"jobName": "mine-1"}));
    let failed = |class, reason| ended(mode, "Failed", reason, Some(class));
    let mut all = vec![
        Value::Null,
        waiting,
        prepared,
        running(mode),
        ended(mode, "Finished", "Finished", None),
        ended(mode, "Cancelled", "Cancelled", None),
        failed("Infrastructure", "EvaluatorFailed"),
        failed("Infrastructure", "InputMissing"),
        failed("Participant", "InputInvalid"),
    ];
    if mode != "Predictions" {
        all.extend(["AgentCrashed", "TimeLimit"].map(|reason| failed("Participant", reason)));
    }
    all
}

/// All lines that the commands print about it.
fn printed(one: &Submission, board: &Leaderboard) -> Vec<String> {
    let (found, all) = (Observed::Found(board), std::slice::from_ref(one));
    let changes = [Request::Cancel, Request::Resume, Request::Restart].map(|request| {
        let planned = plan(request, one, found, frame());
        planned.map_or_else(|why| vec![why], |planned| planned.lines)
    });
    let place = overview::Place {
        namespace: "arena",
        is_all: false,
    };
    let sources = Whose::Evaluator.sources(2, None);
    let shown = [
        why::explain(one, found, frame()),
        status::screen(one, found, frame()),
        status::lines(all, true, true, frame()),
        overview::lines(place, all, Some(std::slice::from_ref(board)), frame()),
        check::lines(one, found, frame()),
        submit::lines(one, found, frame()),
        resume::lines(&[one], frame()),
        get::done(one, frame()),
        in_bucket(one, Whose::Evaluator, &sources, frame()).unwrap_or_else(|why| vec![why]),
        top::lines(all, std::slice::from_ref(board), frame()),
        scores::text(&scores::boards(std::slice::from_ref(board), all, None), frame()),
    ];
    shown.into_iter().chain(changes).flatten().collect()
}

#[test]
fn no_command_shows_a_word_of_carla_for_a_hosts_own_evaluator_nor_of_an_agent_where_none_runs() {
    for mode in ["Interactive", "Batch", "Predictions"] {
        let board = leaderboard(mode);
        let of_agent = (mode == "Predictions").then_some("agent");
        for state in states(mode) {
            for line in printed(&submission(mode, &state), &board) {
                let mut words = OF_CARLA.into_iter().chain(of_agent);
                let found = words.find(|word| line.to_lowercase().contains(word));
                assert_eq!(found, None, "{mode}: {line}");
            }
        }
    }
    let check = Line::parse_from(["check", "games"]).check;
    let why = check::object(&leaderboard("Interactive"), &check).unwrap_err();
    assert!(why.ends_with("set spec.check.image"), "{why}");
}

#[test]
fn a_submitted_file_is_shown_in_place_of_an_image() {
    let board = leaderboard("Predictions");
    let one = |status: &Value| submission("Predictions", status);
    assert_shown("status-file", |frame| {
        status::screen(&one(&running("Predictions")), Observed::Found(&board), frame)
    });
    let failed = ended("Predictions", "Failed", "EvaluatorFailed", Some("Infrastructure"));
    assert_shown("why-file", |frame| {
        why::explain(&one(&failed), Observed::Found(&board), frame)
    });
    // Of a submission of EvalAI, the size is known once the operator has fetched the file.
    for (size, expected) in [
        (0, "file (0 B)"),
        (1023, "file (1023 B)"),
        (3_i64 << 30, "file (3 GiB)"),
    ] {
        let mut fetched = one(&with(
            running("Predictions"),
            &json!({"input": {"sha256": "0".repeat(64), "size": size}}),
        ));
        fetched.spec.input = None;
        let lines = status::screen(&fetched, Observed::Found(&board), frame());
        assert!(lines.iter().any(|line| line.ends_with(expected)), "{lines:#?}");
    }
}

#[test]
fn a_leaderboard_takes_a_file_or_an_image() {
    for (mode, is_file, expected) in [
        ("Batch", false, None),
        ("Batch", true, Some("takes images and no files")),
        ("Predictions", true, None),
        ("Predictions", false, Some("takes files and no images")),
    ] {
        let board = leaderboard(mode);
        let why = fits("games", "test", is_file, Observed::Found(&board)).err();
        let is_well = match (&why, expected) {
            (Some(why), Some(expected)) => why.contains(expected),
            (found, expected) => found.is_none() && expected.is_none(),
        };
        assert!(is_well, "{mode}: {why:?}");
        assert_eq!(fits("games", "test", is_file, Observed::Forbidden), Ok(()));
    }
    let check = Line::parse_from(["check", "games", "--image", "agent:1"]).check;
    let why = check::object(&leaderboard("Predictions"), &check).unwrap_err();
    assert!(why.ends_with("Use `kubectl leaderboard submit --file FILE`"), "{why}");
}

#[test]
fn the_images_of_a_hosts_evaluator_stand_in_a_column_of_their_own() {
    let failed = ended("Interactive", "Failed", "EvaluatorFailed", Some("Infrastructure"));
    let lines = resume::lines(&[&submission("Interactive", &failed)], frame());
    assert!(
        lines[0].ends_with("EVALUATOR") && lines[1].ends_with("evaluator:1"),
        "{lines:?}"
    );
}
