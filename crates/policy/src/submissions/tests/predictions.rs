//! A run of the mode Predictions: a file, and the evaluators that read it. People read of no agent.

use super::builders::*;
use super::container::{complete, of_mode, speaks_of_no_other_kind, texts, told};
use super::log::places;
use crate::submissions::{Action, Plan};
use leaderboard_api::FailureClass::{self, Infrastructure, Participant};
use leaderboard_api::State::{Cancelled, Failed, Finished, Pending, Running};
use leaderboard_api::conditions::RUNNING;
use leaderboard_api::{Reason, SubmittedFile};
use leaderboard_contract::report::{Outcome, RefusedResults, Report};
use leaderboard_contract::run::Stop;

fn file() -> SubmittedFile {
    SubmittedFile {
        sha256: "a".repeat(64),
        size: 12,
    }
}

pub(super) fn local() -> World {
    let mut world = of_mode("Predictions");
    let spec = &mut world.submission().spec;
    (spec.image, spec.input) = (None, Some(file()));
    world
}

/// The Pod is on its node; its workspace is being filled.
fn with_pod() -> World {
    let mut world = local().with_job();
    world.view.pod = Some(pod(0));
    let containers = ["workspace", "logcopy", "evaluator-1", "evaluator-2"];
    world.pod().containers = containers.map(|name| waiting(name, "PodInitializing", "")).to_vec();
    world
}

/// Its evaluators run since second 10.
fn see_evaluators(world: &mut World) {
    let pod = world.pod();
    (pod.agent_started, pod.logcopy_running) = (Some(at(10)), true);
    let containers = ["logcopy", "evaluator-1", "evaluator-2"];
    pod.containers = containers.map(running).to_vec();
    pod.containers.push(ended("workspace", 0, "", 0, 5));
}

fn evaluating() -> World {
    let mut world = with_pod();
    see_evaluators(&mut world);
    world.go_to(10);
    world.pass_to(Running, Reason::Running);
    world
}

#[track_caller]
fn speaks_of_no_agent(plan: &Plan) {
    speaks_of_no_other_kind(plan);
    let texts = texts(plan).to_lowercase();
    assert!(!texts.contains("agent"), "{texts}");
}

#[test]
fn it_runs_from_its_file_to_its_score() {
    let mut world = local();
    let plan = world.pass_to(Pending, Reason::Preparing);
    assert!(creates(&plan));
    assert_eq!(plan.status.input, Some(file()));
    assert_eq!(plan.status.plan.as_ref().unwrap().image, None);
    speaks_of_no_agent(&plan);

    let mut world = with_pod();
    for second in [5, 100] {
        world.go_to(second);
        speaks_of_no_agent(&world.pass_to(Pending, Reason::Preparing));
    }
    see_evaluators(&mut world);
    let plan = world.pass_to(Running, Reason::Running);
    assert_eq!(
        plan.events[0].message,
        "The evaluators of attempt 1 run on node node-a."
    );
    assert_eq!(condition(&plan, RUNNING).0, "True");
    assert_eq!(plan.status.times.started.as_ref().map(|time| time.0), Some(at(10)));
    speaks_of_no_agent(&plan);

    world.report(told(4));
    let plan = world.pass_to(Running, Reason::Running);
    assert_eq!(plan.status.message.as_deref(), Some("4/10 units done."));
    world.complete();
    world.report(complete());
    let plan = world.pass_to(Finished, Reason::Finished);
    assert_eq!((&plan.status.image, &plan.status.input), (&None, &Some(file())));
    speaks_of_no_agent(&plan);
}

type End = fn(&mut World);

/// Ends of a run under way, with their class and reason, and where their log is once the Job has ended.
const ENDS: [(End, FailureClass, Reason, &[&str]); 6] = [
    (
        |world| world.see_alone(ended("evaluator-1", 3, "exited", 1, 100)),
        Infrastructure,
        Reason::EvaluatorFailed,
        &["node evaluator-1", "s3 evaluators/1/console.log"],
    ),
    (
        |world| world.see_alone(ended("evaluator-2", 3, "noProcess", 75, 100)),
        Infrastructure,
        Reason::EvaluatorFailed,
        &["node evaluator-2", "s3 evaluators/2/console.log"],
    ),
    (
        |world| world.see_alone(ended("evaluator-1", 0, "noGpu", 69, 100)),
        Infrastructure,
        Reason::NoGPU,
        &[],
    ),
    (
        |world| world.go_to(90_000),
        Infrastructure,
        Reason::EvaluatorFailed,
        &["node evaluator-1", "s3 evaluators/1/console.log"],
    ),
    (
        |world| {
            let words = "Usage of EmptyDir volume \"logs\" exceeds the limit \"2Gi\". ";
            world.pod().ended_by_node = Some(("Evicted".into(), words.into()));
        },
        Infrastructure,
        Reason::DiskFull,
        &["s3 evaluators/1/console.log", "node evaluator-1"],
    ),
    (
        |world| world.see_alone(waiting("evaluator-2", "InvalidImageName", "it has spaces")),
        Infrastructure,
        Reason::ImagePull,
        &[],
    ),
];

#[test]
fn no_end_of_a_run_speaks_of_an_agent() {
    for (end, class, reason, log) in ENDS {
        let mut world = evaluating();
        world.leaderboard().retries.infrastructure = 0;
        end(&mut world);
        if reason == Reason::ImagePull {
            world.pass_to(Running, reason);
            world.go_to(9000);
        }
        let plan = world.pass_to(Running, Reason::Stopping);
        speaks_of_no_agent(&plan);
        assert_eq!(plan.status.failure.as_ref().unwrap().class, class, "{reason}");
        world.complete();
        let plan = world.pass_to(Failed, reason);
        speaks_of_no_agent(&plan);
        assert_eq!(places(&plan), log, "{reason}");
    }
}

#[test]
fn an_evaluator_without_a_final_result_was_late_and_not_deaf() {
    let mut world = evaluating();
    world.see_alone(ended("evaluator-1", 3, "noResult", 1, 100));
    let failure = world.pass_to(Running, Reason::Stopping).status.failure.unwrap();
    assert_eq!(
        failure.message,
        "The evaluator of worker 1 failed 4 times: it had no final result in time."
    );
    let mut world = evaluating();
    world.see_alone(ended("evaluator-1", 2, "noResult", 1, 100));
    world.pass_to(Running, Reason::Running);
}

#[test]
fn a_file_that_is_refused_or_does_not_count_is_the_participants() {
    let refused = Report {
        is_final: true,
        refused: Some(RefusedResults::new(Some(2), "Row 3 has no label.")),
        ..told(5)
    };
    let rejected = Report {
        eligible: false,
        outcome: Outcome::Rejected,
        ..complete()
    };
    for (report, reason, log) in [
        (refused, Reason::InvalidResults, "s3 evaluators/2/console.log"),
        (rejected, Reason::NotEligible, "s3 evaluators/1/console.log"),
    ] {
        let mut world = evaluating();
        world.complete();
        world.report(report);
        let plan = world.pass_to(Failed, reason);
        speaks_of_no_agent(&plan);
        assert_eq!(places(&plan)[0], log);
        assert_eq!(plan.status.failure.unwrap().class, Participant);
    }
}

#[test]
fn a_file_that_is_not_in_the_bucket_ends_the_run_at_once_and_for_good() {
    let mut world = with_pod();
    let mut workspace = ended("workspace", 0, "InputMissing", 1, 20);
    workspace.last.as_mut().unwrap().why = Some("s3://results/sub/input/file is missing.".into());
    world.see_alone(workspace);
    let plan = world.pass_to(Pending, Reason::Stopping);
    assert!(has(&plan, |action| matches!(action, Action::DeleteJob { .. })));
    world.job_gone();
    let plan = world.pass_to(Failed, Reason::InputMissing);
    speaks_of_no_agent(&plan);
    assert_eq!(plan.status.retry, 0);
    let failure = plan.status.failure.unwrap();
    assert_eq!(failure.class, Infrastructure);
    assert!(
        failure
            .message
            .starts_with("s3://results/sub/input/file is missing. Check "),
        "{}",
        failure.message
    );
    assert_eq!(
        failure.participant_message.as_deref(),
        Some(
            "The submitted file could not be read. Your submission is not the cause. Ask the challenge's hosts to resume the submission, or \
             submit again."
        )
    );
}

#[test]
fn a_cancel_is_obeyed_as_of_other_runs() {
    let mut world = with_pod();
    world.submission().spec.cancel = true;
    let plan = world.pass_to(Pending, Reason::Stopping);
    assert!(has(&plan, |action| matches!(action, Action::DeleteJob { .. })));
    speaks_of_no_agent(&plan);

    let mut world = evaluating();
    world.submission().spec.cancel = true;
    let plan = world.pass_to(Running, Reason::Stopping);
    assert_eq!(annotated(&plan), Some(Stop::Cancel));
    speaks_of_no_agent(&plan);
    world.complete();
    speaks_of_no_agent(&world.pass_to(Cancelled, Reason::Cancelled));
}
