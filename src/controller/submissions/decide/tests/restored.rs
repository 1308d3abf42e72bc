//! Objects that have lost their status: what EvalAI, the table and the bucket hold shows whether they have ended.

use std::sync::Arc;

use super::builders::*;
use crate::controller::submissions::decide::stored::{Found, found};
use crate::controller::submissions::decide::{Action, EvalaiUpdate};
use crate::controller::submissions::foreign_runs::{StoredRun, Traces};
use crate::controller::submissions::report_digest::{ReportDigest, StoredReport};
use crate::controller::submissions::view::{EvalaiInfo, ObservedReport, ObservedTraces, Standing};
use crate::pod::report::Report;
use crate::pod::run::Stop;
use crate::services::table::ObservedRow;
use leaderboard_api::ImportedState::{Cancelled as WasCancelled, Failed as HasFailed, Finished as HasFinished};
use leaderboard_api::State::{Cancelled, Failed, Finished, Pending};
use leaderboard_api::conditions::{ACCEPTED, PUBLISHED, RECORDED};
use leaderboard_api::{Attempt, names, reasons};

/// UID of the object before it was restored.
const OLD: &str = "uid-0";

fn row(status: &str, attempt: i64) -> ObservedRow {
    ObservedRow {
        status: status.into(),
        is_ours: true,
        attempt: Some(attempt),
        since: None,
    }
}

fn traces(row: Option<ObservedRow>, report: Option<Report>) -> Traces {
    Traces {
        row,
        stored: StoredRun {
            newest: report.as_ref().map(|_| at(-100)),
            is_ours: report.is_some(),
            has_ended: false,
        },
        report: report.map(|report| {
            Box::new(StoredReport {
                submission_uid: OLD.into(),
                digest: ReportDigest::from(&report),
            })
        }),
    }
}

fn evalai(standing: Standing, status: &str) -> EvalaiInfo {
    EvalaiInfo {
        standing,
        status: status.into(),
        ..info()
    }
}

fn stopped(stop: Stop) -> Report {
    Report {
        is_final: true,
        stopped: Some(stop),
        ..report(2)
    }
}

fn refused() -> Report {
    Report {
        is_final: true,
        why: Some("a torn checkpoint".into()),
        ..report(2)
    }
}

#[test]
fn one_that_is_not_evalais_ends_as_bucket_and_table_show() {
    let of = |row, report| found(&traces(row, report), Attempt(1), None);
    assert_eq!(of(None, None), Found::Nothing);
    assert_eq!(of(Some(row("RUNNING", 1)), None), Found::Nothing, "nothing was stored");
    assert_eq!(of(None, Some(report(2))), Found::Run);
    assert_eq!(of(None, Some(final_report())), Found::Stored);
    assert_eq!(of(None, Some(refused())), Found::Stored);
    assert_eq!(of(None, Some(stopped(Stop::Retries))), Found::Stored);
    assert_eq!(of(None, Some(stopped(Stop::Cancel))), Found::Stored);
    assert_eq!(of(None, Some(stopped(Stop::Interruption))), Found::Run, "its node went");
    let ended = Found::Ended(HasFinished);
    assert_eq!(of(Some(row("FINISHED", 1)), Some(final_report())), ended);
    assert_eq!(of(Some(row("FAILED", 1)), Some(report(2))), Found::Ended(HasFailed));
    assert_eq!(of(Some(row("CANCELLED", 1)), None), Found::Ended(WasCancelled));
    assert_eq!(of(Some(row("RUNNING", 1)), Some(final_report())), Found::Stored);
    // A person asks for another attempt.
    let again = |row, report| found(&traces(row, report), Attempt(2), None);
    assert_eq!(again(Some(row("FAILED", 1)), Some(report(2))), Found::Run);
    assert_eq!(again(None, Some(stopped(Stop::Retries))), Found::Run);
}

#[test]
fn what_evalai_shows_goes_before_what_is_stored() {
    let of =
        |standing, status: &str, row, report| found(&traces(row, report), Attempt(1), Some(&evalai(standing, status)));
    let running = || Some(row("RUNNING", 1));
    assert_eq!(of(Standing::Wanted, "submitted", None, None), Found::Nothing);
    assert_eq!(of(Standing::Wanted, "running", running(), Some(report(2))), Found::Run);
    assert_eq!(
        of(Standing::Wanted, "running", running(), Some(final_report())),
        Found::Stored
    );
    let resumed = of(Standing::Resumed, "resuming", Some(row("FAILED", 1)), Some(refused()));
    assert_eq!(resumed, Found::Run, "it was resumed after that end");
    let finished = of(
        Standing::Ended,
        "finished",
        Some(row("FINISHED", 1)),
        Some(final_report()),
    );
    assert_eq!(finished, Found::Ended(HasFinished));
    let unrecorded = of(Standing::Ended, "finished", running(), Some(final_report()));
    assert_eq!(unrecorded, Found::Stored, "the table lacks it");
    let claimed = of(Standing::Ended, "finished", running(), Some(report(2)));
    assert_eq!(claimed, Found::Nothing, "participants can write finished");
    let failed = of(Standing::Ended, "failed", running(), Some(report(2)));
    assert_eq!(failed, Found::Ended(HasFailed));
    assert_eq!(
        of(Standing::Ended, "failed", None, None),
        Found::Nothing,
        "it was never ours"
    );
    let rerun = of(
        Standing::Ended,
        "cancelled",
        Some(row("FINISHED", 1)),
        Some(final_report()),
    );
    assert_eq!(rerun, Found::Ended(HasFinished), "a re-run cancels its original");
    assert_eq!(
        of(Standing::Ended, "cancelled", running(), Some(report(2))),
        Found::Nothing
    );
}

/// A restored object, of whose run this is known.
fn restored(mut world: World, traces: Traces) -> World {
    if let Some(report) = &traces.report {
        world.view.report = ObservedReport::Ours(Arc::new(report.digest.clone()));
    }
    world.view.traces = ObservedTraces::Answered(Arc::new(looked(at(0), Ok(traces))));
    let label = (names::LABEL_VELERO_RESTORE.to_owned(), "restore-1".to_owned());
    world.submission().metadata.labels = Some([label].into());
    world
}

fn in_evalai(standing: Standing, status: &str, traces: Traces) -> World {
    let mut world = restored(World::evalai(), traces);
    world.in_evalai().info = Some(evalai(standing, status));
    world.in_evalai().cancelled = standing == Standing::Ended;
    world
}

#[test]
fn an_end_that_every_system_has_is_shown_and_nothing_else_happens() {
    let finished = || traces(Some(row("FINISHED", 1)), Some(final_report()));
    let failed = || traces(Some(row("FAILED", 1)), Some(report(2)));
    let cases = [
        (in_evalai(Standing::Ended, "finished", finished()), Finished),
        (in_evalai(Standing::Ended, "failed", failed()), Failed),
        (restored(World::local(), finished()), Finished),
        (restored(World::local(), failed()), Failed),
    ];
    for (mut world, state) in cases {
        let shown = world.pass();
        assert_eq!(shown.status.state, Some(state), "{:?}", shown.status);
        assert!(
            shown
                .status
                .message
                .clone()
                .unwrap()
                .contains("restored without a status")
        );
        let score = shown.status.score.clone().map(|score| score.text);
        assert_eq!(score.as_deref(), (state == Finished).then_some("43.13"));
        assert!(shown.status.failure.iter().all(|failure| !failure.charged));
        for _ in 0..3 {
            let plan = world.pass();
            assert_eq!(plan.status, shown.status);
            assert!(
                plan.actions.iter().all(|action| *action == Action::Forget),
                "{:?}",
                plan.actions
            );
            world.wait(3600);
        }
    }
}

#[test]
fn an_end_that_was_not_published_is_published_once_and_nothing_runs() {
    let mut world = in_evalai(
        Standing::Wanted,
        "running",
        traces(Some(row("RUNNING", 1)), Some(final_report())),
    );
    let plan = world.pass();
    assert!(!creates(&plan));
    assert_eq!(condition(&plan, ACCEPTED), ("True".into(), reasons::RESTORED.into()));
    let pinned = plan.status.plan.unwrap();
    assert_eq!(
        pinned.submission_uid.as_deref(),
        Some(OLD),
        "the report is that of the old object"
    );
    world.report(final_report());
    let plan = world.pass_to(Finished, reasons::FINISHED);
    assert!(!creates(&plan));
    let plan = world.pass();
    assert_eq!(evalai_updates(&plan), [EvalaiUpdate::Finished]);
    world.published();
    world.recorded();
    let plan = world.pass();
    assert_eq!(condition(&plan, PUBLISHED).0, "True");
    assert_eq!(condition(&plan, RECORDED).0, "True");
    assert_eq!(evalai_updates(&plan), []);
}

#[test]
fn what_was_stopped_keeps_its_end() {
    for (stop, state, reason) in [
        (Stop::Cancel, Cancelled, reasons::CANCELLED),
        (Stop::Retries, Failed, reasons::IMPORTED_FAILURE),
        (Stop::RunDeadline, Failed, reasons::IMPORTED_FAILURE),
    ] {
        let mut world = restored(World::local(), traces(None, Some(stopped(stop))));
        world.pass();
        let plan = world.pass_to(state, reason);
        assert!(!creates(&plan));
        assert!(plan.status.failure.iter().all(|failure| !failure.charged));
    }
}

#[test]
fn what_ran_is_resumed_in_its_turn() {
    let live = || traces(Some(row("RUNNING", 2)), Some(report(2)));
    for mut world in [
        restored(World::local(), live()),
        in_evalai(Standing::Wanted, "running", live()),
    ] {
        let plan = world.pass();
        assert!(creates(&plan), "{plan:?}");
        let pinned = plan.status.plan.as_ref().unwrap();
        assert!(pinned.resume);
        assert_eq!(pinned.submission_uid.as_deref(), Some(UID));
        assert_eq!(
            pinned.earlier_attempts, 1,
            "the row counts the resume that the backup lacks"
        );
        assert_eq!(plan.status.progress.as_ref().unwrap().text, "2/4");
        assert_eq!(condition(&plan, ACCEPTED), ("True".into(), reasons::RESTORED.into()));
    }
}

#[test]
fn a_local_one_without_a_mark_is_not_taken_for_another_of_its_name() {
    let mut world = restored(World::local(), traces(None, Some(final_report())));
    world.submission().metadata.labels = None;
    world.submission().metadata.finalizers = None;
    let plan = world.pass();
    assert!(creates(&plan));
    assert!(!plan.status.plan.unwrap().resume, "its Pod then finds the place in use");
}

#[test]
fn a_marked_one_waits_until_table_and_bucket_have_answered() {
    let mut world = restored(World::local(), Traces::default());
    world.view.traces = ObservedTraces::NotAsked;
    let plan = world.pass();
    assert!(has(&plan, |action| matches!(action, Action::LookForForeignRun(_))));
    assert!(!creates(&plan));
    world.view.traces = ObservedTraces::Answered(Arc::new(looked(at(0), Ok(Traces::default()))));
    let plan = world.pass_to(Pending, reasons::PREPARING);
    assert!(creates(&plan));
    assert!(!plan.status.plan.unwrap().resume);
}
