//! The whole output of `submit`, `logs` and `report`.

use std::fmt::Write as _;

use serde_json::{Value, json};

use super::golden::{assert_golden, assert_shown};
use super::{crashed, leaderboard, now, ran_with, submission, waiting, with};
use crate::board::Observed;
use crate::error::Error;
use crate::logs::{Whose, in_bucket};
use crate::output::labelled;
use crate::text::{Frame, log_line};
use crate::{report, submit};
use leaderboard_api::Submission;

fn submitted() -> Submission {
    let object = json!({
        "apiVersion": "leaderboard.carla.org/v1alpha1", "kind": "Submission",
        "metadata": {"name": "carla-20-x7k2p", "namespace": "carla"},
        "spec": {"leaderboardName": "carla-20", "track": "sensors", "image": "registry.example/agent:1"},
    });
    serde_json::from_value(object).unwrap()
}

#[test]
fn a_submission_is_printed_as_its_files_show() {
    let board = leaderboard();
    assert_shown("submit", |frame| {
        submit::lines(&submitted(), Observed::Found(&board), frame)
    });
    let mut paused = leaderboard();
    paused.spec.paused = true;
    assert_shown("submit-paused", |frame| {
        submit::lines(&submitted(), Observed::Found(&paused), frame)
    });
    assert_shown("submit-unknown", |frame| {
        submit::lines(&submitted(), Observed::Forbidden, frame)
    });
}

/// Lines of programs are never broken: what a person searches for must be found in them.
#[test]
fn logs_are_printed_as_their_files_show() {
    let lines = [
        (1, "1", "2026-11-01 11:59:58 Traceback (most recent call last):"),
        (1, "1", "  File \"agent.py\", line 7, in run_step"),
        (2, "2", "\tindented \u{1b}[31mred\u{1b}[0m and \u{7}loud\r"),
        (2, "2", ""),
        (0, "workspace", "restored 12 files"),
        (1, "contents", "copied 3 folders"),
    ];
    let mut text = String::new();
    for is_coloured in [false, true] {
        writeln!(text, "=== {} colours", if is_coloured { "with" } else { "without" }).unwrap();
        for (stream, label, line) in lines {
            let printed = labelled(stream, label, &log_line(line), is_coloured);
            assert!(is_coloured || !printed.contains('\u{1b}'), "{printed:?}");
            writeln!(text, "{printed}").unwrap();
        }
    }
    assert_golden("logs", &text);
    let stored = submission(&ran_with(crashed(), "simulator:2"));
    assert_shown("logs-in-bucket", |frame| {
        in_bucket(&stored, Whose::Agent, &Whose::Agent.sources(2, None), frame).unwrap()
    });
}

#[test]
fn a_log_that_is_not_there_is_explained() {
    let frame = |width| Frame { now: now(), width };
    let why =
        |status: &Value, of: Whose| in_bucket(&submission(status), of, &of.sources(2, None), frame(80)).unwrap_err();
    assert!(why(&waiting(), Whose::Agent).starts_with("submission-42 is Pending and has no Pod yet"));
    // The attempt before has stored something.
    let again = with(waiting(), &json!({"attempt": 2, "resultsURL": "s3://results/v2/42"}));
    let lines = in_bucket(
        &submission(&again),
        Whose::Agent,
        &Whose::Agent.sources(1, None),
        frame(80),
    )
    .unwrap();
    assert!(
        lines
            .last()
            .unwrap()
            .contains("s3://results/v2/42/agent/agent1/leaderboard.log")
    );
}

#[test]
fn a_report_is_printed_as_its_files_show() {
    let file = "leaderboard-report-carla.json";
    let texts = |texts: &[&str]| texts.iter().map(|text| (*text).to_owned()).collect::<Vec<_>>();
    let all = texts(&["1 Leaderboard", "12 submissions", "3 Pods", "40 events"]);
    assert_shown("report", |frame| report::lines(file, "carla", &all, &[], frame));
    let denied = Error::Forbidden(
        "events.events.k8s.io is forbidden: User \"host\" cannot list resource \"events\" in API group \"events.k8s.io\" in the \
         namespace \"carla\""
            .to_owned(),
    );
    let missing = texts(&[&format!("events: {denied}")]);
    assert_shown("report-incomplete", |frame| {
        report::lines(file, "carla", &all[..3], &missing, frame)
    });
    let none = texts(&["0 Leaderboards", "0 submissions", "0 Pods", "0 events"]);
    assert_shown("report-empty", |frame| {
        report::lines(file, "default", &none, &[], frame)
    });
}
