//! In line: slots, pauses, and the Leaderboard's changes before the first Job.

use super::builders::*;
use crate::slots::turns::{InLine, Turn};
use crate::submissions::{Action, EvalaiUpdate, SlotUse};
use crate::view::ObservedJob;
use leaderboard_api::State::{Cancelled, Pending};
use leaderboard_api::{Eta, Reason, SubmissionStatus, Waiting};

#[test]
fn who_waits_sees_place_and_time() {
    let mut world = World::local();
    let eta = Some(Eta::between(20 * 60, 35 * 60));
    world.view.turn = Turn::Wait { position: 3, eta };
    let plan = world.pass_to(Pending, Reason::WaitingForSlot);
    assert_eq!(plan.status.waiting.as_deref(), Some(&Waiting::new(3, eta)));
    assert!(!creates(&plan));

    let before = world.status();
    world.view.turn = Turn::Wait {
        position: 3,
        eta: Some(Eta::between(25 * 60, 40 * 60)),
    };
    assert_eq!(world.pass().status, before, "another estimate is not another write");

    let eta = Some(Eta::between(15 * 60, 25 * 60));
    world.view.turn = Turn::Wait { position: 2, eta };
    let plan = world.pass();
    assert_eq!(plan.status.waiting.as_deref(), Some(&Waiting::new(2, eta)));
    assert!(plan.events.is_empty(), "a step forward is no transition");

    world.view.turn = Turn::Paused { position: 2 };
    let plan = world.pass_to(Pending, Reason::Paused);
    assert_eq!(events(&plan), [Reason::Paused]);
    let place = Waiting::new(2, None);
    assert_eq!(
        plan.status.waiting.as_deref(),
        Some(&place),
        "nobody knows for how long"
    );

    world.view.turn = Turn::Go;
    let plan = world.pass_to(Pending, Reason::Preparing);
    assert!(creates(&plan));
    assert_eq!(plan.status.waiting, None);
}

#[test]
fn joining_the_line_shows_nothing_and_starts_nothing() {
    for mut world in [World::local(), World::evalai()] {
        world.view.turn = Turn::NotInLine;
        let created = world.view.submission.metadata.creation_timestamp.clone().unwrap().0;
        let is_evalais = world.view.submission.spec.evalai.is_some();
        let plan = world.pass();
        assert_eq!(
            plan.status,
            SubmissionStatus::default(),
            "its first place is worth a write, joining is not"
        );
        assert!(plan.events.is_empty() && !creates(&plan) && evalai_updates(&plan).is_empty());
        let place = InLine {
            uid: UID.into(),
            name: world.view.submission.metadata.name.clone().unwrap(),
            team: if is_evalais { "42" } else { "t1" }.into(),
            track: "sensors".into(),
            priority: 0,
            submitted: if is_evalais { at(-60) } else { created },
            is_check: false,
        };
        assert_eq!(plan.actions, [Action::JoinLine(place.clone())]);

        world.view.turn = Turn::Wait { position: 1, eta: None };
        let plan = world.pass_to(Pending, Reason::WaitingForSlot);
        assert!(
            plan.actions.contains(&Action::JoinLine(place.clone())),
            "it stays in line"
        );
        world.submission().spec.priority = 5;
        assert!(
            world
                .pass()
                .actions
                .contains(&Action::JoinLine(InLine { priority: 5, ..place }))
        );

        // After a takeover it joins anew, and keeps what it showed.
        let before = world.status();
        world.view.turn = Turn::NotInLine;
        assert_eq!(world.pass().status, before);
        world.view.turn = Turn::Go;
        assert!(creates(&world.pass_to(Pending, Reason::Preparing)));
    }
}

#[test]
fn a_slot_is_held_from_the_job_to_the_end_and_by_nobody_who_waits_for_something_else() {
    let mut world = World::local();
    world.view.turn = Turn::NotInLine;
    assert_eq!(world.pass().slot(), SlotUse::Waits);
    world.view.turn = Turn::Wait { position: 1, eta: None };
    assert_eq!(world.pass().slot(), SlotUse::Waits);
    world.view.is_policy_in_place = false;
    assert_eq!(world.pass().slot(), SlotUse::Leaves, "its policy is missing");
    world.view.is_policy_in_place = true;
    world.view.turn = Turn::Go;
    assert_eq!(world.pass().slot(), SlotUse::Holds, "its Job is created");

    let mut world = World::local().running();
    assert_eq!(world.pass().slot(), SlotUse::Holds);
    world.submission().spec.cancel = true;
    assert_eq!(world.pass().slot(), SlotUse::Holds, "its Pod stops");
    world.job_gone();
    world.pass_to(Cancelled, Reason::Cancelled);
    assert_eq!(world.pass().slot(), SlotUse::Leaves, "it has ended");
}

#[test]
fn who_waits_for_something_else_does_not_join() {
    let refused: [fn(&mut World); 4] = [
        |world| world.view.leaderboard = None,
        |world| world.view.is_policy_in_place = false,
        |world| world.in_evalai().info = None,
        |world| world.submission().spec.cancel = true,
    ];
    for refuse in refused {
        let mut world = World::evalai();
        world.view.turn = Turn::NotInLine;
        refuse(&mut world);
        assert!(!has(&world.pass(), |action| matches!(action, Action::JoinLine(_))));
    }
}

#[test]
fn who_waits_is_queued_in_evalai_so_that_a_cancel_there_is_heard() {
    for turn in [Turn::Wait { position: 1, eta: None }, Turn::Paused { position: 1 }] {
        let mut world = World::evalai();
        world.view.turn = turn;
        assert_eq!(evalai_updates(&world.pass()), [EvalaiUpdate::Queued]);
        world.in_evalai().cancelled = true;
        world.pass_to(Cancelled, Reason::EndedInEvalAI);
    }
}

#[test]
fn images_follow_the_leaderboard_until_the_job_is_made_and_the_rest_is_pinned() {
    let mut world = World::local();
    world.view.turn = Turn::Wait { position: 1, eta: None };
    world.pass();
    let carla = world.leaderboard().evaluation.carla_mut().unwrap();
    carla.simulator.image = "simulator:2".into();
    carla.pairs = 4;
    world.view.turn = Turn::Go;
    world.pass();
    let pinned = world.status().plan.unwrap();
    let carla = pinned.carla().unwrap();
    assert_eq!(carla.simulator_image, "simulator:2");
    assert_eq!(carla.slices.len(), 2);
}

#[test]
fn a_job_of_an_older_object_is_waited_for_and_never_taken() {
    let mut world = World::local();
    world.view.job = ObservedJob::Foreign;
    let plan = world.pass_to(Pending, Reason::JobNameTaken);
    assert!(!creates(&plan));
    world.view.job = ObservedJob::Absent { refused: None };
    assert!(creates(&world.pass_to(Pending, Reason::Preparing)));

    // Also when it was only seen after ours had been asked for: it is no deletion of ours then.
    world.view.job = ObservedJob::Foreign;
    world.pass_to(Pending, Reason::JobNameTaken);
    world.view.job = ObservedJob::Absent { refused: None };
    let plan = world.pass_to(Pending, Reason::Preparing);
    assert!(creates(&plan));
    assert_eq!(plan.status.recreated, 0);
}

#[test]
fn a_cancel_ends_the_wait_at_once() {
    let turns = [Turn::Wait { position: 1, eta: None }, Turn::Paused { position: 1 }];
    for turn in turns {
        let mut world = World::local();
        world.view.turn = turn;
        world.pass();
        world.submission().spec.cancel = true;
        let plan = world.pass_to(Cancelled, Reason::Cancelled);
        assert_eq!(plan.status.waiting, None);
        assert!(!creates(&plan));
    }
    let mut world = World::local();
    world.view.job = ObservedJob::Foreign;
    world.pass();
    world.submission().spec.cancel = true;
    world.pass_to(Cancelled, Reason::Cancelled);
}

#[test]
fn a_job_that_is_slow_to_show_is_asked_for_again_without_counting() {
    let mut world = World::local();
    for _ in 0..10 {
        let plan = world.pass_to(Pending, Reason::Preparing);
        assert!(creates(&plan));
        assert_eq!(plan.status.recreated, 0);
    }
}
