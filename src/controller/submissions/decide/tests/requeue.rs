//! A host puts submissions back in line: runs, those that wait, and those that have failed.

use super::builders::*;
use crate::controller::submissions::decide::Action;
use crate::controller::submissions::view::{ObservedReport, Turn};
use crate::pod::run::Stop;
use leaderboard_api::State::{Cancelled, Failed, Finished, Pending, Running};
use leaderboard_api::{Attempt, JobNumber, reasons};

const WHY: &str = "Simulator image 0.9.15-3 was broken";

/// A run that is asked to stop at second 100, of a Leaderboard that retries nothing.
fn requeued() -> World {
    let mut world = World::evalai().running();
    world.leaderboard().retries.infrastructure = 0;
    world.go_to(100);
    world.requeue(Some(WHY));
    world
}

#[test]
fn a_run_stops_with_all_that_was_reached_and_waits_for_its_turn_in_the_same_attempt() {
    let mut world = requeued();
    let plan = world.pass_to(Running, reasons::REPLACING);
    assert_eq!(annotated(&plan), Some(Stop::Cancel));
    assert_eq!(
        plan.status.message.as_deref(),
        Some(
            "A host has requeued the submission: Simulator image 0.9.15-3 was broken. Its results are being stored; a new Job resumes \
             from them."
        )
    );
    assert_eq!(evalai_updates(&plan), [], "EvalAI keeps saying running");
    assert_eq!(plan.status.requeued, None, "it is not carried out yet");
    world.pod().stop = Some(Stop::Cancel);
    world.go_to(120);
    world.complete();
    let plan = world.pass_to(Pending, reasons::REPLACING);
    assert_eq!((plan.status.attempt, plan.status.retry), (Some(Attempt(1)), 1));
    assert_eq!((plan.status.failure, plan.status.interruptions), (None, None));
    let done = plan.status.requeued.unwrap();
    assert_eq!((done.number, done.retries, done.time.0), (1, 1, at(120)));
    world.job_gone();
    world.view.turn = Turn::Paused { position: 1 };
    let plan = world.pass_to(Pending, reasons::PAUSED);
    assert!(!creates(&plan), "a host who upgrades nodes pauses the Leaderboard");
    world.view.turn = Turn::Go;
    let plan = world.pass();
    assert!(has(&plan, |a| *a
        == Action::CreateJob(JobNumber {
            attempt: Attempt(1),
            retry: 1
        })));
}

#[test]
fn a_request_is_carried_out_once_and_costs_no_retry() {
    let mut world = requeued();
    world.leaderboard().retries.infrastructure = 1;
    world.pass();
    world.complete();
    world.pass_to(Pending, reasons::REPLACING);
    world.job_gone();
    assert!(creates(&world.pass()));
    world.see_job();
    world.view.pod = Some(pod(200));
    world.see_agents();
    world.pass_to(Running, reasons::RUNNING);
    world.view.report = ObservedReport::Absent;
    world.complete();
    let plan = world.pass_to(Pending, reasons::REPLACING);
    let message = plan.status.message.unwrap();
    assert!(
        message.contains("The submission is tried again in 10 s"),
        "the first of its kind: {message}"
    );
    assert_eq!(plan.status.retry, 2);
}

#[test]
fn what_ends_a_run_while_it_stops_is_forgiven_and_a_result_counts() {
    let mut world = requeued();
    world.pass();
    world.see(ended("agent-1", 3, "exited", 1, 110));
    world.complete();
    world.pass_to(Pending, reasons::REPLACING);

    // The failure was there before the request.
    let mut world = World::evalai().running();
    world.see(ended("agent-1", 3, "exited", 1, 100));
    world.pass_to(Running, reasons::STOPPING);
    world.requeue(None);
    world.complete();
    let status = world.pass_to(Pending, reasons::REPLACING).status;
    assert_eq!((status.failure, status.requeued.unwrap().number), (None, 1));

    let mut world = requeued();
    world.pass();
    world.complete();
    world.report(final_report());
    let status = world.pass_to(Finished, reasons::FINISHED).status;
    assert_eq!((status.retry, status.requeued), (0, None));
    world.pass_to(Finished, reasons::FINISHED);

    let mut world = requeued();
    world.submission().spec.cancel = true;
    world.pass_to(Running, reasons::STOPPING);
    world.complete();
    world.pass_to(Cancelled, reasons::CANCELLED);
}

#[test]
fn a_failed_submission_begins_again_with_a_higher_attempt() {
    let mut world = World::local().running();
    world.leaderboard().retries.infrastructure = 0;
    world.see_alone(ended("simulator-1", 3, "exited", 1, 100));
    world.pass();
    world.complete();
    world.pass_to(Failed, reasons::SIMULATION_CRASHED);
    world.requeue(Some(WHY));
    let status = world.pass_to(Failed, reasons::SIMULATION_CRASHED).status;
    assert_eq!(status.requeued, None, "without a higher attempt nothing begins");
    world.submission().spec.attempt = Attempt(2);
    world.pass_to(Pending, reasons::PREPARING);
    world.job_gone();
    let plan = world.pass();
    assert!(has(&plan, |a| *a == Action::CreateJob(JobNumber::first(Attempt(2)))));
    assert_eq!(plan.status.requeued.unwrap().retries, 0);
    let event = plan
        .events
        .iter()
        .find(|event| event.reason == reasons::REQUEUED)
        .unwrap();
    assert_eq!(
        (event.warning, event.message.as_str()),
        (
            false,
            "A host has requeued the submission: Simulator image 0.9.15-3 was broken."
        )
    );
    assert!(world.pass().events.is_empty(), "once");
}

#[test]
fn one_that_waits_for_its_next_try_starts_at_once() {
    let mut world = World::local().running();
    world.leaderboard().retries.infrastructure = 1;
    world.complete();
    let plan = world.pass_to(Pending, reasons::REPLACING);
    assert!(plan.status.next_retry_time.is_some());
    world.job_gone();
    assert!(!creates(&world.pass()));
    world.requeue(None);
    let plan = world.pass();
    assert!(creates(&plan));
    assert_eq!(plan.status.requeued.unwrap().retries, 1, "that retry is forgiven");
}
