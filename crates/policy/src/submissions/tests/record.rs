//! Ends over which the table keeps another row.

use super::builders::*;
use crate::submissions::{Action, EvalaiUpdate, Plan, TableUpdate};
use crate::view::{EvalaiEnd, EvalaiView, RecordView};
use leaderboard_api::Reason;
use leaderboard_api::State::{Cancelled, Finished};
use leaderboard_api::conditions::{self, RECORDED};
use leaderboard_api::evalai_status::Status;

/// A run of EvalAI's that has finished, and of which no system has the end.
pub(super) fn finished() -> World {
    let mut world = World::evalai().running();
    world.complete();
    world.report(final_report());
    let plan = world.pass_to(Finished, Reason::Finished);
    assert!(plan.events.is_empty(), "the event is that of its publication");
    world
}

/// Such a run after EvalAI has refused its result.
pub(super) fn refused() -> World {
    let mut world = finished();
    world.in_evalai().end = Some(EvalaiEnd::Refused {
        message: "it belongs to another phase".into(),
    });
    world
}

/// The table has not taken the row of this end.
fn supersede(world: &mut World) {
    world.view.record = Some(RecordView {
        superseded_by: Some(3),
        error: Some("table rows already holds attempt 3 of submission 77".into()),
        ..RecordView::default()
    });
}

fn records(plan: &Plan) -> bool {
    has(plan, |a| *a == Action::Record(TableUpdate::End))
}

#[test]
fn an_end_that_the_table_does_not_take_is_settled_and_not_written_again() {
    let mut world = finished();
    world.published();
    assert!(records(&world.pass()));
    supersede(&mut world);
    let plan = world.pass_to(Finished, Reason::Finished);
    let shown = conditions::get(&plan.status.conditions, RECORDED).unwrap();
    assert_eq!(
        (shown.status.as_str(), shown.reason.known().unwrap()),
        ("False", Reason::Superseded)
    );
    for part in ["of attempt 3", "Raise spec.attempt to 4", "Correct the row by hand"] {
        assert!(shown.message.contains(part), "{}", shown.message);
    }
    assert_eq!(plan.actions, [Action::Forget]);
    assert_eq!(plan.requeue, None);
    // The recorder has forgotten it; the condition remembers.
    world.view.evalai = None;
    world.view.record = Some(RecordView::default());
    let again = world.pass();
    assert_eq!((again.actions, again.status), (plan.actions, plan.status));
    world.delete();
    assert!(has(&world.pass(), |a| *a == Action::SetFinalizer(false)));
}

#[test]
fn a_cancel_in_evalai_after_a_refusal_is_written_over_the_end_that_the_table_kept() {
    for is_restarted in [false, true] {
        let mut world = refused();
        assert!(records(&world.pass()));
        supersede(&mut world);
        let plan = world.pass();
        assert_eq!(condition(&plan, RECORDED).1, Reason::Superseded);
        assert!(!records(&plan) && !has(&plan, |a| *a == Action::Forget));
        if is_restarted {
            world.view.record = Some(RecordView::default());
        }
        world.in_evalai().end = Some(EvalaiEnd::Ended(Status::Cancelled));
        let plan = world.pass_to(Cancelled, Reason::EndedInEvalAI);
        assert!(records(&plan));
        assert_eq!(condition(&plan, RECORDED), ("False".into(), Reason::Waiting.into()));
        // The recorder has the new row.
        world.view.record = Some(RecordView::default());
        assert!(records(&world.pass()));
        world.recorded();
        let plan = world.pass();
        assert_eq!(condition(&plan, RECORDED).0, "True");
        assert!(has(&plan, |a| *a == Action::Forget));
    }
}

#[test]
fn a_row_that_waits_for_evalai_says_so() {
    let mut world = finished();
    world.in_evalai().error = Some("EvalAI could not be reached".into());
    let shown = |plan: &Plan| {
        conditions::get(&plan.status.conditions, RECORDED)
            .unwrap()
            .message
            .to_string()
    };
    let plan = world.pass();
    assert!(shown(&plan).contains("when EvalAI has answered"), "{}", shown(&plan));
    world.published();
    let first = world.pass();
    assert!(records(&first));
    assert_eq!(shown(&first), shown(&plan), "it is shown with EvalAI's answer");
    world.wait(60);
    let plan = world.pass();
    assert_eq!(condition(&plan, conditions::PUBLISHED).0, "True");
    assert!(shown(&plan).contains("waits for the table"), "{}", shown(&plan));
}

#[test]
fn a_cancel_before_evalais_row_is_known_keeps_what_had_finished_there() {
    for is_deleted in [false, true] {
        let mut world = World::evalai();
        world.view.evalai = Some(EvalaiView::default());
        if is_deleted {
            world.delete();
        } else {
            world.submission().spec.cancel = true;
        }
        let reason = if is_deleted { Reason::Deleted } else { Reason::Cancelled };
        let plan = world.pass_to(Cancelled, reason);
        let asked = has(&plan, |a| *a == Action::UpdateEvalai(EvalaiUpdate::Cancelled));
        assert!(asked, "the row is read before anything is written");
        world.in_evalai().end = Some(EvalaiEnd::Ended(Status::Finished));
        let plan = world.pass_to(Cancelled, Reason::EndedInEvalAI);
        assert!(!has(&plan, |a| matches!(a, Action::UpdateEvalai(_))));
        let published = condition(&plan, conditions::PUBLISHED);
        assert_eq!(published, ("False".into(), Reason::NotRequired.into()));
        assert_eq!(has(&plan, |a| *a == Action::SetFinalizer(false)), is_deleted);
        assert_eq!(world.pass().status, plan.status, "once");
    }
}
