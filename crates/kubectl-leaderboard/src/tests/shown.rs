//! The whole output of each command, for a narrow and a wide terminal, without and with colours: files in `shown/`. UPDATE_GOLDEN=1
//! writes them; read the difference then.

use std::fmt::Write as _;
use std::path::Path;

use clap::Parser;
use serde_json::{Value, json};

use super::{
    cancelled, condition, crashed, driving, finished, leaderboard, named, node_lost, now, of_team, running, submission,
    waiting, with,
};
use crate::board::Observed;
use crate::change::{Request, plan};
use crate::output::painted;
use crate::requeue::{self, Requeue};
use crate::text::{Frame, columns};
use crate::transitions::Waiting;
use crate::{overview, status, top, why};
use leaderboard_api::Submission;

/// Columns of the terminals.
const WIDTHS: [usize; 2] = [80, 120];
/// Lines that are longer: they are copied.
const COPIED: [&str; 5] = ["s3://", "aws s3", "https://", "kubectl leaderboard", "CANCELLED"];

/// Compares what one command prints with its file.
fn assert_shown(name: &str, lines: impl Fn(Frame) -> Vec<String>) {
    let mut text = String::new();
    for width in WIDTHS {
        let lines = lines(Frame { now: now(), width });
        for line in &lines {
            let is_copied = COPIED.iter().any(|part| line.contains(part));
            assert!(is_copied || columns(line) <= width, "{name}, {width} columns: {line}");
        }
        for (colours, line_of) in [("without", str::to_owned as fn(&str) -> String), ("with", painted)] {
            writeln!(text, "=== {width} columns, {colours} colours").unwrap();
            for line in &lines {
                // Files of text hold no escapes.
                writeln!(text, "{}", line_of(line).replace('\u{1b}', "␛")).unwrap();
            }
        }
    }
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("src/tests/shown/{name}.txt"));
    if std::env::var_os("UPDATE_GOLDEN").is_some() {
        return std::fs::write(file, text).unwrap();
    }
    let known = std::fs::read_to_string(&file).unwrap_or_default();
    assert_eq!(
        text, known,
        "{name} is shown in another way; set UPDATE_GOLDEN=1 and read the difference"
    );
}

/// The status of a failure in a run with this simulator.
fn ran_with(status: Value, simulator: &str) -> Value {
    let plan = json!({"runId": "mine", "leaderboardVersion": "V2", "track": "sensors", "codename": "S",
                      "slices": [{"first": 0, "last": 9}, {"first": 10, "last": 19}], "routes": 20, "repetitions": 1,
                      "storage": {"bucket": "results"}, "image": "agent:1", "contentsImage": "contents:1",
                      "simulatorImage": simulator});
    with(status, &json!({"plan": plan, "nodeName": "gpu-3"}))
}

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
fn status() {
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
fn why_of_one() {
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
    let mut requeued = submission(&with(
        driving(),
        &json!({"requeued": {"number": 1, "time": "2026-11-01T11:30:00Z"}}),
    ));
    requeued.spec.requeue =
        serde_json::from_value(json!({"number": 1, "reason": "The simulator image was broken."})).unwrap();
    assert_shown("why-requeued", |frame| {
        why::explain(&requeued, Observed::Found(&board), frame)
    });
    requeued.spec.requeue.as_mut().unwrap().number = 2;
    assert_shown("why-requeue-requested", |frame| {
        why::explain(&requeued, Observed::Found(&board), frame)
    });
}

#[test]
fn why_of_all() {
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
    let elsewhere = [("carla-20".to_owned(), 12), ("test".to_owned(), 1)];
    assert_shown("nothing", |frame| overview::nothing("default", None, &elsewhere, frame));
}

#[test]
fn top() {
    assert_shown("top", |frame| top::lines(&some(), &[leaderboard()], frame));
}

#[test]
fn changes() {
    let board = leaderboard();
    for (name, request, status) in [
        ("cancel", Request::Cancel, running()),
        ("resume", Request::Resume, crashed()),
        ("requeue-run", Request::Requeue(None), running()),
        ("requeue-failed", Request::Requeue(None), crashed()),
    ] {
        assert_shown(name, |frame| {
            plan(request, &submission(&status), Observed::Found(&board), frame)
                .unwrap()
                .lines
        });
    }
    assert_shown("wait", |frame| {
        let mut wait = Waiting::new(1).within(frame.width);
        let states = [running(), crashed()];
        let lines = states
            .iter()
            .flat_map(|status| wait.observe(&submission(status), frame.now).lines);
        lines.collect()
    });
}

#[derive(Parser)]
struct Line {
    #[command(flatten)]
    requeue: Requeue,
}

#[test]
fn requeue() {
    let all = some();
    let wanted = Line::parse_from(["requeue", "--all", "--state", "failed,running"]).requeue;
    assert_shown("requeue", |frame| {
        requeue::lines(&wanted.chosen(&all, frame.now), frame)
    });
}
