//! Ends over which the table keeps another row.

use super::builders::*;
use crate::controller::submissions::decide::{Action, Plan, TableUpdate};
use crate::controller::submissions::view::{EvalaiEnd, RecordView};
use leaderboard_api::State::{Cancelled, Finished};
use leaderboard_api::conditions::{self, RECORDED};
use leaderboard_api::reasons;

/// A run of EvalAI's that has finished, and of which no system has the end.
pub(super) fn finished() -> World {
    let mut world = World::evalai().running();
    world.complete();
    world.report(final_report());
    world.pass_to(Finished, reasons::FINISHED);
    world
}

/// The same after EvalAI has refused its result.
pub(super) fn refused() -> World {
    let mut world = finished();
    world.in_evalai().end = Some(EvalaiEnd::Refused {
        message: "it belongs to another phase".into(),
        is_due: false,
    });
    world
}

/// The table has not taken the row of this end.
fn supersede(world: &mut World) {
    world.view.record = Some(RecordView {
        is_superseded: true,
        error: Some("table rows already holds a later attempt or another end of submission 77".into()),
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
    let plan = world.pass_to(Finished, reasons::FINISHED);
    let shown = conditions::get(&plan.status.conditions, RECORDED).unwrap();
    assert_eq!(
        (shown.status.as_str(), shown.reason.as_str()),
        ("False", reasons::NOT_REQUIRED)
    );
    for part in ["a later attempt or another end", "Correct the row by hand"] {
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
    assert!(has(&world.pass(), |a| *a == Action::ReleaseFinalizer));
}

#[test]
fn a_cancel_in_evalai_after_a_refusal_is_written_over_the_end_that_the_table_kept() {
    for is_restarted in [false, true] {
        let mut world = refused();
        assert!(records(&world.pass()));
        supersede(&mut world);
        let plan = world.pass();
        assert_eq!(condition(&plan, RECORDED).1, reasons::NOT_REQUIRED);
        assert!(!records(&plan) && !has(&plan, |a| *a == Action::Forget));
        if is_restarted {
            world.view.record = Some(RecordView::default());
        }
        world.in_evalai().end = Some(EvalaiEnd::Ended {
            status: "cancelled".into(),
        });
        let plan = world.pass_to(Cancelled, reasons::ENDED_IN_EVALAI);
        assert!(records(&plan));
        assert_eq!(condition(&plan, RECORDED), ("False".into(), reasons::WAITING.into()));
        // The recorder has the new row.
        world.view.record = Some(RecordView::default());
        assert!(records(&world.pass()));
        world.recorded();
        let plan = world.pass();
        assert_eq!(condition(&plan, RECORDED).0, "True");
        assert!(has(&plan, |a| *a == Action::Forget));
    }
}
