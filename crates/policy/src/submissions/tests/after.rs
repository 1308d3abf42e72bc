//! After the end: EvalAI, the table, the Job's time to live.

use std::time::Duration;

use jiff::SignedDuration;

use super::builders::*;
use super::record::{finished, refused};
use crate::submissions::{Action, EvalaiUpdate, Plan, TableUpdate};
use crate::view::{EvalaiEnd, ObservedReport};
use leaderboard_api::Reason;
use leaderboard_api::State::{Cancelled, Failed, Finished};
use leaderboard_api::conditions::{self, PUBLISHED, RECORDED};
use leaderboard_api::evalai_status::Status;

fn failed() -> World {
    let mut world = World::evalai().running();
    world.see(ended("agent-1", 3, "exited", 1, 100));
    world.pass();
    world.complete();
    world.pass_to(Failed, Reason::AgentCrashed);
    world
}

const PUBLISHED_AS: &str = "EvalAI has the result: 4 of 4 routes, Driving score 43.13.";

#[test]
fn evalai_first_then_the_table_then_rest() {
    // A failure has had its event at once.
    for (mut world, state, update, told) in [
        (finished(), Finished, EvalaiUpdate::Finished, vec![Reason::Published]),
        (failed(), Failed, EvalaiUpdate::Failed, Vec::new()),
    ] {
        let mut plan = world.pass();
        plan.actions.retain(|a| !matches!(a, Action::KeepLog { .. }));
        assert_eq!(plan.actions, [Action::UpdateEvalai(update)]);
        assert_eq!(condition(&plan, PUBLISHED), ("False".into(), Reason::Waiting.into()));
        let before = world.status();
        world.published();
        let plan = world.pass();
        assert_eq!(plan.status, before, "both answers are one write");
        assert_eq!(plan.actions, [Action::Record(TableUpdate::End)]);
        world.recorded();
        let plan = world.pass();
        assert_eq!(condition(&plan, PUBLISHED).0, "True");
        assert_eq!(condition(&plan, RECORDED).0, "True");
        assert_eq!(events(&plan), told);
        assert!(plan.events.iter().all(|event| event.message == PUBLISHED_AS));
        assert_eq!(
            (plan.actions.as_slice(), plan.requeue),
            ([Action::Forget].as_slice(), None)
        );
        // The services have forgotten; the conditions remember.
        world.view.evalai = None;
        world.view.record = Some(crate::view::RecordView::default());
        let plan = world.pass();
        assert_eq!(
            (plan.status.state, plan.actions.as_slice()),
            (Some(state), [Action::Forget].as_slice())
        );
    }
}

#[test]
fn evalais_answer_is_shown_after_ten_seconds_without_the_tables() {
    let mut world = finished();
    world.published();
    let plan = world.pass();
    assert_eq!(condition(&plan, PUBLISHED).0, "False");
    assert!(plan.requeue.is_some_and(|wait| wait <= Duration::from_secs(11)));
    world.wait(9);
    assert_eq!(condition(&world.pass(), PUBLISHED).0, "False");
    world.wait(1);
    let plan = world.pass();
    assert_eq!(condition(&plan, PUBLISHED).0, "True");
    assert_eq!(condition(&plan, RECORDED).0, "False");
    assert!(plan.status.times.published.is_some());
}

#[test]
fn a_job_goes_early_only_by_the_hosts_choice_and_when_all_have_its_end() {
    let deletes = |plan: &Plan| has(plan, |a| matches!(a, Action::DeleteJob { .. }));
    let mut world = World::local().running();
    world.leaderboard().ttl_seconds_after_finished = 600;
    world.complete();
    world.report(final_report());
    world.pass_to(Finished, Reason::Finished);
    world.wait(600);
    assert!(!deletes(&world.pass()), "the table has no end yet");
    let mut late = world.clone();
    late.recorded();
    assert!(deletes(&late.pass()));
    late.job().deleting = true;
    assert!(!deletes(&late.pass()));
    late.job_gone();
    assert_eq!(late.pass().requeue, None);

    world.wait(-1);
    world.recorded();
    let plan = world.pass();
    assert!(!deletes(&plan));
    assert!(plan.requeue.is_some_and(|wait| wait <= Duration::from_secs(2)));

    world.leaderboard().ttl_seconds_after_finished = 7 * 86_400;
    world.wait(30 * 86_400);
    let plan = world.pass();
    assert!(!deletes(&plan), "Kubernetes does it");
    assert_eq!(plan.requeue, None);
}

#[test]
fn an_end_whose_result_cannot_be_read_shows_why_it_waits() {
    let mut world = finished();
    world.view.report.stored = ObservedReport::Unreadable("the bucket results did not answer in time".into());
    let told = |plan: &Plan, type_: &str| {
        let condition = conditions::get(&plan.status.conditions, type_).unwrap();
        (condition.reason.clone(), condition.message.to_string())
    };
    let waits = (
        Reason::Unread.into(),
        "The stored result cannot be read: the bucket results did not answer in time. It is published when it can; look at the bucket."
            .to_owned(),
    );
    assert_eq!(told(&world.pass(), PUBLISHED), waits);
    world.view.report.stored = ObservedReport::Unreadable("request 2 timed out".into());
    assert_eq!(
        told(&world.pass(), PUBLISHED),
        waits,
        "another text is not another write"
    );
    world.view.report.stored = ObservedReport::Unreadable("the bucket results did not answer in time".into());
    world.published();
    assert_eq!(told(&world.pass(), RECORDED), waits);
    world.report(final_report());
    let (reason, message) = told(&world.pass(), RECORDED);
    assert_eq!(reason, Reason::Waiting);
    assert!(message.starts_with("The table's row is written when"), "{message}");
}

#[test]
fn a_cancel_that_our_own_write_may_have_undone_is_sent_again() {
    let mut world = World::evalai().running();
    (world.in_evalai().cancelled, world.in_evalai().overtaken) = (true, true);
    world.pass();
    world.job_gone();
    world.view.report.stored = ObservedReport::Absent;
    let plan = world.pass_to(Cancelled, Reason::EndedInEvalAI);
    assert_eq!(evalai_updates(&plan), [EvalaiUpdate::Cancelled]);
    assert_eq!(
        condition(&plan, PUBLISHED),
        ("False".into(), Reason::ConcurrentUpdate.into())
    );
    // Also by a controller that has seen nothing of it.
    world.in_evalai().overtaken = false;
    assert_eq!(evalai_updates(&world.pass()), [EvalaiUpdate::Cancelled]);
    world.published();
    world.recorded();
    let plan = world.pass_to(Cancelled, Reason::EndedInEvalAI);
    assert_eq!(
        (evalai_updates(&plan), condition(&plan, PUBLISHED).0),
        (vec![], "True".into())
    );
}

#[test]
fn evalais_end_wins_until_ours_is_answered_and_not_after() {
    for mut world in [finished(), failed()] {
        world.in_evalai().end = Some(EvalaiEnd::Ended(Status::Cancelled));
        let plan = world.pass_to(Cancelled, Reason::EndedInEvalAI);
        assert_eq!(
            condition(&plan, PUBLISHED),
            ("False".into(), Reason::NotRequired.into())
        );
        assert_eq!(evalai_updates(&plan), []);
        world.recorded();
        world.pass();
        world.view.evalai = None;
        assert_eq!(
            evalai_updates(&world.pass()),
            [],
            "also when EvalAI's word is forgotten"
        );
    }
    let mut world = finished();
    world.published();
    world.recorded();
    world.pass();
    world.in_evalai().end = Some(EvalaiEnd::Ended(Status::Cancelled));
    world.pass_to(Finished, Reason::Finished);
}

#[test]
fn a_cancelled_one_that_evalai_ended_too_is_sent_once() {
    let mut world = World::evalai();
    world.submission().spec.cancel = true;
    assert_eq!(
        evalai_updates(&world.pass_to(Cancelled, Reason::Cancelled)),
        [EvalaiUpdate::Cancelled]
    );
    world.in_evalai().end = Some(EvalaiEnd::Ended(Status::Cancelled));
    world.pass();
    world.recorded();
    world.pass();
    world.view.evalai = None;
    assert_eq!(evalai_updates(&world.pass_to(Cancelled, Reason::Cancelled)), []);
}

#[test]
fn a_refused_result_is_shown_once_and_does_not_hold_up_the_row() {
    let mut world = finished();
    world.in_evalai().end = Some(EvalaiEnd::Refused {
        message: "metric x is unknown".into(),
    });
    let plan = world.pass();
    assert_eq!(condition(&plan, PUBLISHED), ("False".into(), Reason::Refused.into()));
    assert_eq!(events(&plan), [Reason::Refused]);
    assert!(has(&plan, |a| *a == Action::Record(TableUpdate::End)));
    assert!(world.pass().events.is_empty());
    world.recorded();
    let plan = world.pass();
    assert!(plan.requeue.is_some() && !has(&plan, |a| *a == Action::Forget));
}

#[test]
fn a_cancel_in_evalai_after_a_refusal_reaches_the_row_too() {
    for is_shown in [true, false] {
        let mut world = refused();
        world.pass();
        world.recorded();
        if is_shown {
            world.pass();
        }
        world.in_evalai().end = Some(EvalaiEnd::Ended(Status::Cancelled));
        let plan = world.pass_to(Cancelled, Reason::EndedInEvalAI);
        assert!(
            has(&plan, |a| *a == Action::Record(TableUpdate::End)),
            "the row said FINISHED"
        );
        assert_eq!(condition(&plan, RECORDED), ("False".into(), Reason::Waiting.into()));
        assert!(!has(&plan, |a| *a == Action::Forget));
        // The row that was handed in is not the written one.
        world.view.record.as_mut().unwrap().end_written = false;
        assert!(has(&world.pass(), |a| *a == Action::Record(TableUpdate::End)));
        world.recorded();
        let plan = world.pass();
        assert_eq!(condition(&plan, RECORDED).0, "True");
        assert!(has(&plan, |a| *a == Action::Forget));
    }
}

#[test]
fn an_outage_is_shown_and_waited_for() {
    let mut world = finished();
    world.in_evalai().error = Some("502 Bad Gateway".into());
    let plan = world.pass();
    assert_eq!(evalai_updates(&plan), [EvalaiUpdate::Finished]);
    let shown = leaderboard_api::conditions::get(&plan.status.conditions, PUBLISHED).unwrap();
    assert_eq!(shown.message, "The last request failed: 502 Bad Gateway.");

    world.published();
    world.view.record.as_mut().unwrap().error = Some("AccessDenied".into());
    let plan = world.pass();
    assert_eq!(condition(&plan, RECORDED), ("False".into(), Reason::Refused.into()));
    assert_eq!(plan.status.state, Some(Finished));
    world.recorded();
    assert_eq!(condition(&world.pass(), RECORDED).0, "True");
}

#[test]
fn what_is_not_wanted_is_not_waited_for() {
    let mut world = World::local().running();
    world.view.record = None;
    world.complete();
    world.report(final_report());
    let plan = world.pass_to(Finished, Reason::Finished);
    assert_eq!(condition(&plan, PUBLISHED).1, Reason::NotRequired);
    assert_eq!(condition(&plan, RECORDED).1, Reason::NotRequired);
    assert_eq!(plan.requeue, None);

    let mut world = World::local();
    world.submission().spec.team = None;
    let mut world = world.running();
    world.complete();
    world.report(final_report());
    let plan = world.pass_to(Finished, Reason::Finished);
    let shown = leaderboard_api::conditions::get(&plan.status.conditions, RECORDED).unwrap();
    assert!(shown.message.contains("spec.team.id"));
}

#[test]
fn a_leaderboard_that_is_gone_wants_what_it_wanted() {
    let mut world = finished();
    world.view.leaderboard = None;
    world.view.evalai = None;
    world.view.record = None;
    let plan = world.pass();
    assert_eq!(
        condition(&plan, PUBLISHED),
        ("False".into(), Reason::LeaderboardNotFound.into())
    );
    assert!(plan.requeue.is_some() && evalai_updates(&plan).is_empty());

    // A submission that never ran under it needs nothing from it.
    let mut world = World::evalai();
    world.view.leaderboard = None;
    world.pass();
    world.delete();
    assert!(has(&world.pass_to(Cancelled, Reason::Deleted), |a| *a
        == Action::SetFinalizer(false)));
}

#[test]
fn a_result_that_evalai_cancels_later_is_shown_as_cancelled_there_and_stays() {
    let mut world = finished();
    world.published();
    world.recorded();
    world.pass();
    world.view.evalai = None;
    let before = world.pass().status;
    let listed = world.view.now;
    world.in_evalai().cancelled_as_of = Some(listed);
    let plan = world.pass();
    assert_eq!(
        condition(&plan, PUBLISHED).0,
        "True",
        "the list may be older than the result"
    );
    assert!(plan.requeue.is_some(), "the next list decides");
    world.in_evalai().cancelled_as_of = listed.checked_add(SignedDuration::from_secs(2)).ok();
    let plan = world.pass();
    assert_eq!(
        condition(&plan, PUBLISHED),
        ("False".into(), Reason::CancelledInEvalAI.into())
    );
    assert_eq!(condition(&plan, RECORDED).0, "True");
    assert_eq!(
        (plan.actions, plan.events.len(), plan.requeue),
        (vec![Action::Forget], 0, None)
    );
    assert_eq!(
        (
            plan.status.state,
            plan.status.reason,
            plan.status.message,
            plan.status.score
        ),
        (before.state, before.reason, before.message, before.score)
    );

    // The list of later shows it no more, or the controller has begun anew.
    world.view.evalai = None;
    let plan = world.pass();
    assert_eq!(condition(&plan, PUBLISHED).1, Reason::CancelledInEvalAI);
    assert_eq!(plan.actions, [Action::Forget], "nothing is sent again");
}

#[test]
fn a_failure_that_evalai_cancels_later_stays_published() {
    let mut world = failed();
    world.published();
    world.recorded();
    world.pass();
    world.view.evalai = None;
    let later = world.view.now.checked_add(SignedDuration::from_secs(2)).ok();
    world.in_evalai().cancelled_as_of = later;
    assert_eq!(condition(&world.pass(), PUBLISHED).0, "True");
}

#[test]
fn an_end_shows_until_when_it_waits_for_the_controller_before() {
    let mut world = finished();
    let until = world.view.now.checked_add(SignedDuration::from_secs(20)).unwrap();
    world.in_evalai().writes_from = Some(until);
    let plan = world.pass();
    let shown = conditions::get(&plan.status.conditions, PUBLISHED).unwrap();
    assert_eq!(shown.reason, Reason::WaitingForPreviousController);
    let until = until.strftime("%H:%M:%S").to_string();
    assert!(
        shown.message.contains(&format!("before {until} UTC")),
        "{}",
        shown.message
    );
    assert_eq!(
        evalai_updates(&plan),
        [EvalaiUpdate::Finished],
        "it is the first to be sent then"
    );
    assert!(plan.requeue.unwrap() <= std::time::Duration::from_secs(21));
    world.in_evalai().writes_from = None;
    assert_eq!(
        condition(&world.pass(), PUBLISHED),
        ("False".into(), Reason::Waiting.into())
    );
}

#[test]
fn a_row_that_has_gone_to_another_team_is_shown_with_its_end() {
    let mut world = finished();
    world.in_evalai().team_id = Some("42".into());
    let mut same = world.clone();
    same.published();
    same.recorded();
    assert_eq!(events(&same.pass()), [Reason::Published]);

    world.in_evalai().team_id = Some("43".into());
    world.published();
    world.recorded();
    let plan = world.pass();
    assert_eq!(events(&plan), [Reason::TeamDiffers, Reason::Published]);
    let shown = conditions::get(&plan.status.conditions, PUBLISHED).unwrap();
    assert!(
        shown.message.contains("team 43") && shown.message.contains("team 42"),
        "{}",
        shown.message
    );
}

#[test]
fn the_team_is_that_of_the_acceptance() {
    let mut world = World::evalai();
    let (position, eta) = (1, None);
    world.view.turn = crate::view::Turn::Wait { position, eta };
    world.pass();
    let info = world.in_evalai().info.as_mut().unwrap();
    (info.team_id, info.team_name) = ("43".into(), Some("Other".into()));
    let team = world.pass().status.team.unwrap();
    assert_eq!((team.id.as_deref(), team.name.as_deref()), (Some("42"), Some("Team")));
}
