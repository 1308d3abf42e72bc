//! Nodes that admit no Pod, end one, or are lost, silent or late under a run.

use super::builders::*;
use crate::submissions::Action;
use crate::view::{ObservedNode, ObservedReport, PodView};
use leaderboard_api::FailureClass::Infrastructure;
use leaderboard_api::State::{Failed, Pending, Running};
use leaderboard_api::{Attempt, FailedNode, JobNumber, Reason};

#[test]
fn a_node_that_does_not_come_back_is_given_up_and_another_job_made() {
    let mut world = World::evalai().running();
    world.go_to(100);
    world.pod().delete_by = Some(at(700));
    world.pass_to(Running, Reason::Replacing);
    world.go_to(729);
    world.pass_to(Running, Reason::Replacing);
    world.go_to(730);
    let plan = world.pass_to(Running, Reason::Replacing);
    let wanted = |a: &Action| matches!(a, Action::TakeOwnership | Action::DeletePod { .. });
    assert_eq!(plan.actions.iter().filter(|a| wanted(a)).count(), 2);
    assert!(has(&plan, |a| matches!(a, Action::DeleteJob { grace_seconds: 0, .. })));
    // A crash of ours before the actions: they are requested again.
    assert!(has(&world.pass(), |a| matches!(a, Action::DeletePod { .. })));
    world.job().deleting = true;
    world.pass_to(Running, Reason::Replacing);
    world.job_gone();
    let plan = world.pass_to(Pending, Reason::Replacing);
    assert!(plan.status.message.as_ref().unwrap().contains("Node node-a was lost"));
    assert_eq!((plan.status.retry, plan.status.attempt), (1, Some(Attempt(1))));
    assert!(!creates(&plan), "after a pause");
    world.wait(10);
    let plan = world.pass();
    assert!(has(&plan, |a| *a
        == Action::CreateJob(JobNumber {
            attempt: Attempt(1),
            retry: 1
        })));
    assert_eq!(evalai_updates(&plan), [], "EvalAI keeps saying running");
    assert_eq!(plan.status.job_name.as_deref(), Some("sub-1-r1"));
}

/// A Pod that somebody else deletes at second 100 with a grace of 600 s, on a node that is seen like this.
fn going(node: ObservedNode) -> World {
    let mut world = World::evalai().running();
    world.see(ended("agent-1", 2, "exited", 1, 50));
    world.see(running("agent-1"));
    world.go_to(100);
    world.pod().deleted = Some(at(100));
    world.pod().delete_by = Some(at(700));
    world.view.node.state = node;
    world
}

#[test]
fn a_node_that_is_away_is_reported_before_kubernetes_gives_its_pod_up() {
    let silent = ObservedNode::Silent { since: at(40) };
    for (node, words) in [
        (ObservedNode::Gone, "Node node-a is gone, and the Pod with it."),
        (silent, "node-a has been silent since 2026-01-01T00:00:40Z."),
    ] {
        let mut world = World::local().running();
        world.view.node.state = node;
        let plan = world.pass_to(Running, Reason::Replacing);
        assert!(
            plan.status.message.as_ref().unwrap().contains(words),
            "{:?}",
            plan.status.message
        );
        assert!(!has(&plan, |a| matches!(
            a,
            Action::DeleteJob { .. } | Action::DeletePod { .. }
        )));
        world.view.node.state = ObservedNode::Reports;
        world.pass_to(Running, Reason::Running);
        // For one that is being stopped, the stop is shown.
        world.view.node.state = node;
        world.submission().spec.cancel = true;
        world.pass_to(Running, Reason::Stopping);
    }
}

#[test]
fn a_pod_is_given_up_early_only_where_its_kubelet_is_silent() {
    let silent = |since| ObservedNode::Silent { since: at(since) };
    let cases = [
        ("silent before the eviction", silent(40), 130),
        ("silent since just now", silent(110), 140),
        ("silent late in its grace", silent(695), 725),
        ("no such node any more", ObservedNode::Gone, 130),
        ("the kubelet reports", ObservedNode::Reports, 820),
        ("nobody may look", ObservedNode::Unknown, 730),
    ];
    for (what, node, second) in cases {
        let mut world = going(node);
        world.pass_to(Running, Reason::Replacing);
        world.go_to(second - 1);
        let plan = world.pass_to(Running, Reason::Replacing);
        assert!(!has(&plan, |a| *a == Action::TakeOwnership), "{what}");
        let left = plan.requeue.unwrap();
        assert!(
            left <= std::time::Duration::from_millis(1050),
            "{what}: by exact requeue, not {left:?}"
        );
        world.go_to(second);
        let plan = world.pass_to(Running, Reason::Replacing);
        let order = plan.actions.iter().filter_map(|a| match a {
            Action::TakeOwnership => Some("fence"),
            Action::DeletePod { .. } => Some("pod"),
            Action::DeleteJob { grace_seconds: 0, .. } => Some("job"),
            _ => None,
        });
        assert_eq!(order.collect::<Vec<_>>(), ["fence", "pod", "job"], "{what}");
    }
}

#[test]
fn a_lost_node_costs_neither_an_attempt_nor_a_pairs_retry() {
    let mut world = going(ObservedNode::Silent { since: at(40) });
    world.pass();
    world.go_to(130);
    world.pass_to(Running, Reason::Replacing);
    world.job_gone();
    world.view.node.state = ObservedNode::Unknown;
    let plan = world.pass_to(Pending, Reason::Replacing);
    assert_eq!(
        (plan.status.attempt, plan.status.failure.as_ref()),
        (Some(Attempt(1)), None)
    );
    assert!(
        plan.status.workers.iter().all(|pair| pair.crashes == 0),
        "{:?}",
        plan.status.workers
    );
    assert!(plan.status.message.as_ref().unwrap().contains("Node node-a was lost"));
}

#[test]
fn a_kubelet_that_comes_back_in_time_keeps_its_pod() {
    let mut world = going(ObservedNode::Silent { since: at(90) });
    world.pass();
    world.go_to(129);
    world.pass();
    world.view.node.state = ObservedNode::Reports;
    world.go_to(400);
    let plan = world.pass_to(Running, Reason::Replacing);
    assert!(!has(&plan, |a| *a == Action::TakeOwnership));
    // It ends the Pod in order, and the Job makes another.
    world.view.pod = Some(PodView {
        uid: "pod-2".into(),
        ..pod(410)
    });
    world.view.node.state = ObservedNode::Unknown;
    world.go_to(500);
    let plan = world.pass_to(Running, Reason::Replacing);
    assert_eq!(plan.status.failure, None);
}

#[test]
fn a_pod_that_its_node_does_not_admit_ends_its_job_with_the_kubelets_words() {
    let words = "Pod was rejected: Allocate failed due to requested number of devices unavailable for nvidia.com/gpu. Requested: 1, \
                 Available: 0, which is unexpected";
    let mut world = World::local().with_pod();
    let refused = |world: &mut World| {
        world.view.pod = Some(pod(0));
        world.pod().ended_by_node = Some(("UnexpectedAdmissionError".into(), words.into()));
        let plan = world.pass_to(Pending, Reason::Stopping);
        assert!(has(&plan, |a| matches!(a, Action::DeleteJob { .. })));
        world.job_gone();
        plan.status.failure.unwrap()
    };
    let failure = refused(&mut world);
    assert_eq!(failure.class, Infrastructure);
    let expected = format!("On node node-a the kubelet did not admit the Pod (UnexpectedAdmissionError): {words}.");
    assert_eq!(failure.message, expected);
    let plan = world.pass_to(Pending, Reason::Replacing);
    let node_name = "node-a".into();
    assert_eq!(plan.status.failed_nodes, [FailedNode { node_name, jobs: 1 }]);
    world.wait(60);
    assert!(creates(&world.pass()));
    world.see_job();
    world.view.report.stored = ObservedReport::NotRead;
    refused(&mut world);
    world.pass_to(Failed, Reason::NodeCannotStart);
}

#[test]
fn a_pod_that_its_kubelet_ended_shows_why_and_its_job_makes_another() {
    for reason in ["OutOfcpu", "NodeShutdown"] {
        let mut world = World::local().with_pod();
        world.pod().ended_by_node = Some((reason.into(), "Pod was rejected: no more of it".into()));
        let plan = world.pass_to(Pending, Reason::Replacing);
        let message = plan.status.message.unwrap();
        let begin =
            format!("On node node-a the kubelet ended the Pod ({reason}): Pod was rejected: no more of it. A new Pod");
        assert!(message.starts_with(&begin), "{message}");
        assert_eq!(plan.status.failure, None);
    }
}
