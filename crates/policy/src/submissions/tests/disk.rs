//! Evictions: whose disk was full.

use serde_json::json;

use super::batch;
use super::builders::*;
use leaderboard_api::FailureClass::{Infrastructure, Participant};
use leaderboard_api::State::{Failed, Running};
use leaderboard_api::{FailureClass, Reason};
use leaderboard_contract::report::Report;

/// A run whose Pod was evicted with these words, in a Leaderboard without another Job.
fn evicted(words: &str) -> World {
    let mut world = World::local().running();
    let board = world.leaderboard();
    board.retries.infrastructure = 0;
    let mount = |volume: &str, read_only: bool| json!({"name": volume, "mountPath": format!("/{volume}"), "readOnly": read_only});
    board.pod_overrides = Some(json!({"spec": {
        "volumes": [{"name": "scratch", "emptyDir": {}}, {"name": "maps", "emptyDir": {}}, {"name": "common", "emptyDir": {}}],
        "initContainers": [{"name": "contents", "volumeMounts": [mount("maps", false)]}],
        "containers": [
            {"name": "agent", "volumeMounts": [mount("scratch", false), mount("maps", true), mount("common", false)]},
            {"name": "simulator", "volumeMounts": [mount("scratch", true), mount("common", false)]},
        ],
    }}));
    world.pod().ended_by_node = Some(("Evicted".into(), words.into()));
    world.pod().logcopy_running = false;
    world
}

#[test]
fn an_eviction_for_the_agents_disk_is_the_participants_and_stops_the_job() {
    let volume = |name: &str| format!("Usage of EmptyDir volume \"{name}\" exceeds the limit \"10Mi\". ");
    let container = |name: &str| format!("Container {name} exceeded its local ephemeral storage limit \"1Gi\". ");
    let cases: [(String, FailureClass); 9] = [
        (container("agent-1"), Participant),
        (container("simulator-1"), Infrastructure),
        (container("contents"), Infrastructure),
        (volume("scratch"), Participant),
        (volume("shm-agent-2"), Participant),
        // Others write to them, too.
        (volume("maps"), Infrastructure),
        (volume("common"), Infrastructure),
        (volume("leaderboard"), Infrastructure),
        // CARLA's saves and core dumps are on the Pod's account.
        (
            "Pod ephemeral local storage usage exceeds the total limit of containers 20Mi. ".into(),
            Infrastructure,
        ),
    ];
    for (words, class) in cases {
        let mut world = evicted(&words);
        world.pass_to(Running, Reason::Stopping);
        world.job_gone();
        let status = world.pass_to(Failed, Reason::DiskFull).status;
        let failure = status.failure.unwrap();
        assert_eq!(failure.class, class, "{words}");
    }
}

/// CARLA saves what it has to there as well.
#[test]
fn a_full_volume_of_logs_is_the_agents_where_logcopy_has_measured_it_in_this_pod() {
    for (fills, pod_uid, class) in [
        (true, "pod-uid", Participant),
        (false, "pod-uid", Infrastructure),
        (true, "pod-before", Infrastructure),
    ] {
        let mut world = evicted("Usage of EmptyDir volume \"logs\" exceeds the limit \"10Gi\". ");
        world.report(Report {
            agents_fill_disk: fills,
            pod_uid: pod_uid.into(),
            ..report(1)
        });
        let failure = world.pass_to(Running, Reason::Stopping).status.failure.unwrap();
        assert_eq!(
            (failure.reason.known().unwrap(), failure.class),
            (Reason::DiskFull, class),
            "{pod_uid}"
        );
    }
}

/// Nobody but the agent of Batch writes before the evaluators begin.
#[test]
#[expect(clippy::large_stack_arrays, reason = "a table of worlds")]
fn before_the_evaluators_a_full_pod_is_the_agents_that_runs_first() {
    let logs = "Usage of EmptyDir volume \"logs\" exceeds the limit \"10Gi\". ";
    let all = "Pod ephemeral local storage usage exceeds the total limit of containers 20Mi. ";
    let node = "Container evaluator-1 exceeded its local ephemeral storage limit \"1Gi\". ";
    for (words, mut world, class) in [
        (logs, batch::agent_runs().0, Participant),
        (all, batch::agent_runs().0, Participant),
        (node, batch::agent_runs().0, Infrastructure),
        (logs, batch::collected(), Participant),
        (logs, batch::prepared(), Infrastructure),
        (logs, batch::evaluating(), Infrastructure),
        (all, batch::evaluating(), Infrastructure),
    ] {
        world.pod().ended_by_node = Some(("Evicted".into(), words.into()));
        let failure = world.pass().status.failure.unwrap();
        let found = (failure.reason.known(), failure.class);
        assert_eq!(found, (Some(Reason::DiskFull), class), "{words}");
    }
}

#[test]
fn a_node_that_has_too_little_for_all_its_pods_is_nobodys_failure() {
    for words in [
        "The node was low on resource: ephemeral-storage. Container agent-1 was using 1Gi.",
        "The node was low on resource: memory.",
    ] {
        let plan = evicted(words).pass_to(Running, Reason::Replacing);
        assert_eq!(plan.status.failure, None, "{words}");
        let message = plan.status.message.unwrap();
        assert!(
            message.starts_with("On node node-a the kubelet ended the Pod (Evicted): The node was low on"),
            "{message}"
        );
    }
}
