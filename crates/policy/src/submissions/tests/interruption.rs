//! A node that is taken away under a run, and a Pod that is evicted.

use super::builders::*;
use crate::submissions::Action;
use crate::view::{JobEnd, ObservedNode, PodView};
use leaderboard_api::State::{Finished, Pending, Running};
use leaderboard_api::{Attempt, Interruptions, JobNumber, Reason, conditions};
use leaderboard_contract::report::{RefusedResults, Report};
use leaderboard_contract::run::Stop;

const TAINT: &str = "karpenter.sh/disrupted";

/// A run on a node that gets the taint at second 100; no failure of the infrastructure is retried.
fn leaving() -> World {
    let mut world = World::evalai().running();
    world.leaderboard().retries.infrastructure = 0;
    world.go_to(100);
    world.view.node.state = ObservedNode::Reports;
    world.view.node.leaving = Some(TAINT.into());
    world
}

/// The next Job's Pod runs on this node.
fn on(world: &mut World, node: &str) {
    world.view.node.leaving = None;
    world.job_gone();
    assert!(creates(&world.pass()));
    world.see_job();
    world.view.pod = Some(PodView {
        node: Some(node.into()),
        ..pod(world.view.now.as_second() - at(0).as_second())
    });
    world.see_agents();
    world.pass_to(Running, Reason::Running);
}

/// The Pod of an interrupted run has stored all and ended.
fn ends(world: &mut World) -> Option<Interruptions> {
    world.pass_to(Running, Reason::Replacing);
    world.wait(20);
    world.complete();
    world
        .pass_to(Pending, Reason::Replacing)
        .status
        .interruptions
        .map(|known| *known)
}

#[test]
fn a_node_that_is_about_to_go_is_left_with_all_that_was_reached() {
    let mut world = leaving();
    let plan = world.pass_to(Running, Reason::Replacing);
    assert_eq!(annotated(&plan), Some(Stop::Interruption));
    assert!(
        !has(&plan, |a| matches!(a, Action::DeleteJob { .. })),
        "it ends by itself"
    );
    let expected = "Node node-a is about to be taken away (taint karpenter.sh/disrupted). Its results are being stored; a new Job \
                    resumes from them.";
    assert_eq!(plan.status.message.as_deref(), Some(expected));
    assert_eq!(evalai_updates(&plan), [], "EvalAI keeps saying running");
    world.pod().stop = Some(Stop::Interruption);
    world.go_to(120);
    world.complete();
    let plan = world.pass_to(Pending, Reason::Replacing);
    assert!(
        plan.status
            .message
            .unwrap()
            .ends_with("this costs neither an attempt nor a retry.")
    );
    assert_eq!((plan.status.attempt, plan.status.retry), (Some(Attempt(1)), 1));
    assert_eq!((plan.status.failure, plan.status.done_before), (None, None));
    let known = plan.status.interruptions.unwrap();
    assert_eq!((known.number, known.nodes), (1, vec!["node-a".to_owned()]));
    world.job_gone();
    let plan = world.pass();
    assert!(
        has(&plan, |a| *a
            == Action::CreateJob(JobNumber {
                attempt: Attempt(1),
                retry: 1
            })),
        "at once"
    );
}

#[test]
fn a_pod_that_does_not_end_in_time_is_ended_before_its_node_is() {
    let mut world = leaving();
    world.pass();
    world.pod().stop = Some(Stop::Interruption);
    for (second, grace) in [(189, None), (190, Some(5)), (209, Some(5)), (210, Some(0))] {
        world.go_to(second);
        let plan = world.pass_to(Running, Reason::Replacing);
        let deletion = plan.actions.iter().find_map(|action| match action {
            Action::DeleteJob { grace_seconds, .. } => Some(*grace_seconds),
            _ => None,
        });
        assert_eq!(deletion, grace, "{second}");
        assert_eq!(has(&plan, |a| *a == Action::TakeOwnership), second == 210, "{second}");
    }
    world.job_gone();
    let status = world.pass_to(Pending, Reason::Replacing).status;
    assert_eq!(status.interruptions.unwrap().number, 1);
}

#[test]
fn who_takes_a_pod_away_decides_whether_it_is_an_interruption() {
    let silent = ObservedNode::Silent { since: at(90) };
    for (who, node, is_one) in [
        ("EvictionByEvictionAPI", ObservedNode::Unknown, true),
        ("PreemptionByScheduler", ObservedNode::Reports, true),
        // An agent can take its node's memory.
        ("DeletionByTaintManager", silent, false),
        ("DeletionByTaintManager", ObservedNode::Reports, false),
        ("TerminationByKubelet", ObservedNode::Reports, false),
        ("DeletionByPodGC", ObservedNode::Gone, false),
    ] {
        let mut world = World::local().running();
        world.go_to(100);
        world.view.node.state = node;
        let pod = world.pod();
        (pod.disruption, pod.deleted, pod.delete_by) = (Some(who.into()), Some(at(100)), Some(at(700)));
        let plan = world.pass_to(Running, Reason::Replacing);
        let failure = plan.status.failure.as_ref().and_then(|failure| failure.reason.known());
        assert_eq!(failure, is_one.then_some(Reason::NodeInterrupted), "{who}");
        // The Job makes no other Pod, and the Pod has the time that there is.
        let is_ended = has(&plan, |a| matches!(a, Action::DeleteJob { grace_seconds: 90, .. }));
        assert_eq!(is_ended, is_one, "{who}");
    }
}

#[test]
fn a_pod_that_has_not_begun_leaves_at_once() {
    let mut world = World::local().with_pod();
    world.view.node.leaving = Some(TAINT.into());
    let plan = world.pass_to(Pending, Reason::Replacing);
    assert!(has(&plan, |a| matches!(a, Action::DeleteJob { grace_seconds: 5, .. })));
    assert_eq!(annotated(&plan), None);
}

#[test]
fn a_pod_that_tolerates_the_taint_is_not_moved_in_circles() {
    let mut world = leaving();
    assert_eq!(ends(&mut world).unwrap().number, 1);
    on(&mut world, "node-a");
    world.view.node.leaving = Some(TAINT.into());
    assert_eq!(world.pass_to(Running, Reason::Running).status.failure, None);
    // Another node is another matter.
    world.view.node.leaving = None;
    world.pod().node = Some("node-b".into());
    world.pass();
    world.view.node.leaving = Some(TAINT.into());
    let known = ends(&mut world).unwrap();
    assert_eq!(
        (known.number, known.nodes),
        (2, vec!["node-a".to_owned(), "node-b".to_owned()])
    );
}

#[test]
fn a_cluster_that_takes_every_node_away_comes_to_an_end() {
    let mut world = leaving();
    for number in 1..=20 {
        let known = ends(&mut world).unwrap();
        assert_eq!(known.number, number);
        assert!(known.nodes.len() <= leaderboard_api::MAX_INTERRUPTED_NODES);
        on(&mut world, &format!("node-{number}"));
        world.view.node.leaving = Some(TAINT.into());
    }
    let status = world.pass_to(Running, Reason::Running).status;
    assert_eq!((status.failure, status.retry), (None, 20));
}

#[test]
fn interruptions_use_up_no_retry_and_put_no_other_off() {
    let mut world = leaving();
    world.leaderboard().retries.infrastructure = 1;
    ends(&mut world);
    on(&mut world, "node-b");
    world.view.report.stored = super::super::super::view::ObservedReport::Absent;
    world.complete();
    let plan = world.pass_to(Pending, Reason::Replacing);
    assert!(
        plan.status
            .message
            .unwrap()
            .contains("The submission is tried again in 10 s"),
        "the first of its kind"
    );
    assert_eq!(plan.status.retry, 2);
    assert_eq!(plan.status.interruptions.unwrap().number, 1);
}

#[test]
fn a_cancel_and_a_complete_result_come_before_an_interruption() {
    let mut world = leaving();
    world.pass();
    world.submission().spec.cancel = true;
    world.pass_to(Running, Reason::Stopping);

    let mut world = leaving();
    world.pass();
    world.complete();
    world.report(final_report());
    let status = world.pass_to(Finished, Reason::Finished).status;
    assert_eq!((status.retry, status.interruptions), (0, None));
}

/// A Job that follows this run, which is stopped and has stored a refused checkpoint; its Pod has a node and has stored nothing yet.
fn followed(mut world: World, stop: Stop) -> World {
    world.leaderboard().retries.infrastructure = 2;
    world.pass();
    world.wait(20);
    world.complete();
    world.report(Report {
        is_final: true,
        refused: Some(RefusedResults::new(None, "nonsense")),
        stopped: Some(stop),
        ..report(2)
    });
    world.pass_to(Pending, Reason::Replacing);
    world.view.node.leaving = None;
    world.job_gone();
    // One that has failed waits before it is tried again.
    world.wait(20);
    assert!(creates(&world.pass()));
    world.see_job();
    world.view.pod = Some(PodView {
        uid: "pod-2".into(),
        ..pod(200)
    });
    world.pass();
    world
}

#[test]
fn what_a_stopped_run_has_stored_is_no_verdict_on_the_job_that_follows() {
    let mut crashed = World::evalai().running();
    crashed.see_alone(ended("simulator-1", 3, "exited", 1, 100));
    for (world, stop) in [(leaving(), Stop::Interruption), (crashed, Stop::Retries)] {
        let mut deleted = followed(world, stop);
        let mut ended = deleted.clone();
        deleted.job_gone();
        let plan = deleted.pass();
        assert!(creates(&plan), "{stop:?}: {:?}", plan.status.failure);
        assert!(events(&plan).contains(&Reason::JobRecreated.into()), "{stop:?}");

        let now = ended.view.now;
        ended.job().end = Some(JobEnd::Complete { at: Some(now) });
        let plan = ended.pass();
        let running = conditions::get(&plan.status.conditions, conditions::RUNNING).unwrap();
        assert_eq!(running.reason, Reason::ResultsNotStored, "{stop:?}");
    }
}
