//! The waits of a run before its Pod is prepared, for a node, a quota or a slot, and how they show.

use std::time::Duration;

use super::builders::*;
use crate::submissions::EvalaiUpdate;
use crate::view::{ObservedJob, ScaleUp, Turn};
use leaderboard_api::FailureClass::Infrastructure;
use leaderboard_api::Reason;
use leaderboard_api::State::{Failed, Pending};
use leaderboard_api::conditions::STALLED;

/// Whole seconds.
fn whole(requeue: Option<Duration>) -> Option<u64> {
    requeue.map(|after| after.as_secs())
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
    let plan = world.pass_to(Pending, Reason::Preparing);
    assert!(
        plan.requeue.is_some_and(|wait| wait <= Duration::from_secs(2)),
        "the Pod before it may still be leaving"
    );
    world.go_to(5);
    let plan = world.pass_to(Pending, Reason::Unschedulable);
    assert_eq!(plan.status.message.as_deref(), Some(words));
    world.go_to(1_000_000);
    world.pass_to(Pending, Reason::Unschedulable);

    world.leaderboard().deadlines.schedule_seconds = Some(1_000_001);
    world.pass_to(Pending, Reason::Unschedulable);
    world.go_to(1_000_001);
    world.pass_to(Pending, Reason::Stopping);
    world.job_gone();
    let failure = world.pass_to(Failed, Reason::ScheduleDeadline).status.failure.unwrap();
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
        let plan = world.pass_to(Pending, Reason::Unschedulable);
        let stalled = condition(&plan, STALLED);
        assert_eq!(
            stalled,
            (expected.into(), Reason::Unschedulable.into()),
            "after {second} s"
        );
        assert_eq!(plan.status.blocked_since.unwrap().time.0, at(10));
    }
}

#[test]
fn a_wait_for_a_slot_is_no_stall_and_names_its_reason() {
    for (turn, reason) in [
        (Turn::Wait { position: 3, eta: None }, Reason::WaitingForSlot),
        (Turn::Paused { position: 3 }, Reason::Paused),
    ] {
        let mut world = World::local();
        world.view.turn = turn;
        let plan = world.pass_to(Pending, reason);
        assert_eq!(condition(&plan, STALLED), ("False".into(), reason.into()));
        assert_eq!(plan.status.blocked_since, None);
    }
}

#[test]
fn a_wait_for_a_node_shows_whether_one_is_on_its_way() {
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
        let plan = world.pass_to(Pending, Reason::Unschedulable);
        assert_eq!(plan.status.message.as_deref(), Some(expected));
    }
}

#[test]
fn a_quota_or_a_refusal_is_shown_and_the_run_goes_on_once_it_is_fixed() {
    let cases = [
        (
            "pods \"x\" is forbidden: exceeded quota: q, requested: cpu=2",
            Reason::QuotaExceeded,
        ),
        (
            "failed quota: q: must specify limits.memory for: m",
            Reason::QuotaExceeded,
        ),
        ("violates PodSecurity \"restricted:v1.35\": x", Reason::PodRefused),
    ];
    for (words, reason) in cases {
        let mut world = World::local().with_job();
        world.job().failed_create = Some(words.into());
        let plan = world.pass_to(Pending, Reason::Preparing);
        assert_eq!(whole(plan.requeue), Some(5), "the Pod before it may be leaving");
        world.go_to(5);
        let plan = world.pass_to(Pending, reason);
        assert!(plan.status.message.unwrap().contains(words));
        world.go_to(1_000_000);
        world.pass_to(Pending, reason);
        world.job().failed_create = None;
        world.view.pod = Some(pod(1_000_000));
        world.pass_to(Pending, Reason::Preparing);
    }
}

#[test]
fn a_job_that_the_api_server_refuses_is_shown_and_tried_again() {
    let cases = [
        (
            "exceeded quota: q, requested: count/jobs.batch=1",
            Reason::QuotaExceeded,
        ),
        ("denied by a policy", Reason::PodRefused),
    ];
    for (words, reason) in cases {
        let mut world = World::evalai();
        world.pass_to(Pending, Reason::Preparing);
        world.view.job = ObservedJob::Absent {
            refused: Some(words.into()),
        };
        let plan = world.pass_to(Pending, reason);
        assert!(creates(&plan));
        assert_eq!(evalai_updates(&plan), [EvalaiUpdate::Queued]);
        assert_eq!(condition(&plan, STALLED), ("True".to_owned(), reason.into()));
        assert!(plan.status.message.unwrap().contains(words));
        world.see_job();
        world.view.pod = Some(pod(0));
        world.pass_to(Pending, Reason::Preparing);
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
    let plan = world.pass_to(Pending, Reason::Preparing);
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
        ) = (None, 10_000, 10_000);
        sees(&mut world);
        world.go_to(second);
        assert_eq!(whole(world.pass().requeue), Some(expected), "{what}");
    }
}
