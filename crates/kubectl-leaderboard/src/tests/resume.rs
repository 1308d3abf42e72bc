//! `resume`: which submissions are chosen, and what is changed in each.

use clap::Parser;
use serde_json::{Value, json};

use super::{cancelled, crashed, finished, frame, leaderboard, named, node_lost, running, submission, waiting, with};
use crate::board::Observed;
use crate::change::{Request, after_refusal, plan};
use crate::facts;
use crate::resume::Resume;
use leaderboard_api::{Attempt, Submission};

#[derive(Parser)]
struct Line {
    #[command(flatten)]
    resume: Resume,
}

fn parsed(arguments: &str) -> Result<Resume, clap::Error> {
    let words = std::iter::once("resume").chain(arguments.split_whitespace());
    Line::try_parse_from(words).map(|line| line.resume)
}

/// One of each kind.
fn all() -> Vec<Submission> {
    let mut check = named("check-a", &crashed());
    check.spec.check = true;
    let mut higher = named("resumed", &crashed());
    higher.spec.attempt = Attempt(2);
    let mut restarted = named("restarted", &running());
    restarted.spec.attempt = Attempt(2);
    let mut going = named("going", &crashed());
    going.metadata.deletion_timestamp = going.metadata.creation_timestamp.clone();
    vec![
        named("lost", &node_lost()),
        named("crashed", &crashed()),
        named("runs", &running()),
        named(
            "starts",
            &with(waiting(), &json!({"jobName": "starts-1", "reason": "Preparing"})),
        ),
        named("stopped", &cancelled()),
        named("done", &finished()),
        named("waits", &waiting()),
        named("new", &Value::Null),
        check,
        higher,
        restarted,
        going,
    ]
}

#[test]
fn the_flags_choose_the_submissions() {
    for (arguments, expected) in [
        ("--all", &["crashed", "lost"][..]),
        ("-l a=b", &["crashed", "lost"]),
        ("--all --infrastructure", &["lost"]),
        ("--all --reason AgentCrashed", &["crashed"]),
        ("--all --reason NodeLost,AgentCrashed", &["crashed", "lost"]),
        ("--all --infrastructure --reason AgentCrashed", &[]),
        ("--all --restart", &["runs", "starts"]),
    ] {
        let all = all();
        let chosen = parsed(arguments).unwrap().chosen(&all);
        let names: Vec<&str> = chosen.iter().filter_map(|one| one.metadata.name.as_deref()).collect();
        assert_eq!(names, expected, "{arguments}");
    }
}

#[test]
fn nothing_is_chosen_by_accident() {
    for (arguments, part) in [
        ("", "required arguments"),
        ("--reason AgentCrashed", "required arguments"),
        ("--restart", "required arguments"),
        ("--all one", "cannot be used with"),
        ("--all -l a=b", "cannot be used with"),
        ("--all --restart --infrastructure", "cannot be used with"),
        ("one --reason AgentCrashed", "cannot be used with"),
        ("one --dry-run", "cannot be used with"),
        ("--all --wait", "cannot be used with"),
    ] {
        let why = parsed(arguments).unwrap_err().to_string();
        assert!(why.contains(part), "{arguments}: {why}");
    }
    for (arguments, request) in [
        ("one", Request::Resume),
        ("one two", Request::ResumeMany),
        ("--all", Request::ResumeMany),
        ("one --restart", Request::Restart),
        ("--all --restart", Request::Restart),
    ] {
        assert_eq!(parsed(arguments).unwrap().request(), request, "{arguments}");
    }
}

#[test]
fn only_a_run_is_restarted_and_only_an_end_is_resumed() {
    let board = leaderboard();
    let planned = |request, status: &Value| plan(request, &submission(status), Observed::Found(&board), frame());
    let patch = json!({"metadata": {"resourceVersion": "17"}, "spec": {"attempt": 2, "cancel": false}});
    for (request, status) in [(Request::Restart, running()), (Request::ResumeMany, crashed())] {
        let planned = planned(request, &status).unwrap();
        assert_eq!((planned.patch, planned.attempt), (Some(patch.clone()), Attempt(2)));
    }
    for (status, begins) in [
        (crashed(), "submission-42 is Failed and has no run to restart."),
        (waiting(), "submission-42 is Pending and has no run to restart."),
        (finished(), "submission-42 is Finished and has no run to restart."),
    ] {
        let why_not = planned(Request::Restart, &status).unwrap_err();
        assert!(why_not.starts_with(begins), "{why_not}");
    }
    let mut twice = submission(&running());
    twice.spec.attempt = Attempt(2);
    let why_not = plan(Request::Restart, &twice, Observed::Found(&board), frame()).unwrap_err();
    assert!(
        why_not.starts_with("attempt 2 of submission-42 is already requested"),
        "{why_not}"
    );
    let next = after_refusal(Request::Restart, &submission(&running()));
    assert!(
        next.starts_with("Fix what it names"),
        "EvalAI restarts no live run: {next}"
    );
}

#[test]
fn what_finished_before_its_restart_has_ended() {
    let mut object = submission(&finished());
    object.spec.attempt = Attempt(2);
    assert!(facts::has_ended(&object) && !facts::is_attempt_requested(&object));
}
