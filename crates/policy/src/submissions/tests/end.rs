//! The end of a Job: by report and by class, with retries, and with a bucket that does not answer.

use std::time::Duration;

use super::builders::*;
use crate::submissions::{Action, Plan};
use crate::view::{JobEnd, ObservedReport};
use leaderboard_api::FailureClass::{Infrastructure, Participant};
use leaderboard_api::Reason;
use leaderboard_api::State::{Cancelled, Failed, Finished, Pending, Running};
use leaderboard_api::conditions::{ARCHIVED, FINISHED, RUNNING, STALLED, SUCCEEDED};
use leaderboard_api::{Attempt, Failure, JobNumber};
use leaderboard_contract::report::{Outcome, RefusedResults, Report};

#[test]
fn complete_results_that_count_finish() {
    let mut world = World::local().running();
    world.go_to(500);
    world.complete();
    world.report(final_report());
    world.go_to(510);
    let plan = world.pass_to(Finished, Reason::Finished);
    assert_eq!(
        plan.status.score.as_ref().map(|score| score.text.as_str()),
        Some("43.13")
    );
    assert_eq!(
        plan.status.message.as_deref(),
        Some("4 of 4 routes, Driving score 43.13.")
    );
    assert_eq!(
        plan.status.times.finished.clone().unwrap().0,
        at(500),
        "the Job's time, not ours"
    );
    assert_eq!(events(&plan), [Reason::Finished]);
    assert_eq!(plan.status.reason, None, "the state says it");
    assert_eq!(condition(&plan, FINISHED), ("True".into(), Reason::Finished.into()));
    assert_eq!(condition(&plan, SUCCEEDED), ("True".into(), Reason::Finished.into()));
    assert_eq!(condition(&plan, ARCHIVED), ("True".into(), Reason::Stored.into()));
    assert_eq!(condition(&plan, RUNNING).0, "False");
}

/// The Pod's agents and simulators have ended well at this second; its Job shows nothing of it yet.
fn run_ends(world: &mut World, second: i64) {
    world.go_to(second + 1);
    world.pod().run_ended = Some(at(second));
}

#[test]
fn a_complete_run_waits_neither_for_logcopys_farewell_nor_for_its_job() {
    let mut world = World::local().running();
    run_ends(&mut world, 500);
    world.report(final_report());
    let plan = world.pass_to(Finished, Reason::Finished);
    assert_eq!(plan.status.times.finished.clone().unwrap().0, at(500));
    assert_eq!(condition(&plan, ARCHIVED), ("True".into(), Reason::Stored.into()));
    assert!(
        !has(&plan, |a| matches!(a, Action::DeleteJob { .. })),
        "it ends by itself"
    );
    world.complete();
    world.pass_to(Finished, Reason::Finished);
}

#[test]
fn a_farewell_that_never_ends_does_not_keep_the_job() {
    let mut world = World::local().running();
    run_ends(&mut world, 500);
    world.report(final_report());
    world.pass_to(Finished, Reason::Finished);
    let deletes = |plan: &Plan| has(plan, |a| matches!(a, Action::DeleteJob { .. }));
    world.recorded();
    world.go_to(620);
    let plan = world.pass();
    assert!(!deletes(&plan));
    assert!(
        plan.requeue.is_some_and(|wait| wait <= Duration::from_secs(2)),
        "{:?}",
        plan.requeue
    );
    let mut lost = world.clone();
    world.go_to(621);
    assert!(deletes(&world.pass()));
    // Its node is gone, so no kubelet ends the Pod.
    lost.pod().delete_by = Some(at(500));
    let plan = lost.pass();
    assert!(deletes(&plan));
    lost.job().deleting = true;
    assert!(has(&lost.pass(), |a| matches!(a, Action::DeletePod { .. })));
}

#[test]
fn every_other_end_of_a_run_waits_for_its_job() {
    let foreign = Report {
        pod_uid: "an earlier Pod".into(),
        ..final_report()
    };
    let ineligible = Report {
        eligible: false,
        outcome: Outcome::Rejected,
        ..final_report()
    };
    for told in [foreign, ineligible, report(4), report(3)] {
        let mut world = World::local().running();
        run_ends(&mut world, 500);
        world.report(told);
        world.pass_to(Running, Reason::Running);
    }
    let mut world = World::local().running();
    run_ends(&mut world, 500);
    world.view.report.stored = ObservedReport::Unreadable("away".into());
    world.pass_to(Running, Reason::Running);
}

#[test]
fn results_that_are_complete_win_over_a_cancel_that_comes_with_them() {
    let mut world = World::local().running();
    world.submission().spec.cancel = true;
    run_ends(&mut world, 500);
    world.report(final_report());
    world.pass_to(Finished, Reason::Finished);
}

/// The Job is complete with this report, and no retry is left.
fn completes_with(report: Option<Report>, reason: Reason) -> Failure {
    let mut world = World::local().running();
    world.leaderboard().retries.infrastructure = 0;
    world.complete();
    if let Some(report) = report {
        world.report(report);
    }
    let plan = world.pass_to(Failed, reason);
    assert!(plan.events.last().unwrap().warning, "{reason}");
    *plan.status.failure.unwrap()
}

#[test]
fn each_end_without_that_has_its_class_and_reason() {
    let ineligible = |outcome| Report {
        eligible: false,
        outcome,
        ..final_report()
    };
    let refused = |is_final| Report {
        is_final,
        refused: Some(RefusedResults::new(None, "a score of NaN.")),
        ..report(3)
    };
    for (report, reason) in [
        (ineligible(Outcome::Rejected), Reason::NotEligible),
        (ineligible(Outcome::Invalid), Reason::NotEligible),
        (refused(true), Reason::InvalidResults),
    ] {
        let failure = completes_with(Some(report), reason);
        assert_eq!(failure.class, Participant, "{reason}");
    }
    for (report, reason) in [
        (Some(refused(false)), Reason::ResultsNotStored),
        // Routes are missing.
        (Some(report(3)), Reason::ResultsNotStored),
        (None, Reason::ResultsNotStored),
    ] {
        let failure = completes_with(report, reason);
        assert_eq!(failure.class, Infrastructure, "{reason}");
    }
}

/// The final report of a run whose pair 2 names a crash of the simulation in its results.
fn names_a_crash() -> Report {
    let mut told = Report {
        eligible: false,
        outcome: Outcome::Crashed,
        ..final_report()
    };
    told.workers[1].names_crash = true;
    told
}

#[test]
fn results_that_name_a_crash_that_no_simulator_had_are_the_participants() {
    let failure = completes_with(Some(names_a_crash()), Reason::InvalidResults);
    assert_eq!((failure.class, failure.worker), (Participant, Some(2)));
    assert_eq!(
        failure.message,
        "The results of pair 2 name a crash of the simulation that its simulator did not have. Check what the agent writes into its \
         checkpoint, and submit again."
    );
    // Neither another pair's simulator, nor an agent that crashed, nor the end of a Pod is a witness.
    for ends in [
        vec![ended("simulator-1", 0, "exited", 1, 100)],
        vec![ended("agent-2", 0, "exited", 1, 100)],
        vec![
            ended("simulator-2", 0, "stopped", 143, 100),
            ended("agent-2", 0, "silentDeath", 137, 100),
        ],
    ] {
        let mut world = World::local().running();
        for end in ends {
            world.see(end);
        }
        world.pass();
        world.complete();
        world.report(names_a_crash());
        let failure = world.pass_to(Failed, Reason::InvalidResults).status.failure.unwrap();
        assert_eq!(failure.class, Participant, "{failure:?}");
    }
}

#[test]
fn results_that_name_a_crash_that_the_simulator_had_are_nobodys_fault() {
    for what in ["exited", "killed", "silentDeath", "notReady", "serverSilent"] {
        let mut world = World::local().running();
        world.leaderboard().retries.infrastructure = 0;
        world.see(ended("simulator-2", 0, what, 1, 100));
        world.pass();
        // A later end, and another Pod of the Job without a crash, take nothing back.
        world.see_alone(ended("simulator-2", 1, "peerCrashed", 1, 200));
        world.see_alone(ended("agent-2", 1, "exited", 1, 200));
        world.pass();
        world.view.pod = Some(pod(210));
        world.see_agents();
        world.pass();
        world.complete();
        world.report(names_a_crash());
        let failure = world.pass_to(Failed, Reason::SimulationCrashed).status.failure.unwrap();
        assert_eq!((failure.class, failure.worker), (Infrastructure, Some(2)), "{what}");
    }
}

#[test]
fn a_crash_of_an_earlier_job_whose_record_is_kept_is_nobodys_fault() {
    let mut world = World::local().running();
    world.leaderboard().retries.infrastructure = 1;
    world.see_alone(ended("simulator-2", 3, "exited", 1, 100));
    world.pass_to(Running, Reason::Stopping);
    world.gets_another_job();
    world.view.pod = Some(pod(200));
    world.see_agents();
    world.view.report.stored = ObservedReport::NotRead;
    world.pass_to(Running, Reason::Running);
    world.complete();
    world.report(names_a_crash());
    let failure = world.pass_to(Failed, Reason::SimulationCrashed).status.failure.unwrap();
    assert_eq!(failure.class, Infrastructure, "{failure:?}");
}

#[test]
fn an_older_pod_that_names_no_pair_of_a_crash_is_believed() {
    let told = Report {
        eligible: false,
        outcome: Outcome::Crashed,
        ..final_report()
    };
    let failure = completes_with(Some(told), Reason::SimulationCrashed);
    assert_eq!(failure.class, Infrastructure);
}

#[test]
fn an_agent_that_ends_by_itself_with_a_refused_checkpoint_gets_what_is_wrong_with_it() {
    let refused = Report {
        is_final: true,
        refused: Some(RefusedResults::new(None, "the records are not a list.")),
        ..report(3)
    };
    for (word, told, reason) in [
        ("exited", Some(refused.clone()), Reason::InvalidResults),
        ("incomplete", Some(refused.clone()), Reason::InvalidResults),
        ("incomplete", None, Reason::InvalidResults),
        // A crash in the middle of a write leaves half a file; the crash is the cause then.
        ("killed", Some(refused), Reason::AgentCrashed),
        ("exited", Some(report(3)), Reason::AgentCrashed),
        ("exited", None, Reason::AgentCrashed),
    ] {
        let mut world = World::local().running();
        world.leaderboard().retries.per_worker = 0;
        world.see(ended("agent-1", 0, word, 1, 20));
        world.pass_to(Running, Reason::Stopping);
        world.complete();
        if let Some(told) = told {
            world.report(told);
        }
        let failure = world.pass_to(Failed, reason).status.failure.unwrap();
        assert_eq!(failure.class, Participant, "{word}: {failure:?}");
    }
}

#[test]
fn a_foreign_report_counts_for_nothing() {
    let mut world = World::local().running();
    world.leaderboard().retries.infrastructure = 0;
    world.complete();
    world.view.report.stored = ObservedReport::Foreign;
    world.pass_to(Failed, Reason::ResultsNotStored);
}

#[test]
fn a_failed_job_is_blamed_on_its_worst_pair_or_on_nobody() {
    let fail = |world: &mut World, reason: &str| {
        let (reason, message) = (reason.to_owned(), "no more".to_owned());
        world.job().end = Some(JobEnd::Failed {
            at: Some(at(60)),
            reason,
            message,
        });
        world.view.report.stored = ObservedReport::Absent;
        world.view.pod = None;
    };
    let mut world = World::local().running();
    world.leaderboard().retries.infrastructure = 0;
    let mut crashed = world.clone();
    fail(&mut world, "BackoffLimitExceeded");
    let plan = world.pass_to(Failed, Reason::JobFailed);
    assert!(plan.status.message.unwrap().contains("BackoffLimitExceeded: no more."));

    crashed.see(ended("agent-2", 1, "idle", 1, 50));
    crashed.pass();
    let mut late = crashed.clone();
    fail(&mut crashed, "BackoffLimitExceeded");
    crashed.pass_to(Failed, Reason::Idle);
    let mut unlimited = late.clone();
    fail(&mut late, "DeadlineExceeded");
    late.pass_to(Failed, Reason::TimeLimit);
    // The Pod's deadline was not ours: what its pair reported counts.
    unlimited.leaderboard().deadlines.run_seconds = None;
    fail(&mut unlimited, "DeadlineExceeded");
    unlimited.pass_to(Failed, Reason::Idle);
}

#[test]
fn infrastructure_failures_are_tried_again_then_fail() {
    let mut world = World::evalai().running();
    for (n, routes, pause) in [(1, 1, 10), (2, 2, 20)] {
        world.complete();
        world.report(report(routes));
        let plan = world.pass_to(Pending, Reason::Replacing);
        assert_eq!(events(&plan), [Reason::Replacing]);
        assert_eq!(evalai_updates(&plan), [], "EvalAI keeps saying running");
        assert_eq!((plan.status.retry, plan.status.attempt), (n, Some(Attempt(1))));
        assert_eq!(
            (plan.status.failure.as_ref(), plan.status.node_name.as_ref()),
            (None, None)
        );
        let message = plan.status.message.unwrap();
        assert!(
            message.contains(&format!("again in {pause} s")) && !message.contains("resume the submission"),
            "{message}"
        );
        world.job_gone();
        world.wait(pause - 1);
        let plan = world.pass();
        assert!(!creates(&plan) && evalai_updates(&plan).is_empty());
        world.wait(1);
        let plan = world.pass();
        assert!(has(&plan, |a| *a
            == Action::CreateJob(JobNumber {
                attempt: Attempt(1),
                retry: n
            })));
        world.see_job();
        let now = world.view.now;
        world.view.pod = Some(crate::view::PodView {
            scheduled: Some(now),
            ..pod(0)
        });
        world.see_agents();
        world.pass_to(Running, Reason::Running);
    }
    world.complete();
    let failure = world.pass_to(Failed, Reason::ResultsNotStored).status.failure.unwrap();
    assert!(failure.class == Infrastructure && failure.message.contains("resume the submission"));
}

#[test]
fn a_retry_stands_in_line_and_needs_the_leaderboard_like_anyone() {
    let mut world = World::local().running();
    world.complete();
    world.pass_to(Pending, Reason::Replacing);
    world.job_gone();
    let leaderboard = world.view.leaderboard.take();
    world.pass_to(Pending, Reason::LeaderboardNotFound);
    world.view.leaderboard = leaderboard;
    world.pass_to(Pending, Reason::Replacing);
    world.wait(10);
    world.view.turn = crate::view::Turn::Wait { position: 1, eta: None };
    world.pass_to(Pending, Reason::WaitingForSlot);
}

#[test]
fn what_is_stored_of_the_first_job_is_no_verdict_on_the_second() {
    let mut world = World::local().running();
    let crashed = Report {
        eligible: false,
        outcome: Outcome::Crashed,
        ..final_report()
    };
    world.complete();
    world.report(crashed);
    world.pass_to(Pending, Reason::Replacing);
    world.view.job = crate::view::ObservedJob::Absent { refused: None };
    world.view.pod = None;
    world.wait(10);
    assert!(creates(&world.pass()));
    let plan = world.pass_to(Pending, Reason::Preparing);
    assert_eq!(plan.status.retry, 1, "the second Job is not to be seen yet");
}

#[test]
fn a_bucket_that_does_not_answer_is_waited_for() {
    let mut world = World::local().running();
    world.complete();
    world.view.report.stored = ObservedReport::Unreadable("request 1 timed out".into());
    let plan = world.pass_to(Running, Reason::NotStored);
    assert_eq!(condition(&plan, STALLED).0, "True");
    let before = world.status();
    world.view.report.stored = ObservedReport::Unreadable("request 2 timed out".into());
    assert_eq!(world.pass().status, before, "another request id is not another write");
    let mut for_good = world.clone();
    world.wait(3600);
    world.pass_to(Running, Reason::NotStored);
    world.report(final_report());
    world.pass_to(Finished, Reason::Finished);

    for_good.leaderboard().retries.infrastructure = 0;
    for_good.wait(86_400);
    for_good.pass_to(Failed, Reason::ResultsNotStored);
}

#[test]
fn the_wait_for_a_bucket_ends_though_the_clock_is_set_back() {
    let mut world = World::local().running();
    world.leaderboard().retries.infrastructure = 0;
    world.go_to(500_000);
    world.complete();
    world.submission().spec.cancel = true;
    world.view.report.stored = ObservedReport::Unreadable("away".into());
    world.pass_to(Running, Reason::NotStored);
    world.go_to(100);
    world.pass_to(Running, Reason::NotStored);
    world.wait(120);
    world.pass_to(Cancelled, Reason::Cancelled);
}

#[test]
fn a_report_that_was_not_read_is_read_first() {
    let mut world = World::local().running();
    world.complete();
    world.view.report.stored = ObservedReport::NotRead;
    let before = world.status();
    let plan = world.pass();
    assert_eq!(
        (plan.status, plan.requeue),
        (before, Some(std::time::Duration::from_secs(15)))
    );
}

#[test]
fn complete_results_count_though_the_run_was_being_stopped() {
    let mut world = World::local().running();
    world.see(ended("agent-1", 3, "exited", 1, 100));
    world.pass_to(Running, Reason::Stopping);
    world.complete();
    world.report(final_report());
    assert_eq!(world.pass_to(Finished, Reason::Finished).status.failure, None);
}
