//! A submission whose host evaluates with a container: what is pinned, whose fault its ends are, and in which words people read of them.

use serde_json::json;

use super::builders::*;
use super::log::places;
use crate::submissions::Plan;
use leaderboard_api::FailureClass::{Infrastructure, Participant};
use leaderboard_api::State::{Failed, Finished, Pending, Running};
use leaderboard_api::{
    Attempt, Evaluation, FailedNode, Failure, MergeMethod, Metric, Progress, Reason, State, WorkerState,
};
use leaderboard_contract::report::{Outcome, RefusedResults, Report, ReportWorker};

/// Words that only CARLA has.
const CARLAS: [&str; 9] = [
    "route",
    "pair",
    "imulator",
    "imulation",
    "sensor",
    "checkpoint",
    "infraction",
    "scenario",
    "CARLA",
];

/// A Leaderboard with two evaluators, and agents as their mode has them.
pub(super) fn of_mode(mode: &str) -> World {
    let mut world = World::local();
    let evaluation =
        json!({"container": {"mode": mode, "image": "evaluator:1", "command": ["/evaluate"], "workers": 2}});
    let spec = world.leaderboard();
    spec.evaluation = serde_json::from_value(evaluation).unwrap();
    spec.tracks[0].container = Some(serde_json::from_value(json!({"score": {"metric": "accuracy"}})).unwrap());
    world
}

fn local() -> World {
    of_mode("Interactive")
}

/// Its evaluators and agents run since second 10.
fn see_workers(world: &mut World) {
    world.view.pod = Some(pod(0));
    world.see_agents();
    world.pod().containers = ["logcopy", "evaluator-1", "evaluator-2", "agent-1", "agent-2"]
        .map(running)
        .to_vec();
}

fn under_way() -> World {
    let mut world = local().with_job();
    see_workers(&mut world);
    world.go_to(10);
    world.pass_to(Running, Reason::Running);
    world
}

/// The report of two evaluators that have done so many of ten units together.
pub(super) fn told(done: u32) -> Report {
    let worker = |id: u32, done: u32| ReportWorker {
        done,
        total: 5,
        ..report(0).workers[id as usize - 1].clone()
    };
    Report {
        done,
        total: 10,
        unit: "units".into(),
        workers: vec![worker(1, done.min(5)), worker(2, done.saturating_sub(5))],
        score: Some(Metric::new("accuracy", 0.5, 1)),
        metrics: vec![Metric::new("loss", 1.0, 1)],
        ..report(0)
    }
}

pub(super) fn complete() -> Report {
    Report {
        is_final: true,
        eligible: true,
        outcome: Outcome::Finished,
        ..told(10)
    }
}

fn spoiled(worker: Option<u32>, why: &str) -> Report {
    Report {
        is_final: true,
        unusable: Some(RefusedResults::new(worker, why)),
        ..told(5)
    }
}

/// All that people read of a status.
pub(super) fn texts(plan: &Plan) -> String {
    let status = &plan.status;
    let failure = status.failure.as_deref();
    let of_failure = failure.map(|failure| (&failure.message, &failure.next_step, &failure.participant_message));
    let conditions: Vec<&str> = status.conditions.iter().map(|condition| &*condition.message).collect();
    let events: Vec<&str> = plan.events.iter().map(|event| event.message.as_str()).collect();
    format!("{:?} {of_failure:?} {conditions:?} {events:?}", status.message)
}

#[track_caller]
pub(super) fn speaks_of_no_other_kind(plan: &Plan) {
    let texts = texts(plan);
    for word in CARLAS {
        assert!(!texts.contains(word), "{word}: {texts}");
    }
}

/// The Job is over with this report, and no retry is left.
#[track_caller]
fn ends_with(report: Report, state: State, reason: Reason) -> Plan {
    let mut world = under_way();
    world.leaderboard().retries.infrastructure = 0;
    world.complete();
    world.report(report);
    let plan = world.pass_to(state, reason);
    speaks_of_no_other_kind(&plan);
    plan
}

#[test]
fn the_plan_has_the_evaluator_and_its_results_are_the_runs() {
    let plan = local().pass_to(Pending, Reason::Preparing);
    let pinned = plan.status.plan.unwrap();
    let container = pinned.container().unwrap();
    assert_eq!((container.workers, &*container.image), (2, "evaluator:1"));
    assert_eq!(container.score.metric, "accuracy");
    assert_eq!(pinned.carla(), None);

    let plan = ends_with(complete(), Finished, Reason::Finished);
    let status = plan.status;
    assert_eq!(status.message.as_deref(), Some("10 of 10 units, accuracy 0.5."));
    assert_eq!(status.progress, Some(Progress::new(10, 10, "units")));
    assert_eq!(status.workers.len(), 2);
}

#[test]
fn a_check_runs_one_worker() {
    let mut world = local();
    world.submission().spec.check = true;
    let plan = world.pass_to(Pending, Reason::Preparing);
    assert_eq!(plan.status.plan.unwrap().workers(), 1);
}

#[test]
fn a_leaderboard_that_cannot_run_it_is_waited_for() {
    let mut world = local();
    world.leaderboard().tracks[0].container = None;
    let plan = world.pass_to(Pending, Reason::TrackNotFound);
    assert_eq!(
        plan.status.message.as_deref(),
        Some(
            "Leaderboard carla can't run the submission. Its track sensors names no score. Set container.score of the track."
        )
    );
    assert!(!creates(&plan) && plan.status.plan.is_none());

    // It was made anew between two attempts.
    let mut world = under_way();
    world.leaderboard().retries.infrastructure = 0;
    world.complete();
    world.pass_to(Failed, Reason::ResultsNotStored);
    let pinned = world.status().plan;
    world.leaderboard().evaluation = leaderboard(false).spec.evaluation;
    world.submission().spec.attempt = Attempt(2);
    world.job_gone();
    world.pass_to(Pending, Reason::Preparing);
    let plan = world.pass_to(Pending, Reason::TrackNotFound);
    assert!(!creates(&plan));
    let kept = plan.status.plan.unwrap();
    assert_eq!(Some(kept.evaluation), pinned.map(|plan| plan.evaluation));
}

/// The evaluator of worker 1 ends like this as often as it may, with so many units stored.
fn evaluator_fails(world: &mut World, what: &str, done: u32) -> Plan {
    world.see_alone(ended("evaluator-1", 3, what, 1, 100));
    let plan = world.pass_to(Running, Reason::Stopping);
    speaks_of_no_other_kind(&plan);
    world.complete();
    world.report(told(done));
    plan
}

#[test]
fn an_evaluator_that_fails_is_the_infrastructures_and_its_log_is_kept() {
    for (what, expected) in [
        (
            "exited",
            "The evaluator of worker 1 failed 4 times: it ended without a final result.",
        ),
        (
            "notReady",
            "The evaluator of worker 1 failed 4 times: it did not listen on its port in time, or had no final result in time.",
        ),
    ] {
        let mut world = under_way();
        let plan = evaluator_fails(&mut world, what, 0);
        assert_eq!(places(&plan), ["node evaluator-1"]);
        let failure = plan.status.failure.unwrap();
        assert_eq!(
            (failure.class, failure.reason.known()),
            (Infrastructure, Some(Reason::EvaluatorFailed))
        );
        assert_eq!((failure.message.as_str(), failure.worker), (expected, Some(1)));
        let expected = "The challenge's evaluator failed. Your submission is not the cause. Ask the challenge's hosts to resume the \
                        submission, or submit again.";
        assert_eq!(failure.participant_message.as_deref(), Some(expected));
    }
    let mut world = under_way();
    evaluator_fails(&mut world, "exited", 0);
    world.leaderboard().retries.infrastructure = 0;
    world.job_gone();
    let plan = world.pass_to(Failed, Reason::EvaluatorFailed);
    assert_eq!(places(&plan), ["s3 evaluators/1/console.log"]);
    speaks_of_no_other_kind(&plan);
}

#[test]
fn a_further_job_follows_once_and_then_only_if_more_is_done() {
    let runs_again = |world: &mut World| {
        let plan = world.pass_to(Pending, Reason::Replacing);
        speaks_of_no_other_kind(&plan);
        world.job_gone();
        world.wait(600);
        world.pass_to(Pending, Reason::Preparing);
        world.see_job();
        see_workers(world);
        world.pass_to(Running, Reason::Running);
    };
    let mut world = under_way();
    world.leaderboard().retries.infrastructure = 9;
    evaluator_fails(&mut world, "exited", 1);
    runs_again(&mut world);
    let suspect = FailedNode {
        node_name: "node-a".into(),
        jobs: 0,
    };
    assert_eq!(
        (world.status().done_before, world.status().failed_nodes),
        (Some(1), vec![suspect])
    );
    evaluator_fails(&mut world, "exited", 2);
    runs_again(&mut world);
    evaluator_fails(&mut world, "exited", 2);
    let plan = world.pass_to(Failed, Reason::EvaluatorFailed);
    speaks_of_no_other_kind(&plan);
    let message = plan.status.failure.unwrap().message;
    let rule = "The attempt had such an end before, and this Job has finished no unit, so no further Job follows.";
    assert!(message.contains(rule), "{message}");
}

/// The agent of worker 2 ends like this as often as it may.
fn agent_fails(what: &str) -> Failure {
    let mut world = under_way();
    world.see_alone(ended("agent-2", 3, what, 1, 100));
    world.see_alone(ended("evaluator-2", 3, "peerCrashed", 1, 100));
    let plan = world.pass_to(Running, Reason::Stopping);
    speaks_of_no_other_kind(&plan);
    *plan.status.failure.unwrap()
}

#[test]
fn an_agent_that_fails_is_the_participants() {
    for (what, reason) in [
        ("exited", Reason::AgentCrashed),
        ("silentDeath", Reason::AgentCrashed),
        ("incomplete", Reason::AgentCrashed),
        ("idle", Reason::Idle),
        ("cannotStart", Reason::CannotStart),
        ("notReady", Reason::AgentCrashed),
    ] {
        let failure = agent_fails(what);
        let found = (failure.reason.known(), failure.class, failure.worker);
        assert_eq!(found, (Some(reason), Participant, Some(2)), "{what}");
    }
    assert_eq!(
        agent_fails("exited").participant_message.as_deref(),
        Some(
            "Agent 2 crashed 4 times. Reproduce it on data of your own, fix the agent and submit again; the challenge's hosts have its log."
        )
    );
    let mut world = under_way();
    world.see_alone(ended("evaluator-2", 3, "portTaken", 1, 100));
    let plan = world.pass_to(Running, Reason::Stopping);
    speaks_of_no_other_kind(&plan);
    assert_eq!(
        plan.status.failure.unwrap().message,
        "Another container of the Pod listened on the port of evaluator 2, which failed 4 times. Let the agents listen on no port of an \
         evaluator, and submit again."
    );
}

#[test]
fn results_that_the_evaluator_has_spoiled_are_no_fault_of_the_participants() {
    let why =
        "evaluator 2: result.json can't be used: its schema is 2, and this operator reads 1. Write \"schema\": 1.";
    let failure = ends_with(spoiled(Some(2), why), Failed, Reason::EvaluatorFailed)
        .status
        .failure
        .unwrap();
    assert_eq!((failure.class, failure.worker), (Infrastructure, Some(2)));
    let begin = "Evaluator 2: result.json can't be used: its schema is 2, and this operator reads 1. Write \"schema\": 1. A file that cannot be \
                 used is kept at logcopy/refused/evaluators/2/result.json. Look at the evaluator's log and at evaluators/2/result.json; ";
    assert!(failure.message.starts_with(begin), "{}", failure.message);
    assert!(!failure.participant_message.unwrap().contains("schema"));
    let together = ends_with(
        spoiled(None, "the results have too many metrics."),
        Failed,
        Reason::EvaluatorFailed,
    );
    assert_eq!(together.status.failure.unwrap().worker, None);

    // It is tried once more, on another node.
    let mut world = under_way();
    world.complete();
    world.report(spoiled(Some(1), why));
    let plan = world.pass_to(Pending, Reason::Replacing);
    assert_eq!(plan.status.failed_nodes[0].node_name, "node-a");
    // What is not final may still be written anew.
    let mut world = under_way();
    world.report(Report {
        is_final: false,
        ..spoiled(Some(1), why)
    });
    world.pass_to(Running, Reason::Running);
}

#[test]
fn a_submission_that_the_evaluator_refuses_is_the_participants() {
    let refused = Report {
        is_final: true,
        refused: Some(RefusedResults::new(
            Some(1),
            "The agent answered with 3 labels where 10 were asked for.",
        )),
        unusable: Some(RefusedResults::new(
            Some(2),
            "evaluator 2 ended without a final result.",
        )),
        ..told(5)
    };
    let failure = ends_with(refused, Failed, Reason::InvalidResults)
        .status
        .failure
        .unwrap();
    assert_eq!((failure.class, failure.worker), (Participant, Some(1)));
    assert_eq!(
        failure.message,
        "The results cannot be used: The agent answered with 3 labels where 10 were asked for. Check what the agent sends to the evaluator, \
         and submit again."
    );
    let rejected = Report {
        eligible: false,
        outcome: Outcome::Rejected,
        ..complete()
    };
    let failure = ends_with(rejected, Failed, Reason::NotEligible).status.failure.unwrap();
    assert_eq!(failure.class, Participant);
}

/// A run like `under_way` whose results a third evaluator merges.
fn merging() -> World {
    let mut world = local();
    if let Evaluation::Container(container) = &mut world.leaderboard().evaluation {
        container.merge = MergeMethod::Command;
    }
    let mut world = world.with_job();
    see_workers(&mut world);
    world.see_alone(running("evaluator-3"));
    world.go_to(10);
    world.pass_to(Running, Reason::Running);
    world
}

#[test]
fn a_command_that_merges_and_fails_is_an_evaluator_beside_no_agent() {
    for (what, expected) in [
        ("exited", "it ended without a final result."),
        ("noResult", "it had no final result in time."),
    ] {
        let mut world = merging();
        world.see_alone(ended("evaluator-3", 0, what, 1, 50));
        let worker = world.pass_to(Running, Reason::Running).status.workers.pop().unwrap();
        assert_eq!((worker.id, worker.crashes), (3, 1), "{what}");
        world.see_alone(ended("evaluator-3", 3, what, 1, 100));
        let plan = world.pass_to(Running, Reason::Stopping);
        assert_eq!(places(&plan), ["node evaluator-3"]);
        speaks_of_no_other_kind(&plan);
        let failure = plan.status.failure.unwrap();
        assert_eq!(
            (failure.class, failure.reason.known()),
            (Infrastructure, Some(Reason::EvaluatorFailed))
        );
        let expected = format!("The evaluator of worker 3 failed 4 times: {expected}");
        assert_eq!((failure.message.as_str(), failure.worker), (expected.as_str(), Some(3)));
        world.leaderboard().retries.infrastructure = 9;
        world.complete();
        world.report(told(10));
        world.pass_to(Pending, Reason::Replacing);
    }
}

#[test]
fn the_time_in_which_a_command_merges_is_no_agents() {
    let (done, at_work) = (WorkerState::Done, WorkerState::Running);
    for (states, class, reason) in [
        (vec![], Participant, Reason::TimeLimit),
        (vec![done, at_work, done], Participant, Reason::TimeLimit),
        (vec![done, done, at_work], Infrastructure, Reason::EvaluatorFailed),
    ] {
        let mut world = merging();
        let worker = |(id, state)| ReportWorker {
            id,
            state,
            ..told(10).workers[0].clone()
        };
        world.report(Report {
            workers: (1..).zip(states.clone()).map(worker).collect(),
            ..told(10)
        });
        world.go_to(90_000);
        let failure = world.pass_to(Running, Reason::Stopping).status.failure.unwrap();
        assert_eq!(
            (failure.class, failure.reason.known()),
            (class, Some(reason)),
            "{states:?}"
        );
    }
}

#[test]
fn a_refusal_by_the_command_that_merges_is_the_participants_with_the_log_of_an_agent() {
    let mut world = merging();
    world.leaderboard().retries.infrastructure = 0;
    world.complete();
    world.report(Report {
        is_final: true,
        refused: Some(RefusedResults::new(Some(3), "Both files have row 7.")),
        ..told(10)
    });
    let plan = world.pass_to(Failed, Reason::InvalidResults);
    assert_eq!(places(&plan)[0], "s3 agent/agent1/leaderboard.log");
    let failure = plan.status.failure.unwrap();
    assert_eq!((failure.class, failure.worker), (Participant, Some(3)));
}

#[test]
fn no_other_end_speaks_of_another_kind_of_evaluation() {
    let mut late = under_way();
    late.go_to(90_000);
    speaks_of_no_other_kind(&late.pass_to(Running, Reason::Stopping));
    let mut cancelled = under_way();
    cancelled.submission().spec.cancel = true;
    speaks_of_no_other_kind(&cancelled.pass_to(Running, Reason::Stopping));
    let mut full = under_way();
    let words = "Usage of EmptyDir volume \"shm-evaluator-1\" exceeds the limit \"64Mi\". ";
    full.pod().ended_by_node = Some(("Evicted".into(), words.into()));
    let plan = full.pass_to(Running, Reason::Stopping);
    speaks_of_no_other_kind(&plan);
    assert_eq!(
        plan.status.failure.unwrap().class,
        Infrastructure,
        "an evaluator's memory is no agent's"
    );
    full = under_way();
    full.pod().ended_by_node = Some(("Evicted".into(), words.replace("evaluator", "agent")));
    assert_eq!(full.pass().status.failure.unwrap().class, Participant);
    let mut without_gpu = under_way();
    without_gpu.see_alone(ended("evaluator-1", 0, "noGpu", 69, 20));
    let plan = without_gpu.pass_to(Running, Reason::Stopping);
    speaks_of_no_other_kind(&plan);
    assert!(
        plan.status
            .failure
            .unwrap()
            .message
            .starts_with("Worker 1 lacks a GPU on node node-a")
    );
}

#[test]
fn a_pod_without_contents_goes_on_to_logcopy_after_its_workspace() {
    let mut world = local().with_job();
    world.view.pod = Some(pod(0));
    world.see_alone(ended("workspace", 0, "", 0, 20));
    world.see_alone(waiting("logcopy", "PodInitializing", ""));
    world.go_to(100);
    let plan = world.pass_to(Pending, Reason::Preparing);
    let message = plan.status.message.unwrap();
    assert!(message.contains("logcopy starts"), "{message}");
}
