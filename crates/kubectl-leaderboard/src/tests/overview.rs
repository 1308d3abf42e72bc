//! `why` without a name.

use serde_json::{Value, json};

use super::{
    assert_width, cancelled, condition, crashed, finished, leaderboard, named, node_lost, now, running, waiting, with,
};
use crate::overview::lines;
use leaderboard_api::{Leaderboard, Submission};

fn said(submissions: &[Submission], leaderboards: Option<&[Leaderboard]>) -> String {
    let lines = lines("carla", submissions, leaderboards, now());
    assert_width(&lines);
    lines.join("\n")
}

#[test]
fn those_that_wait_failed_or_are_in_trouble_have_a_line() {
    let first = with(waiting(), &json!({"waiting": {"position": 1}}));
    let stalled = with(
        running(),
        &json!({"reason": "NotStored", "message": "Its results cannot be read.",
                "conditions": [condition("Running", "True", "Running", ""),
                               condition("Stalled", "True", "NotStored", "Its results cannot be read: 503.")]}),
    );
    let refused = with(
        finished(),
        &json!({"conditions": [condition("Finished", "True", "Finished", ""),
                               condition("Published", "False", "Refused", "EvalAI does not take the result.")]}),
    );
    let submissions = [
        named("well", &running()),
        named("done", &finished()),
        named("stopped", &cancelled()),
        named("third", &waiting()),
        named("first", &first),
        named("stalled", &stalled),
        named("crashed", &crashed()),
        named("lost", &node_lost()),
        named("unpublished", &refused),
        named("new", &Value::Null),
    ];
    assert_eq!(
        said(&submissions, Some(&[leaderboard()])),
        "\
NAME         STATE     SINCE   WHY
stalled      Running   60 min  NotStored: Its results cannot be read: 503.
new          (new)             The operator has not looked at it yet.
first        Pending   60 min  WaitingForSlot: place 1
third        Pending   60 min  WaitingForSlot: place 3, 20-35 min
crashed      Failed    3 min   EvalAI: Waiting. AgentCrashed (the participant's, charged): Agent 2…
lost         Failed    3 min   NodeLost (the infrastructure's, not charged): Node gpu-3 was lost an…
unpublished  Finished  3 min   EvalAI: Refused.

`kubectl leaderboard why NAME` says more, and what to do next."
    );
}

#[test]
fn leaderboards_in_trouble_are_named_also_when_no_submission_waits() {
    let mut paused = leaderboard();
    paused.spec.paused = true;
    let words = said(&[named("done", &finished())], Some(&[paused]));
    assert_eq!(
        words,
        "\
Leaderboard carla-20 is paused: nothing new starts, and what runs goes on.

Nothing waits, has failed or is in trouble in namespace carla (1 submissions)."
    );
    let words = said(&[named("a", &waiting()), named("b", &waiting())], Some(&[]));
    assert_eq!(words.matches("There is no Leaderboard carla-20").count(), 1, "{words}");
    let words = said(&[named("done", &finished())], Some(&[]));
    assert!(
        !words.contains("There is no Leaderboard"),
        "what has ended needs none: {words}"
    );
    let words = said(&[], None);
    assert!(words.starts_with("You may not read Leaderboards"), "{words}");
}

#[test]
fn one_that_goes_or_begins_anew_has_a_line() {
    let mut going = named("going", &finished());
    going.metadata.deletion_timestamp = going.metadata.creation_timestamp.clone();
    let mut higher = named("higher", &cancelled());
    higher.spec.attempt = 2;
    let words = said(&[going, higher], Some(&[leaderboard()]));
    assert!(words.contains("going   Finished   3 min  Being deleted."), "{words}");
    assert!(
        words.contains("Attempt 2 is wished; the operator has not taken it up yet."),
        "{words}"
    );
}

#[test]
fn an_end_that_is_being_published_is_no_trouble_yet() {
    let fresh = json!({"type": "Published", "status": "False", "reason": "Waiting", "message": "",
                       "lastTransitionTime": "2026-11-01T11:59:00Z"});
    let status = with(
        finished(),
        &json!({"conditions": [condition("Finished", "True", "Finished", ""), fresh]}),
    );
    let words = said(&[named("done", &status)], Some(&[leaderboard()]));
    assert!(words.starts_with("Nothing waits"), "{words}");
}

#[test]
fn long_names_leave_room_for_the_reason() {
    let words = said(&[named(&"n".repeat(52), &crashed())], Some(&[leaderboard()]));
    assert!(words.contains("…"), "{words}");
}
