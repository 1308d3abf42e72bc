//! What another program still runs is left alone until it has ended there, or a person hands it over.

use std::sync::Arc;
use std::time::Duration;

use super::builders::*;
use crate::controller::submissions::decide::Action;
use crate::controller::submissions::decide::foreign::{Found, found};
use crate::controller::submissions::foreign_runs::{Question, StoredRun, Traces, Unread};
use crate::controller::submissions::view::{EvalaiInfo, ObservedTraces, Standing};
use crate::services::table::ObservedRow;
use leaderboard_api::State::{Cancelled, Pending};
use leaderboard_api::conditions::{ACCEPTED, STALLED};
use leaderboard_api::{SubmissionStatus, names, reasons};

fn row(status: &str) -> ObservedRow {
    ObservedRow {
        status: status.into(),
        is_ours: false,
        attempt: None,
        since: Some("2026-11-20 10:00:00 UTC".into()),
    }
}

fn with_row(row: ObservedRow) -> Traces {
    Traces {
        row: Some(row),
        ..Traces::default()
    }
}

fn stored(newest: i64) -> StoredRun {
    StoredRun {
        newest: Some(at(newest)),
        ..StoredRun::default()
    }
}

fn with_objects(stored: StoredRun) -> Traces {
    Traces {
        stored,
        ..Traces::default()
    }
}

/// A submission of EvalAI's of which this was found.
fn seen(traces: Traces) -> World {
    let mut world = World::evalai();
    world.view.traces = ObservedTraces::Answered(Arc::new(looked(at(0), Ok(traces))));
    world
}

fn asked(world: &mut World) -> Option<Question> {
    world.pass().actions.into_iter().find_map(|action| match action {
        Action::LookForForeignRun(question) => Some(*question),
        _ => None,
    })
}

fn resumed(second: i64) -> EvalaiInfo {
    EvalaiInfo {
        standing: Standing::Resumed,
        resumed_at: Some(at(second)),
        ..info()
    }
}

/// What is found at second 100, and the run that it shows.
fn each_shows(cases: impl IntoIterator<Item = (&'static str, Traces, EvalaiInfo, Option<Found>)>) {
    for (name, traces, info, expected) in cases {
        assert_eq!(found(&traces, &info, 100, at(100)), expected, "{name}");
    }
}

#[test]
fn a_row_of_a_run_shows_that_another_program_runs_it() {
    let by_row = |status: &str| {
        let since = row(status).since;
        let status = status.into();
        Some(Found::Row { status, since })
    };
    let of = |status: &str| with_row(row(status));
    let ours = ObservedRow {
        is_ours: true,
        ..row("RUNNING")
    };
    let both = |status: &str| Traces {
        stored: stored(90),
        ..of(status)
    };
    each_shows([
        ("nothing", Traces::default(), info(), None),
        ("a row at its start", of("SUBMITTED"), info(), by_row("SUBMITTED")),
        ("a row of a run", of("RUNNING"), info(), by_row("RUNNING")),
        ("one that EvalAI resumes", of("RUNNING"), resumed(50), by_row("RUNNING")),
        ("a row with our mark", with_row(ours), info(), None),
        ("an ended row", both("FAILED"), info(), None),
        ("an ended row of a resumed one", both("FAILED"), resumed(80), None),
        ("another ended row", both("CANCELLED"), info(), None),
        ("the last ended row", both("FINISHED"), info(), None),
    ]);
}

#[test]
fn young_objects_show_that_another_program_runs_it() {
    let objects = |newest, until| {
        Some(Found::Objects {
            newest: at(newest),
            until: at(until),
        })
    };
    let marked = with_objects(StoredRun {
        is_ours: true,
        ..stored(90)
    });
    let ended = with_objects(StoredRun {
        has_ended: true,
        ..stored(90)
    });
    let of = |newest| with_objects(stored(newest));
    each_shows([
        ("young objects", of(90), info(), objects(90, 190)),
        ("old objects", of(0), info(), None),
        ("objects of the future", of(500), info(), objects(500, 600)),
        ("young objects with our mark", marked, info(), None),
        ("young objects of a run that has ended", ended, info(), None),
        ("objects from before a resume", of(79), resumed(80), None),
        ("objects from after a resume", of(80), resumed(80), objects(80, 180)),
    ]);
}

#[test]
fn it_is_looked_once_before_the_first_job_and_an_answer_within_five_seconds_costs_no_write() {
    let mut world = World::evalai();
    world.view.traces = ObservedTraces::NotAsked;
    let question = asked(&mut world).unwrap();
    assert_eq!((question.run_id.as_str(), question.team.as_str()), ("77", "42"));
    assert_eq!(question.table.as_ref().unwrap().name, "submissions");
    assert_eq!(question.prefix(), "s3://results/77/");
    world.view.traces = ObservedTraces::Asked(Duration::from_secs(2));
    let plan = world.pass();
    assert_eq!((&plan.status, creates(&plan)), (&SubmissionStatus::default(), false));
    world.view.traces = ObservedTraces::Asked(Duration::from_secs(5));
    assert!(!creates(&world.pass_to(Pending, reasons::LOOKING_FOR_FOREIGN_RUN)));
    world.view.traces = ObservedTraces::Answered(Arc::new(looked(at(0), Ok(Traces::default()))));
    assert!(creates(&world.pass_to(Pending, reasons::PREPARING)));
    // With its Job, and between two of them, nobody looks.
    world.view.traces = ObservedTraces::NotAsked;
    assert_eq!(asked(&mut world), None);
    let status = world.submission().status.as_mut().unwrap();
    (status.retry, status.job_name) = (1, None);
    assert_eq!(asked(&mut world), None);
}

#[test]
fn only_evalai_hands_a_submission_to_two_programs() {
    let mut world = World::local();
    world.view.traces = ObservedTraces::NotAsked;
    // Our finalizer comes with the first Job: with it and without a status the object was restored, and is looked for.
    world.submission().metadata.finalizers = None;
    assert!(creates(&world.pass_to(Pending, reasons::PREPARING)));
}

#[test]
fn what_another_program_runs_waits_and_nothing_is_written_of_it() {
    let mut world = seen(with_row(row("RUNNING")));
    // A refusal would end it, and the end would be written over the other program's.
    world.leaderboard().agent.images = Some(vec![]);
    world.submission().spec.image = Some("contents:1".into());
    let plan = world.pass_to(Pending, reasons::FOREIGN);
    assert!(!creates(&plan) && evalai_updates(&plan).is_empty());
    assert!(!has(&plan, |a| matches!(a, Action::Record(_) | Action::AddFinalizer)));
    assert!(
        has(&plan, |a| matches!(a, Action::LookForForeignRun(_))),
        "it is looked for again"
    );
    assert!(plan.status.plan.is_none() && plan.requeue.is_some());
    assert_eq!(condition(&plan, ACCEPTED), ("False".into(), reasons::FOREIGN.into()));
    let message = plan.status.message.unwrap();
    for part in [
        "RUNNING since 2026-11-20 10:00:00 UTC",
        "submission_status",
        names::ANNOTATION_ADOPT,
    ] {
        assert!(message.contains(part), "{message}");
    }
}

#[test]
fn when_the_other_run_has_ended_evalai_decides_what_follows() {
    let of = |status| ObservedTraces::Answered(Arc::new(looked(at(30), Ok(with_row(row(status))))));
    let held = || {
        let mut world = seen(with_row(row("RUNNING")));
        world.pass_to(Pending, reasons::FOREIGN);
        world.view.traces = of("FAILED");
        world.go_to(40);
        world.in_evalai().read_at = Some(at(10));
        world
    };
    // What EvalAI has answered before may be older than the end: it is asked anew, some seconds later.
    let mut world = held();
    let plan = world.pass_to(Pending, reasons::FOREIGN);
    assert!(!creates(&plan) && !has(&plan, |a| *a == Action::ForgetEvalai));
    assert!(plan.requeue.is_some_and(|wait| wait < Duration::from_secs(6)));
    world.go_to(45);
    let plan = world.pass_to(Pending, reasons::FOREIGN);
    assert!(!creates(&plan) && has(&plan, |a| *a == Action::ForgetEvalai));
    // Resumed there: what is stored is taken up.
    let mut world = held();
    world.in_evalai().info.as_mut().unwrap().standing = Standing::Resumed;
    world.in_evalai().read_at = Some(at(45));
    assert!(creates(&world.pass_to(Pending, reasons::PREPARING)));
    assert!(world.status().plan.unwrap().resume);
    // Ended there: nothing is run, and the other program's row and results stay.
    let mut world = held();
    world.in_evalai().info = Some(EvalaiInfo {
        standing: Standing::Ended,
        status: "finished".into(),
        ..info()
    });
    let plan = world.pass_to(Cancelled, reasons::ENDED_IN_EVALAI);
    assert!(!creates(&plan) && evalai_updates(&plan).is_empty() && plan.status.plan.is_none());
    // The same while the row is not ended yet.
    let mut world = held();
    world.view.traces = of("RUNNING");
    world.in_evalai().cancelled = true;
    assert!(!creates(&world.pass_to(Cancelled, reasons::ENDED_IN_EVALAI)));
}

#[test]
fn a_person_hands_over_what_nothing_runs_any_more_and_it_takes_up_what_is_stored() {
    let mut world = seen(with_row(row("RUNNING")));
    world.pass_to(Pending, reasons::FOREIGN);
    let annotate = |world: &mut World, text: &str| {
        let annotations = world.submission().metadata.annotations.get_or_insert_default();
        annotations.insert(names::ANNOTATION_ADOPT.into(), text.into());
    };
    annotate(&mut world, "false");
    world.pass_to(Pending, reasons::FOREIGN);
    annotate(&mut world, "true");
    let plan = world.pass_to(Pending, reasons::PREPARING);
    assert!(creates(&plan) && !has(&plan, |a| matches!(a, Action::LookForForeignRun(_))));
    assert!(world.status().plan.unwrap().resume);
}

#[test]
fn a_run_without_a_limit_is_left_alone_for_a_day_after_its_last_object() {
    for (limit, seconds) in [(0, 86_400), (100, 100)] {
        let mut world = seen(with_objects(stored(0)));
        world.leaderboard().deadlines.run_seconds = limit;
        world.go_to(seconds - 1);
        world.pass_to(Pending, reasons::FOREIGN);
        world.go_to(seconds);
        world.in_evalai().read_at = Some(at(seconds));
        assert!(creates(&world.pass_to(Pending, reasons::PREPARING)), "{limit}");
    }
}

#[test]
fn nothing_starts_while_it_is_not_known_and_a_refusal_is_a_persons_to_fix() {
    for (is_refused, stalled) in [(true, "True"), (false, "False")] {
        let why = "table rows: GetItem is not allowed".to_owned();
        let unread = Unread { is_refused, why };
        let mut world = World::evalai();
        world.view.traces = ObservedTraces::Answered(Arc::new(looked(at(0), Err(unread))));
        let plan = world.pass_to(Pending, reasons::FOREIGN);
        assert!(!creates(&plan));
        assert_eq!(condition(&plan, STALLED).0, stalled);
        let message = plan.status.message.unwrap();
        assert!(
            message.contains("is not known: table rows: GetItem is not allowed."),
            "{message}"
        );
    }
}
