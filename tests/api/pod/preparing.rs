//! The init container: whose prefix it is, and what comes back from it.

use std::time::Instant;

use leaderboard_api::{Enforcement, RouteSlice};
use leaderboard_contract::run::Isolation;
use tokio::io::AsyncReadExt;
use tokio::net::{TcpListener, TcpStream};

use super::*;

#[tokio::test]
async fn a_fresh_prefix_is_taken_and_everybody_gets_the_runner() {
    let pod = Pod::new().await;
    pod.prepare().await.unwrap();
    let runner = fs::metadata(pod.setting.places.runner_for_all()).unwrap();
    assert_eq!(runner.permissions().mode() & 0o7777, 0o755);
    assert_eq!(pod.keys().await, [OWNER_KEY, REPORT_KEY]);
    assert_eq!(pod.owner().await, "pod-1");
    let report = pod.report().await.unwrap();
    assert!(report.belongs_to("uid-1", Attempt(1)) && !report.is_final && report.done == 0);
    for folder in ["agent", STATUS_FOLDER, "logcopy"] {
        assert_eq!(
            fs::metadata(pod.path(folder)).unwrap().mode() & 0o7777,
            0o777,
            "{folder}"
        );
    }
}

#[tokio::test]
async fn every_pod_start_copies_the_files_by_which_names_are_resolved() {
    let pod = Pod::new().await;
    let etc = pod.setting.places.root.join("etc");
    fs::create_dir(&etc).unwrap();
    let copy = |name: &str| fs::read_to_string(pod.setting.places.tools.join("etc").join(name)).unwrap();
    fs::write(etc.join("hosts"), "10.0.0.7\tsubmission-77\n").unwrap();
    fs::write(etc.join("resolv.conf"), "nameserver 10.96.0.10\n").unwrap();
    pod.prepare().await.unwrap();
    assert_eq!(copy("hosts"), "10.0.0.7\tsubmission-77\n");
    assert_eq!(copy("resolv.conf"), "nameserver 10.96.0.10\n");
    // Without a file there the kubelet would mount a folder.
    assert_eq!(copy("hostname"), "");
    for name in ["hosts", "resolv.conf", "hostname"] {
        let file = fs::metadata(pod.setting.places.tools.join("etc").join(name)).unwrap();
        assert_eq!(file.mode() & 0o7777, 0o644, "{name}");
    }
    // The node was restarted: the volume is prepared, but the Pod has another address.
    fs::write(etc.join("hosts"), "10.0.0.8\tsubmission-77\n").unwrap();
    pod.prepare().await.unwrap();
    assert_eq!(copy("hosts"), "10.0.0.8\tsubmission-77\n");
}

#[tokio::test]
async fn somebody_elses_prefix_is_left_alone() {
    let pod = Pod::new().await;
    pod.prepare().await.unwrap();
    let mut other = pod.replaced("pod-2").await;
    other.setting.run.uid = "uid-2".to_owned();
    let verdict = other.prepare().await.unwrap_err().verdict();
    assert_eq!(verdict.reason, WorkspaceReason::PrefixInUse);
    assert_eq!(WorkspaceVerdict::parse(&verdict.to_json()), Ok(verdict));
    assert_eq!(pod.owner().await, "pod-1");

    let foreign = Pod::new().await;
    foreign
        .archive
        .put("evalai/results.json", b"[]".to_vec())
        .await
        .unwrap();
    assert!(matches!(foreign.prepare().await, Err(WorkspaceError::PrefixInUse(_))));
    assert_eq!(foreign.keys().await, ["evalai/results.json"]);
}

#[tokio::test]
async fn a_fence_taken_before_the_first_pod_came_is_no_foreign_prefix() {
    let pod = Pod::new().await;
    pod.archive
        .put(OWNER_KEY, Owner::new("nobody").to_json())
        .await
        .unwrap();
    let told = pod.archive.put(FAILURE_LOG_KEY, b"why it failed".to_vec()).await;
    told.unwrap();
    pod.prepare().await.unwrap();
    assert_eq!(pod.owner().await, "pod-1");
}

#[tokio::test]
async fn a_replaced_pod_goes_on_where_the_lost_one_was() {
    let lost = Pod::new().await;
    lost.prepare().await.unwrap();
    for (key, bytes) in [
        ("agent/agent1/agent_results.json", checkpoint(0, 1, 2).into_bytes()),
        ("agent/agent1/leaderboard.log", noise(6 * MIB, 3)),
        ("agent/agent3/agent_results.json", b"another plan".to_vec()),
        ("simulator/../../escaped", b"x".to_vec()),
        ("containers-status/agent-1.crash0", Vec::new()),
        ("containers-status/simulation.cancel", Vec::new()),
    ] {
        lost.archive.put(key, bytes).await.unwrap();
    }
    let next = lost.replaced("pod-2").await;
    next.prepare().await.unwrap();
    assert_eq!(next.owner().await, "pod-2");
    assert_eq!(
        fs::read(next.path("agent/agent1/leaderboard.log")).unwrap(),
        noise(6 * MIB, 3)
    );
    let file = fs::metadata(next.path("agent/agent1/agent_results.json")).unwrap();
    let folder = fs::metadata(next.path("agent/agent1")).unwrap();
    assert_eq!((file.mode() & 0o7777, folder.mode() & 0o7777), (0o666, 0o777));
    assert!(!next.path("agent/agent3").exists() && !next.folder.path().join("escaped").exists());
    assert_eq!(fs::read_dir(next.path(STATUS_FOLDER)).unwrap().count(), 0);
    assert!(!next.keys().await.iter().any(|key| key.starts_with(STATUS_FOLDER)));
}

#[tokio::test]
async fn what_was_restored_is_not_sent_again() {
    let lost = Pod::new().await;
    lost.prepare().await.unwrap();
    let log = "agent/agent1/leaderboard.log";
    lost.archive.put(log, noise(6 * MIB, 3)).await.unwrap();
    let next = lost.replaced("pod-2").await;
    next.prepare().await.unwrap();
    let mut uploader = next.uploader();
    let stamp = Tree::open(next.logs()).unwrap().file(log).unwrap().unwrap().1;
    let sent = uploader
        .sync(&[Wanted::new(log, stamp, Haste::Now)], Window::default())
        .await
        .unwrap();
    assert_eq!(sent, Sent::default());
}

#[tokio::test]
async fn a_restarted_node_finds_its_volume_as_it_was_and_takes_no_fence_back() {
    let pod = Pod::new().await;
    pod.prepare().await.unwrap();
    pod.checkpoint(1, 1);
    pod.archive
        .put("agent/agent1/agent_results.json", b"older".to_vec())
        .await
        .unwrap();
    pod.archive.put(OWNER_KEY, Owner::new("pod-2").to_json()).await.unwrap();
    pod.prepare().await.unwrap();
    assert_eq!(
        fs::read_to_string(pod.path("agent/agent1/agent_results.json")).unwrap(),
        checkpoint(0, 1, 2)
    );
    assert_eq!(pod.owner().await, "pod-2");
}

#[tokio::test]
async fn a_resume_takes_up_what_has_no_report() {
    let mut pod = Pod::new().await;
    pod.setting.run.plan.resume = true;
    pod.archive
        .put("agent/agent2/agent_results.json", b"{}".to_vec())
        .await
        .unwrap();
    pod.prepare().await.unwrap();
    assert_eq!(fs::read(pod.path("agent/agent2/agent_results.json")).unwrap(), b"{}");
}

/// As carla-simulator/leaderboard-cloud stores it since it has one Job for each worker.
#[tokio::test]
async fn a_resume_takes_up_the_checkpoints_of_the_newest_pipelines_workers() {
    let mut pod = Pod::new().await;
    pod.setting.run.plan.resume = true;
    for (key, text) in [
        (
            "agent/partial_agent_results1.json",
            "{\"_checkpoint\": {\"progress\": [1, 2]}}",
        ),
        ("agent/partial_agent_results2.json", "{}"),
        ("agent/agent2/agent_results.json", "{\"newer\": true}"),
        ("agent_results.json", "{}"),
        ("containers-status/agent-1.crash0", ""),
        ("logs/agent-1.log", "one"),
    ] {
        pod.archive.put(key, text.as_bytes().to_vec()).await.unwrap();
    }
    pod.prepare().await.unwrap();
    let first = fs::read(pod.path("agent/agent1/agent_results.json")).unwrap();
    assert_eq!(first, b"{\"_checkpoint\": {\"progress\": [1, 2]}}");
    let second = fs::read(pod.path("agent/agent2/agent_results.json")).unwrap();
    assert_eq!(second, b"{\"newer\": true}", "a pair's own goes before it");
    assert!(!pod.path("agent/partial_agent_results1.json").exists());
    assert!(
        pod.keys()
            .await
            .contains(&"agent/partial_agent_results1.json".to_owned()),
        "it stays in the bucket"
    );
}

#[tokio::test]
async fn a_failure_is_written_to_the_termination_log() {
    let mut pod = Pod::new().await;
    carla(&mut pod.setting.run).slices = vec![RouteSlice { first: 0, last: 1 }, RouteSlice { first: 1, last: 2 }];
    // It never asks S3, so that no credentials are needed.
    workspace::main(pod.setting.clone()).await.unwrap_err();
    let said = fs::read_to_string(&pod.setting.places.termination_log).unwrap();
    let verdict = WorkspaceVerdict::parse(&said).unwrap();
    assert_eq!(verdict.reason, WorkspaceReason::PlanInvalid);
    assert!(verdict.message.contains("overlap"), "{said}");
}

#[tokio::test]
async fn a_pod_that_has_to_be_isolated_and_is_not_changes_nothing() {
    let mut pod = Pod::new().await;
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    pod.setting.api_server = listener.local_addr().ok();
    pod.setting.run.isolation = Some(Isolation {
        enforcement: Enforcement::Require,
        probe: None,
        egress: Vec::new(),
        is_known_open: false,
    });
    let began = Instant::now();
    workspace::main(pod.setting.clone()).await.unwrap_err();
    assert!(
        began.elapsed() >= pod.setting.pace.enforced_within,
        "a network plugin may be late"
    );
    let said = fs::read_to_string(&pod.setting.places.termination_log).unwrap();
    let verdict = WorkspaceVerdict::parse(&said).unwrap();
    assert_eq!(verdict.reason, WorkspaceReason::NotIsolated);
    for part in ["could connect to 127.0.0.1:", "network.enforcement is Require"] {
        assert!(verdict.message.contains(part), "{}", verdict.message);
    }
    assert!(pod.keys().await.is_empty() && !pod.setting.places.runner_for_all().exists());
}

/// A way to the stand-in that cuts the first connections in the middle of an answer. A network plugin does that when it begins to
/// enforce a policy.
async fn cutting(connections: u32) -> String {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let endpoint = format!("http://{}", listener.local_addr().unwrap());
    let beyond = server().await.endpoint();
    let beyond = beyond.trim_start_matches("http://").to_owned();
    tokio::spawn(async move {
        for number in 0.. {
            let (mut near, _) = listener.accept().await.unwrap();
            let mut far = TcpStream::connect(&beyond).await.unwrap();
            tokio::spawn(async move {
                if number >= connections {
                    let _ = tokio::io::copy_bidirectional(&mut near, &mut far).await;
                    return;
                }
                let (mut asks, mut answers) = (near.split(), far.split());
                let forth = tokio::io::copy(&mut asks.0, &mut answers.1);
                let mut some = answers.0.take(64 << 10);
                let back = tokio::io::copy(&mut some, &mut asks.1);
                tokio::select! { _ = forth => {}, _ = back => {} }
                near.set_zero_linger().unwrap();
            });
        }
    });
    endpoint
}

#[tokio::test]
async fn connections_that_are_cut_in_mid_transfer_are_made_anew() {
    let lost = Pod::new().await;
    lost.prepare().await.unwrap();
    let log = "agent/agent1/leaderboard.log";
    lost.archive.put(log, noise(6 * MIB, 3)).await.unwrap();
    let bucket = lost.setting.run.plan.storage.s3.bucket.clone();
    let mut next = Pod::on(&cutting(3).await, &bucket, lost.setting.run.clone()).await;
    "pod-2".clone_into(&mut next.setting.pod_uid);
    next.prepare().await.unwrap();
    assert_eq!(fs::read(next.path(log)).unwrap(), noise(6 * MIB, 3));
    assert_eq!(lost.owner().await, "pod-2");
}
