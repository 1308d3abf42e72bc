//! `requeue`: which submissions are chosen, and what is changed in each.

use clap::Parser;
use serde_json::{Value, json};

use super::{
    cancelled, crashed, finished, frame, leaderboard, named, node_lost, now, ran_with, running, submission, waiting,
    with,
};
use crate::board::Observed;
use crate::change::{Request, plan};
use crate::requeue::Requeue;
use leaderboard_api::{Attempt, Submission};

#[derive(Parser)]
struct Line {
    #[command(flatten)]
    requeue: Requeue,
}

fn parsed(arguments: &str) -> Result<Requeue, clap::Error> {
    let words = std::iter::once("requeue").chain(arguments.split_whitespace());
    Line::try_parse_from(words).map(|line| line.requeue)
}

/// One of each kind.
fn all() -> Vec<Submission> {
    let of = |status: Value, simulator: &str, node: &str| with(ran_with(status, simulator), &json!({"nodeName": node}));
    let mut check = named("check-a", &crashed());
    check.spec.check = true;
    let mut higher = named("resumed", &crashed());
    higher.spec.attempt = Attempt(2);
    let mut going = named("going", &crashed());
    going.metadata.deletion_timestamp = going.metadata.creation_timestamp.clone();
    let mut requested = named("requested", &running());
    requested.spec.requeue = serde_json::from_value(json!({"number": 1})).unwrap();
    let yesterday = json!({"times": {"finished": "2026-10-31T11:57:00Z"}});
    vec![
        named("crashed", &of(crashed(), "registry/sim:bad", "gpu-1")),
        named("lost", &of(node_lost(), "sim:good", "gpu-2")),
        named("old", &with(of(crashed(), "registry/sim:bad", "gpu-2"), &yesterday)),
        named("runs", &of(running(), "sim:good", "gpu-1")),
        named("stopped", &cancelled()),
        named(
            "stopped-in-evalai",
            &with(cancelled(), &json!({"reason": "EndedInEvalAI"})),
        ),
        named("done", &finished()),
        named("waits", &waiting()),
        named("new", &Value::Null),
        check,
        higher,
        going,
        requested,
    ]
}

#[test]
fn a_name_that_is_given_twice_is_one_submission() {
    let found = [named("crashed", &crashed()), named("crashed", &crashed())];
    let wanted = parsed("crashed crashed").unwrap();
    assert_eq!(wanted.chosen(&found, now()).len(), 1);
}

#[test]
fn the_flags_choose_the_submissions() {
    for (arguments, expected) in [
        ("--all", &["crashed", "lost", "old"][..]),
        ("-l a=b", &["crashed", "lost", "old"]),
        ("--all --class participant", &["crashed", "old"]),
        ("--all --class infrastructure", &["lost"]),
        ("--all --reason NodeLost", &["lost"]),
        ("--all --reason NodeLost,AgentCrashed", &["crashed", "lost", "old"]),
        ("--all --since 1h", &["crashed", "lost"]),
        ("--all --since 2d", &["crashed", "lost", "old"]),
        ("--all --since 2026-11-01T11:00Z", &["crashed", "lost"]),
        ("--all --simulator registry/sim:bad", &["crashed", "old"]),
        ("--all --simulator sim:bad", &["crashed", "old"]),
        ("--all --simulator im:bad", &[]),
        ("--all --simulator sim:bad --since 3h", &["crashed"]),
        ("--all --state running", &["runs"]),
        ("--all --state running,failed --node gpu-1 --since 1m", &["runs"]),
        ("--all --state running,failed --node gpu-1", &["crashed", "runs"]),
        ("--all --state cancelled", &["stopped"]),
        ("runs crashed done", &["crashed", "runs"]),
        ("requested resumed going check-a waits new", &[]),
    ] {
        let all = all();
        let chosen = parsed(arguments).unwrap().chosen(&all, now());
        let names: Vec<&str> = chosen.iter().filter_map(|one| one.metadata.name.as_deref()).collect();
        assert_eq!(names, expected, "{arguments}");
    }
}

#[test]
fn nothing_is_chosen_by_accident() {
    for (arguments, part) in [
        ("", "required arguments"),
        ("--reason AgentCrashed", "required arguments"),
        ("--all one", "cannot be used with"),
        ("--all -l a=b", "cannot be used with"),
        ("--all --since yesterday", "neither a time such as"),
        ("--all --state finished", "possible values: failed, cancelled, running"),
    ] {
        let why = parsed(arguments).unwrap_err().to_string();
        assert!(why.contains(part), "{arguments}: {why}");
    }
    let long = "x".repeat(257);
    assert!(
        parsed(&format!("--all --why {long}"))
            .unwrap_err()
            .to_string()
            .contains("256 characters")
    );
}

#[test]
fn a_run_keeps_its_attempt_and_an_end_gets_a_higher_one() {
    let board = leaderboard();
    let patch = |object: &Submission| {
        let planned = plan(Request::Requeue(Some("why")), object, Observed::Found(&board), frame());
        planned.map(|planned| (planned.patch.unwrap(), planned.attempt))
    };
    let version = json!({"resourceVersion": "17"});
    let (run, attempt) = patch(&submission(&running())).unwrap();
    assert_eq!(
        run,
        json!({"metadata": version, "spec": {"requeue": {"number": 1, "reason": "why"}}})
    );
    assert_eq!(attempt, Attempt(1));
    let mut ended = submission(&with(
        crashed(),
        &json!({"requeued": {"number": 4, "time": "2026-11-01T10:00:00Z"}}),
    ));
    ended.spec.requeue = serde_json::from_value(json!({"number": 4, "reason": "before"})).unwrap();
    let (end, attempt) = patch(&ended).unwrap();
    let spec = json!({"requeue": {"number": 5, "reason": "why"}, "attempt": 2, "cancel": false});
    assert_eq!((end, attempt), (json!({"metadata": version, "spec": spec}), Attempt(2)));
    let mut twice = submission(&running());
    twice.spec.requeue = serde_json::from_value(json!({"number": 1})).unwrap();
    let why_not = patch(&twice).unwrap_err();
    assert!(
        why_not.starts_with("submission-42 is already requeued and has not stopped yet."),
        "{why_not}"
    );
    let why_not = patch(&submission(&finished())).unwrap_err();
    assert!(
        why_not.starts_with("submission-42 has finished and cannot be resumed."),
        "{why_not}"
    );
}
