//! `cancel` and `resume`, and what is printed while their end is waited for.

use serde_json::{Value, json};

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
    for (status, expected) in [
        (Value::Null, "It has no Job, so it ends at once."),
        (waiting(), "It has no Job, so it ends at once."),
        (
            prepared,
            "a Pod that is already running is first asked to stop and has 120 s",
        ),
        (
            running(),
            "After 120 s the Job is deleted, then the Pod is force-deleted.",
        ),
    ] {
        let plan = planned(Request::Cancel, &submission(&status)).unwrap();
        assert_eq!(plan.patch.as_ref().map(|p| &p["spec"]), Some(&json!({"cancel": true})));
        assert_eq!(plan.attempt, Attempt(1));
        assert!(text(&plan).contains(expected), "{expected}: {}", text(&plan));
        assert!(text(&plan).contains("To continue it later: `kubectl leaderboard resume submission-42 -n carla`."));
    }
}

#[test]
fn the_grace_is_the_leaderboards_of_this_moment() {
    let mut slow = leaderboard();
    slow.spec.deadlines.cancel_seconds = 900;
    for (leaderboard, expected) in [
        (Observed::Found(&slow), "After 900 s the Job"),
        (Observed::Missing, "After 120 s the Job"),
        (Observed::Forbidden, "After deadlines.cancelSeconds the Job"),
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
    assert!(text(&plan).starts_with("submission-42 is already being cancelled."));
}

#[test]
fn what_has_ended_is_not_cancelled() {
    for (status, state) in [
        (finished(), "Finished"),
        (crashed(), "Failed"),
        (cancelled(), "Cancelled"),
    ] {
        let why_not = planned(Request::Cancel, &submission(&status)).unwrap_err();
        let expected =
            format!("submission-42 is {state} since 2026-11-01 11:57:00 UTC (3 min ago), so there is nothing");
        assert!(why_not.starts_with(&expected), "{why_not}");
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
        assert!(
            text(&plan).contains("It continues from the results in s3://results/v2/42"),
            "{}",
            text(&plan)
        );
        assert!(
            text(&plan).contains("The operator asks EvalAI first."),
            "{}",
            text(&plan)
        );
    }
}

#[test]
fn nothing_else_is_resumed_and_the_next_step_is_named() {
    let mut going = submission(&crashed());
    going.metadata.deletion_timestamp = going.metadata.creation_timestamp.clone();
    let mut higher = submission(&crashed());
    higher.spec.attempt = Attempt(2);
    for (object, expected, next) in [
        (
            submission(&Value::Null),
            "submission-42 is new; only Failed and Cancelled",
            "cancel submission-42 -n carla",
        ),
        (
            submission(&waiting()),
            "submission-42 is Pending; only Failed and Cancelled",
            "cancel submission-42 -n carla",
        ),
        (
            submission(&running()),
            "submission-42 is Running; only Failed and Cancelled",
            "resume submission-42 -n carla --restart",
        ),
        (
            submission(&finished()),
            "submission-42 has finished and cannot be resumed.",
            "Submit the image again",
        ),
        (going, "submission-42 is being deleted.", "apply it again"),
        (
            higher,
            "attempt 2 of submission-42 is already requested",
            "why submission-42 -n carla",
        ),
    ] {
        let why_not = planned(Request::Resume, &object).unwrap_err();
        assert!(why_not.starts_with(expected) && why_not.contains(next), "{why_not}");
    }
}

#[test]
fn a_resume_names_what_keeps_the_leaderboard_from_it() {
    let mut paused = leaderboard();
    paused.spec.paused = true;
    let plan = plan(
        Request::Resume,
        &submission(&crashed()),
        Observed::Found(&paused),
        frame(),
    )
    .unwrap();
    assert!(
        text(&plan).contains("Leaderboard carla-20 is paused"),
        "{}",
        text(&plan)
    );
}

#[test]
fn a_refusal_names_the_other_way() {
    let evalais = submission(&crashed());
    assert_eq!(
        after_refusal(Request::Resume, &evalais),
        "Resume submission 42 in EvalAI (challenge 3): its message raises the attempt here"
    );
    let mut local = evalais;
    local.spec.evalai = None;
    let next = after_refusal(Request::Resume, &local);
    assert!(
        next.ends_with("`kubectl leaderboard why submission-42 -n carla`"),
        "{next}"
    );
}

#[test]
fn a_wait_prints_the_states_of_its_own_attempt() {
    let of = |status: Value| transition(&submission(&status), Attempt(2), frame());
    let again = |status: Value| of(with(status, &json!({"attempt": 2}))).unwrap();
    assert_eq!(of(crashed()), None, "that was the attempt before");
    let (state, lines) = again(waiting());
    assert_eq!(state, "submission-42 is Pending (WaitingForSlot)");
    assert_eq!(
        lines[0],
        "12:00:00Z:   submission-42 is Pending (WaitingForSlot): All slots of the Leaderboard are in use;"
    );
    assert_width(&lines);
    let (before, lines) = again(running());
    assert_eq!(
        lines,
        ["12:00:00Z:   submission-42 is Resumed (Running): 12/20 routes done."]
    );
    let (more, _) = again(with(running(), &json!({"message": "13/20 routes done."})));
    assert_eq!(more, before, "progress is no transition");
}
