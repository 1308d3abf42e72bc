//! A higher attempt of a live submission: its run stops, and goes on in that attempt.

use super::builders::*;
use crate::submissions::{Action, EvalaiUpdate};
use crate::view::{JobEnd, ObservedNode, ObservedReport, Standing, Turn};
use leaderboard_api::State::{Cancelled, Finished, Pending, Resumed, Running};
use leaderboard_api::conditions::{FINISHED, PUBLISHED, RECORDED};
use leaderboard_api::{Attempt, JobNumber, Reason};
use leaderboard_contract::report::{RefusedResults, Report};
use leaderboard_contract::run::Stop;

/// A run of a Leaderboard that retries nothing; its second attempt is asked for at second 100.
fn restarted() -> World {
    let mut world = World::evalai().running();
    world.leaderboard().retries.infrastructure = 0;
    world.go_to(100);
    world.submission().spec.attempt = Attempt(2);
    world
}

/// The second attempt has begun, and no system has heard of an end.
#[track_caller]
fn assert_begins(world: &mut World) {
    let plan = world.pass_to(Pending, Reason::Replacing);
    assert_eq!((plan.status.attempt, plan.status.retry), (Some(Attempt(2)), 0));
    assert_eq!((&plan.status.failure, &plan.status.interruptions), (&None, &None));
    assert_eq!(
        (evalai_updates(&plan), condition(&plan, FINISHED).0),
        (vec![], "False".into())
    );
    assert_eq!(
        (condition(&plan, PUBLISHED).0, condition(&plan, RECORDED).0),
        Default::default()
    );
    assert!(!has(&plan, |action| matches!(action, Action::Record(_))));
    assert_eq!(plan.requeue, Some(std::time::Duration::ZERO));
    assert!(world.status().is_restart());
}

#[test]
fn a_run_stops_with_all_that_was_reached_and_waits_for_its_turn_in_the_higher_attempt() {
    let mut world = restarted();
    world.report(report(2));
    let plan = world.pass_to(Running, Reason::Replacing);
    assert_eq!(annotated(&plan), Some(Stop::Interruption));
    assert!(
        !has(&plan, |a| matches!(a, Action::DeleteJob { .. })),
        "it ends by itself"
    );
    let expected = "The run stops for attempt 2, which resumes from its results; they are being stored.";
    assert_eq!(plan.status.message.as_deref(), Some(expected));
    assert_eq!(evalai_updates(&plan), [], "EvalAI keeps saying running");
    assert_eq!((plan.status.attempt, plan.status.failure), (Some(Attempt(1)), None));
    world.pod().stop = Some(Stop::Interruption);
    world.go_to(120);
    world.complete();
    world.report(report(2));
    assert_begins(&mut world);
    assert_eq!(world.status().progress.unwrap().text, "2/4");

    world.job_gone();
    world.view.report.stored = ObservedReport::NotRead;
    world.view.turn = Turn::Paused { position: 1 };
    let plan = world.pass_to(Pending, Reason::Paused);
    assert!(!creates(&plan), "a host who upgrades nodes pauses the Leaderboard");
    assert_eq!(evalai_updates(&plan), [EvalaiUpdate::Queued]);
    world.view.turn = Turn::Go;
    let plan = world.pass();
    assert!(has(&plan, |a| *a == Action::CreateJob(JobNumber::first(Attempt(2)))));
    assert!(plan.status.plan.unwrap().resume);
    world.see_job();
    world.view.pod = Some(pod(200));
    world.see_agents();
    world.pass_to(Resumed, Reason::Resumed);
}

#[test]
fn a_pod_that_does_not_stop_has_the_time_of_a_cancel() {
    let mut world = restarted();
    world.pass();
    world.pod().stop = Some(Stop::Interruption);
    let seconds = world.leaderboard().deadlines.cancel_seconds;
    for (second, is_deleted) in [(100 + seconds, false), (100 + seconds + 15, true)] {
        world.go_to(second);
        let plan = world.pass_to(Running, Reason::Replacing);
        assert_eq!(
            has(&plan, |a| matches!(a, Action::DeleteJob { .. })),
            is_deleted,
            "{second}"
        );
    }
    world.job_gone();
    assert_begins(&mut world);
}

#[test]
fn what_else_ends_a_run_meanwhile_is_forgiven() {
    let mut crashes = restarted();
    crashes.pass();
    crashes.see(ended("agent-1", 3, "exited", 1, 110));
    // The failure was there before the request.
    let mut crashed = World::evalai().running();
    crashed.see(ended("agent-1", 3, "exited", 1, 100));
    crashed.pass_to(Running, Reason::Stopping);
    crashed.submission().spec.attempt = Attempt(2);
    let mut cancelled = World::evalai().running();
    cancelled.submission().spec.cancel = true;
    cancelled.pass_to(Running, Reason::Stopping);
    cancelled.submission().spec.cancel = false;
    cancelled.submission().spec.attempt = Attempt(2);
    for mut world in [crashes, crashed, cancelled] {
        world.complete();
        world.report(Report {
            is_final: true,
            refused: Some(RefusedResults::new(None, "nonsense")),
            stopped: Some(Stop::Interruption),
            ..report(2)
        });
        assert_begins(&mut world);
    }

    let mut lost = restarted();
    lost.pass();
    lost.view.node.state = ObservedNode::Gone;
    (lost.pod().deleted, lost.pod().delete_by) = (Some(at(100)), Some(at(101)));
    lost.go_to(200);
    lost.pass();
    lost.job_gone();
    assert_begins(&mut lost);
}

#[test]
fn a_run_that_comes_to_its_results_is_finished_for_good() {
    let mut world = restarted();
    world.pass();
    world.complete();
    world.report(final_report());
    let plan = world.pass_to(Finished, Reason::Finished);
    assert_eq!((plan.status.attempt, plan.status.retry), (Some(Attempt(1)), 0));
    assert_eq!(evalai_updates(&world.pass()), [EvalaiUpdate::Finished]);
    world.pass_to(Finished, Reason::Finished);

    // It had ended by itself, and only its Job is still there.
    let mut world = restarted();
    world.pod().run_ended = Some(at(99));
    world.view.report.stage = None;
    assert_eq!(annotated(&world.pass()), None);
    world.view.report.stage = Some(crate::view::Stage::RunEnded);
    world.report(final_report());
    world.pass_to(Finished, Reason::Finished);
}

#[test]
fn a_run_that_fails_by_itself_goes_on_in_the_higher_attempt() {
    let mut world = restarted();
    let pod = world.pod();
    pod.run_ended = Some(at(99));
    world.see(ended("agent-1", 3, "exited", 1, 99));
    world.pass();
    world.job().end = Some(JobEnd::Failed {
        at: Some(at(101)),
        reason: "BackoffLimitExceeded".into(),
        message: "no".into(),
    });
    world.report(report(2));
    assert_begins(&mut world);
}

#[test]
fn a_cancel_meanwhile_is_that_of_the_higher_attempt() {
    let asked: [(fn(&mut World), _); 3] = [
        (|world| world.submission().spec.cancel = true, Reason::Cancelled),
        (World::delete, Reason::Deleted),
        (|world| world.in_evalai().cancelled = true, Reason::EndedInEvalAI),
    ];
    for (ask, reason) in asked {
        let mut world = restarted();
        world.pass();
        ask(&mut world);
        world.pass_to(Running, Reason::Stopping);
        world.complete();
        assert_begins(&mut world);
        world.job_gone();
        let plan = world.pass_to(Cancelled, reason);
        assert!(!creates(&plan));
        assert_eq!(plan.status.attempt, Some(Attempt(2)));
        let kept = "between two tries; what it had reached is kept.";
        assert!(
            plan.status.message.as_ref().unwrap().ends_with(kept),
            "{:?}",
            plan.status.message
        );
    }
}

#[test]
fn what_has_no_job_begins_at_once() {
    let mut waits = World::local();
    waits.view.turn = Turn::Paused { position: 1 };
    waits.pass_to(Pending, Reason::Paused);
    // It would be tried again in some seconds.
    let mut tried = World::local().running();
    tried.leaderboard().retries.infrastructure = 1;
    tried.complete();
    assert!(
        tried
            .pass_to(Pending, Reason::Replacing)
            .status
            .next_retry_time
            .is_some()
    );
    tried.job_gone();
    assert!(!creates(&tried.pass()));
    for mut world in [waits, tried] {
        world.submission().spec.attempt = Attempt(2);
        let plan = world.pass_to(Pending, Reason::Preparing);
        assert_eq!((plan.status.attempt, plan.status.retry), (Some(Attempt(2)), 0));
        assert!(!plan.status.is_restart(), "nothing ran that goes on");
        world.view.turn = Turn::Go;
        let plan = world.pass();
        assert!(has(&plan, |a| *a == Action::CreateJob(JobNumber::first(Attempt(2)))));
    }
}

#[test]
fn what_evalai_has_ended_before_the_higher_attempt_is_known_stays_ended() {
    let mut world = restarted();
    world.pass();
    world.complete();
    assert_begins(&mut world);
    world.job_gone();
    world.in_evalai().info.as_mut().unwrap().standing = Standing::Ended;
    let plan = world.pass_to(Cancelled, Reason::EndedInEvalAI);
    assert!(!creates(&plan) && evalai_updates(&plan).is_empty());
}
