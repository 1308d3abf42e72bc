//! docs/plugin.md shows the lines that the plugin prints.

use jiff::Timestamp;
use serde_json::json;

use super::{
    cancelled, condition, crashed, finished, frame, leaderboard, named, node_lost, of_team, ran_with, running,
    submission, waiting, with,
};
use crate::board::Observed;
use crate::change::{Request, plan};
use crate::error::Error;
use crate::facts::transition;
use crate::text::{Frame, WIDTH};
use crate::{overview, resume, why};
use leaderboard_api::{Attempt, Submission};

const DOCS: &str = include_str!("../../../../docs/plugin.md");

pub(super) fn assert_documented(lines: &[String]) {
    let block = format!("```\n{}\n```\n", lines.join("\n"));
    assert!(DOCS.contains(&block), "docs/plugin.md does not show\n{block}");
}

fn planned(request: Request, submission: &Submission) -> Result<Vec<String>, String> {
    let plan = plan(request, submission, Observed::Found(&leaderboard()), frame());
    plan.map(|plan| plan.lines)
}

#[test]
fn why_is_documented_as_it_is_printed() {
    for status in [crashed(), waiting()] {
        let board = leaderboard();
        assert_documented(&why::explain(&submission(&status), Observed::Found(&board), frame()));
    }
}

#[test]
fn why_of_all_is_documented_as_it_is_printed() {
    let mut paused = leaderboard();
    paused.spec.paused = true;
    let stalled = with(
        running(),
        &json!({"conditions": [condition("Running", "True", "Running", ""),
                               condition("Stalled", "True", "NotStored", "The results cannot be read: 503.")]}),
    );
    let refused = with(
        finished(),
        &json!({"conditions": [condition("Finished", "True", "Finished", ""),
                               condition("Published", "False", "Refused", "")]}),
    );
    let submissions = [
        named("submission-38", &refused),
        named("submission-39", &node_lost()),
        named("submission-40", &stalled),
        named("submission-41", &running()),
        named("submission-42", &crashed()),
        named(
            "submission-43",
            &with(waiting(), &json!({"waiting": {"position": 1, "text": "1st"}})),
        ),
        named("submission-45", &waiting()),
    ];
    let place = overview::Place {
        namespace: "carla",
        is_all: false,
    };
    let lines = overview::lines(place, &submissions, Some(&[paused]), frame());
    assert_documented(&lines);
}

#[test]
fn cancel_and_resume_are_documented_as_they_are_printed() {
    assert_documented(&planned(Request::Cancel, &submission(&running())).unwrap());
    assert_documented(&planned(Request::Resume, &submission(&crashed())).unwrap());
    let why_not = planned(Request::Resume, &submission(&running())).unwrap_err();
    assert_documented(&[format!("kubectl leaderboard: {}", Error::Unfit(why_not))]);
}

#[test]
fn the_states_on_the_way_are_documented_as_they_are_printed() {
    let stopping = json!({"reason": "Stopping", "message": "Stopping as requested; completed routes are kept."});
    let mut lines = Vec::new();
    for (time, status) in [
        ("2026-11-01T12:00:00Z", running()),
        ("2026-11-01T12:00:01Z", with(running(), &stopping)),
        ("2026-11-01T12:00:07Z", cancelled()),
    ] {
        let now: Timestamp = time.parse().unwrap();
        let frame = Frame { now, width: WIDTH };
        lines.extend(transition(&submission(&status), Attempt::FIRST, frame).unwrap().1);
    }
    assert_documented(&lines);
}

#[test]
fn resume_of_many_is_documented_as_it_is_printed() {
    let simulator = "registry.example/carla/simulator:0.9.15-3";
    let of = |status, id, team| ran_with(of_team(status, id, team), simulator);
    let crashed = named("submission-42", &of(crashed(), "7", "Team Seven"));
    let lost = named("submission-39", &of(node_lost(), "8", "Team Eight"));
    assert_documented(&resume::dry_run("resume", &[&lost, &crashed], frame()));
    assert_documented(&planned(Request::Restart, &submission(&running())).unwrap());
}
