//! A check: the Submission that is made, what is shown of it, and whether it has passed.

use clap::Parser;
use serde_json::{Value, json};

use super::golden::assert_shown;
use super::{condition, frame, plan_with, with};
use crate::board::Observed;
use crate::check::{Check, has_passed, lines, object};
use leaderboard_api::{Leaderboard, Submission};

#[derive(Parser)]
struct Line {
    #[command(flatten)]
    check: Check,
}

/// A Leaderboard with two tracks, and a note that has nothing to do with a check.
fn leaderboard(image: &Value, conditions: &[Value]) -> Leaderboard {
    let object = json!({
        "apiVersion": "leaderboard.carla.org/v1alpha1", "kind": "Leaderboard",
        "metadata": {"name": "carla-20", "namespace": "carla"},
        "spec": {
            "tracks": [{"name": "sensors"}, {"name": "map"}],
            "evaluation": {"carla": {
                "version": "V2", "contents": {"image": "contents:1"}, "simulator": {"image": "simulator:1"},
            }}, "check": image, "storage": {"s3": {"bucket": "results"}},
        },
        "status": {"conditions": conditions},
    });
    serde_json::from_value(object).unwrap()
}

fn good_leaderboard() -> Leaderboard {
    let note = "Runs of the tracks sensors, map have no time limit: an agent that does not end keeps its nodes until it is cancelled; set \
                deadlines.runSeconds.";
    let reached = "The Pod of check-carla-20-x7k2p could not reach 10.96.0.1:443.";
    let conditions = [
        condition("Ready", "True", "Ready", note),
        condition("Isolated", "True", "Enforced", reached),
    ];
    leaderboard(&Value::Null, &conditions)
}

fn check(status: &Value) -> Submission {
    let object = json!({
        "apiVersion": "leaderboard.carla.org/v1alpha1", "kind": "Submission",
        "metadata": {"name": "check-carla-20-x7k2p", "namespace": "carla"},
        "spec": {"leaderboardName": "carla-20", "track": "sensors", "check": true, "image": "registry.example/carla/baseline:1"},
        "status": status,
    });
    serde_json::from_value(object).unwrap()
}

fn passed() -> Value {
    json!({
        "attempt": 1, "message": "1 of 1 routes, Driving score 98.00.", "track": "sensors",
        "progress": {"done": 1, "total": 1, "unit": "routes", "text": "1/1"}, "score": {"name": "Driving score", "value": "98.00", "final": true, "text": "98.00"},
        "jobName": "check-carla-20-x7k2p-1", "nodeName": "gpu-3", "resultsURL": "s3://results/v2/check-carla-20-x7k2p",
        "plan": with(plan_with("simulator:1"), &json!({"runId": "check-carla-20-x7k2p"})),
        "times": {"accepted": "2026-11-01T11:50:00Z", "started": "2026-11-01T11:54:02Z", "finished": "2026-11-01T11:57:00Z"},
        "conditions": [
            condition("Accepted", "True", "Accepted", ""), condition("Finished", "True", "Finished", ""),
            condition("Archived", "True", "Stored", ""), condition("Published", "False", "NotRequired", ""),
            condition("Recorded", "False", "NotRequired", ""),
        ],
    })
}

/// The image of its simulator does not exist.
fn failed() -> Value {
    let message = "The image of simulator-1 cannot be pulled: not found. It was tried for 1800 s.";
    with(
        passed(),
        &json!({
            "reason": "ImagePull", "message": message, "progress": null, "score": null,
            "failure": {"class": "Infrastructure", "reason": "ImagePull", "message": message},
            "conditions": [
                condition("Accepted", "True", "Accepted", ""), condition("Finished", "True", "ImagePull", message),
                condition("Archived", "False", "NotStored", ""), condition("Recorded", "False", "NotRequired", ""),
            ],
        }),
    )
}

#[test]
fn track_and_image_have_defaults_and_a_name_fits_with_the_five_letters_of_the_api_server() {
    let name = format!("{}-20", "carla".repeat(9));
    let made = |image: &Value, flags: &[&str]| {
        let line = Line::parse_from([&["check", name.as_str()], flags].concat());
        object(&leaderboard(image, &[]), &line.check)
    };
    let named = json!({"image": "host/baseline:1"});
    for (flags, track, image) in [
        (&[][..], "sensors", "host/baseline:1"),
        (&["--track", "map", "--image", "host/other:2"], "map", "host/other:2"),
    ] {
        let object = made(&named, flags).unwrap();
        assert_eq!(
            (&object["spec"]["track"], &object["spec"]["image"]),
            (&json!(track), &json!(image))
        );
        assert_eq!(object["spec"]["check"], true);
        let name = object["metadata"]["generateName"].as_str().unwrap();
        let fits = name.starts_with("check-carla") && name.ends_with('-') && name.len() + 5 <= 52;
        assert!(fits, "{name}");
    }
    for (flags, words) in [
        (&["--track", "lidar"][..], "has no track lidar. It has sensors, map"),
        (&[], "with --image, or set spec.check.image"),
    ] {
        let why = made(&Value::Null, flags).unwrap_err();
        assert!(why.contains(words), "{why}");
    }
}

#[test]
fn a_check_is_printed_as_its_files_show() {
    let good = good_leaderboard();
    assert_shown("check-passed", |frame| {
        lines(&check(&passed()), Observed::Found(&good), frame)
    });
    let refused = "The update of the table submissions is denied: not authorized to perform dynamodb:UpdateItem.";
    let unready = leaderboard(
        &Value::Null,
        &[
            condition("Ready", "False", "TokenRefused", "EvalAI answers 401."),
            condition("Isolated", "Unknown", "NotMeasured", "No run has measured it."),
        ],
    );
    assert_shown("check-failed", |frame| {
        lines(&check(&failed()), Observed::Found(&unready), frame)
    });
    let noted = leaderboard(&Value::Null, &[condition("Ready", "True", "Ready", refused)]);
    let unlogged = with(
        passed(),
        &json!({"conditions": [
            condition("Finished", "True", "Finished", ""), condition("Logged", "False", "LogsRefused", "The group /carla does not exist."),
        ]}),
    );
    assert_shown("check-notes", |frame| {
        lines(&check(&unlogged), Observed::Found(&noted), frame)
    });
}

#[test]
fn a_check_is_documented_as_it_is_printed() {
    let docs = include_str!("../../../../docs/check.md");
    let block = lines(&check(&passed()), Observed::Found(&good_leaderboard()), frame()).join("\n");
    assert!(
        docs.contains(&format!("```\n{block}\n\nThe check passed.\n```\n")),
        "docs/check.md does not show\n{block}"
    );
}

#[test]
fn a_check_passes_if_its_route_is_finished_and_the_leaderboard_ready() {
    let unready = leaderboard(&Value::Null, &[condition("Ready", "False", "TokenRefused", "")]);
    let good = good_leaderboard();
    let logged = |truth: &str| {
        with(
            passed(),
            &json!({"conditions": [
                condition("Finished", "True", "Finished", ""), condition("Logged", truth, "LogsRefused", ""),
            ]}),
        )
    };
    for (status, board, expected) in [
        (passed(), Observed::Found(&good), true),
        (logged("True"), Observed::Found(&good), true),
        (logged("False"), Observed::Found(&good), false),
        (failed(), Observed::Found(&good), false),
        (Value::Null, Observed::Found(&good), false),
        (passed(), Observed::Found(&unready), false),
        (passed(), Observed::Missing, false),
    ] {
        assert_eq!(has_passed(&check(&status), board), expected, "{status}");
    }
}
