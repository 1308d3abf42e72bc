//! The whole output of the commands that show or change submissions.

use clap::Parser;
use serde_json::{Value, json};

use super::golden::assert_shown;
use super::{
    cancelled, condition, crashed, driving, finished, leaderboard, named, node_lost, of_team, ran_with, running,
    submission, waiting, with,
};
use crate::board::Observed;
use crate::change::{Request, plan};
use crate::facts::transition;
use crate::resume::{self, Resume};
use crate::{overview, status, top, why};
use leaderboard_api::{Attempt, Submission};

fn some() -> Vec<Submission> {
    let broken = "registry.example/carla/simulator:0.9.15-3";
    let first = with(waiting(), &json!({"waiting": {"position": 1, "text": "1st"}}));
    vec![
        named("submission-38", &of_team(finished(), "7", "Team Seven")),
        named(
            "submission-39",
            &ran_with(of_team(node_lost(), "8", "チーム自動運転"), broken),
        ),
        named("submission-40", &ran_with(driving(), "simulator:2")),
        named(
            "submission-41",
            &of_team(
                cancelled(),
                "9",
                "A team whose name is much longer than those of others",
            ),
        ),
        named(
            "submission-42",
            &ran_with(of_team(crashed(), "7", "Team Seven"), broken),
        ),
        named("submission-43", &of_team(first, "8", "チーム自動運転")),
        named("submission-45", &of_team(waiting(), "7", "Team Seven")),
        named("submission-46", &Value::Null),
    ]
}

#[test]
fn status_is_printed_as_its_files_show() {
    assert_shown("status", |frame| status::lines(&some(), false, false, frame));
    assert_shown("status-all-namespaces", |frame| {
        status::lines(&some(), true, false, frame)
    });
    let board = leaderboard();
    for (name, status) in [
        ("status-running", driving()),
        ("status-waiting", waiting()),
        ("status-failed", crashed()),
        ("status-finished", finished()),
        ("status-new", Value::Null),
    ] {
        assert_shown(name, |frame| {
            status::screen(&submission(&status), Observed::Found(&board), frame)
        });
    }
}

#[test]
fn why_of_one_is_printed_as_its_files_show() {
    let board = leaderboard();
    for (name, status) in [
        ("why-running", driving()),
        ("why-waiting", waiting()),
        ("why-failed", crashed()),
        ("why-lost", node_lost()),
        ("why-finished", finished()),
        ("why-cancelled", cancelled()),
    ] {
        assert_shown(name, |frame| {
            why::explain(&submission(&status), Observed::Found(&board), frame)
        });
    }
}

#[test]
fn why_of_all_is_printed_as_its_files_show() {
    let mut paused = leaderboard();
    paused.spec.paused = true;
    let stalled = json!({"conditions": [condition("Running", "True", "Running", ""),
                                        condition("Stalled", "True", "NotStored", "The results cannot be read: 503.")]});
    let mut all = some();
    all.push(named("submission-47", &with(running(), &stalled)));
    let place = |is_all| overview::Place {
        namespace: "carla",
        is_all,
    };
    assert_shown("why", |frame| {
        overview::lines(place(false), &all, Some(&[paused.clone()]), frame)
    });
    assert_shown("why-all-namespaces", |frame| {
        overview::lines(place(true), &all, None, frame)
    });
}

#[test]
fn an_empty_list_is_printed_as_its_files_show() {
    let place = |namespace, is_all| overview::Place { namespace, is_all };
    let elsewhere = [("carla-20".to_owned(), 12), ("test".to_owned(), 1)];
    assert_shown("nothing", |frame| {
        overview::nothing(place("default", false), None, &elsewhere, frame)
    });
    assert_shown("nothing-anywhere", |frame| {
        let phase = Some("leaderboard.carla.org/phase=7");
        [
            overview::nothing(place("default", false), None, &[], frame),
            overview::nothing(place("default", true), None, &[], frame),
            overview::nothing(place("carla", false), phase, &[], frame),
            overview::nothing(place("carla", true), phase, &[], frame),
        ]
        .concat()
    });
}

#[test]
fn top_is_printed_as_its_file_shows() {
    assert_shown("top", |frame| top::lines(&some(), &[leaderboard()], frame));
}

#[test]
fn changes_are_printed_as_their_files_show() {
    let board = leaderboard();
    let prepared = with(waiting(), &json!({"jobName": "submission-42-1", "reason": "Preparing"}));
    let unstored = with(crashed(), &json!({"resultsURL": null}));
    for (name, request, status) in [
        ("cancel", Request::Cancel, running()),
        ("cancel-waiting", Request::Cancel, waiting()),
        ("cancel-preparing", Request::Cancel, prepared),
        ("resume", Request::Resume, crashed()),
        ("resume-without-results", Request::Resume, unstored),
        ("resume-many", Request::ResumeMany, node_lost()),
        ("restart", Request::Restart, running()),
    ] {
        assert_shown(name, |frame| {
            plan(request, &submission(&status), Observed::Found(&board), frame)
                .unwrap()
                .lines
        });
    }
    let mut again = submission(&running());
    again.spec.cancel = true;
    assert_shown("cancel-again", |frame| {
        plan(Request::Cancel, &again, Observed::Found(&board), frame)
            .unwrap()
            .lines
    });
    let mut paused = leaderboard();
    paused.spec.paused = true;
    assert_shown("resume-paused", |frame| {
        plan(
            Request::Resume,
            &submission(&crashed()),
            Observed::Found(&paused),
            frame,
        )
        .unwrap()
        .lines
    });
    assert_shown("wait", |frame| {
        let lines = |status| transition(&submission(status), Attempt::FIRST, frame).unwrap().1;
        [running(), crashed()].iter().flat_map(lines).collect()
    });
}

#[derive(Parser)]
struct Line {
    #[command(flatten)]
    resume: Resume,
}

#[test]
fn what_is_chosen_is_printed_as_its_files_show() {
    let all = some();
    let of = |words: &str| Line::parse_from(words.split(' ')).resume;
    assert_shown("resume-dry", |frame| {
        resume::dry_run("resume", &of("resume --all").chosen(&all), frame)
    });
    assert_shown("restart-dry", |frame| {
        resume::dry_run("restart", &of("resume --all --restart").chosen(&all), frame)
    });
    assert_shown("resume-end", |frame| {
        [
            resume::summary(38, 38, "carla", frame),
            resume::summary(37, 38, "carla", frame),
            resume::summary(0, 2, "carla", frame),
            of("resume --all").none(7, "carla", frame),
            of("resume --all --restart").none(1, "carla", frame),
            of("resume --all --infrastructure --reason SimulationCrashed,NodeLost").none(7, "carla", frame),
        ]
        .concat()
    });
}
