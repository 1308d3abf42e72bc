//! From the Job to its first agent: every cause of waiting, and its end.

use std::time::Duration;

use super::builders::*;
use crate::controller::submissions::decide::{Action, EvalaiUpdate};
use crate::controller::submissions::view::{ContainerView, ScaleUp, Turn};
use crate::pod::run::Stop;
use leaderboard_api::FailureClass::{self, Infrastructure, Participant};
use leaderboard_api::State::{Failed, Pending, Running};
use leaderboard_api::conditions::{RUNNING, STALLED};
use leaderboard_api::reasons;

const NOT_FOUND: &str = "rpc error: code = NotFound desc = failed to pull and unpack image \"r/x:1\": not found";

/// Whole seconds.
fn whole(requeue: Option<Duration>) -> Option<u64> {
    requeue.map(|after| after.as_secs())
}

fn back_off() -> String {
    format!("Back-off pulling image \"r/x:1\": ErrImagePull: {NOT_FOUND}")
}

#[test]
fn a_healthy_start_costs_one_write_and_no_event_until_its_agents_run() {
    let mut world = World::evalai().with_pod();
    let plan = world.pass_to(Pending, reasons::PREPARING);
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
    let plan = world.pass_to(Running, reasons::RUNNING);
    assert!(events(&plan).is_empty(), "the status shows it");
    assert_eq!(condition(&plan, RUNNING).0, "True");
    assert_eq!(evalai_updates(&plan), [EvalaiUpdate::Running]);
}

#[test]
fn a_silent_node_is_reported_in_steps() {
    let mut world = World::local().with_pod();
    let said = |world: &mut World, second| {
        world.go_to(second);
        world.pass_to(Pending, reasons::PREPARING).status.message.unwrap()
    };
    assert!(said(&mut world, 61).contains("on node-a: the operator's image is pulled and the workspace is filled."));
    assert!(said(&mut world, 130).contains("for over 2 min."));
    let five = said(&mut world, 300);
    assert!(five.contains("for over 5 min."));
    assert_eq!(said(&mut world, 590), five, "no write a minute");
}

/// A container that keeps its Pod from starting is shown at once, and fails it after `startSeconds`.
#[track_caller]
fn is_shown_then_fails(container: ContainerView, reason: &str, class: FailureClass, fails_as: &str) {
    let mut world = World::local().with_pod();
    world.leaderboard().retries.infrastructure = 0;
    world.see(container);
    let plan = world.pass_to(Pending, reason);
    assert_eq!(condition(&plan, STALLED), ("True".into(), reason.into()));
    assert_eq!(plan.status.failure, None);

    world.go_to(1799);
    world.pass_to(Pending, reason);
    world.go_to(1800);
    let plan = world.pass_to(Pending, reasons::STOPPING);
    assert!(has(&plan, |a| matches!(a, Action::DeleteJob { .. })));
    world.job_gone();
    let plan = world.pass_to(Failed, fails_as);
    assert_eq!(plan.status.failure.unwrap().class, class);
}

#[test]
fn an_image_that_cannot_be_pulled_is_its_owners_failure() {
    let status = |status: &str| format!("failed with status code [manifests 1]: {status}");
    let cases = [
        ("agent-1", NOT_FOUND.to_owned(), Participant),
        ("agent-1", back_off(), Participant),
        ("agent-1", status("401 Unauthorized"), Participant),
        (
            "agent-1",
            "no match for platform in manifest: not found".into(),
            Participant,
        ),
        (
            "agent-1",
            "dial tcp 10.0.0.1:443: connect: connection refused".into(),
            Infrastructure,
        ),
        ("agent-1", status("503 Service Unavailable"), Infrastructure),
        ("simulator-1", NOT_FOUND.to_owned(), Infrastructure),
        ("contents", NOT_FOUND.to_owned(), Infrastructure),
    ];
    for (name, words, class) in cases {
        let container = waiting(name, "ImagePullBackOff", &words);
        is_shown_then_fails(container, reasons::IMAGE_PULL, class, reasons::IMAGE_PULL);
    }
}

#[test]
fn a_container_that_cannot_be_set_up_or_started_says_why() {
    let cases = [
        (
            "agent-1",
            "CreateContainerConfigError",
            reasons::CONTAINER_CONFIG,
            Infrastructure,
        ),
        ("agent-1", "CreateContainerError", reasons::CANNOT_START, Participant),
        (
            "simulator-1",
            "RunContainerError",
            reasons::CANNOT_START,
            Infrastructure,
        ),
    ];
    for (name, word, reason, class) in cases {
        is_shown_then_fails(waiting(name, word, "it is missing"), reason, class, reason);
    }
}

#[test]
fn a_failing_preparation_is_the_hosts() {
    for name in ["contents", "workspace", "logcopy"] {
        let container = ended(name, 1, "Storage", 3, 5);
        is_shown_then_fails(container, reasons::PREPARING, Infrastructure, reasons::START_DEADLINE);
    }
}

#[test]
fn pulling_and_backing_off_are_one_message() {
    let mut world = World::local().with_pod();
    world.see(waiting("agent-1", "ErrImagePull", NOT_FOUND));
    let first = world.pass();
    assert_eq!(events(&first), [reasons::IMAGE_PULL]);
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
    world.pass_to(Pending, reasons::CONTAINER_CONFIG);
    world.see(running("agent-1"));
    assert_eq!(
        condition(&world.pass_to(Pending, reasons::PREPARING), STALLED).0,
        "False"
    );
}

#[test]
fn a_crashing_init_container_says_why_all_the_time() {
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
fn a_prefix_in_use_fails_at_once_and_is_not_tried_again() {
    let mut world = World::local().with_pod();
    let mut workspace = ended("workspace", 0, reasons::PREFIX_IN_USE, 1, 5);
    workspace.last.as_mut().unwrap().why = Some("results/77/ holds another's. Apply it with attempt: 2.".into());
    world.see(workspace);
    world.pass_to(Pending, reasons::STOPPING);
    world.job_gone();
    let failure = world.pass_to(Failed, reasons::PREFIX_IN_USE).status.failure.unwrap();
    assert_eq!(failure.class, Infrastructure);
    assert_eq!(
        failure.message,
        "results/77/ holds another's. Apply it with attempt: 2."
    );
}

#[test]
fn the_start_has_no_deadline_before_the_scheduler_has_spoken() {
    let mut world = World::local().with_pod();
    world.leaderboard().deadlines.start_seconds = 1;
    (world.pod().scheduled, world.pod().node) = (None, None);
    world.go_to(600);
    let plan = world.pass_to(Pending, reasons::PREPARING);
    assert!(
        plan.requeue.is_none_or(|pause| pause > Duration::ZERO),
        "{:?}",
        plan.requeue
    );
    world.pod().scheduled = Some(at(600));
    world.go_to(602);
    world.leaderboard().retries.infrastructure = 0;
    world.pass();
    assert_eq!(world.status().failure.unwrap().reason, reasons::START_DEADLINE);
}

#[test]
fn a_silent_kubelet_fails_as_infrastructure_after_start_seconds() {
    let mut world = World::local().with_pod();
    world.leaderboard().retries.infrastructure = 0;
    world.go_to(1800);
    world.pass_to(Pending, reasons::STOPPING);
    world.job_gone();
    let failure = world.pass_to(Failed, reasons::START_DEADLINE).status.failure.unwrap();
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
        world.pass_to(Pending, reasons::PREPARING);
    }
    world.leaderboard().tracks[0].deadlines = Some(leaderboard_api::TrackDeadlines {
        pull_seconds: Some(6000),
        ..Default::default()
    });
    world.go_to(5500);
    world.pass_to(Pending, reasons::PREPARING);
    world.leaderboard().tracks[0].deadlines = None;
    world.pass_to(Pending, reasons::STOPPING);
    world.job_gone();
    let failure = world.pass_to(Failed, reasons::START_DEADLINE).status.failure.unwrap();
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
    world.pass_to(Pending, reasons::PREPARING);
    world.see(waiting("contents", "ErrImagePull", "unexpected EOF"));
    let plan = world.pass_to(Pending, reasons::IMAGE_PULL);
    assert_eq!(events(&plan), [reasons::IMAGE_PULL]);
    world.go_to(5799);
    world.pass_to(Pending, reasons::IMAGE_PULL);
    world.go_to(5800);
    world.pass_to(Pending, reasons::STOPPING);
}

#[test]
fn without_a_node_it_waits_without_a_limit_and_shows_why() {
    let words = "0/1 nodes are available: 1 Insufficient nvidia.com/gpu.";
    let mut world = World::local().with_pod();
    let pod = world.pod();
    pod.scheduled = None;
    pod.node = None;
    pod.unschedulable = Some(words.into());
    world.go_to(4);
    let plan = world.pass_to(Pending, reasons::PREPARING);
    assert!(
        plan.requeue.is_some_and(|wait| wait <= Duration::from_secs(2)),
        "the Pod before it may still be leaving"
    );
    world.go_to(5);
    let plan = world.pass_to(Pending, reasons::UNSCHEDULABLE);
    assert_eq!(plan.status.message.as_deref(), Some(words));
    world.go_to(1_000_000);
    world.pass_to(Pending, reasons::UNSCHEDULABLE);

    world.leaderboard().deadlines.schedule_seconds = 1_000_001;
    world.pass_to(Pending, reasons::UNSCHEDULABLE);
    world.go_to(1_000_001);
    world.pass_to(Pending, reasons::STOPPING);
    world.job_gone();
    let failure = world
        .pass_to(Failed, reasons::SCHEDULE_DEADLINE)
        .status
        .failure
        .unwrap();
    assert_eq!(failure.class, Infrastructure);
    assert!(failure.message.contains(words));
}

/// Tools that follow kstatus take `Stalled=True` for a failure, which a wait for an autoscaled node is not.
#[test]
fn a_wait_for_a_node_is_a_stall_after_15_minutes_without_a_scale_up() {
    let coming = || Some(ScaleUp::Coming("pod triggered scale-up".into()));
    let refused = || Some(ScaleUp::Refused("pod didn't trigger scale-up".into()));
    let mut world = World::local().with_pod();
    let pod = world.pod();
    (pod.scheduled, pod.node) = (None, None);
    pod.unschedulable = Some("0/1 nodes are available".into());
    for (second, scale_up, expected) in [
        (10, None, "False"),
        (100, refused(), "False"),
        (909, None, "False"),
        (910, None, "True"),
        (911, coming(), "False"),
        (90_000, coming(), "False"),
        (90_001, refused(), "True"),
    ] {
        world.pod().scale_up = scale_up;
        world.go_to(second);
        let plan = world.pass_to(Pending, reasons::UNSCHEDULABLE);
        let stalled = condition(&plan, STALLED);
        assert_eq!(
            stalled,
            (expected.into(), reasons::UNSCHEDULABLE.into()),
            "after {second} s"
        );
        assert_eq!(plan.status.blocked_since.unwrap().time.0, at(10));
    }
}

#[test]
fn a_wait_for_a_slot_is_no_stall_and_names_its_reason() {
    for (turn, reason) in [
        (Turn::Wait { position: 3, eta: None }, reasons::WAITING_FOR_SLOT),
        (Turn::Paused { position: 3 }, reasons::PAUSED),
    ] {
        let mut world = World::local();
        world.view.turn = turn;
        let plan = world.pass_to(Pending, reason);
        assert_eq!(condition(&plan, STALLED), ("False".into(), reason.into()));
        assert_eq!(plan.status.blocked_since, None);
    }
}

#[test]
fn a_wait_for_a_node_says_whether_one_is_on_its_way() {
    let coming = ScaleUp::Coming("pod triggered scale-up: [{gpu 0->1 (max: 2)}]".into());
    let refused = ScaleUp::Refused("pod didn't trigger scale-up: 1 max node group size reached".into());
    for (said, expected) in [
        (None, "0/1 nodes are available."),
        (
            Some(coming),
            "0/1 nodes are available. A node is on its way: pod triggered scale-up: [{gpu 0->1 (max: 2)}].",
        ),
        (
            Some(refused),
            "0/1 nodes are available. The autoscaler adds no node: pod didn't trigger scale-up: 1 max node group size reached.",
        ),
    ] {
        let mut world = World::local().with_pod();
        let pod = world.pod();
        (pod.scheduled, pod.node, pod.scale_up) = (None, None, said);
        pod.unschedulable = Some("0/1 nodes are available".into());
        world.go_to(30);
        let plan = world.pass_to(Pending, reasons::UNSCHEDULABLE);
        assert_eq!(plan.status.message.as_deref(), Some(expected));
    }
}

#[test]
fn a_quota_or_a_refusal_is_shown_and_the_run_goes_on_once_it_is_fixed() {
    let cases = [
        (
            "pods \"x\" is forbidden: exceeded quota: q, requested: cpu=2",
            reasons::QUOTA_EXCEEDED,
        ),
        (
            "failed quota: q: must specify limits.memory for: m",
            reasons::QUOTA_EXCEEDED,
        ),
        ("violates PodSecurity \"restricted:v1.35\": x", reasons::POD_REFUSED),
    ];
    for (words, reason) in cases {
        let mut world = World::local().with_job();
        world.job().failed_create = Some(words.into());
        let plan = world.pass_to(Pending, reasons::PREPARING);
        assert_eq!(whole(plan.requeue), Some(5), "the Pod before it may be leaving");
        world.go_to(5);
        let plan = world.pass_to(Pending, reason);
        assert!(plan.status.message.unwrap().contains(words));
        world.go_to(1_000_000);
        world.pass_to(Pending, reason);
        world.job().failed_create = None;
        world.view.pod = Some(pod(1_000_000));
        world.pass_to(Pending, reasons::PREPARING);
    }
}

#[test]
fn a_job_that_the_api_server_refuses_is_shown_and_tried_again() {
    let cases = [
        (
            "exceeded quota: q, requested: count/jobs.batch=1",
            reasons::QUOTA_EXCEEDED,
        ),
        ("denied by a policy", reasons::POD_REFUSED),
    ];
    for (words, reason) in cases {
        let mut world = World::evalai();
        world.pass_to(Pending, reasons::PREPARING);
        world.view.job_refused = Some(words.into());
        let plan = world.pass_to(Pending, reason);
        assert!(creates(&plan));
        assert_eq!(evalai_updates(&plan), [EvalaiUpdate::Queued]);
        assert_eq!(condition(&plan, STALLED), ("True".to_owned(), reason.to_owned()));
        assert!(plan.status.message.unwrap().contains(words));
        world.view.job_refused = None;
        world.see_job();
        world.view.pod = Some(pod(0));
        world.pass_to(Pending, reasons::PREPARING);
    }
}

#[test]
fn a_job_without_a_pod_is_shown_when_it_lasts() {
    let mut world = World::local().with_job();
    world.go_to(44);
    let plan = world.pass();
    assert_eq!(condition(&plan, STALLED).0, "False");
    assert_eq!(whole(plan.requeue), Some(1));
    world.go_to(45);
    let plan = world.pass_to(Pending, reasons::PREPARING);
    assert_eq!(condition(&plan, STALLED).0, "True");
    assert!(plan.status.message.unwrap().contains("controller manager"));
}

#[test]
fn what_waits_is_looked_at_again_by_the_clock_or_when_it_is_woken() {
    type Sees = fn(&mut World);
    const BACKSTOP: u64 = 300;
    let refused: Sees = |world| world.job().failed_create = Some("exceeded quota: q".into());
    let unschedulable: Sees = |world| {
        world.view.pod = Some(pod(0));
        let pod = world.pod();
        (pod.scheduled, pod.node) = (None, None);
        pod.unschedulable = Some("0/1 nodes are available".into());
    };
    let prepared: Sees = |world| world.view.pod = Some(pod(0));
    let nothing: Sees = |_| {};
    let cases: [(&str, Sees, i64, u64); 8] = [
        ("no Pod yet", nothing, 10, 35),
        ("no Pod, and no reason", nothing, 50, BACKSTOP),
        ("a quota", refused, 10, BACKSTOP),
        ("no node yet", unschedulable, 1, 4),
        ("no node", unschedulable, 10, BACKSTOP),
        ("it is prepared", prepared, 10, 35),
        ("that takes long", prepared, 50, 70),
        ("that is reported for the last time", prepared, 3600, BACKSTOP),
    ];
    for (what, sees, second, expected) in cases {
        let mut world = World::local().with_job();
        let deadlines = &mut world.leaderboard().deadlines;
        (
            deadlines.schedule_seconds,
            deadlines.pull_seconds,
            deadlines.start_seconds,
        ) = (0, 10_000, 10_000);
        sees(&mut world);
        world.go_to(second);
        assert_eq!(whole(world.pass().requeue), Some(expected), "{what}");
    }
}

#[test]
fn an_agent_that_waits_for_a_simulator_without_image_is_no_run() {
    let mut world = World::evalai().with_pod();
    world.see_agents();
    for name in ["simulator-1", "simulator-2"] {
        world.see(waiting(name, "ErrImagePull", NOT_FOUND));
    }
    world.go_to(10);
    let plan = world.pass_to(Pending, reasons::IMAGE_PULL);
    assert!(plan.status.message.as_ref().unwrap().contains("simulator-1"));
    assert_eq!(evalai_updates(&plan), [], "it has begun, and does not run");
    world.go_to(10 + 1800);
    let plan = world.pass_to(Pending, reasons::STOPPING);
    let stop = Stop::Retries;
    assert!(has(&plan, |a| *a
        == Action::AnnotateStop {
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
    let plan = world.pass_to(Running, reasons::IMAGE_PULL);
    assert_eq!(plan.status.failure, None);
}

#[test]
fn an_image_name_that_the_kubelet_refuses_fails_at_once() {
    let words = "Failed to apply default image tag \"team/Agent\": couldn't parse image name";
    let mut world = World::local().with_pod();
    world.see(waiting("agent-1", "InvalidImageName", words));
    world.pass_to(Pending, reasons::STOPPING);
    world.job_gone();
    let failure = world.pass_to(Failed, reasons::IMAGE_INVALID).status.failure.unwrap();
    assert_eq!(failure.class, Participant);
    assert!(
        failure.message.contains("couldn't parse image name. Submit again"),
        "{}",
        failure.message
    );
    is_shown_then_fails(
        waiting("simulator-1", "InvalidImageName", words),
        reasons::IMAGE_PULL,
        Infrastructure,
        reasons::IMAGE_PULL,
    );
}
