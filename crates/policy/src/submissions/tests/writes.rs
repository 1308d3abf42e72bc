//! When a changed status is written, and what memory and nodes a plan asks for.

use std::time::Duration;

use super::builders::*;
use crate::slots::turns::Turn;
use crate::submissions::{Action, EvalaiUpdate, StatusWrite, TableUpdate};

#[test]
fn progress_waits_since_the_last_write_and_what_matters_does_not() {
    let running = || {
        let mut world = World::local().running();
        world.report(report(1));
        world.pass();
        world.report(report(2));
        world
    };
    for (written_ago, expected) in [
        (None, StatusWrite::Now),
        (Some(5), StatusWrite::NotNow),
        (Some(29), StatusWrite::NotNow),
        (Some(31), StatusWrite::Now),
    ] {
        let mut world = running();
        world.view.written_ago = written_ago.map(Duration::from_secs);
        let plan = world.pass();
        assert_eq!(plan.write, expected, "{written_ago:?}");
        if expected == StatusWrite::NotNow {
            let left = Duration::from_secs(30 - written_ago.unwrap());
            assert!(plan.requeue.is_some_and(|at| at <= left), "{:?}", plan.requeue);
        }
        assert_eq!(world.pass().write, StatusWrite::NotNow, "nothing is new");
    }
    let mut world = running();
    world.view.written_ago = Some(Duration::from_secs(1));
    world.submission().spec.cancel = true;
    assert_eq!(world.pass().write, StatusWrite::Now);
}

#[test]
fn a_place_far_back_is_written_in_its_turn() {
    for (position, expected) in [(20, StatusWrite::Now), (21, StatusWrite::InTurn)] {
        let mut world = World::local();
        let at = |position| Turn::Wait { position, eta: None };
        world.view.turn = at(position + 100);
        assert_eq!(world.pass().write, StatusWrite::Now, "its first place");
        world.view.turn = at(position);
        assert_eq!(world.pass().write, expected, "{position}");
    }
}

#[test]
fn a_partial_result_has_metrics_where_its_phase_shows_them() {
    for is_shown in [false, true] {
        let mut world = World::evalai().running();
        world.in_evalai().shows_partial = is_shown;
        world.report(report(1));
        assert!(evalai_updates(&world.pass()).contains(&EvalaiUpdate::Partial { is_shown }));
    }
}

#[test]
fn only_of_a_team_is_there_a_row() {
    for has_team in [true, false] {
        let mut world = World::local();
        world.submission().metadata.finalizers = None;
        world.submission().spec.team.take_if(|_| !has_team);
        assert_eq!(has(&world.pass(), |a| *a == Action::SetFinalizer(true)), has_team);
        let mut world = world.running();
        let updates = |world: &mut World| -> Vec<TableUpdate> {
            let actions = world.pass().actions.into_iter();
            let of = |action| match action {
                Action::Record(update) => Some(update),
                _ => None,
            };
            actions.filter_map(of).collect()
        };
        let of = |update| has_team.then_some(update).into_iter().collect::<Vec<_>>();
        assert_eq!(updates(&mut world), of(TableUpdate::Progress));
        world.submission().spec.cancel = true;
        world.pass();
        world.complete();
        assert_eq!(updates(&mut world), of(TableUpdate::End));
    }
}
