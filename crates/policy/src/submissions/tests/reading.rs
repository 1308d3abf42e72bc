//! The waits before an end is decided, a Pod is given up, a Job is deleted and an end is published, with their lengths.

use std::sync::Arc;
use std::time::Duration;

use jiff::{SignedDuration, Timestamp};

use super::builders::*;
use crate::submissions::{Action, EvalaiUpdate, Plan, TableUpdate, patience};
use crate::view::{ObservedFence, ObservedLog, ObservedNode, ObservedReport, Stage};
use leaderboard_api::Reason;
use leaderboard_api::State::{Cancelled, Failed, Finished, Pending, Running};
use leaderboard_api::conditions::{self, PUBLISHED, RECORDED};
use leaderboard_contract::report::Patience;

const SECOND: Duration = Duration::from_secs(1);

fn demanded(plan: &Plan) -> Option<(Stage, Option<&str>)> {
    let demand = plan.report.as_ref()?;
    Some((demand.stage, demand.pod.as_deref()))
}

fn deletes(plan: &Plan) -> bool {
    has(plan, |a| {
        matches!(a, Action::DeleteJob { .. } | Action::DeletePod { .. })
    })
}

#[test]
fn each_moment_of_a_life_needs_its_own_report() {
    let mut world = World::evalai();
    assert_eq!(demanded(&world.pass()), None, "nothing is stored yet");
    assert_eq!(
        demanded(&world.pass()),
        None,
        "the Job that was asked for is not there yet"
    );
    let mut world = World::evalai().with_pod();
    world.pod().scheduled = None;
    assert_eq!(demanded(&world.pass()), None);
    let mut world = World::evalai().running();
    let live = world.pass();
    assert_eq!(demanded(&live), Some((Stage::Live, Some("pod-uid"))));
    assert_eq!(live.report.unwrap().period, 10 * SECOND);
    world.pod().run_ended = Some(at(500));
    world.view.report.stage = Some(Stage::Live);
    assert_eq!(demanded(&world.pass()), Some((Stage::RunEnded, Some("pod-uid"))));
    world.complete();
    assert_eq!(demanded(&world.pass()), Some((Stage::JobEnded, Some("pod-uid"))));
    world.job_gone();
    assert_eq!(demanded(&world.pass()), Some((Stage::JobEnded, None)));
    world.view.report.stage = Some(Stage::JobEnded);
    world.report(final_report());
    let end = world.pass_to(Finished, Reason::Finished);
    assert_eq!(demanded(&end), Some((Stage::JobEnded, None)), "it is to be published");
    world.published();
    assert_eq!(demanded(&world.pass()), Some((Stage::JobEnded, None)), "and recorded");
    world.recorded();
    let plan = world.pass();
    assert_eq!(demanded(&plan), None);
    assert!(has(&plan, |a| *a == Action::Forget), "nothing is kept of it");
}

#[test]
fn a_run_without_news_is_reconciled_every_five_minutes() {
    let mut world = World::local().running();
    assert_eq!(world.pass().requeue, Some(300 * SECOND));
}

#[test]
fn an_end_is_decided_only_on_a_report_that_was_asked_for_after_it() {
    for stage in [None, Some(Stage::Live), Some(Stage::RunEnded)] {
        // The last live report speaks of a run that is not complete, or not at all.
        for early in [
            ObservedReport::Absent,
            ObservedReport::Ours(Arc::new((&report(3)).into())),
        ] {
            let mut world = World::local().running();
            world.leaderboard().retries.infrastructure = 0;
            world.complete();
            world.view.report.stored = early;
            world.view.report.stage = stage;
            world.view.report.waited = 2 * SECOND;
            let plan = world.pass_to(Running, Reason::Running);
            assert_eq!(plan.requeue, Some(13 * SECOND), "the answer wakes it before");
            world.view.report.waited = 15 * SECOND;
            world.pass_to(Running, Reason::NotStored);
            world.view.report.stage = Some(Stage::JobEnded);
            world.report(final_report());
            world.pass_to(Finished, Reason::Finished);
        }
    }
}

#[test]
fn a_complete_run_ends_only_on_a_report_that_was_asked_for_after_its_agents_ended() {
    for (stage, state) in [
        (None, Running),
        (Some(Stage::Live), Running),
        (Some(Stage::RunEnded), Finished),
    ] {
        let mut world = World::local().running();
        world.go_to(501);
        world.pod().run_ended = Some(at(500));
        world.report(final_report());
        world.view.report.stage = stage;
        assert_eq!(world.pass().status.state, Some(state), "{stage:?}");
    }
}

#[test]
fn a_job_that_is_gone_is_made_again_only_when_it_is_known_what_its_run_has_stored() {
    let mut world = World::local().running();
    world.job_gone();
    world.view.report.stage = Some(Stage::Live);
    let plan = world.pass();
    assert!(!creates(&plan) && plan.requeue == Some(15 * SECOND));
    let mut silent = world.clone();
    world.view.report.stage = Some(Stage::JobEnded);
    let mut complete = world.clone();
    assert!(creates(&world.pass()));
    complete.report(final_report());
    complete.pass_to(Finished, Reason::Finished);
    silent.view.report.waited = 15 * SECOND;
    assert!(creates(&silent.pass()), "a bucket that is away does not keep it");
}

/// Its node has been silent for long while its Pod was being deleted.
fn lost() -> World {
    let mut world = World::local().running();
    world.go_to(100);
    world.pod().deleted = Some(at(100));
    world.pod().delete_by = Some(at(700));
    world.view.node.state = ObservedNode::Silent { since: at(40) };
    world.go_to(130);
    world
}

#[test]
fn a_lost_pod_is_given_up_with_the_fence_held_or_a_minute_after_it_was_requested() {
    for (fence, expected) in [
        (ObservedFence::NotRequested, Err(60)),
        (ObservedFence::Pending(Duration::ZERO), Err(60)),
        (ObservedFence::Pending(59 * SECOND), Err(1)),
        (ObservedFence::Failed(20 * SECOND), Err(40)),
        (ObservedFence::Failed(60 * SECOND), Ok(())),
        (ObservedFence::Pending(60 * SECOND), Ok(())),
        (ObservedFence::Held, Ok(())),
    ] {
        let mut world = lost();
        world.view.requested.fence = fence;
        let plan = world.pass_to(Running, Reason::Replacing);
        assert!(has(&plan, |a| *a == Action::TakeOwnership), "{fence:?}");
        assert_eq!(deletes(&plan), expected.is_ok(), "{fence:?}");
        if let Err(left) = expected {
            assert_eq!(plan.requeue, Some(left * SECOND), "{fence:?}");
        }
    }
}

#[test]
fn the_next_job_waits_for_a_fence_that_was_requested() {
    for (fence, waits) in [
        (ObservedFence::Pending(5 * SECOND), true),
        (ObservedFence::Failed(59 * SECOND), true),
        (ObservedFence::Failed(60 * SECOND), false),
        (ObservedFence::Held, false),
        (ObservedFence::NotRequested, false),
    ] {
        let mut world = lost();
        world.pass();
        world.job_gone();
        world.view.requested.fence = fence;
        let plan = world.pass();
        assert_eq!(plan.status.retry, i32::from(!waits), "{fence:?}");
        // Somebody else's deletion, in the middle of which the Pod was removed by force.
        let mut world = World::local().running();
        world.job_gone();
        world.view.requested.fence = fence;
        assert_eq!(creates(&world.pass()), !waits, "{fence:?}");
    }
}

#[test]
fn a_job_is_deleted_after_a_failure_when_its_log_is_kept_or_was_waited_for() {
    for (log, expected) in [
        (ObservedLog::NotRequested, Err(15)),
        (ObservedLog::Pending(4 * SECOND), Err(11)),
        (ObservedLog::Pending(15 * SECOND), Ok(())),
        (ObservedLog::Kept, Ok(())),
        (ObservedLog::None, Ok(())),
        (ObservedLog::GivenUp, Ok(())),
    ] {
        let mut world = World::local().with_pod();
        world.see(ended("workspace", 5, "", 3, 1700));
        world.pass();
        world.go_to(1800);
        world.view.requested.log = log;
        let plan = world.pass_to(Pending, Reason::Stopping);
        assert!(has(&plan, |a| matches!(a, Action::KeepLog { .. })));
        assert_eq!(deletes(&plan), expected.is_ok(), "{log:?}");
        if let Err(left) = expected {
            assert_eq!(plan.requeue, Some(left * SECOND), "{log:?}");
        }
    }
    // A cancelled run needs no log.
    let mut world = World::local().with_pod();
    world.view.requested.log = ObservedLog::NotRequested;
    world.submission().spec.cancel = true;
    assert!(deletes(&world.pass()));
}

#[test]
fn evalai_has_a_failure_with_its_log_or_after_that_was_waited_for() {
    let mut world = World::evalai().running();
    world.see(ended("agent-1", 3, "exited", 1, 100));
    world.pass();
    world.complete();
    let plan = world.pass_to(Failed, Reason::AgentCrashed);
    assert_eq!(
        (evalai_updates(&plan), plan.requeue),
        (vec![], Some(15 * SECOND)),
        "it was requested just now"
    );
    for (log, told) in [
        (ObservedLog::Pending(3 * SECOND), vec![]),
        (ObservedLog::Pending(15 * SECOND), vec![EvalaiUpdate::Failed]),
        (ObservedLog::GivenUp, vec![EvalaiUpdate::Failed]),
        (ObservedLog::Kept, vec![EvalaiUpdate::Failed]),
    ] {
        world.view.requested.log = log;
        assert_eq!(evalai_updates(&world.pass()), told, "{log:?}");
    }
}

#[test]
fn nothing_is_forgotten_before_the_log_is_stored() {
    let mut world = World::local().running();
    world.see(ended("agent-1", 3, "exited", 1, 100));
    world.pass();
    world.complete();
    world.recorded();
    world.view.requested.log = ObservedLog::NotRequested;
    let forgets = |plan: &Plan| has(plan, |a| *a == Action::Forget);
    let plan = world.pass_to(Failed, Reason::AgentCrashed);
    assert!(has(&plan, |a| matches!(a, Action::KeepLog { .. })) && !forgets(&plan));
    world.view.requested.log = ObservedLog::Pending(SECOND);
    assert!(!forgets(&world.pass()));
    world.view.requested.log = ObservedLog::Kept;
    assert!(forgets(&world.pass()));
}

/// Finished just now.
fn finished() -> World {
    let mut world = World::evalai().running();
    world.complete();
    world.report(final_report());
    world.pass_to(Finished, Reason::Finished);
    world
}

fn waits_with(plan: &Plan, type_: &str) -> String {
    conditions::get(&plan.status.conditions, type_)
        .unwrap()
        .message
        .to_string()
}

#[test]
fn what_cannot_be_read_of_a_result_is_shown_and_waited_for_but_not_permanently() {
    let mut world = finished();
    world.in_evalai().unread = Some("stdout is of another round".into());
    let plan = world.pass();
    assert_eq!(evalai_updates(&plan), [EvalaiUpdate::Finished]);
    let shown = waits_with(&plan, PUBLISHED);
    assert!(
        shown.starts_with("The stored result cannot be read: stdout is of another round"),
        "{shown}"
    );
    // Another text for the same would be a write each time.
    world.in_evalai().unread = Some("request 2 timed out".into());
    assert_eq!(waits_with(&world.pass(), PUBLISHED), shown);

    let (status, ended) = (world.status(), world.view.now);
    let after = |seconds| ended + SignedDuration::from_secs(seconds);
    let expected = Patience {
        unfit: after(600),
        unread: after(86_400),
        report: Timestamp::MAX,
    };
    assert_eq!(patience(&world.view, &status), expected, "nothing without its numbers");
    world.delete();
    let release = after(900 - 120);
    let patience = patience(&world.view, &world.status());
    assert_eq!((patience.unfit, patience.unread), (after(600), release));
}

#[test]
fn what_is_finished_is_nothing_without_its_numbers_and_everything_else_goes_without() {
    let unreadable = ObservedReport::Unreadable("torn".into());
    let mut world = finished();
    world.view.report.stored = unreadable.clone();
    world.wait(10 * 86_400);
    assert_eq!(evalai_updates(&world.pass()), []);

    let mut world = World::evalai().running();
    world.submission().spec.cancel = true;
    world.pass();
    world.complete();
    world.pass_to(Cancelled, Reason::Cancelled);
    world.view.report.stored = unreadable;
    assert_eq!(evalai_updates(&world.pass()), []);
    world.wait(86_400);
    assert_eq!(evalai_updates(&world.pass()), [EvalaiUpdate::Cancelled]);
}

#[test]
fn the_end_of_a_deleted_one_does_not_wait_until_the_finalizer_gives_up() {
    let mut world = World::evalai().running();
    world.delete();
    world.pass();
    world.complete();
    world.pass_to(Cancelled, Reason::Deleted);
    world.view.report.stored = ObservedReport::Unreadable("torn".into());
    world.wait(900 - 121);
    assert_eq!(evalai_updates(&world.pass()), []);
    world.wait(1);
    assert_eq!(evalai_updates(&world.pass()), [EvalaiUpdate::Cancelled]);
}

#[test]
fn the_row_of_a_finished_submission_waits_for_its_report_but_not_permanently() {
    let records = |plan: &Plan| has(plan, |a| *a == Action::Record(TableUpdate::End));
    let mut world = World::local().running();
    world.complete();
    world.report(final_report());
    assert!(records(&world.pass_to(Finished, Reason::Finished)));
    world.view.report.stored = ObservedReport::Unreadable("torn".into());
    let plan = world.pass();
    assert!(!records(&plan) && waits_with(&plan, RECORDED).contains("torn"));
    // After a restart nothing is known.
    world.view.report.stored = ObservedReport::NotRead;
    world.view.report.stage = None;
    let plan = world.pass();
    assert!(!records(&plan) && demanded(&plan).is_some());

    let mut world = World::local().running();
    world.submission().spec.cancel = true;
    world.pass();
    world.complete();
    world.pass_to(Cancelled, Reason::Cancelled);
    world.view.report.stage = None;
    assert!(records(&world.pass()), "a row without metrics waits for no report");
}

#[test]
fn an_end_that_never_had_a_plan_waits_for_nothing() {
    let mut world = World::evalai();
    world.in_evalai().info = None;
    world.view.report.stage = None;
    world.submission().spec.cancel = true;
    let plan = world.pass_to(Cancelled, Reason::Cancelled);
    assert_eq!(
        (evalai_updates(&plan), demanded(&plan)),
        (vec![EvalaiUpdate::Cancelled], None)
    );
}
