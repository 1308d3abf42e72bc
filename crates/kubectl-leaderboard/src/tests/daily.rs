//! `status`, `top` and `submit`, as they print.

use clap::Parser;
use serde_json::{Value, json};

use super::docs::assert_documented;
use super::{
    assert_width, cancelled, crashed, driving, finished, frame, leaderboard, named, node_lost, of_team, running,
    submission, waiting, with,
};
use crate::board::Observed;
use crate::submit::{Submit, object};
use crate::{pause, status, top, why};

#[test]
fn one_screen_has_progress_crashes_times_and_links() {
    let board = leaderboard();
    let lines = status::screen(&submission(&driving()), Observed::Found(&board), frame());
    assert_width(&lines);
    assert_documented(&lines);
}

#[test]
fn a_screen_exists_for_every_state() {
    for state in [
        Value::Null,
        waiting(),
        running(),
        crashed(),
        node_lost(),
        finished(),
        cancelled(),
    ] {
        let lines = status::screen(&submission(&state), Observed::Missing, frame());
        assert_width(&lines);
        let text = lines.join("\n");
        assert!(
            text.starts_with("submission-42 is ") && text.contains("Next:"),
            "{text}"
        );
        assert!(!text.contains("Reason:      :"), "{text}");
    }
}

fn some() -> Vec<leaderboard_api::Submission> {
    vec![
        named("submission-38", &of_team(finished(), "7", "Team Seven")),
        named("submission-39", &of_team(node_lost(), "8", "Team Eight")),
        named("submission-40", &driving()),
        named("submission-42", &of_team(crashed(), "7", "Team Seven")),
        named(
            "submission-43",
            &of_team(
                with(waiting(), &json!({"waiting": {"position": 1, "text": "1st"}})),
                "8",
                "Team Eight",
            ),
        ),
        named("submission-45", &of_team(waiting(), "7", "Team Seven")),
        named("submission-46", &Value::Null),
    ]
}

#[test]
fn every_submission_has_a_line_those_that_run_first() {
    let lines = status::lines(&some(), false, false, frame());
    assert_documented(&lines);
    let wide = status::lines(&some(), true, true, frame());
    assert!(
        wide[0].starts_with("NAMESPACE  NAME") && wide[0].contains("TEAM        ATTEMPT  CRASHES"),
        "{}",
        wide[0]
    );
    assert!(
        wide[1].starts_with("carla      submission-40") && wide[1].ends_with("gpu-3"),
        "{}",
        wide[1]
    );
}

#[test]
fn top_shows_slots_and_teams() {
    let lines = top::lines(&some(), &[leaderboard()], frame());
    assert_documented(&lines);
    let value = top::value(&some());
    assert_eq!(
        (&value[0]["team"], &value[0]["crashes"]),
        (&json!("Team Seven"), &json!(5))
    );
}

#[test]
fn a_pause_names_what_becomes_of_runs_and_of_those_that_wait() {
    let mut paused = leaderboard();
    paused.spec.paused = true;
    assert_documented(&pause::lines(&paused, false, frame()));
}

#[test]
fn a_pod_that_starts_uses_a_slot() {
    let starts = with(
        waiting(),
        &json!({"reason": "ImagePull", "jobName": "submission-47-1", "waiting": null}),
    );
    let again = with(waiting(), &json!({"reason": "Replacing", "retry": 1, "waiting": null}));
    let all = [
        named("submission-45", &waiting()),
        named("submission-47", &starts),
        named("submission-48", &again),
    ];
    let lines = top::lines(&all, &[leaderboard()], frame());
    assert_eq!(lines[1], "carla      carla-20     2/2    1");
    assert!(
        lines[4].starts_with("carla-20     Team Seven  2        1 (#3) "),
        "{}",
        lines[4]
    );
    assert_eq!(
        (&top::value(&all)[0]["running"], &top::value(&all)[0]["waiting"]),
        (&json!(2), &json!(1))
    );
}

#[test]
fn teams_of_leaderboards_that_share_a_name_are_told_apart_by_their_namespace() {
    let mut other = named("submission-40", &driving());
    other.metadata.namespace = Some("carla-test".to_owned());
    let lines = top::lines(&[named("submission-40", &driving()), other], &[leaderboard()], frame());
    assert_eq!(
        lines[4..].iter().map(|line| &line[..30]).collect::<Vec<_>>(),
        [
            "NAMESPACE   LEADERBOARD  TEAM  ",
            "carla       carla-20     Team S",
            "carla-test  carla-20     Team S",
        ]
        .map(|line| &line[..30])
    );
}

#[test]
fn programs_get_the_same_facts() {
    let value = why::value(&submission(&crashed()), Observed::Missing);
    assert_eq!(value["state"], "Failed");
    assert_eq!(value["failure"]["class"], "Participant");
    let step = value["nextSteps"][0].as_str().unwrap();
    assert!(step.starts_with("Look at agent/agent2/leaderboard.log"), "{step}");
    assert_eq!(
        status::value(&submission(&waiting()))["status"]["waiting"]["position"],
        3
    );
}

#[derive(Parser)]
struct Line {
    #[command(flatten)]
    submit: Submit,
}

#[test]
fn a_submission_is_made_of_the_flags() {
    let made = |more: &[&str]| {
        let usual = [
            "submit",
            "--leaderboard",
            "carla-20",
            "--track",
            "sensors",
            "--image",
            "a:1",
        ];
        object(&Line::parse_from(usual.iter().chain(more)).submit)
    };
    let plain = made(&[]);
    assert_eq!(plain["metadata"]["generateName"], "carla-20-");
    assert_eq!(
        plain["spec"],
        json!({"leaderboardName": "carla-20", "track": "sensors", "image": "a:1", "priority": 0})
    );
    let full = made(&[
        "--name",
        "mine",
        "--team-id",
        "7",
        "--team",
        "Team Seven",
        "--priority",
        "-5",
    ]);
    assert_eq!(full["metadata"]["name"], "mine");
    assert_eq!(full["spec"]["team"], json!({"id": "7", "name": "Team Seven"}));
    assert_eq!(full["spec"]["priority"], -5);
}

#[test]
fn a_submission_is_an_image_or_a_file() {
    for (flags, is_right) in [
        ("--image a:1", true),
        ("--file f.csv", true),
        ("--file f.csv --endpoint https://s3.example", true),
        ("", false),
        ("--image a:1 --file f.csv", false),
        ("--image a:1 --endpoint https://s3.example", false),
    ] {
        let usual = "submit --leaderboard digits --track test";
        let words = usual.split(' ').chain(flags.split_whitespace());
        assert_eq!(Line::try_parse_from(words).is_ok(), is_right, "{flags}");
    }
}
