//! `cancel` and `resume`, and what is said while their end is waited for.

use serde_json::{Value, json};

use super::{
    assert_width, cancelled, crashed, finished, leaderboard, node_lost, now, running, submission, waiting, with,
};
use crate::board::Sight;
use crate::change::{Plan, Wish, after_refusal, plan};
use crate::transitions::Waiting;
use leaderboard_api::{State, Submission};

fn planned(wish: Wish, submission: &Submission) -> Result<Plan, String> {
    let plan = plan(wish, submission, Sight::There(&leaderboard()), now());
    if let Ok(plan) = &plan {
        assert_width(&plan.says);
    }
    plan
}

fn says(plan: &Plan) -> String {
    plan.says.join(" ")
}

#[test]
fn a_cancel_says_what_happens_at_its_stage() {
    let prepared = with(waiting(), &json!({"jobName": "submission-42-1", "reason": "Preparing"}));
    for (status, expected) in [
        (Value::Null, "It has no Job, so it ends at once."),
        (waiting(), "It has no Job, so it ends at once."),
        (prepared, "if its Pod is up already, that is told first"),
        (running(), "if it takes longer than 120 s, its Job is deleted"),
    ] {
        let plan = planned(Wish::Cancel, &submission(&status)).unwrap();
        assert_eq!(plan.patch.as_ref().map(|p| &p["spec"]), Some(&json!({"cancel": true})));
        assert_eq!(plan.attempt, 1);
        assert!(says(&plan).contains(expected), "{expected}: {}", says(&plan));
        assert!(says(&plan).contains("`kubectl leaderboard resume submission-42 -n carla` takes it up again."));
    }
}

#[test]
fn the_grace_is_the_leaderboards_of_this_moment() {
    let mut slow = leaderboard();
    slow.spec.deadlines.cancel_seconds = 900;
    for (sight, expected) in [
        (Sight::There(&slow), "longer than 900 s, its Job"),
        (Sight::Missing, "longer than 120 s, its Job"),
        (Sight::Unread, "longer than deadlines.cancelSeconds, its Job"),
    ] {
        let plan = plan(Wish::Cancel, &submission(&running()), sight, now()).unwrap();
        assert!(says(&plan).contains(expected), "{}", says(&plan));
    }
}

#[test]
fn what_is_cancelled_already_is_not_patched_again() {
    let mut object = submission(&running());
    object.spec.cancel = true;
    let plan = planned(Wish::Cancel, &object).unwrap();
    assert_eq!(plan.patch, None);
    assert!(says(&plan).starts_with("submission-42 is being cancelled already."));
}

#[test]
fn what_has_ended_is_not_cancelled() {
    for (status, state) in [
        (finished(), "Finished"),
        (crashed(), "Failed"),
        (cancelled(), "Cancelled"),
    ] {
        let why_not = planned(Wish::Cancel, &submission(&status)).unwrap_err();
        let expected =
            format!("submission-42 is {state} since 2026-11-01 11:57:00 UTC (3 min ago), so there is nothing");
        assert!(why_not.starts_with(&expected), "{why_not}");
    }
    let mut higher = submission(&crashed());
    higher.spec.attempt = 2;
    let plan = planned(Wish::Cancel, &higher).unwrap();
    assert_eq!(plan.attempt, 2, "the attempt that is wished can still be cancelled");
}

#[test]
fn what_failed_or_was_cancelled_is_resumed() {
    for status in [crashed(), node_lost(), cancelled()] {
        let mut object = submission(&status);
        object.spec.cancel = true;
        let plan = planned(Wish::Resume, &object).unwrap();
        let patch = json!({"metadata": {"resourceVersion": "17"}, "spec": {"attempt": 2, "cancel": false}});
        assert_eq!(plan.patch, Some(patch));
        assert_eq!(plan.attempt, 2);
        assert!(
            says(&plan).contains("It takes up what is stored in s3://results/v2/42"),
            "{}",
            says(&plan)
        );
        assert!(says(&plan).contains("EvalAI is asked first."), "{}", says(&plan));
    }
}

#[test]
fn nothing_else_is_resumed_and_the_next_step_is_named() {
    let mut going = submission(&crashed());
    going.metadata.deletion_timestamp = going.metadata.creation_timestamp.clone();
    let mut higher = submission(&crashed());
    higher.spec.attempt = 2;
    for (object, expected, next) in [
        (
            submission(&Value::Null),
            "submission-42 is new; only what is Failed",
            "cancel submission-42 -n carla",
        ),
        (
            submission(&waiting()),
            "submission-42 is Pending; only what is Failed",
            "cancel submission-42 -n carla",
        ),
        (
            submission(&running()),
            "submission-42 is Running; only what is Failed",
            "cancel submission-42 -n carla",
        ),
        (
            submission(&finished()),
            "submission-42 is Finished, which is for ever.",
            "Submit the image again",
        ),
        (going, "submission-42 is being deleted.", "apply it again"),
        (
            higher,
            "attempt 2 of submission-42 is wished already",
            "why submission-42 -n carla",
        ),
    ] {
        let why_not = planned(Wish::Resume, &object).unwrap_err();
        assert!(why_not.starts_with(expected) && why_not.contains(next), "{why_not}");
    }
}

#[test]
fn a_resume_says_what_keeps_the_leaderboard_from_it() {
    let mut paused = leaderboard();
    paused.spec.paused = true;
    let plan = plan(Wish::Resume, &submission(&crashed()), Sight::There(&paused), now()).unwrap();
    assert!(
        says(&plan).contains("Leaderboard carla-20 is paused"),
        "{}",
        says(&plan)
    );
}

#[test]
fn a_refusal_names_the_other_way() {
    let evalais = submission(&crashed());
    assert_eq!(
        after_refusal(Wish::Resume, &evalais),
        "Resume submission 42 in EvalAI (challenge 3): its message raises the attempt here"
    );
    let mut local = evalais;
    local.spec.evalai = None;
    let next = after_refusal(Wish::Resume, &local);
    assert!(
        next.ends_with("`kubectl leaderboard why submission-42 -n carla`"),
        "{next}"
    );
}

#[test]
fn who_waits_hears_each_transition_once_and_the_end() {
    let mut wait = Waiting::new(2);
    let attempt = |status: Value| submission(&with(status, &json!({"attempt": 2})));
    let mut see = |object: &Submission| wait.see(object, now());
    assert_eq!(see(&submission(&crashed())).end, None, "that was the attempt before");
    let seen = see(&attempt(waiting()));
    assert_eq!(
        seen.says[0],
        "12:00:00  submission-42 is Pending (WaitingForSlot): All slots of the Leaderboard are in use;"
    );
    assert_width(&seen.says);
    assert!(see(&attempt(waiting())).says.is_empty());
    assert_eq!(
        see(&attempt(running())).says,
        ["12:00:00  submission-42 is Running (Running): 12/20 routes done."]
    );
    let more = with(running(), &json!({"attempt": 2, "message": "13/20 routes done."}));
    assert!(see(&submission(&more)).says.is_empty(), "progress is no transition");
    let seen = see(&attempt(finished()));
    assert_eq!((seen.end, seen.says.len()), (Some(State::Finished), 1));
}
