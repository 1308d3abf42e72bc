//! A run of another program is left alone until it has ended there, or a person hands it over.

use std::sync::Arc;
use std::time::Duration;

use super::builders::*;
use crate::ask::{Answered, Failure, Lookup};
use crate::questions::{ForeignRun, Row};
use crate::submissions::{Action, Plan, Question, SlotUse};
use crate::view::{EvalaiInfo, JobEnd, Standing};
use leaderboard_api::State::{Cancelled, Pending};
use leaderboard_api::conditions::{ACCEPTED, PUBLISHED, RECORDED, STALLED};
use leaderboard_api::evalai_status::Status;
use leaderboard_api::{Attempt, Reason, SubmissionStatus, names};

/// The question of an attempt.
fn question(attempt: i64) -> Row {
    Row {
        attempt: Attempt(attempt),
        table: leaderboard(true).spec.table.unwrap().dynamo_db,
        team: "42".into(),
        run_id: "77".parse().unwrap(),
    }
}

fn answer(question: Row, sent_ago: u64, result: Result<Option<ForeignRun>, Failure>) -> Lookup<Row> {
    Lookup {
        last: Some(Answered {
            question,
            sent_ago: Duration::from_secs(sent_ago),
            result: Arc::new(result),
        }),
        ..Lookup::default()
    }
}

/// This was found in the table of the first attempt, by a question that was sent so many seconds ago.
fn found(sent_ago: u64, result: Result<Option<ForeignRun>, Failure>) -> Lookup<Row> {
    answer(question(1), sent_ago, result)
}

/// No other program runs this attempt.
pub fn free(attempt: i64) -> Lookup<Row> {
    answer(question(attempt), 0, Ok(None))
}

/// Another program runs it.
fn runs() -> Lookup<Row> {
    let run = ForeignRun {
        status: "RUNNING".into(),
        since: Some("2026-11-20 10:00:00 UTC".into()),
    };
    found(0, Ok(Some(run)))
}

/// A submission of EvalAI's that another program runs.
fn held() -> World {
    let mut world = World::evalai();
    world.view.row = runs();
    world
}

/// A submission whose Pod has found results of something else below its prefix.
fn with_prefix_in_use(mut world: World) -> World {
    world.see(ended("workspace", 0, "PrefixInUse", 1, 5));
    world
}

fn adopt(world: &mut World, text: &str) {
    let annotations = world.submission().metadata.annotations.get_or_insert_default();
    annotations.insert(names::ANNOTATION_ADOPT.into(), text.into());
}

fn asked(plan: &Plan) -> Option<&Row> {
    plan.actions.iter().find_map(|action| match action {
        Action::Ask(Question::Row(row)) => Some(&**row),
        _ => None,
    })
}

fn writes_nothing(plan: &Plan) -> bool {
    let writes = |action: &Action| {
        matches!(
            action,
            Action::UpdateEvalai(_) | Action::Record(_) | Action::CreateJob(_)
        )
    };
    !has(plan, writes)
}

#[test]
fn the_row_is_read_before_the_first_write_and_an_answer_within_five_seconds_costs_no_write() {
    let mut world = World::evalai();
    world.view.row = Lookup::default();
    let plan = world.pass();
    assert_eq!(asked(&plan), Some(&question(1)));
    assert_eq!(
        (&plan.status, writes_nothing(&plan)),
        (&SubmissionStatus::default(), true)
    );
    world.view.row.waited = Some(Duration::from_secs(2));
    let plan = world.pass();
    assert_eq!(
        (&plan.status, writes_nothing(&plan)),
        (&SubmissionStatus::default(), true)
    );
    world.view.row.waited = Some(Duration::from_secs(5));
    let plan = world.pass_to(Pending, Reason::Foreign);
    assert_eq!(condition(&plan, ACCEPTED).0, "Unknown");
    assert!(writes_nothing(&plan));
    world.view.row = free(1);
    assert!(creates(&world.pass_to(Pending, Reason::Preparing)));
    // With its Job, and between two of them, no reconcile asks for the row.
    world.view.row = Lookup::default();
    assert_eq!(asked(&world.pass()), None);
    let status = world.submission().status.as_mut().unwrap();
    (status.retry, status.job_name) = (1, None);
    assert_eq!(asked(&world.pass()), None);
}

#[test]
fn an_answer_to_another_attempt_is_none() {
    let mut world = World::evalai();
    let last = world.view.row.last.as_mut().unwrap();
    last.question.attempt = Attempt(2);
    let plan = world.pass();
    assert!(asked(&plan).is_some() && writes_nothing(&plan));
}

#[test]
fn only_evalai_hands_a_submission_to_two_programs_and_only_a_table_shows_it() {
    let mut without_table = World::evalai();
    without_table.leaderboard().table = None;
    for mut world in [World::local(), without_table] {
        world.view.row = Lookup::default();
        let plan = world.pass_to(Pending, Reason::Preparing);
        assert!(creates(&plan) && asked(&plan).is_none());
    }
}

#[test]
fn what_another_program_runs_waits_and_nothing_is_written_of_it() {
    let mut refused = held();
    // A refusal would end it, and the end would be written over the other program's.
    refused.leaderboard().agent.images = Some(vec![]);
    refused.submission().spec.image = Some("contents:1".into());
    let mut moved = held();
    moved.in_evalai().info.as_mut().unwrap().phase = Some(999);
    for mut world in [refused, moved] {
        for _ in 0..3 {
            let plan = world.pass_to(Pending, Reason::Foreign);
            assert!(writes_nothing(&plan) && !has(&plan, |a| *a == Action::SetFinalizer(true)));
            assert_eq!((asked(&plan), plan.slot()), (Some(&question(1)), SlotUse::Leaves));
            assert!(plan.status.plan.is_none() && plan.requeue.is_some());
            assert_eq!(condition(&plan, ACCEPTED), ("False".into(), Reason::Foreign.into()));
            let message = plan.status.message.unwrap();
            for part in [
                "RUNNING since 2026-11-20 10:00:00 UTC",
                "submission_status",
                names::ANNOTATION_ADOPT,
            ] {
                assert!(message.contains(part), "{message}");
            }
            world.wait(3600);
        }
    }
}

#[test]
fn when_the_other_run_has_ended_evalai_decides_what_follows() {
    let ended = || {
        let mut world = held();
        world.pass_to(Pending, Reason::Foreign);
        world.go_to(40);
        world.view.row = found(10, Ok(None));
        world.in_evalai().read_at = Some(at(29));
        world
    };
    // EvalAI's answer from before the row was read may be older than the end: EvalAI is asked anew.
    let mut world = ended();
    let plan = world.pass_to(Pending, Reason::Foreign);
    assert!(writes_nothing(&plan) && has(&plan, |a| *a == Action::Ask(Question::EvalaiAnew)));
    // Resumed there: the stored results are taken up.
    let mut world = ended();
    world.in_evalai().info.as_mut().unwrap().standing = Standing::Resumed;
    world.in_evalai().read_at = Some(at(30));
    assert!(creates(&world.pass_to(Pending, Reason::Preparing)));
    assert!(world.status().plan.unwrap().resume);
    // Ended there: nothing is run, and the other program's row and results stay.
    let mut world = ended();
    world.in_evalai().info = Some(EvalaiInfo {
        standing: Standing::Ended,
        status: Status::Finished,
        ..info()
    });
    let plan = world.pass_to(Cancelled, Reason::EndedInEvalAI);
    assert!(writes_nothing(&plan) && plan.status.plan.is_none());
    // A cancel in EvalAI has this effect before the row has ended, too.
    let mut world = ended();
    world.view.row = runs();
    world.in_evalai().cancelled = true;
    assert!(!creates(&world.pass_to(Cancelled, Reason::EndedInEvalAI)));
}

#[test]
fn a_person_hands_over_what_nothing_runs_any_more_and_it_takes_up_what_is_stored() {
    let mut world = held();
    world.pass_to(Pending, Reason::Foreign);
    adopt(&mut world, "false");
    world.pass_to(Pending, Reason::Foreign);
    adopt(&mut world, "true");
    let plan = world.pass_to(Pending, Reason::Preparing);
    assert!(creates(&plan) && asked(&plan).is_none());
    assert!(world.status().plan.unwrap().resume);
}

#[test]
fn nothing_starts_while_it_is_not_known_and_a_refusal_is_a_persons_to_fix() {
    for (is_refused, stalled) in [(true, "True"), (false, "False")] {
        let why = "table rows: GetItem is not allowed".to_owned();
        let mut world = World::evalai();
        world.view.row = found(0, Err(Failure { is_refused, why }));
        let plan = world.pass_to(Pending, Reason::Foreign);
        assert!(writes_nothing(&plan));
        assert_eq!(condition(&plan, STALLED).0, stalled);
        let message = plan.status.message.unwrap();
        assert!(
            message.contains("runs the submission: table rows: GetItem is not allowed."),
            "{message}"
        );
    }
}

#[test]
fn a_prefix_in_use_is_a_hold_and_no_end() {
    for world in [World::local(), World::evalai()] {
        let mut world = with_prefix_in_use(world.with_pod());
        let plan = world.pass_to(Pending, Reason::Foreign);
        assert!(writes_nothing(&plan) && has(&plan, |a| matches!(a, Action::DeleteJob { .. })));
        assert_eq!((plan.status.retry, plan.slot()), (0, SlotUse::Leaves));
        assert_eq!(condition(&plan, ACCEPTED), ("False".into(), Reason::Foreign.into()));
        assert_eq!(condition(&plan, STALLED).0, "True");
        assert!(plan.status.failure.is_none() && plan.status.job_name.is_none());
        assert!(plan.status.message.unwrap().contains(names::ANNOTATION_ADOPT));
        world.job().deleting = true;
        assert!(!has(&world.pass(), |a| matches!(a, Action::DeleteJob { .. })), "once");
        world.job_gone();
        for _ in 0..3 {
            world.wait(86_400);
            let before = world.status();
            let plan = world.pass_to(Pending, Reason::Foreign);
            assert!(writes_nothing(&plan) && plan.slot() == SlotUse::Leaves);
            assert_eq!(plan.status, before, "nothing is new");
        }
        adopt(&mut world, "true");
        let plan = world.pass_to(Pending, Reason::Preparing);
        assert!(creates(&plan) && plan.status.plan.unwrap().resume);
        assert_eq!(condition(&world.pass(), ACCEPTED).0, "True");
    }
}

#[test]
fn a_job_that_has_failed_by_a_prefix_in_use_is_held_back_too_and_a_higher_retry_takes_up_what_is_stored() {
    let mut world = with_prefix_in_use(World::evalai().with_pod());
    world.job().end = Some(JobEnd::Failed {
        at: Some(at(9)),
        reason: "BackoffLimitExceeded".into(),
        message: String::new(),
    });
    world.submission().status.as_mut().unwrap().retry = 1;
    world.job().name = "sub-1-r1".into();
    let plan = world.pass_to(Pending, Reason::Foreign);
    assert!(has(&plan, |a| matches!(a, Action::DeleteJob { .. })));
    // It is handed over before the Job is gone, whose name the next one has.
    adopt(&mut world, "true");
    assert!(!creates(&world.pass_to(Pending, Reason::Foreign)));
    world.job_gone();
    assert!(creates(&world.pass_to(Pending, Reason::Preparing)));
    let status = world.status();
    assert_eq!((status.retry, status.plan.unwrap().resume), (1, true));
}

#[test]
fn who_cancels_what_is_held_back_ends_it_and_nothing_is_written_of_it() {
    for reason in [Reason::Cancelled, Reason::Deleted, Reason::EndedInEvalAI] {
        let mut held_by_prefix = with_prefix_in_use(World::evalai().with_pod());
        held_by_prefix.pass_to(Pending, Reason::Foreign);
        held_by_prefix.job_gone();
        for mut world in [held(), held_by_prefix] {
            world.pass_to(Pending, Reason::Foreign);
            world.submission().spec.cancel = reason == Reason::Cancelled;
            world.in_evalai().cancelled = reason == Reason::EndedInEvalAI;
            if reason == Reason::Deleted {
                world.delete();
            }
            let plans = [world.pass_to(Cancelled, reason), world.pass()];
            for plan in &plans {
                assert!(writes_nothing(plan), "{reason}: {:?}", plan.actions);
            }
            for type_ in [PUBLISHED, RECORDED] {
                let shown = condition(&plans[1], type_);
                assert_eq!(shown, ("False".into(), Reason::NotRequired.into()), "{reason} {type_}");
            }
        }
    }
}
