//! Jobs that Kueue or a person suspends, before their first Pod and in mid-run.

use std::time::Duration;

use super::builders::*;
use crate::submissions::Action;
use crate::view::{PodView, Suspension};
use leaderboard_api::Reason;
use leaderboard_api::State::{Cancelled, Finished, Pending, Running};
use leaderboard_api::conditions::{RUNNING, STALLED};

/// How long a run may take.
const LIMIT: i64 = 3600;

#[allow(clippy::unnecessary_wraps, reason = "the field of a Job is optional")]
fn suspended(since: i64, queue: Option<&str>) -> Option<Box<Suspension>> {
    Some(Box::new(Suspension {
        since: Some(at(since)),
        queue: queue.map(Into::into),
    }))
}

/// A run that may take `LIMIT` seconds and is retried after no failure. The Job is suspended at second 90, and the Pod is ending.
fn suspended_in_mid_run() -> World {
    let mut world = World::evalai().running();
    world.leaderboard().deadlines.run_seconds = Some(LIMIT);
    world.leaderboard().retries.infrastructure = 0;
    world.job().started = Some(at(0));
    world.go_to(100);
    world.job().suspension = suspended(90, Some("gpus"));
    (world.job().started, world.pod().deleted, world.pod().delete_by) = (None, Some(at(90)), Some(at(690)));
    world
}

fn resume(world: &mut World, second: i64) {
    world.job().suspension = None;
    world.job().started = Some(at(second));
    world.go_to(second);
}

/// The Pod of a Job that is resumed runs ten seconds later.
fn runs_again(world: &mut World, second: i64) {
    world.view.pod = Some(PodView {
        uid: "pod-2".into(),
        created: Some(at(second)),
        ..pod(second)
    });
    world.see_agents();
    world.pod().agent_started = Some(at(second + 10));
    world.go_to(second + 10);
    world.pass_to(Running, Reason::Running);
}

fn stalled(world: &World) -> bool {
    world.status().is_true(STALLED)
}

#[test]
fn a_queue_that_admits_the_job_at_once_costs_no_write() {
    let mut world = World::local().with_job();
    let before = world.status();
    world.job().suspension = suspended(0, Some("gpus"));
    world.go_to(4);
    let plan = world.pass_to(Pending, Reason::Preparing);
    assert_eq!(plan.status, before);
    assert!(plan.requeue.unwrap() < Duration::from_secs(2));
}

#[test]
fn a_job_that_waits_for_its_queue_is_pending_and_meets_no_deadline() {
    let mut world = World::evalai().with_job();
    world.leaderboard().deadlines.schedule_seconds = Some(300);
    world.job().suspension = suspended(0, Some("gpus"));
    for second in [5, 301, 100_000] {
        world.go_to(second);
        let plan = world.pass_to(Pending, Reason::Suspended);
        let message = plan.status.message.unwrap();
        assert!(message.contains("LocalQueue gpus"), "{message}");
        assert!(plan.status.failure.is_none() && !stalled(&world), "{second}");
    }
    assert!(world.status().has_slot(), "it may be resumed at any moment");

    resume(&mut world, 100_000);
    world.pass_to(Pending, Reason::Preparing);
    // Its deadline begins with the resume.
    world.view.pod = Some(PodView {
        node: None,
        scheduled: None,
        unschedulable: Some("0/1 nodes are available.".into()),
        ..pod(0)
    });
    for (second, reason) in [(100_299, Reason::Unschedulable), (100_300, Reason::Stopping)] {
        world.go_to(second);
        world.pass_to(Pending, reason);
    }
    assert_eq!(world.status().failure.unwrap().reason, Reason::ScheduleDeadline);
}

#[test]
fn a_pod_is_missed_only_so_long_after_the_resume() {
    let mut world = World::local().with_job();
    world.job().suspension = suspended(0, None);
    world.go_to(1000);
    world.pass_to(Pending, Reason::Suspended);
    resume(&mut world, 1000);
    world.go_to(1044);
    world.pass_to(Pending, Reason::Preparing);
    assert!(!stalled(&world));
    world.go_to(1045);
    world.pass_to(Pending, Reason::Preparing);
    assert!(stalled(&world), "no event explains why there is no Pod");
}

#[test]
fn a_suspension_in_mid_run_takes_no_time_and_no_retry() {
    let mut world = suspended_in_mid_run();
    // The Pod has its grace, and longer.
    for second in [100, 820, 10_000] {
        world.go_to(second);
        let plan = world.pass_to(Running, Reason::Suspended);
        let ends = |a: &Action| {
            matches!(
                a,
                Action::DeleteJob { .. } | Action::DeletePod { .. } | Action::TakeOwnership | Action::StopPod { .. }
            )
        };
        assert!(!has(&plan, ends), "{second}: {:?}", plan.actions);
        let running = plan.status.condition(RUNNING).unwrap();
        assert_eq!((running.is_true(), running.last_transition_time.0), (false, at(90)));
    }
    world.view.pod = None;
    world.go_to(90_000);
    world.pass_to(Running, Reason::Suspended);

    resume(&mut world, 90_000);
    let message = world.pass_to(Running, Reason::Replacing).status.message.unwrap();
    assert!(message.starts_with("The Job was suspended"), "{message}");
    runs_again(&mut world, 90_000);
    let status = world.status();
    assert_eq!((status.retry, status.recreated, status.failure), (0, 0, None));
    assert_eq!((status.interruptions, status.ran_seconds), (None, 80));
    assert!(status.workers.iter().all(|worker| worker.crashes == 0));
    // It had run from second 10 to second 90.
    world.go_to(90_010 + LIMIT - 80 - 1);
    world.pass_to(Running, Reason::Running);
    world.go_to(90_010 + LIMIT - 80);
    let failure = world.pass_to(Running, Reason::Stopping).status.failure.unwrap();
    assert_eq!(failure.reason, Reason::TimeLimit);
}

#[test]
fn a_controller_that_was_away_counts_from_the_suspension_too() {
    let mut world = suspended_in_mid_run();
    world.view.pod = None;
    // No reconcile runs for longer than the run may take.
    world.go_to(50_000);
    world.pass_to(Running, Reason::Suspended);
    resume(&mut world, 50_010);
    runs_again(&mut world, 50_010);
    assert_eq!(world.status().ran_seconds, 80);
}

#[test]
fn evalai_keeps_what_it_shows() {
    let mut world = suspended_in_mid_run();
    let plan = world.pass_to(Running, Reason::Suspended);
    let expected = [crate::submissions::EvalaiUpdate::Running];
    assert_eq!(evalai_updates(&plan), expected);
}

#[test]
fn a_suspended_job_is_stopped_like_any_other() {
    let mut world = suspended_in_mid_run();
    world.view.pod = None;
    world.pass_to(Running, Reason::Suspended);
    world.submission().spec.cancel = true;
    let plan = world.pass_to(Running, Reason::Stopping);
    assert!(has(&plan, |a| matches!(a, Action::DeleteJob { .. })));
    world.job_gone();
    world.pass_to(Cancelled, Reason::Cancelled);
}

#[test]
fn results_that_were_complete_before_the_suspension_count() {
    let mut world = suspended_in_mid_run();
    world.pod().run_ended = Some(at(95));
    world.report(final_report());
    world.pass_to(Finished, Reason::Finished);
}

#[test]
fn a_suspension_without_a_queue_calls_for_a_person_after_a_while() {
    let mut world = World::local().with_job();
    world.job().suspension = suspended(0, None);
    for (second, stalls) in [(5, false), (904, false), (905, true)] {
        world.go_to(second);
        let plan = world.pass_to(Pending, Reason::Suspended);
        assert_eq!(stalled(&world), stalls, "{second}");
        assert!(plan.status.message.unwrap().contains("--show-managed-fields"));
    }
}
