//! Objects that have lost their status: what EvalAI, the table and the bucket hold shows whether they have ended.

use std::sync::Arc;
use std::time::Duration;

use super::builders::*;
use crate::controller::submissions::decide::stored::{Found, found};
use crate::controller::submissions::decide::{Action, EvalaiUpdate};
use crate::controller::submissions::foreign_runs::{StoredRun, Traces, Unread};
use crate::controller::submissions::report_digest::{ReportDigest, StoredReport};
use crate::controller::submissions::result_texts::attempt_of_run;
use crate::controller::submissions::view::{EvalaiInfo, ObservedReport, ObservedTraces, Stage, Standing};
use crate::pod::report::Report;
use crate::pod::run::Stop;
use crate::services::table::ObservedRow;
use leaderboard_api::ImportedState::{Cancelled as WasCancelled, Failed as HasFailed, Finished as HasFinished};
use leaderboard_api::State::{Cancelled, Failed, Finished, Pending};
use leaderboard_api::conditions::{ACCEPTED, PUBLISHED, RECORDED, STALLED};
use leaderboard_api::{Attempt, FailureClass, names, reasons};

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
        assert!(
            shown
                .status
                .failure
                .iter()
                .all(|failure| failure.class == FailureClass::Infrastructure)
        );
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
        assert!(
            plan.status
                .failure
                .iter()
                .all(|failure| failure.class == FailureClass::Infrastructure)
        );
    }
}

#[test]
fn what_was_stopped_to_be_restarted_goes_on() {
    // The backup is older than the request, or has it.
    for attempt in [Attempt(1), Attempt(2)] {
        let known = || traces(Some(row("RUNNING", 1)), Some(stopped(Stop::Interruption)));
        for mut world in [
            restored(World::local(), known()),
            in_evalai(Standing::Wanted, "running", known()),
        ] {
            world.submission().spec.attempt = attempt;
            world.pass();
            let plan = world.pass();
            assert_eq!(plan.status.attempt, Some(attempt));
            assert_ne!(plan.status.state, Some(Cancelled));
            assert!(plan.status.plan.unwrap().resume);
        }
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

/// Table and bucket cannot be read.
fn unreadable(world: &mut World, is_refused: bool) {
    let why = "table rows: GetItem is not allowed".to_owned();
    let unread = Unread { is_refused, why };
    world.view.traces = ObservedTraces::Answered(Arc::new(looked(at(0), Err(unread))));
}

#[test]
fn an_end_in_evalai_that_may_be_ours_waits_until_table_and_bucket_can_be_read() {
    for (is_refused, stalled) in [(true, "True"), (false, "False")] {
        let known = traces(Some(row("FINISHED", 1)), Some(final_report()));
        let mut world = in_evalai(Standing::Ended, "finished", known.clone());
        unreadable(&mut world, is_refused);
        let plan = world.pass_to(Pending, reasons::FOREIGN);
        assert!(!creates(&plan) && evalai_updates(&plan).is_empty());
        let looks = |action: &Action| matches!(action, Action::LookForForeignRun(_));
        assert!(has(&plan, looks), "it is looked for again");
        assert_eq!(condition(&plan, ACCEPTED), ("False".into(), reasons::FOREIGN.into()));
        assert_eq!(condition(&plan, STALLED).0, stalled);
        let message = plan.status.message.unwrap();
        for part in [
            "EvalAI shows finished",
            "is not known: table rows: GetItem is not allowed. It is looked for again",
            "spec.cancel",
        ] {
            assert!(message.contains(part), "{message}");
        }
        world.view.traces = ObservedTraces::Answered(Arc::new(looked(at(60), Ok(known))));
        let plan = world.pass_to(Finished, reasons::FINISHED);
        assert!(!creates(&plan) && evalai_updates(&plan).is_empty());
        assert_eq!(plan.status.score.unwrap().text, "43.13");
    }
}

#[test]
fn who_ends_the_wait_for_that_ends_nothing_in_evalai() {
    for is_deleted in [false, true] {
        let mut world = in_evalai(Standing::Ended, "finished", Traces::default());
        unreadable(&mut world, true);
        world.pass_to(Pending, reasons::FOREIGN);
        if is_deleted {
            world.delete();
        } else {
            world.submission().spec.cancel = true;
        }
        let plan = world.pass_to(Cancelled, reasons::ENDED_IN_EVALAI);
        assert_eq!(
            evalai_updates(&plan),
            [],
            "`cancelled` would be written over `finished`"
        );
        assert!(!has(&plan, |a| matches!(a, Action::Record(_))));
        assert_eq!(has(&plan, |a| *a == Action::ReleaseFinalizer), is_deleted);
    }
}

#[test]
fn what_is_not_known_is_shown_anew_when_evalai_ends_what_waits() {
    let mut world = in_evalai(Standing::Wanted, "submitted", Traces::default());
    unreadable(&mut world, true);
    let plan = world.pass_to(Pending, reasons::FOREIGN);
    assert!(plan.status.message.unwrap().contains(names::ANNOTATION_ADOPT));
    world.in_evalai().info = Some(evalai(Standing::Ended, "cancelled"));
    world.in_evalai().cancelled = true;
    let plan = world.pass_to(Pending, reasons::FOREIGN);
    let message = plan.status.message.unwrap();
    assert!(message.starts_with("EvalAI shows cancelled"), "{message}");
}

#[test]
fn an_end_that_is_an_attempt_ahead_of_the_object_is_taken_over_too() {
    for (standing, status) in [(Standing::Wanted, "running"), (Standing::Ended, "finished")] {
        let later = || Report {
            attempt: Attempt(2),
            ..final_report()
        };
        let mut world = in_evalai(standing, status, traces(Some(row("RUNNING", 2)), Some(later())));
        assert!(!creates(&world.pass()));
        world.report(later());
        let plan = world.pass_to(Finished, reasons::FINISHED);
        assert!(!creates(&plan));
        assert_eq!(attempt_of_run(&plan.status), 2, "as the row counts them");
    }
}

#[test]
fn a_kept_status_that_is_older_than_the_last_report_ends_with_that_and_counts_on() {
    let mut world = World::local().running();
    world.report(report(2));
    world.pass();
    let status = world.submission().status.as_mut().unwrap();
    status.plan.as_mut().unwrap().submission_uid = Some(OLD.into());
    world.job_gone();
    world.report(Report {
        attempt: Attempt(2),
        ..final_report()
    });
    let plan = world.pass_to(Finished, reasons::FINISHED);
    assert_eq!(attempt_of_run(&plan.status), 2);
    let shown = (plan.status.progress.unwrap().text, plan.status.score.unwrap().text);
    assert_eq!(shown, ("4/4".into(), "43.13".into()));
}

#[test]
fn a_resume_takes_no_report_of_before_the_restore_for_its_own() {
    let later = Report {
        attempt: Attempt(2),
        ..refused()
    };
    let found = traces(Some(row("RUNNING", 2)), Some(later));
    let mut world = in_evalai(Standing::Wanted, "running", found);
    assert!(!creates(&world.pass()));
    world.pass_to(Failed, reasons::INVALID_RESULTS);
    world.view.report = ObservedReport::Foreign;
    world.submission().spec.attempt = Attempt(2);
    let plan = world.pass_to(Pending, reasons::PREPARING);
    assert_eq!(attempt_of_run(&plan.status), 3, "the row has two already");
    let pinned = plan.status.plan.unwrap();
    assert_eq!(pinned.submission_uid.as_deref(), Some(UID));
}

#[test]
fn an_end_that_was_taken_over_waits_for_its_report_and_makes_no_job() {
    let unread = ObservedReport::Unreadable("slow down".into());
    for (stage, report) in [(Some(Stage::JobEnded), unread), (None, ObservedReport::NotRead)] {
        let found = traces(Some(row("RUNNING", 1)), Some(final_report()));
        let mut world = in_evalai(Standing::Wanted, "running", found);
        world.pass();
        (world.view.report_stage, world.view.report) = (stage, report);
        world.view.report_waited = Duration::from_mins(1);
        assert!(!creates(&world.pass_to(Pending, reasons::NOT_STORED)));
        world.view.report_stage = Some(Stage::JobEnded);
        world.report(final_report());
        assert!(!creates(&world.pass_to(Finished, reasons::FINISHED)));
    }
}
