//! `cancel` and `resume`, and what is printed while their end is waited for.

use serde_json::{Value, json};

use super::golden::assert_texts;
use super::{
    assert_width, cancelled, crashed, finished, frame, leaderboard, node_lost, running, submission, waiting, with,
};
use crate::board::Observed;
use crate::change::{Change, Request, after_refusal, plan};
use crate::facts::transition;
use leaderboard_api::{Attempt, Submission};

fn planned(request: Request, submission: &Submission) -> Result<Change, String> {
    let plan = plan(request, submission, Observed::Found(&leaderboard()), frame());
    if let Ok(plan) = &plan {
        assert_width(&plan.lines);
    }
    plan
}

fn text(plan: &Change) -> String {
    plan.lines.join(" ")
}

#[test]
fn a_cancel_explains_what_happens_at_its_stage() {
    let prepared = with(waiting(), &json!({"jobName": "submission-42-1", "reason": "Preparing"}));
    let stages = [
        ("new", Value::Null),
        ("in line", waiting()),
        ("being prepared", prepared),
        ("running", running()),
    ];
    let texts = stages.map(|(stage, status)| {
        let plan = planned(Request::Cancel, &submission(&status)).unwrap();
        assert_eq!(plan.patch.as_ref().map(|p| &p["spec"]), Some(&json!({"cancel": true})));
        assert_eq!(plan.attempt, Attempt(1));
        (stage, plan.lines.join("\n"))
    });
    assert_texts("cancel-stages", &texts);
}

#[test]
fn the_grace_is_the_leaderboards_of_this_moment() {
    let mut slow = leaderboard();
    slow.spec.deadlines.cancel_seconds = 900;
    for (leaderboard, expected) in [
        (Observed::Found(&slow), " 15m "),
        (Observed::Missing, " 2m "),
        (Observed::Forbidden, "deadlines.cancelSeconds"),
    ] {
        let plan = plan(Request::Cancel, &submission(&running()), leaderboard, frame()).unwrap();
        assert!(text(&plan).contains(expected), "{}", text(&plan));
    }
}

#[test]
fn what_is_cancelled_already_is_not_patched_again() {
    let mut object = submission(&running());
    object.spec.cancel = true;
    let plan = planned(Request::Cancel, &object).unwrap();
    assert_eq!(plan.patch, None);
}

#[test]
fn what_has_ended_is_not_cancelled() {
    for status in [finished(), crashed(), cancelled()] {
        assert!(planned(Request::Cancel, &submission(&status)).is_err(), "{status}");
    }
    let mut higher = submission(&crashed());
    higher.spec.attempt = Attempt(2);
    let plan = planned(Request::Cancel, &higher).unwrap();
    assert_eq!(plan.attempt, Attempt(2), "the requested attempt can still be cancelled");
}

#[test]
fn what_failed_or_was_cancelled_is_resumed() {
    for status in [crashed(), node_lost(), cancelled()] {
        let mut object = submission(&status);
        object.spec.cancel = true;
        let plan = planned(Request::Resume, &object).unwrap();
        let patch = json!({"metadata": {"resourceVersion": "17"}, "spec": {"attempt": 2, "cancel": false}});
        assert_eq!(plan.patch, Some(patch));
        assert_eq!(plan.attempt, Attempt(2));
        assert!(text(&plan).contains("s3://results/v2/42"), "{}", text(&plan));
    }
}

#[test]
fn nothing_else_is_resumed_and_the_next_step_is_named() {
    let mut going = submission(&crashed());
    going.metadata.deletion_timestamp = going.metadata.creation_timestamp.clone();
    let mut higher = submission(&crashed());
    higher.spec.attempt = Attempt(2);
    let objects = [
        ("new", submission(&Value::Null)),
        ("waiting", submission(&waiting())),
        ("running", submission(&running())),
        ("finished", submission(&finished())),
        ("being deleted", going),
        ("resumed already", higher),
    ];
    let texts = objects.map(|(what, object)| (what, planned(Request::Resume, &object).unwrap_err()));
    assert_texts("resume-refused", &texts);
}

#[test]
fn a_refusal_names_the_other_way() {
    let evalais = submission(&crashed());
    let of_evalai = after_refusal(Request::Resume, &evalais);
    let mut local = evalais;
    local.spec.evalai = None;
    let texts = [
        ("of EvalAI", of_evalai),
        ("local", after_refusal(Request::Resume, &local)),
    ];
    assert_texts("resume-rejected", &texts);
}

#[test]
fn a_wait_prints_the_states_of_its_own_attempt() {
    let of = |status: Value| transition(&submission(&status), Attempt(2), frame());
    let again = |status: Value| of(with(status, &json!({"attempt": 2}))).unwrap();
    assert_eq!(of(crashed()), None, "that was the attempt before");
    let (state, lines) = again(waiting());
    assert_eq!(state, "submission-42 is Pending (WaitingForSlot)");
    assert_width(&lines);
    let (before, _) = again(running());
    let (more, _) = again(with(running(), &json!({"message": "13/20 routes done."})));
    assert_eq!(more, before, "progress is no transition");
}
