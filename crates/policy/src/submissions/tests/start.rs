//! From the Job to its first agent: every cause of waiting, and its end.

use std::time::Duration;

use super::builders::*;
use crate::submissions::{Action, EvalaiUpdate};
use crate::view::ContainerView;
use leaderboard_api::FailureClass::{self, Infrastructure, Participant};
use leaderboard_api::State::{Failed, Pending, Running};
use leaderboard_api::conditions::{RUNNING, STALLED};
use leaderboard_api::{FailedNode, Reason};
use leaderboard_contract::run::Stop;

const NOT_FOUND: &str = "rpc error: code = NotFound desc = failed to pull and unpack image \"r/x:1\": failed to resolve reference \
                         \"r/x:1\": r/x:1: not found";
const CDI: &str = "failed to generate spec: failed to inject CDI devices: unresolvable CDI devices nvidia.com/gpu=0";
const NO_PROGRAM: &str = "OCI runtime create failed: runc create failed: unable to start container process: exec: \"/nope\": stat \
                          /nope: no such file or directory: unknown";

fn back_off() -> String {
    format!("Back-off pulling image \"r/x:1\": ErrImagePull: {NOT_FOUND}")
}

#[test]
fn a_healthy_start_costs_one_write_and_one_event_when_its_agents_run() {
    let mut world = World::evalai().with_pod();
    let plan = world.pass_to(Pending, Reason::Preparing);
    assert!(plan.events.is_empty());
    assert_eq!(plan.status.node_name.as_deref(), Some("node-a"));
    assert_eq!(evalai_updates(&plan), [EvalaiUpdate::Queued]);
    let before = world.status();
    for (second, name) in [(5, "contents"), (20, "workspace"), (40, "logcopy")] {
        world.go_to(second);
        world.see(ended(name, 0, "", 0, second));
        assert_eq!(world.pass().status, before, "{name}");
    }
    world.go_to(50);
    world.see_agents();
    let plan = world.pass_to(Running, Reason::Running);
    assert_eq!(plan.status.reason, None, "the state says it");
    assert_eq!(events(&plan), [Reason::Started]);
    assert_eq!(plan.events[0].message, "The agents of attempt 1 run on node node-a.");
    assert_eq!(condition(&plan, RUNNING), ("True".into(), Reason::Running.into()));
    assert_eq!(evalai_updates(&plan), [EvalaiUpdate::Running]);
    assert!(events(&world.pass()).is_empty(), "once");
}

#[test]
fn a_silent_node_is_reported_in_steps() {
    let mut world = World::local().with_pod();
    let said = |world: &mut World, second| {
        world.go_to(second);
        world.pass_to(Pending, Reason::Preparing).status.message.unwrap()
    };
    assert!(said(&mut world, 61).contains("on node-a: the operator's image is pulled and the workspace is filled."));
    assert!(said(&mut world, 130).contains("for over 2 min."));
    let five = said(&mut world, 300);
    assert!(five.contains("for over 5 min."));
    assert_eq!(said(&mut world, 590), five, "no write a minute");
}

/// A container that keeps its Pod from starting is shown at once, and fails it after `startSeconds`.
#[track_caller]
fn is_shown_then_fails(container: ContainerView, reason: Reason, class: FailureClass, fails_as: Reason) {
    let mut world = World::local().with_pod();
    world.leaderboard().retries.infrastructure = 0;
    world.see(container);
    let plan = world.pass_to(Pending, reason);
    assert_eq!(condition(&plan, STALLED), ("True".into(), reason.into()));
    assert_eq!(plan.status.failure, None);

    world.go_to(1799);
    world.pass_to(Pending, reason);
    world.go_to(1800);
    let plan = world.pass_to(Pending, Reason::Stopping);
    assert!(has(&plan, |a| matches!(a, Action::DeleteJob { .. })));
    world.job_gone();
    let plan = world.pass_to(Failed, fails_as);
    assert_eq!(plan.status.failure.unwrap().class, class);
}

#[test]
fn an_image_that_cannot_be_pulled_is_its_owners_failure_only_where_its_registry_has_none_that_fits() {
    let status = |status: &str| format!("failed with status code [manifests 1]: {status}");
    let cases = [
        ("agent-1", NOT_FOUND.to_owned(), Participant, Reason::ImageNotFound),
        ("agent-1", back_off(), Participant, Reason::ImageNotFound),
        (
            "agent-1",
            "no match for platform in manifest: not found".into(),
            Participant,
            Reason::ImagePlatform,
        ),
        (
            "agent-1",
            "unsupported media type application/x".into(),
            Participant,
            Reason::ImageInvalid,
        ),
        ("agent-1", status("401 Unauthorized"), Infrastructure, Reason::ImagePull),
        (
            "agent-1",
            "dial tcp 10.0.0.1:443: connect: connection refused".into(),
            Infrastructure,
            Reason::ImagePull,
        ),
        ("agent-1", "unheard of".into(), Infrastructure, Reason::ImagePull),
        ("simulator-1", NOT_FOUND.to_owned(), Infrastructure, Reason::ImagePull),
        ("contents", NOT_FOUND.to_owned(), Infrastructure, Reason::ImagePull),
    ];
    for (name, words, class, fails_as) in cases {
        let container = waiting(name, "ImagePullBackOff", &words);
        is_shown_then_fails(container, Reason::ImagePull, class, fails_as);
    }
}

#[test]
fn a_container_that_cannot_be_set_up_or_started_shows_why_and_only_a_proof_charges_the_participant() {
    use Reason::{CannotStart, ContainerConfig, NodeCannotStart};
    let (config, create, run) = (
        "CreateContainerConfigError",
        "CreateContainerError",
        "RunContainerError",
    );
    let root = "container has runAsNonRoot and image will run as root";
    let fails = |name, word, words, reason, class| {
        is_shown_then_fails(waiting(name, word, words), reason, class, reason);
    };
    fails(
        "agent-1",
        config,
        "secret \"s\" not found",
        ContainerConfig,
        Infrastructure,
    );
    fails("agent-1", create, "no users found", CannotStart, Participant);
    fails("agent-1", run, NO_PROGRAM, CannotStart, Participant);
    fails("agent-1", create, CDI, NodeCannotStart, Infrastructure);
    fails("agent-1", run, "unheard of", NodeCannotStart, Infrastructure);
    fails("simulator-1", run, NO_PROGRAM, CannotStart, Infrastructure);
    fails("simulator-1", create, CDI, NodeCannotStart, Infrastructure);
    fails("simulator-1", config, root, ContainerConfig, Infrastructure);
}

#[test]
fn an_image_whose_user_the_pod_forbids_is_refused_at_once_at_the_participants_cost() {
    for words in [
        "container has runAsNonRoot and image will run as root (pod: \"sub-1-x\", container: agent-1)",
        "container has runAsNonRoot and image has non-numeric user (carla), cannot verify user is non-root (pod: \"sub-1-x\")",
    ] {
        let mut world = World::local().with_pod();
        world.see(waiting("agent-1", "CreateContainerConfigError", words));
        let plan = world.pass_to(Pending, Reason::Stopping);
        assert!(has(&plan, |a| matches!(a, Action::DeleteJob { .. })));
        world.job_gone();
        let status = world.pass_to(Failed, Reason::ImageInvalid).status;
        let failure = status.failure.unwrap();
        assert_eq!((failure.class, failure.worker, status.retry), (Participant, Some(1), 0));
        assert!(failure.message.contains(words), "{}", failure.message);
        let shown = failure.participant_message.unwrap();
        assert!(
            shown.contains("Set USER of the image to a number") && !shown.contains("sub-1-x"),
            "{shown}"
        );
    }
}

#[test]
fn the_hosts_containers_are_looked_at_before_the_agents() {
    let mut world = World::local().with_pod();
    world.leaderboard().retries.infrastructure = 0;
    // As the kubelet sorts them.
    world.see_alone(waiting("agent-1", "CreateContainerError", "no users found"));
    world.see_alone(waiting("simulator-1", "CreateContainerError", CDI));
    let plan = world.pass_to(Pending, Reason::NodeCannotStart);
    assert!(plan.status.message.unwrap().contains("simulator-1"));
    world.go_to(1800);
    world.pass_to(Pending, Reason::Stopping);
    world.job_gone();
    let failure = world.pass_to(Failed, Reason::NodeCannotStart).status.failure.unwrap();
    assert_eq!((failure.class, failure.worker), (Infrastructure, None));
}

#[test]
fn a_node_that_cannot_start_a_container_is_named_and_remembered() {
    let mut world = World::local().with_pod();
    world.see(waiting("agent-2", "CreateContainerError", CDI));
    world.pass_to(Pending, Reason::NodeCannotStart);
    world.go_to(1800);
    world.pass_to(Pending, Reason::Stopping);
    world.job_gone();
    let plan = world.pass_to(Pending, Reason::Replacing);
    let message = plan.status.message.unwrap();
    assert!(message.contains("It was tried for 1800 s on node node-a."), "{message}");
    let node_name = "node-a".into();
    assert_eq!(plan.status.failed_nodes, [FailedNode { node_name, jobs: 1 }]);
}

#[test]
fn a_failing_preparation_is_the_hosts() {
    for name in ["contents", "workspace", "logcopy"] {
        let container = ended(name, 1, "Storage", 3, 5);
        is_shown_then_fails(container, Reason::Preparing, Infrastructure, Reason::StartDeadline);
    }
}

#[test]
fn pulling_and_backing_off_are_one_message() {
    let mut world = World::local().with_pod();
    world.see(waiting("agent-1", "ErrImagePull", NOT_FOUND));
    let first = world.pass();
    assert_eq!(events(&first), [Reason::ImagePull]);
    world.see(waiting("agent-1", "ImagePullBackOff", &back_off()));
    let second = world.pass();
    assert_eq!(second.status, first.status);
    assert!(second.events.is_empty());
}

#[test]
fn a_cause_that_is_fixed_is_forgotten() {
    let mut world = World::local().with_pod();
    world.see(waiting(
        "agent-1",
        "CreateContainerConfigError",
        "secret \"s\" not found",
    ));
    world.pass_to(Pending, Reason::ContainerConfig);
    world.see(running("agent-1"));
    assert_eq!(
        condition(&world.pass_to(Pending, Reason::Preparing), STALLED).0,
        "False"
    );
}

#[test]
fn a_crashing_init_container_shows_why_all_the_time() {
    let mut world = World::local().with_pod();
    let mut contents = ended("contents", 1, "", 3, 5);
    contents.last.as_mut().unwrap().why = Some("no space left".into());
    world.see(contents.clone());
    let before = world.pass().status;
    assert_eq!(before.message.as_deref(), Some("contents fails: no space left."));
    contents.waiting = Some(("CrashLoopBackOff".into(), "back-off 10s".into()));
    world.see(contents.clone());
    assert_eq!(world.pass().status, before);
    contents.waiting = None;
    contents.running = true;
    world.see(contents);
    assert_eq!(world.pass().status, before);
}

#[test]
fn the_start_has_no_deadline_before_the_scheduler_has_spoken() {
    let mut world = World::local().with_pod();
    world.leaderboard().deadlines.start_seconds = 1;
    (world.pod().scheduled, world.pod().node) = (None, None);
    world.go_to(600);
    let plan = world.pass_to(Pending, Reason::Preparing);
    assert!(
        plan.requeue.is_none_or(|pause| pause > Duration::ZERO),
        "{:?}",
        plan.requeue
    );
    world.pod().scheduled = Some(at(600));
    world.go_to(602);
    world.leaderboard().retries.infrastructure = 0;
    world.pass();
    assert_eq!(world.status().failure.unwrap().reason, Reason::StartDeadline);
}

#[test]
fn a_silent_kubelet_fails_as_infrastructure_after_start_seconds() {
    let mut world = World::local().with_pod();
    world.leaderboard().retries.infrastructure = 0;
    world.go_to(1800);
    world.pass_to(Pending, Reason::Stopping);
    world.job_gone();
    let failure = world.pass_to(Failed, Reason::StartDeadline).status.failure.unwrap();
    assert_eq!(failure.class, Infrastructure);
    assert!(failure.message.contains("node-a reports no reason"));
}

#[test]
fn slow_pulls_use_up_their_own_deadline_and_not_that_of_the_start() {
    let mut world = World::local().with_pod();
    world.leaderboard().retries.infrastructure = 0;
    world.see(ended("contents", 0, "", 0, 1500));
    world.see(ended("workspace", 0, "", 0, 1550));
    world.see(running("logcopy"));
    for name in ["simulator-1", "simulator-2", "agent-1", "agent-2"] {
        world.see(waiting(name, "PodInitializing", ""));
    }
    // Two containers of 50 s have run meanwhile.
    for second in [1801, 5400, 5499] {
        world.go_to(second);
        world.pass_to(Pending, Reason::Preparing);
    }
    world.leaderboard().tracks[0].deadlines = Some(leaderboard_api::TrackDeadlines {
        pull_seconds: Some(6000),
        ..Default::default()
    });
    world.go_to(5500);
    world.pass_to(Pending, Reason::Preparing);
    world.leaderboard().tracks[0].deadlines = None;
    world.pass_to(Pending, Reason::Stopping);
    world.job_gone();
    let failure = world.pass_to(Failed, Reason::StartDeadline).status.failure.unwrap();
    assert_eq!(failure.class, Infrastructure);
    let expected = "The images of the Pod were not pulled within 5400 s on node-a; these containers wait: simulator-1, simulator-2, \
                    agent-1, agent-2.";
    assert!(failure.message.starts_with(expected), "{}", failure.message);
}

#[test]
fn a_pull_that_fails_late_is_shown_at_once_and_has_the_time_of_a_start() {
    let mut world = World::local().with_pod();
    world.leaderboard().retries.infrastructure = 0;
    world.see(waiting("contents", "PodInitializing", ""));
    world.go_to(4000);
    world.pass_to(Pending, Reason::Preparing);
    world.see(waiting("contents", "ErrImagePull", "unexpected EOF"));
    let plan = world.pass_to(Pending, Reason::ImagePull);
    assert_eq!(events(&plan), [Reason::ImagePull]);
    world.go_to(5799);
    world.pass_to(Pending, Reason::ImagePull);
    world.go_to(5800);
    world.pass_to(Pending, Reason::Stopping);
}

#[test]
fn an_agent_that_waits_for_a_simulator_without_image_is_no_run() {
    let mut world = World::evalai().with_pod();
    world.see_agents();
    for name in ["simulator-1", "simulator-2"] {
        world.see(waiting(name, "ErrImagePull", NOT_FOUND));
    }
    world.go_to(10);
    let plan = world.pass_to(Pending, Reason::ImagePull);
    assert!(plan.status.message.as_ref().unwrap().contains("simulator-1"));
    assert_eq!(evalai_updates(&plan), [], "it has begun, and does not run");
    world.go_to(10 + 1800);
    let plan = world.pass_to(Pending, Reason::Stopping);
    let stop = Stop::Retries;
    assert!(has(&plan, |a| *a
        == Action::StopPod {
            pod: "sub-1-x".into(),
            stop
        }));
    assert_eq!(plan.status.failure.unwrap().class, Infrastructure);
}

#[test]
fn a_pull_that_fails_in_mid_run_is_shown_and_does_not_end_it() {
    let mut world = World::local().running();
    world.go_to(40_000);
    let mut agent = ended("agent-1", 1, "exited", 1, 39_000);
    agent.waiting = Some(("ErrImagePull".into(), "connection refused".into()));
    world.see(agent);
    let plan = world.pass_to(Running, Reason::ImagePull);
    assert_eq!(plan.status.failure, None);
}

#[test]
fn a_node_that_does_not_start_an_agent_again_in_mid_run_has_the_time_of_a_start() {
    let mut world = World::local().running();
    world.go_to(40_000);
    let mut agent = ended("agent-1", 1, "exited", 1, 39_000);
    agent.waiting = Some(("CreateContainerError".into(), CDI.into()));
    world.see(agent);
    world.pass_to(Running, Reason::NodeCannotStart);
    world.go_to(41_799);
    world.pass_to(Running, Reason::NodeCannotStart);
    world.go_to(41_800);
    let failure = world.pass_to(Running, Reason::Stopping).status.failure.unwrap();
    assert_eq!(
        (failure.reason.known().unwrap(), failure.class),
        (Reason::NodeCannotStart, Infrastructure)
    );
}

#[test]
fn an_image_name_that_the_kubelet_refuses_fails_at_once() {
    let words = "Failed to apply default image tag \"team/Agent\": couldn't parse image name";
    let mut world = World::local().with_pod();
    world.see(waiting("agent-1", "InvalidImageName", words));
    world.pass_to(Pending, Reason::Stopping);
    world.job_gone();
    let failure = world.pass_to(Failed, Reason::ImageInvalid).status.failure.unwrap();
    assert_eq!(failure.class, Participant);
    assert!(
        failure.message.contains("couldn't parse image name. Submit again"),
        "{}",
        failure.message
    );
    is_shown_then_fails(
        waiting("simulator-1", "InvalidImageName", words),
        Reason::ImagePull,
        Infrastructure,
        Reason::ImagePull,
    );
}
