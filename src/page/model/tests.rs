use serde_json::Value;

use super::*;
use crate::page::samples_tests as samples;
use crate::page::samples_tests::{ago, failed, finished, leaderboards, now, running, submission, waiting};

fn view(leaderboards: &[Arc<Leaderboard>], submissions: &[Arc<Submission>]) -> Value {
    let replica = Replica {
        name: "leaderboard-operator-controller-6c9f7d5b8-x2k4p",
        title: "challenge-eu-1",
        leads: true,
        is_complete: true,
    };
    serde_json::to_value(PageView::of(replica, leaderboards, submissions, now())).unwrap()
}

fn names(list: &Value) -> Vec<&str> {
    let rows = list["rows"].as_array().unwrap();
    rows.iter().map(|row| row["name"].as_str().unwrap()).collect()
}

/// The browser's test shows this view. `UPDATE_GOLDEN=1` writes it.
#[test]
fn the_view_of_a_full_evening() {
    samples::golden("view.json", &view(&leaderboards(), &samples::submissions()));
}

#[test]
fn each_list_has_its_order() {
    let all = [
        finished("older", "a", "1.00", 90, 1),
        waiting("third", "a", Some(3), "WaitingForSlot", ""),
        waiting("elsewhere", "a", None, "Unschedulable", ""),
        running("short", "a", 1, 1, &[(1, 0)]),
        finished("newer", "a", "2.00", 30, 1),
        waiting("first", "a", Some(1), "WaitingForSlot", ""),
        running("long", "a", 1, 5, &[(1, 0)]),
        submission("unseen", "carla-20", "a", &serde_json::json!({})),
    ];
    let view = view(&leaderboards(), &all);
    assert_eq!(names(&view["running"]), ["long", "short"]);
    assert_eq!(names(&view["waiting"]), ["first", "third", "elsewhere", "unseen"]);
    assert_eq!(names(&view["ended"]), ["newer", "older"]);
    assert_eq!(names(&view["leaderboards"]), ["carla-10", "carla-20"]);
    let busy = &view["leaderboards"]["rows"][1];
    let counts = ["running", "waiting", "finished", "failed", "cancelled"].map(|key| busy[key].as_u64().unwrap());
    assert_eq!(counts, [2, 4, 2, 0, 0]);
    assert_eq!(busy["typical"]["runs"], 2);
}

#[test]
fn a_slot_is_in_use_from_its_job_on() {
    let waits_with = |name: &str, reason: &str, job: Option<&str>, retry: i32| {
        let mut one = waiting(name, "a", None, reason, "");
        let status = Arc::make_mut(&mut one).status.as_mut().unwrap();
        (status.job_name, status.retry) = (job.map(str::to_owned), retry);
        one
    };
    let all = [
        running("runs", "a", 1, 1, &[(1, 0)]),
        waits_with("pulls", "ImagePull", Some("pulls-1"), 0),
        waits_with("again", "NodeLost", None, 1),
        waits_with("waits", "WaitingForSlot", None, 0),
        finished("done", "a", "1.00", 5, 1),
    ];
    let view = view(&leaderboards(), &all);
    let busy = &view["leaderboards"]["rows"][1];
    let counts = ["slots", "inUse", "running", "waiting"].map(|key| busy[key].as_u64().unwrap());
    assert_eq!(counts, [4, 3, 1, 3]);
}

#[test]
fn failures_are_counted_by_class_and_reason_for_a_day() {
    let crash = ("AgentCrashed", "It crashed");
    let all = [
        failed("a", "a", "Participant", crash, 10),
        failed("b", "b", "Infrastructure", ("NodeLost", "The node is gone"), 20),
        failed("c", "c", "Participant", crash, 30),
        failed("old", "d", "Participant", crash, 60 * 24 + 1),
        finished("e", "e", "1.00", 5, 1),
    ];
    let view = view(&[], &all);
    let expected = serde_json::json!([
        {"class": "Participant", "reason": "AgentCrashed", "count": 2},
        {"class": "Infrastructure", "reason": "NodeLost", "count": 1},
    ]);
    assert_eq!(view["failures"]["classes"], expected);
    assert_eq!(
        (names(&view["failures"]), &view["failures"]["count"]),
        (vec!["a", "b", "c"], &3.into())
    );
    assert_eq!(view["failures"]["rows"][0]["class"], "Participant");
    assert_eq!(view["ended"]["rows"][1]["open"], serde_json::json!(["EvalAI"]));
}

#[test]
fn the_state_that_somebody_edited_moves_nothing() {
    let mut one = running("one", "a", 1, 1, &[(1, 0)]);
    Arc::make_mut(&mut one).status.as_mut().unwrap().state = Some(State::Finished);
    assert_eq!(names(&view(&[], &[one])["running"]), ["one"]);
}

/// 10,000 submissions of the longest texts that the API server takes are a view of bounded size.
#[test]
fn ten_thousand_submissions_with_the_longest_texts_are_a_bounded_view() {
    let long = "\u{1F697}\u{202e}\"\\ ".repeat(1000);
    let (name, text) = (
        long.chars().take(256).collect::<String>(),
        long.chars().take(4096).collect::<String>(),
    );
    let pairs = [(9, 9); 16];
    let mut all = Vec::new();
    for at in 0..2500 {
        all.push(running(&format!("r{at}"), &name, 1, 3, &pairs));
        all.push(waiting(&format!("w{at}"), &name, Some(at), "WaitingForSlot", &text));
        all.push(failed(
            &format!("f{at}"),
            &name,
            "Participant",
            ("AgentCrashed", &text),
            3,
        ));
        all.push(finished(&format!("e{at}"), &name, "1.00", 3, 1));
    }
    let tracks: Vec<_> = (0..32)
        .map(|at| samples::ranked(&format!("track-{at}"), &name))
        .collect();
    let names_of = |at| serde_json::json!({"name": format!("track-{at}")});
    let spec = serde_json::json!({"tracks": (0..32).map(names_of).collect::<Vec<_>>()});
    let board = |name: &str| samples::leaderboard(name, &spec, &serde_json::json!({"tracks": tracks}));
    let boards = [leaderboards(), vec![board("first"), board("second")]].concat();
    let view = view(&boards, &all);
    let length = view.to_string().len();
    assert!(length < 768 * 1024, "{length} bytes");
    assert_eq!(
        (
            &view["standings"]["count"],
            view["standings"]["rows"].as_array().unwrap().len()
        ),
        (&68.into(), TABLES)
    );
    assert_eq!(
        (&view["waiting"]["count"], names(&view["waiting"]).len()),
        (&2500.into(), WAITING)
    );
    assert_eq!(
        (&view["ended"]["count"], names(&view["ended"]).len()),
        (&5000.into(), ENDED)
    );
    let team = view["running"]["rows"][0]["team"].as_str().unwrap();
    assert!(team.chars().count() == 80 && !team.contains('\u{202e}'), "{team}");
    assert!(view["waiting"]["rows"][0]["message"].as_str().unwrap().chars().count() <= 300);
}

#[test]
fn nothing_at_all_is_a_view_too() {
    let empty = view(&[], &[]);
    for list in ["leaderboards", "running", "waiting", "ended", "failures"] {
        assert_eq!(empty[list]["count"], 0, "{list}");
    }
    let new = view(
        &[samples::leaderboard(
            "new",
            &serde_json::json!({}),
            &serde_json::json!({}),
        )],
        &[],
    );
    assert_eq!(
        new["leaderboards"]["rows"][0]["trouble"],
        "The operator has not processed it yet."
    );
    assert!(ago(0).starts_with("2026-11-01T12:00:00"));
}
