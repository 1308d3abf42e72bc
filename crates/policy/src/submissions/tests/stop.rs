//! Cancels and deletions at every stage, and stops that no program obeys.

use super::builders::*;
use crate::submissions::{Action, EvalaiUpdate, TableUpdate};
use crate::view::{EvalaiEnd, JobEnd, ObservedReport};
use leaderboard_api::State::{Cancelled, Finished, Pending, Running};
use leaderboard_api::evalai_status::Status;
use leaderboard_api::{Reason, names};
use leaderboard_contract::report::Report;
use leaderboard_contract::run::Stop;

type Request = fn(&mut World);

/// The requests that end a submission, each with the reason that it gets.
const REQUESTS: [(Request, Reason); 3] = [
    (|world| world.submission().spec.cancel = true, Reason::Cancelled),
    (World::delete, Reason::Deleted),
    (|world| world.in_evalai().cancelled = true, Reason::EndedInEvalAI),
];

#[test]
fn before_its_job_it_ends_at_once() {
    for (request, reason) in REQUESTS {
        let mut world = World::evalai();
        request(&mut world);
        let plan = world.pass_to(Cancelled, reason);
        assert!(!creates(&plan));
    }
}

#[test]
fn before_its_pod_or_agents_the_job_is_deleted_at_once() {
    for (request, reason) in REQUESTS {
        for stage in [World::with_job, World::with_pod] {
            let mut world = stage(World::evalai());
            request(&mut world);
            let plan = world.pass_to(Pending, Reason::Stopping);
            assert!(has(&plan, |a| matches!(a, Action::DeleteJob { grace_seconds: 60, .. })));
            world.job().deleting = true;
            world.pass_to(Pending, Reason::Stopping);
            world.job_gone();
            world.pass_to(Cancelled, reason);
        }
    }
}

#[test]
fn a_running_one_is_asked_to_stop_and_keeps_what_it_has() {
    for (request, reason) in REQUESTS {
        let mut world = World::evalai().running();
        world.report(report(2));
        world.pass();
        request(&mut world);
        let plan = world.pass_to(Running, Reason::Stopping);
        assert_eq!(
            plan.actions,
            [Action::StopPod {
                pod: "sub-1-x".into(),
                stop: Stop::Cancel
            }]
        );
        assert_eq!(events(&plan), [Reason::Stopping]);
        world.pod().stop = Some(Stop::Cancel);
        assert_eq!(world.pass().actions, []);
        world.complete();
        world.report(Report {
            is_final: true,
            stopped: Some(Stop::Cancel),
            ..report(2)
        });
        let plan = world.pass_to(Cancelled, reason);
        assert_eq!(plan.status.progress.unwrap().text, "2/4");
        assert_eq!(
            plan.status.score.as_ref().map(|score| score.text.as_str()),
            Some("~41.20")
        );
    }
}

#[test]
fn between_two_tries_it_ends_at_once() {
    for (request, reason) in REQUESTS {
        let mut world = World::evalai().running();
        world.complete();
        world.pass_to(Pending, Reason::Replacing);
        world.job_gone();
        request(&mut world);
        let plan = world.pass_to(Cancelled, reason);
        let message = plan.status.message.as_ref().unwrap();
        assert_eq!(message.contains("EvalAI"), reason == Reason::EndedInEvalAI);
        assert!(!has(&plan, |a| matches!(a, Action::CreateJob(_))));
    }
}

/// The first effect of a cancel: the end, the deletion of the Job, or a stop request to its Pod.
#[derive(Debug, PartialEq)]
enum Done {
    Ended,
    Deleted,
    Told,
    /// It waits for what it needs to end.
    Waits,
}

type Stage = (&'static str, fn() -> World, Done);

const STAGES: [Stage; 9] = [
    (
        "EvalAI is asked",
        || {
            let mut world = World::evalai();
            world.in_evalai().info = None;
            world
        },
        Done::Ended,
    ),
    (
        "the Leaderboard is missing",
        || {
            let mut world = World::evalai();
            world.view.leaderboard = None;
            world
        },
        Done::Ended,
    ),
    ("no Pod yet", || World::evalai().with_job(), Done::Deleted),
    (
        "no node fits",
        || {
            let mut world = World::evalai().with_pod();
            world.pod().scheduled = None;
            world.pod().unschedulable = Some("no GPU".into());
            world
        },
        Done::Deleted,
    ),
    (
        "its agent's image cannot be pulled, while simulator and logcopy run",
        || {
            let mut world = World::evalai().with_pod();
            world.pod().logcopy_running = true;
            world.see(running("logcopy"));
            world.see(running("simulator-1"));
            world.see(waiting("agent-1", "ErrImagePull", "not found"));
            world
        },
        Done::Deleted,
    ),
    (
        "contents are copied",
        || {
            let mut world = World::evalai().with_pod();
            world.see(running("contents"));
            world
        },
        Done::Deleted,
    ),
    (
        "its agents have not started, logcopy has",
        || {
            let mut world = World::evalai().with_pod();
            world.pod().logcopy_running = true;
            world
        },
        Done::Deleted,
    ),
    ("it runs", || World::evalai().running(), Done::Told),
    (
        "its end cannot be read",
        || {
            let mut world = World::evalai().running();
            world.complete();
            world.view.report.stored = ObservedReport::Unreadable("away".into());
            world
        },
        Done::Waits,
    ),
];

#[test]
fn a_cancel_is_obeyed_at_each_stage() {
    for (request, _) in REQUESTS {
        for (what, stage, wanted) in &STAGES {
            let mut world = stage();
            world.pass();
            request(&mut world);
            let plan = world.pass();
            let done = match plan.status.state {
                Some(Cancelled) => Done::Ended,
                _ if has(&plan, |a| matches!(a, Action::DeleteJob { .. })) => Done::Deleted,
                _ if annotated(&plan) == Some(Stop::Cancel) => Done::Told,
                _ => Done::Waits,
            };
            assert_eq!(&done, wanted, "{what}");
            assert!(!creates(&plan), "{what}");
        }
    }
}

#[test]
fn a_cancel_after_the_end_changes_nothing() {
    let mut world = World::evalai().running();
    world.complete();
    world.report(final_report());
    world.pass_to(Finished, Reason::Finished);
    world.submission().spec.cancel = true;
    assert_eq!(
        evalai_updates(&world.pass_to(Finished, Reason::Finished)),
        [EvalaiUpdate::Finished]
    );
    world.published();
    world.pass_to(Finished, Reason::Finished);
}

#[test]
fn a_cancel_that_comes_after_the_last_route_loses() {
    let mut world = World::evalai().running();
    world.submission().spec.cancel = true;
    world.pass_to(Running, Reason::Stopping);
    world.complete();
    world.report(final_report());
    let plan = world.pass_to(Finished, Reason::Finished);
    assert_eq!(evalai_updates(&plan), [EvalaiUpdate::Finished]);

    // EvalAI's own cancel still wins, in all systems, until our result is answered.
    let mut world = World::evalai().running();
    world.in_evalai().cancelled = true;
    world.pass();
    world.complete();
    world.report(final_report());
    world.pass_to(Finished, Reason::Finished);
    world.in_evalai().end = Some(EvalaiEnd::Ended(Status::Cancelled));
    let plan = world.pass_to(Cancelled, Reason::EndedInEvalAI);
    assert!(has(&plan, |a| *a == Action::Record(TableUpdate::End)));
}

#[test]
fn a_pod_that_does_not_obey_is_deleted_then_removed() {
    let mut world = World::local().running();
    world.go_to(1000);
    world.submission().spec.cancel = true;
    world.pass_to(Running, Reason::Stopping);
    world.pod().stop = Some(Stop::Cancel);
    world.go_to(1134);
    assert_eq!(world.pass().actions, []);
    world.go_to(1135);
    assert!(has(&world.pass(), |a| matches!(
        a,
        Action::DeleteJob { grace_seconds: 60, .. }
    )));
    // The deletion took: the kubelet does not answer.
    let mut stuck = world.clone();
    stuck.job().deleting = true;
    stuck.pod().delete_by = Some(at(1195));
    stuck.go_to(1209);
    assert_eq!(stuck.pass().actions, []);
    stuck.go_to(1210);
    let plan = stuck.pass();
    assert_eq!(plan.actions[0], Action::TakeOwnership, "the fence goes first");
    assert!(matches!(plan.actions[1], Action::DeletePod { .. }));
    // It did not: by force all the same.
    world.go_to(1210);
    let plan = world.pass();
    assert_eq!(plan.actions[0], Action::TakeOwnership);
    assert!(has(&plan, |a| matches!(a, Action::DeleteJob { grace_seconds: 0, .. })));
    world.job_gone();
    world.pass_to(Cancelled, Reason::Cancelled);
}

#[test]
fn a_logcopy_that_is_being_restarted_may_still_store() {
    let mut world = World::local().running();
    world.pod().logcopy_running = false;
    world.submission().spec.cancel = true;
    let plan = world.pass_to(Running, Reason::Stopping);
    assert!(has(&plan, |a| matches!(a, Action::StopPod { .. })));
    assert!(!has(&plan, |a| matches!(a, Action::DeleteJob { .. })));
}

#[test]
fn a_stop_ends_though_the_clock_is_set_back() {
    let mut world = World::local().running();
    world.go_to(100_000);
    world.submission().spec.cancel = true;
    world.pass_to(Running, Reason::Stopping);
    world.go_to(50);
    world.pass_to(Running, Reason::Stopping);
    world.wait(135);
    assert!(has(&world.pass(), |a| matches!(a, Action::DeleteJob { .. })));

    let mut world = World::local().running();
    world.go_to(100_000);
    world.complete();
    world.pass_to(Pending, Reason::Replacing);
    world.job_gone();
    world.go_to(50);
    assert!(creates(&world.pass()), "a wait of seconds stays one");
}

#[test]
fn a_failing_run_that_is_cancelled_is_cancelled() {
    let mut world = World::local().running();
    world.see(ended("agent-1", 3, "exited", 1, 100));
    world.pass_to(Running, Reason::Stopping);
    world.submission().spec.cancel = true;
    world.pass_to(Running, Reason::Stopping);
    world.complete();
    assert_eq!(world.pass_to(Cancelled, Reason::Cancelled).status.failure, None);
}

#[test]
fn a_deleted_one_is_released_when_all_know_its_end() {
    let mut world = World::evalai().running();
    world.delete();
    world.pass_to(Running, Reason::Stopping);
    world.complete();
    let plan = world.pass_to(Cancelled, Reason::Deleted);
    assert_eq!(evalai_updates(&plan), [EvalaiUpdate::Cancelled]);
    assert!(!has(&plan, |a| *a == Action::SetFinalizer(false)));
    world.published();
    assert!(has(&world.pass(), |a| *a == Action::Record(TableUpdate::End)));
    world.recorded();
    assert!(has(&world.pass(), |a| *a == Action::SetFinalizer(false)));
}

#[test]
fn deletion_does_not_wait_without_end() {
    let mut world = World::evalai().running();
    world.go_to(100);
    world.delete();
    world.pass();
    world.complete();
    world.pass_to(Cancelled, Reason::Deleted);
    world.go_to(999);
    assert!(!has(&world.pass(), |a| *a == Action::SetFinalizer(false)));
    world.go_to(1000);
    let plan = world.pass();
    assert!(has(&plan, |a| *a == Action::SetFinalizer(false)));
    assert_eq!(events(&plan), [Reason::ReleasedUnpublished]);
    world.submission().metadata.finalizers = Some(vec![format!("{}-other", names::FINALIZER_SUBMISSION)]);
    assert!(!has(&world.pass(), |a| *a == Action::SetFinalizer(false)));
}

#[test]
fn a_cancelled_one_does_not_wait_long_for_a_bucket() {
    let mut world = World::local().running();
    world.go_to(100);
    world.delete();
    world.pass();
    let at = Some(at(100));
    world.job().end = Some(JobEnd::Complete { at });
    world.view.report.stored = ObservedReport::Unreadable("no route to the bucket".into());
    world.pass_to(Running, Reason::NotStored);
    world.go_to(219);
    world.pass_to(Running, Reason::NotStored);
    world.go_to(220);
    world.pass_to(Cancelled, Reason::Deleted);
}

#[test]
fn a_job_that_shows_up_after_the_end_is_ended() {
    let mut world = World::local();
    world.pass();
    world.submission().spec.cancel = true;
    world.view.report.stored = ObservedReport::Absent;
    world.pass_to(Cancelled, Reason::Cancelled);
    world.see_job();
    let plan = world.pass_to(Cancelled, Reason::Cancelled);
    assert!(has(&plan, |a| matches!(a, Action::DeleteJob { .. })));
}
