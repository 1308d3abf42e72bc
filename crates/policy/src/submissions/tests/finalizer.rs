//! Which submissions hold up their deletion.

use super::builders::*;
use crate::submissions::Action;
use crate::view::{RecordView, Turn};

#[test]
fn a_finalizer_goes_on_first_where_another_system_has_to_get_the_end() {
    for (evalai, has_table, wanted) in [
        (false, false, false),
        (false, true, true),
        (true, false, true),
        (true, true, true),
    ] {
        let mut world = if evalai { World::evalai() } else { World::local() };
        world.submission().metadata.finalizers = None;
        world.view.record = has_table.then(RecordView::default);
        let plan = world.pass();
        assert!(creates(&plan));
        let is_first = plan.actions[0] == Action::SetFinalizer(true);
        assert_eq!(is_first, wanted, "EvalAI {evalai}, table {has_table}");
        assert_eq!(has(&plan, |a| *a == Action::SetFinalizer(true)), wanted);
    }
}

#[test]
fn a_finalizer_comes_with_the_first_job_or_with_a_later_table() {
    let mut world = World::local();
    world.submission().metadata.finalizers = None;
    let (position, eta) = (1, None);
    world.view.turn = Turn::Wait { position, eta };
    assert!(
        !has(&world.pass(), |a| *a == Action::SetFinalizer(true)),
        "nobody knows of it"
    );

    let mut world = World::local();
    world.submission().metadata.finalizers = None;
    world.view.record = None;
    let mut world = world.running();
    assert!(!has(&world.pass(), |a| *a == Action::SetFinalizer(true)));
    world.view.record = Some(RecordView::default());
    assert_eq!(world.pass().actions[0], Action::SetFinalizer(true));
}
