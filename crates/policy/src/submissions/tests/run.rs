//! A run under way: progress, time and disk, Pods and Jobs that are lost.

use super::builders::*;
use crate::submissions::{Action, EvalaiUpdate};
use crate::view::{ObservedJob, ObservedReport, PodView, Stage};
use leaderboard_api::FailureClass::{Infrastructure, Participant};
use leaderboard_api::Reason;
use leaderboard_api::State::{Failed, Finished, Pending, Resumed, Running};
use leaderboard_api::conditions::{self, LOGGED, PLAUSIBLE, RUNNING, STALLED};
use leaderboard_contract::report::{Logs, Report};
use leaderboard_contract::run::Stop;

#[test]
fn progress_is_no_transition_and_is_sent_once() {
    let mut world = World::evalai().running();
    world.report(report(1));
    let plan = world.pass_to(Running, Reason::Running);
    assert!(plan.events.is_empty());
    assert_eq!(
        evalai_updates(&plan),
        [EvalaiUpdate::Running, EvalaiUpdate::Partial { is_shown: false }]
    );
    assert_eq!(plan.status.progress.as_ref().unwrap().text, "1/4");
    assert_eq!(
        plan.status.score.as_ref().map(|score| score.text.as_str()),
        Some("~41.20")
    );
    assert_eq!(plan.status.message.as_deref(), Some("1/4 routes done."));

    world.in_evalai().partial_done = Some(1);
    assert_eq!(evalai_updates(&world.pass()), [EvalaiUpdate::Running]);
    world.report(report(2));
    assert_eq!(
        evalai_updates(&world.pass()),
        [EvalaiUpdate::Running, EvalaiUpdate::Partial { is_shown: false }]
    );
}

#[test]
fn scores_without_reason_are_a_condition_and_no_failure() {
    let mut world = World::local().running();
    world.report(report(1));
    assert_eq!(condition(&world.pass_to(Running, Reason::Running), PLAUSIBLE).0, "");
    let words = "pair 1, route RouteScenario_3: score_penalty is 1.0, but its infractions allow 0.7 at most";
    let warned = |report: Report| Report {
        warnings: vec![words.to_owned(), "pair 2".to_owned()],
        ..report
    };
    world.report(warned(report(2)));
    let plan = world.pass_to(Running, Reason::Running);
    assert_eq!(
        condition(&plan, PLAUSIBLE),
        ("False".to_owned(), Reason::UnexplainedScores.into())
    );
    let found = conditions::get(&plan.status.conditions, PLAUSIBLE).unwrap();
    assert_eq!(
        found.message,
        format!("Scores do not follow from the infractions: {words}.")
    );

    world.report(report(3));
    assert_eq!(condition(&world.pass_to(Running, Reason::Running), PLAUSIBLE).0, "True");

    world.complete();
    world.report(warned(final_report()));
    let plan = world.pass_to(Finished, Reason::Finished);
    assert_eq!(condition(&plan, PLAUSIBLE).0, "False");
}

#[test]
fn lines_that_cloudwatch_refuses_are_a_condition_and_a_check_shows_that_it_takes_them() {
    let with = |report: Report, logs: &Logs| Report {
        logs: Some(logs.clone()),
        ..report
    };
    let refused = Logs::Refused("creating g/77/agent-1 in CloudWatch Logs: no such group".into());
    let mut world = World::local().running();
    world.report(with(report(1), &Logs::Sent));
    assert_eq!(condition(&world.pass_to(Running, Reason::Running), LOGGED).0, "");
    world.report(with(report(2), &refused));
    let plan = world.pass_to(Running, Reason::Running);
    assert_eq!(condition(&plan, LOGGED), ("False".into(), Reason::LogsRefused.into()));
    let found = conditions::get(&plan.status.conditions, LOGGED).unwrap();
    assert!(found.message.starts_with("creating g/77/agent-1"), "{}", found.message);
    world.complete();
    world.report(with(final_report(), &Logs::Sent));
    let plan = world.pass_to(Finished, Reason::Finished);
    assert_eq!(condition(&plan, LOGGED).0, "True");
}

#[test]
fn a_run_is_seen_even_if_it_was_over_before_anyone_looked() {
    let mut world = World::local().with_pod();
    world.see_agents();
    world.go_to(60);
    world.complete();
    world.report(final_report());
    let plan = world.pass_to(Finished, Reason::Finished);
    assert_eq!(plan.status.times.started.unwrap().0, at(10));
}

#[test]
fn an_edited_leaderboard_leaves_the_plan_of_a_run_alone() {
    let mut world = World::local().running();
    let before = world.status();
    let spec = world.leaderboard();
    let carla = spec.evaluation.carla_mut().unwrap();
    (carla.pairs, carla.routes) = (4, 8);
    carla.simulator.image = "simulator:2".into();
    carla.contents.image = "contents:2".into();
    assert_eq!(world.pass().status, before);
}

#[test]
fn a_run_outlives_its_leaderboard() {
    let mut world = World::local().running();
    let leaderboard = world.view.leaderboard.take();
    world.view.record = None;
    world.pass_to(Running, Reason::Running);
    // The Job can't be made again without, and is when it is back.
    world.job_gone();
    assert!(!creates(&world.pass_to(Running, Reason::LeaderboardNotFound)));
    world.view.leaderboard = leaderboard;
    assert!(creates(&world.pass_to(Running, Reason::Replacing)));
}

#[test]
fn the_run_deadline_counts_from_the_first_agent_to_the_second() {
    let mut world = World::local().running();
    world.go_to(10 + 86_400 - 1);
    let plan = world.pass_to(Running, Reason::Running);
    assert!(plan.requeue.unwrap() <= std::time::Duration::from_millis(1050));
    world.go_to(10 + 86_400);
    let plan = world.pass_to(Running, Reason::Stopping);
    assert_eq!(annotated(&plan), Some(Stop::RunDeadline));
    world.complete();
    let failure = world.pass_to(Failed, Reason::TimeLimit).status.failure.unwrap();
    assert_eq!(failure.class, Participant);
}

#[test]
fn a_run_without_a_limit_goes_on_and_a_track_has_its_own() {
    let mut world = World::local().running();
    world.leaderboard().deadlines.run_seconds = None;
    world.go_to(400 * 86_400);
    world.pass_to(Running, Reason::Running);
    world.leaderboard().tracks[0].deadlines = Some(leaderboard_api::TrackDeadlines {
        run_seconds: Some(86_400),
        ..Default::default()
    });
    let failure = world.pass_to(Running, Reason::Stopping).status.failure.unwrap();
    assert_eq!(failure.reason, Reason::TimeLimit);
}

#[test]
fn a_pair_is_started_again_as_often_as_the_leaderboard_allows() {
    for (per_worker, crashes, fails) in [(0, 1, true), (1, 1, false), (1, 2, true), (3, 3, false), (3, 4, true)] {
        let mut world = World::local().running();
        world.leaderboard().retries.per_worker = per_worker;
        world.see(ended("agent-1", crashes - 1, "exited", 1, 100));
        let (state, reason) = if fails {
            (Running, Reason::Stopping)
        } else {
            (Running, Reason::Running)
        };
        world.pass_to(state, reason);
    }
}

#[test]
fn a_run_that_outlives_its_leaderboard_meets_no_deadline_of_ours() {
    let mut world = World::local().running();
    world.leaderboard().deadlines.run_seconds = Some(200_000);
    let leaderboard = world.view.leaderboard.take();
    world.go_to(150_000);
    world.pass_to(Running, Reason::Running);
    world.view.leaderboard = leaderboard;
    world.go_to(200_010);
    world.pass_to(Running, Reason::Stopping);
}

#[test]
fn time_lost_to_the_infrastructure_is_given_back() {
    let mut world = World::local().running();
    world.go_to(86_000);
    world.gets_another_job();
    world.go_to(200_000);
    world.pass_to(Pending, Reason::Preparing);
    world.view.pod = Some(pod(200_000));
    world.see_agents();
    world.go_to(200_060);
    world.pass_to(Running, Reason::Running);
    world.go_to(200_000 + 86_400);
    world.pass_to(Running, Reason::Stopping);
}

#[test]
fn a_lost_pod_is_replaced_and_the_state_stays() {
    let mut world = World::local().running();
    world.pod().delete_by = Some(at(700));
    let plan = world.pass_to(Running, Reason::Replacing);
    assert_eq!(condition(&plan, RUNNING), ("False".into(), Reason::Replacing.into()));
    world.view.pod = None;
    world.pass_to(Running, Reason::Replacing);
    world.view.pod = Some(PodView {
        uid: "pod-2".into(),
        ..pod(100)
    });
    world.pass_to(Running, Reason::Replacing);
    world.go_to(200);
    world.pod().scheduled = None;
    world.pod().unschedulable = Some("0/1 nodes are available.".into());
    let plan = world.pass_to(Running, Reason::Replacing);
    assert_eq!(
        condition(&plan, STALLED),
        ("False".into(), Reason::Unschedulable.into())
    );
    world.pod().unschedulable = None;
    world.pod().scheduled = Some(at(300));
    world.see_agents();
    let plan = world.pass_to(Running, Reason::Running);
    assert_eq!(condition(&plan, RUNNING).0, "True");
    assert_eq!(plan.status.times.started.unwrap().0, at(10));
}

#[test]
fn a_replacing_pod_has_its_own_time_to_be_scheduled() {
    let mut world = World::local().running();
    world.leaderboard().deadlines.schedule_seconds = Some(600);
    world.go_to(5000);
    let mut second = pod(0);
    second.scheduled = None;
    second.unschedulable = Some("0/1 nodes are available.".into());
    world.view.pod = Some(second);
    world.pass_to(Running, Reason::Replacing);
    world.go_to(5599);
    world.pass_to(Running, Reason::Replacing);
    world.go_to(5600);
    world.pass_to(Running, Reason::Stopping);
}

#[test]
fn crashes_of_an_earlier_pod_are_not_counted_twice() {
    let mut world = World::local().running();
    world.leaderboard().retries.infrastructure = 1;
    for n in [1, 2] {
        world.see(ended(&format!("simulator-{n}"), 3, "exited", 1, 100));
    }
    world.pass_to(Running, Reason::Stopping);
    world.gets_another_job();
    world.view.pod = Some(PodView {
        uid: "pod-2".into(),
        ..pod(200)
    });
    world.see_agents();
    // The report is still the first Pod's.
    let mut told = report(1);
    told.workers[0].crashes = 4;
    world.report(told);
    world.see(ended("agent-1", 0, "exited", 1, 300));
    let plan = world.pass_to(Running, Reason::Running);
    assert_eq!(plan.status.workers[0].crashes, 1);
}

#[test]
fn deadlines_and_retries_are_the_leaderboards_of_this_moment() {
    let mut world = World::local().running();
    world.leaderboard().deadlines.run_seconds = Some(1000);
    world.go_to(1009);
    world.leaderboard().deadlines.run_seconds = Some(5000);
    world.go_to(1010);
    world.pass_to(Running, Reason::Running);
    world.leaderboard().deadlines.run_seconds = Some(1100);
    world.go_to(1110);
    let failure = world.pass_to(Running, Reason::Stopping).status.failure.unwrap();
    assert_eq!(failure.reason, Reason::TimeLimit);
    // The recorded failure stands.
    world.leaderboard().deadlines.run_seconds = Some(90_000);
    world.pass_to(Running, Reason::Stopping);

    let mut world = World::local().running();
    world.see(ended("agent-1", 3, "exited", 1, 100));
    world.leaderboard().retries.per_worker = 8;
    world.pass_to(Running, Reason::Running);
    world.leaderboard().retries.per_worker = 3;
    world.pass_to(Running, Reason::Stopping);
}

#[test]
fn a_job_deleted_by_hand_is_made_again_three_times() {
    let mut world = World::evalai().running();
    for n in 1..=3 {
        world.job_gone();
        let plan = world.pass_to(Running, Reason::Replacing);
        assert!(creates(&plan));
        assert!(events(&plan).contains(&Reason::JobRecreated.into()));
        assert_eq!(plan.status.recreated, n);
        assert!(!evalai_updates(&plan).contains(&EvalaiUpdate::Queued));
        world.see_job();
        world.view.pod = Some(pod(20));
        world.see_agents();
        world.pass_to(Running, Reason::Running);
    }
    world.job_gone();
    let failure = world.pass_to(Failed, Reason::JobDeleted).status.failure.unwrap();
    assert_eq!(failure.class, Infrastructure);
}

#[test]
fn a_job_deleted_before_it_had_a_node_is_made_again_and_not_counted() {
    let mut world = World::local().with_job();
    world.job().failed_create = Some("exceeded quota: q".into());
    world.go_to(5);
    world.pass_to(Pending, Reason::QuotaExceeded);
    world.job_gone();
    let plan = world.pass_to(Pending, Reason::Preparing);
    assert_eq!((creates(&plan), plan.status.recreated), (true, 0));
}

#[test]
fn a_job_that_was_just_created_is_waited_for() {
    let mut world = World::local();
    world.pass();
    world.view.job = ObservedJob::Created;
    let before = world.status();
    let plan = world.pass();
    assert_eq!((plan.status, plan.actions, plan.report), (before, Vec::new(), None));
    // It cannot be deleted without its UID.
    world.submission().spec.cancel = true;
    assert_eq!(world.pass_to(Pending, Reason::Preparing).actions, []);
    world.see_job();
    assert!(has(&world.pass(), |a| matches!(a, Action::DeleteJob { .. })));
}

#[test]
fn a_run_that_began_and_ended_between_two_controllers_is_not_driven_again() {
    let mut world = World::local();
    assert_eq!(world.pass().report, None, "what is stored is no word of a new Job");
    world.view.report.stage = None;
    let plan = world.pass();
    assert!(!creates(&plan));
    assert_eq!(plan.report.unwrap().stage, Stage::JobEnded);
    world.view.report.stage = Some(Stage::JobEnded);
    let mut never = world.clone();
    never.view.report.stored = ObservedReport::Absent;
    let plan = never.pass_to(Pending, Reason::Preparing);
    assert_eq!((creates(&plan), plan.status.recreated), (true, 0));
    world.report(final_report());
    world.pass_to(Finished, Reason::Finished);
}

#[test]
fn a_job_that_is_gone_after_its_time_is_not_made_again() {
    const WEEK: i64 = 7 * 86_400;
    let gone_at = |second: i64| {
        let mut world = World::local().running();
        world.go_to(second);
        world.job_gone();
        world
    };
    let plan = gone_at(WEEK).pass_to(Failed, Reason::JobExpired);
    let failure = plan.status.failure.unwrap();
    assert_eq!(failure.class, Infrastructure);
    assert!(creates(&gone_at(WEEK - 1).pass_to(Running, Reason::Replacing)));

    let mut longer = gone_at(WEEK);
    longer.leaderboard().ttl_seconds_after_finished = 2 * 7 * 86_400;
    assert!(creates(&longer.pass_to(Running, Reason::Replacing)));
    let mut shorter = gone_at(WEEK - 1);
    shorter.leaderboard().ttl_seconds_after_finished = 0;
    assert!(creates(&shorter.pass_to(Running, Reason::Replacing)));

    let mut told = gone_at(WEEK);
    told.report(final_report());
    told.pass_to(Finished, Reason::Finished);
}

#[test]
fn a_job_that_somebody_deletes_slowly_is_waited_for() {
    let mut world = World::local().running();
    world.job().deleting = true;
    world.pod().delete_by = Some(at(70));
    assert!(!creates(&world.pass_to(Running, Reason::Replacing)));
    world.go_to(85);
    assert!(has(&world.pass(), |a| matches!(a, Action::DeletePod { .. })));
    world.job_gone();
    assert!(creates(&world.pass_to(Running, Reason::Replacing)));
}

#[test]
fn a_finished_job_deleted_by_hand_is_finished_all_the_same() {
    let mut world = World::local().running();
    world.job_gone();
    world.report(final_report());
    world.pass_to(Finished, Reason::Finished);
}

#[test]
fn a_lost_status_is_made_anew_from_the_job() {
    let mut world = World::local().running();
    world.submission().status = None;
    let plan = world.pass_to(Running, Reason::Running);
    assert!(plan.status.plan.is_some() && !creates(&plan));
}

#[test]
fn a_job_of_an_earlier_try_is_not_taken_for_the_present_one() {
    let mut world = World::local().running();
    let ObservedJob::Ours(job) = &mut world.view.job else {
        panic!()
    };
    job.name = "sub-1-r7".into();
    let before = world.status();
    let plan = world.pass();
    assert_eq!((plan.status, plan.actions.len()), (before, 0));
}

#[test]
fn a_clock_that_is_set_back_costs_a_run_nothing() {
    let mut world = World::local().running();
    world.go_to(-5000);
    world.pass_to(Running, Reason::Running);
    world.view.report.stored = ObservedReport::NotRead;
    world.go_to(20);
    world.pass_to(Running, Reason::Running);
}

#[test]
fn a_later_run_of_the_same_object_is_resumed() {
    let mut world = World::evalai();
    world.in_evalai().info.as_mut().unwrap().standing = crate::view::Standing::Resumed;
    let mut world = world.with_pod();
    world.see_agents();
    world.pass_to(Resumed, Reason::Resumed);
}
