//! `why` without a name.

use serde_json::{Value, json};

use super::golden::assert_texts;
use super::{
    assert_width, cancelled, condition, crashed, finished, frame, leaderboard, named, node_lost, running, waiting, with,
};
use crate::overview::{Place, lines, nothing, value};
use leaderboard_api::{Attempt, Leaderboard, Submission};

fn printed(submissions: &[Submission], leaderboards: Option<&[Leaderboard]>) -> String {
    let place = Place {
        namespace: "carla",
        is_all: false,
    };
    let lines = lines(place, submissions, leaderboards, frame());
    assert_width(&lines);
    lines.join("\n")
}

#[test]
fn those_that_wait_failed_or_are_stuck_have_a_line() {
    let first = with(waiting(), &json!({"waiting": {"position": 1, "text": "1st"}}));
    let stalled = with(
        running(),
        &json!({"reason": "NotStored", "message": "The results cannot be read.",
                "conditions": [condition("Running", "True", "Running", ""),
                               condition("Stalled", "True", "NotStored", "The results cannot be read: 503.")]}),
    );
    let refused = with(
        finished(),
        &json!({"conditions": [condition("Finished", "True", "Finished", ""),
                               condition("Published", "False", "Refused", "EvalAI rejected the result.")]}),
    );
    let submissions = vec![
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
    let text = printed(&submissions, Some(&[leaderboard()]));
    let first = text.lines().filter_map(|line| line.split(' ').next());
    let names = [
        "NAME",
        "stalled",
        "new",
        "first",
        "third",
        "crashed",
        "lost",
        "unpublished",
    ];
    assert_eq!(first.take(names.len()).collect::<Vec<_>>(), names);
    assert_texts("why-lines", &[("each has a line", text)]);
}

#[test]
fn programs_get_those_that_have_a_line_with_their_next_steps() {
    let mut elsewhere = named("elsewhere", &waiting());
    elsewhere.metadata.namespace = Some("carla-test".to_owned());
    let submissions = [
        named("well", &running()),
        named("done", &finished()),
        named("third", &waiting()),
        named("crashed", &crashed()),
        elsewhere,
    ];
    let found = |boards: Option<&[Leaderboard]>| value(&submissions, boards, frame().now);
    let shown = found(Some(&[leaderboard()]));
    let names: Vec<_> = shown
        .as_array()
        .unwrap()
        .iter()
        .map(|one| one["name"].clone())
        .collect();
    assert_eq!(names, ["third", "crashed", "elsewhere"]);
    assert_eq!(shown[1]["failure"]["class"], "Participant");
    let step = shown[1]["nextSteps"][0].as_str().unwrap();
    assert!(step.starts_with("Look at agent/agent2/leaderboard.log"), "{step}");
    let problems = |all: &Value, at: usize| all[at]["leaderboardProblems"].as_array().unwrap().len();
    assert_eq!(
        (problems(&shown, 0), problems(&shown, 2)),
        (0, 1),
        "each has the Leaderboard of its namespace"
    );
    assert_eq!(problems(&found(None), 0), 1, "one that may not be read may be paused");
}

#[test]
fn leaderboards_with_a_problem_are_named_also_when_no_submission_waits() {
    let mut paused = leaderboard();
    paused.spec.paused = true;
    let text = printed(&[named("done", &finished())], Some(&[paused]));
    assert_texts("why-paused", &[("nothing waits", text)]);
    let text = printed(&[named("a", &waiting()), named("b", &waiting())], Some(&[]));
    assert_eq!(text.matches("Leaderboard carla-20").count(), 1, "{text}");
    let text = printed(&[named("done", &finished())], Some(&[]));
    assert!(
        !text.contains("Leaderboard carla-20"),
        "what has ended needs none: {text}"
    );
    let place = Place {
        namespace: "carla",
        is_all: false,
    };
    let text = |selector, elsewhere: &[(String, usize)]| nothing(place, selector, elsewhere, frame()).join("\n");
    let somewhere = [("carla-20".to_owned(), 12), ("test".to_owned(), 1)];
    let texts = [
        ("nothing", text(None, &[])),
        ("elsewhere", text(None, &somewhere)),
        ("with labels", text(Some("a=b"), &[])),
        ("no right to Leaderboards", printed(&[], None)),
    ];
    assert_texts("why-nothing", &texts);
}

#[test]
fn one_that_is_being_deleted_or_resumed_has_a_line() {
    let mut going = named("going", &finished());
    going.metadata.deletion_timestamp = going.metadata.creation_timestamp.clone();
    let mut higher = named("higher", &cancelled());
    higher.spec.attempt = Attempt(2);
    let text = printed(&[going, higher], Some(&[leaderboard()]));
    assert_texts("why-leaving", &[("deleted, resumed", text)]);
}

#[test]
fn an_end_that_is_being_published_is_no_problem_yet() {
    let fresh = json!({"type": "Published", "status": "False", "reason": "Waiting", "message": "",
                       "lastTransitionTime": "2026-11-01T11:59:00Z"});
    let status = with(
        finished(),
        &json!({"conditions": [condition("Finished", "True", "Finished", ""), fresh]}),
    );
    let text = printed(&[named("done", &status)], Some(&[leaderboard()]));
    assert!(!text.contains("done"), "{text}");
}

#[test]
fn long_names_leave_space_for_the_reason() {
    let text = printed(&[named(&"n".repeat(52), &crashed())], Some(&[leaderboard()]));
    assert!(text.contains("…"), "{text}");
}
