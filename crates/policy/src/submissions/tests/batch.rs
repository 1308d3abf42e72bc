//! A run of the mode Batch: one agent, then the copy of its files, then the evaluators.

use super::builders::*;
use super::container::{complete, of_mode, speaks_of_no_other_kind, told};
use super::log::places;
use crate::submissions::{Action, Plan};
use crate::view::{ContainerView, JobEnd, ObservedReport};
use leaderboard_api::FailureClass::{self, Infrastructure, Participant};
use leaderboard_api::State::{Cancelled, Failed, Finished, Pending, Running};
use leaderboard_api::{EndReason, Failure, PinnedImage, Reason};
use leaderboard_contract::report::{RefusedResults, Report};
use leaderboard_contract::run::Stop;

/// When the agent ends, long after the Pod began.
const AGENT_ENDS: i64 = 7200;

fn next(name: &str) -> ContainerView {
    waiting(name, "PodInitializing", "")
}

/// The Pod is prepared, and its agent's image is pulled.
pub(super) fn prepared() -> World {
    let mut world = of_mode("Batch").with_job();
    world.view.pod = Some(pod(0));
    world.pod().logcopy_running = true;
    let [workspace, logcopy] = [ended("workspace", 0, "", 0, 5), running("logcopy")];
    let later = ["agent-1", "collect", "evaluator-1", "evaluator-2"].map(next);
    world.pod().containers = [workspace, logcopy].into_iter().chain(later).collect();
    world
}

/// Puts a container in the place of what the Pod has by its name.
fn see(world: &mut World, container: ContainerView) {
    let mut containers = world.pod().containers.iter_mut();
    let found = containers.find(|known| known.name == container.name);
    *found.unwrap() = container;
}

/// Its agent runs since second 10.
pub(super) fn agent_runs() -> (World, Plan) {
    let mut world = prepared();
    world.pass_to(Pending, Reason::Preparing);
    world.pod().agent_started = Some(at(10));
    see(&mut world, running("agent-1"));
    world.go_to(10);
    let plan = world.pass_to(Running, Reason::Running);
    (world, plan)
}

/// Its agent has ended well.
fn agent_is_done() -> World {
    let (mut world, _) = agent_runs();
    see(&mut world, ended("agent-1", 0, "incomplete", 0, AGENT_ENDS));
    world.go_to(AGENT_ENDS);
    world
}

/// Its files are copied.
pub(super) fn collected() -> World {
    let mut world = agent_is_done();
    see(&mut world, ended("collect", 0, "", 0, AGENT_ENDS + 10));
    world.go_to(AGENT_ENDS + 10);
    world
}

/// Its evaluators run.
pub(super) fn evaluating() -> World {
    let mut world = collected();
    world.pass_to(Running, Reason::Running);
    for name in ["evaluator-1", "evaluator-2"] {
        see(&mut world, running(name));
    }
    world.go_to(AGENT_ENDS + 20);
    world.pass_to(Running, Reason::Running);
    world
}

#[track_caller]
fn is_stopped(world: &mut World, class: FailureClass, reason: Reason) -> Failure {
    let plan = world.pass_to(Running, Reason::Stopping);
    speaks_of_no_other_kind(&plan);
    let failure = *plan.status.failure.unwrap();
    assert_eq!((failure.class, failure.reason.known()), (class, Some(reason)));
    failure
}

#[test]
fn the_run_begins_with_its_agent_and_ends_with_its_evaluators() {
    let (mut world, plan) = agent_runs();
    assert_eq!(plan.events[0].message, "The agent of attempt 1 runs on node node-a.");
    let digest = format!("sha256:{}", "a".repeat(64));
    see(
        &mut world,
        ContainerView {
            image_id: Some(format!("docker.io/team/agent@{digest}").into()),
            ..running("agent-1")
        },
    );
    assert_eq!(world.pass().status.image, Some(PinnedImage { digest }));

    let mut world = collected();
    let plan = world.pass_to(Running, Reason::Running);
    assert_eq!(
        plan.status.message.as_deref(),
        Some("The agent has ended; the evaluators start.")
    );
    assert_eq!(plan.status.times.started.map(|time| time.0), Some(at(10)));

    let mut world = evaluating();
    world.report(told(4));
    let plan = world.pass_to(Running, Reason::Running);
    assert_eq!(plan.status.message.as_deref(), Some("4/10 units done."));
    world.complete();
    world.report(complete());
    speaks_of_no_other_kind(&world.pass_to(Finished, Reason::Finished));
}

#[test]
fn an_agent_that_crashes_is_started_again() {
    let back_off = ContainerView {
        waiting: Some(("CrashLoopBackOff".into(), "back-off".into())),
        ..ended("agent-1", 0, "exited", 1, 100)
    };
    for crashed in [back_off, restarted("agent-1", 1, "exited", 1, 100)] {
        let (mut world, _) = agent_runs();
        see(&mut world, crashed);
        world.go_to(101);
        let status = world.pass_to(Running, Reason::Running).status;
        let [worker] = &status.workers[..] else {
            panic!("{:?}", status.workers)
        };
        let last = worker.last.as_ref().map(|last| last.reason);
        assert_eq!((worker.id, worker.crashes, last), (1, 1, Some(EndReason::Exited)));
        assert_eq!(status.failure, None);
    }
}

#[test]
fn an_agent_that_crashes_too_often_is_the_participants_at_once() {
    for (what, exit_code, reason) in [
        ("exited", 1, Reason::AgentCrashed),
        ("silentDeath", 137, Reason::AgentCrashed),
        ("idle", 1, Reason::Idle),
        ("cannotStart", 127, Reason::CannotStart),
        ("noGpu", 1, Reason::AgentCrashed),
    ] {
        let (mut world, _) = agent_runs();
        see(&mut world, ended("agent-1", 3, what, exit_code, 100));
        world.go_to(100);
        let failure = is_stopped(&mut world, Participant, reason);
        assert_eq!(failure.worker, Some(1), "{what}");
        world.complete();
        let plan = world.pass_to(Failed, reason);
        assert_eq!(
            places(&plan),
            ["s3 agent/agent1/leaderboard.log", "node agent-1"],
            "{what}"
        );
    }
    let (mut world, _) = agent_runs();
    see(&mut world, ended("agent-1", 2, "exited", 1, 100));
    world.pass_to(Running, Reason::Running);
    let (mut world, _) = agent_runs();
    see(&mut world, ended("agent-1", 0, "noGpu", 69, 100));
    assert_eq!(
        is_stopped(&mut world, Infrastructure, Reason::NoGPU).message,
        "Worker 1 lacks a GPU on node node-a, although the Leaderboard gives it one: its agent or its evaluator saw none."
    );
}

/// `collect` has ended like this, and says why.
fn collect_fails(reason: &str, why: &str) -> World {
    let mut world = agent_is_done();
    let mut collect = ended("collect", 0, reason, 1, AGENT_ENDS + 5);
    collect.last.as_mut().unwrap().why = Some(why.into());
    see(&mut world, collect);
    world.go_to(AGENT_ENDS + 10);
    world
}

#[test]
fn files_that_cannot_be_taken_end_the_run_at_once_at_the_participants_cost() {
    let why = "answers.csv in /submission can't be taken: it is a link; have the agent write regular files, and submit again.";
    let mut world = collect_fails("InputRefused", why);
    let failure = is_stopped(&mut world, Participant, Reason::InputInvalid);
    let expected = [
        format!("{why} Look at agent/agent1/leaderboard.log of the results."),
        format!("{why} The challenge's hosts have the agent's log."),
    ];
    assert_eq!([failure.message, failure.participant_message.unwrap()], expected);
    assert_eq!(annotated(&world.pass()), Some(Stop::Retries));
    world.complete();
    let plan = world.pass_to(Failed, Reason::InputInvalid);
    assert_eq!(places(&plan), ["s3 agent/agent1/leaderboard.log", "node agent-1"]);
    assert_eq!(plan.status.retry, 0);
}

#[test]
fn a_collect_that_fails_otherwise_is_tried_as_long_as_a_start_and_is_the_infrastructures() {
    let mut world = collect_fails("VolumeFailed", "the volume cannot be written");
    let plan = world.pass_to(Running, Reason::Preparing);
    let message = plan.status.message.unwrap();
    assert_eq!(&*message, "collect fails: the volume cannot be written.");
    world.go_to(AGENT_ENDS + 10 + 1799);
    world.pass_to(Running, Reason::Preparing);
    world.go_to(AGENT_ENDS + 10 + 1800);
    let plan = world.pass_to(Running, Reason::Stopping);
    assert_eq!(places(&plan), ["node collect"]);
    let failure = plan.status.failure.unwrap();
    assert_eq!(
        (failure.class, failure.reason.known()),
        (Infrastructure, Some(Reason::StartDeadline))
    );
}

#[test]
fn an_evaluator_that_crashes_after_the_agents_end_is_the_infrastructures() {
    for (what, exit_code, says) in [
        ("exited", 1, "it ended without a final result."),
        ("noResult", 1, "it had no final result in time."),
        ("noProcess", 75, "it ended without a final result."),
    ] {
        let mut world = evaluating();
        see(&mut world, ended("evaluator-2", 3, what, exit_code, 8000));
        let failure = is_stopped(&mut world, Infrastructure, Reason::EvaluatorFailed);
        let expected = format!("The evaluator of worker 2 failed 4 times: {says}");
        assert_eq!((failure.message, failure.worker), (expected, Some(2)));
        world.complete();
        let status = world.pass_to(Pending, Reason::Replacing).status;
        assert_eq!((status.retry, status.failure), (1, None), "{what}");
    }
    // What the agent was forgiven counts against no evaluator.
    let mut world = evaluating();
    see(&mut world, ended("agent-1", 3, "incomplete", 0, AGENT_ENDS));
    see(&mut world, ended("evaluator-1", 2, "exited", 1, 8000));
    world.pass_to(Running, Reason::Running);
}

#[test]
fn an_image_of_an_evaluator_has_its_time_from_the_agents_end() {
    let mut world = collected();
    see(&mut world, waiting("evaluator-1", "ErrImagePull", "no such host"));
    for second in [AGENT_ENDS + 10, AGENT_ENDS + 10 + 1799] {
        world.go_to(second);
        assert_eq!(world.pass_to(Running, Reason::ImagePull).status.failure, None);
    }
    world.go_to(AGENT_ENDS + 10 + 1800);
    assert_eq!(is_stopped(&mut world, Infrastructure, Reason::ImagePull).worker, None);

    // A pull that says nothing is over at last, too.
    let mut world = collected();
    world.go_to(AGENT_ENDS + 10 + 5399);
    world.pass_to(Running, Reason::Running);
    world.go_to(AGENT_ENDS + 10 + 5400);
    assert_eq!(
        is_stopped(&mut world, Infrastructure, Reason::StartDeadline).message,
        "The images of the Pod were not pulled within 5400 s on node-a; these containers wait: evaluator-1, evaluator-2."
    );
    let mut world = collected();
    for name in ["evaluator-1", "evaluator-2"] {
        see(&mut world, waiting(name, "Odd", ""));
    }
    world.go_to(AGENT_ENDS + 10 + 1800);
    let message = is_stopped(&mut world, Infrastructure, Reason::StartDeadline).message;
    assert!(
        message.starts_with("The evaluators did not start within 1800 s, and node-a reports no reason: "),
        "{message}"
    );
}

/// Its files are being copied.
fn collecting() -> World {
    let mut world = agent_is_done();
    let began = Some(at(AGENT_ENDS));
    see(
        &mut world,
        ContainerView {
            began,
            ..running("collect")
        },
    );
    world
}

/// When the run of these worlds is over.
const RUN_ENDS: i64 = 10 + 86_400;

#[test]
fn a_copy_may_take_as_long_as_the_run() {
    let mut world = collecting();
    world.go_to(RUN_ENDS - 1);
    world.pass_to(Running, Reason::Running);
    world.go_to(RUN_ENDS);
    is_stopped(&mut world, Infrastructure, Reason::EvaluatorFailed);
}

#[test]
fn the_end_of_the_runs_time_is_charged_while_the_agent_runs() {
    let (mut world, _) = agent_runs();
    world.go_to(RUN_ENDS);
    let plan = world.pass_to(Running, Reason::Stopping);
    assert_eq!(annotated(&plan), Some(Stop::RunDeadline));
    assert_eq!(plan.status.failure.unwrap().class, Participant);

    let mut world = evaluating();
    world.go_to(RUN_ENDS - 1);
    world.pass_to(Running, Reason::Running);
    world.go_to(RUN_ENDS);
    assert_eq!(
        is_stopped(&mut world, Infrastructure, Reason::EvaluatorFailed).message,
        "The evaluators had not finished after the 86400 s of deadlines.runSeconds; finished units are kept."
    );
    // Their next Job has the whole time again, and the agent's files.
    world.complete();
    assert_eq!(world.pass_to(Pending, Reason::Replacing).status.retry, 1);

    // The Pod's own deadline.
    for (mut world, class, reason) in [
        (agent_runs().0, Participant, Reason::TimeLimit),
        (evaluating(), Infrastructure, Reason::EvaluatorFailed),
    ] {
        world.leaderboard().retries.infrastructure = 0;
        let (reason_of_job, message) = ("DeadlineExceeded".into(), "no more".into());
        world.job().end = Some(JobEnd::Failed {
            at: None,
            reason: reason_of_job,
            message,
        });
        world.view.report.stored = ObservedReport::Absent;
        assert_eq!(world.pass_to(Failed, reason).status.failure.unwrap().class, class);
    }
}

#[test]
fn images_of_evaluators_that_are_pulled_past_the_runs_time_have_their_own() {
    let mut world = collected();
    world.leaderboard().deadlines.run_seconds = Some(AGENT_ENDS);
    world.go_to(AGENT_ENDS + 5000);
    world.pass_to(Running, Reason::Running);
    // A Pod in its place begins with what the agent has left.
    let mut next = world.clone();
    next.view.pod = Some(pod(AGENT_ENDS + 4000));
    next.pod().created = Some(at(AGENT_ENDS + 4000));
    is_stopped(&mut next, Infrastructure, Reason::EvaluatorFailed);
    see(&mut world, running("evaluator-1"));
    is_stopped(&mut world, Infrastructure, Reason::EvaluatorFailed);
}

#[test]
fn a_sandbox_that_is_made_anew_counts_against_neither_side() {
    let made_anew = |world: &mut World, name: &str, restarts: i32, second: i64| {
        see(world, restarted("logcopy", restarts, "", 255, second));
        see(world, restarted(name, restarts, "silentDeath", 137, second));
        world.go_to(second + 1);
        let plan = world.pass_to(Running, Reason::Running);
        assert_eq!(plan.status.workers[0].crashes, 0, "{name} {restarts}");
    };
    let (mut world, _) = agent_runs();
    for time in 1..=5 {
        made_anew(&mut world, "agent-1", time, 100 * i64::from(time));
    }
    let mut world = evaluating();
    for time in 1..=5 {
        // The agent's runner finds its mark, and ends.
        see(&mut world, ended("agent-1", time, "incomplete", 0, AGENT_ENDS));
        made_anew(&mut world, "evaluator-1", time, 8000 + 100 * i64::from(time));
    }
    // An agent that was forgiven its crashes is not charged for it either.
    let (mut world, _) = agent_runs();
    see(&mut world, ended("agent-1", 2, "exited", 1, 100));
    world.go_to(100);
    assert_eq!(world.pass_to(Running, Reason::Running).status.workers[0].crashes, 3);
    world.go_to(AGENT_ENDS);
    for restarts in [3, 4] {
        see(&mut world, ended("agent-1", restarts, "incomplete", 0, AGENT_ENDS));
        world.pass_to(Running, Reason::Running);
    }
}

#[test]
fn a_stop_waits_for_no_image_of_an_evaluator() {
    let is_deleted = |plan: &Plan| has(plan, |action| matches!(action, Action::DeleteJob { .. }));
    for (mut world, ends) in [(agent_runs().0, true), (collected(), true), (evaluating(), false)] {
        world.submission().spec.cancel = true;
        for is_final in [false, true] {
            world.report(Report {
                is_final,
                stopped: is_final.then_some(Stop::Cancel),
                ..told(0)
            });
            let plan = world.pass_to(Running, Reason::Stopping);
            assert_eq!(is_deleted(&plan), ends && is_final);
        }
    }
}

#[test]
fn the_log_of_the_one_agent_explains_what_each_evaluator_refuses() {
    let mut world = evaluating();
    world.complete();
    world.report(Report {
        is_final: true,
        refused: Some(RefusedResults::new(Some(2), "Row 3 has no label.")),
        ..told(5)
    });
    let plan = world.pass_to(Failed, Reason::InvalidResults);
    assert_eq!(places(&plan), ["s3 agent/agent1/leaderboard.log", "node agent-1"]);
    let failure = plan.status.failure.unwrap();
    assert_eq!((failure.class, failure.worker), (Participant, Some(2)));
}

#[test]
fn a_cancel_is_obeyed_before_while_and_after_its_agent_runs() {
    let mut early = prepared();
    early.pass_to(Pending, Reason::Preparing);
    early.submission().spec.cancel = true;
    let plan = early.pass_to(Pending, Reason::Stopping);
    assert!(has(&plan, |action| matches!(action, Action::DeleteJob { .. })));

    for mut world in [agent_runs().0, collected(), evaluating()] {
        world.submission().spec.cancel = true;
        let plan = world.pass_to(Running, Reason::Stopping);
        assert_eq!(annotated(&plan), Some(Stop::Cancel));
        speaks_of_no_other_kind(&plan);
        world.complete();
        world.pass_to(Cancelled, Reason::Cancelled);
    }
}
