//! Single ends that need their own arrangement.

use std::time::Duration;

use fastrand::Rng;
use leaderboard_operator::api::ResultsFormat;
use leaderboard_runner::protocol::{Mark, StatusFile};

use super::kubelet::{Kubelet, Name, members};
use super::results::{report, results};
use super::submission::Submission;
use crate::support::ministack::server;

/// A simulator that dies in its pair's last route leaves a record of each route and no regular end. While the pair is in its
/// back-off, however long, nothing is final; then that route is run again.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_simulation_that_crashes_in_the_last_route_is_repeated_before_anything_is_final() {
    let mut random = Rng::new();
    let bucket = server().await.bucket().await;
    let mut submission = Submission::new(&bucket, ResultsFormat::V2, &mut random).await;
    // The fifth route of a server is its pair's last; the next server has one route left.
    submission.simulator_knobs = "crash@5".to_owned();
    let mut kubelet = Kubelet::new(&submission);
    kubelet.held_back = members().collect();
    kubelet.make_pod();
    let crashed = async |kubelet: &mut Kubelet<'_>| {
        let mut left = members().count();
        while left > 0 {
            let (name, status) = kubelet.ended().await;
            if let Name::Of(member) = name {
                assert_eq!(status.code(), Some(1), "{member}: both sides count the crash");
                left -= 1;
            }
            kubelet.handle(name, status);
        }
    };
    tokio::time::timeout(Duration::from_mins(2), crashed(&mut kubelet)).await.unwrap();
    for member in members() {
        assert!(kubelet.has(StatusFile::Of(member, Mark::Crash(0))), "{member}");
    }
    // As long as it waits for results that are complete, and as much again.
    let agent = "agent/agent1/agent_results.json";
    until_reported(&submission, 20).await;
    tokio::time::sleep(Duration::from_secs(3)).await;
    let waiting = report(&submission.archive).await.unwrap();
    assert!(!waiting.is_final && !kubelet.has(StatusFile::Stored), "{waiting:?}");
    assert!(std::fs::read_to_string(kubelet.path(agent)).unwrap().contains("Simulation crashed"));

    for member in std::mem::take(&mut kubelet.held_back) {
        kubelet.start(Name::Of(member));
    }
    let to_the_end = async {
        loop {
            let (name, status) = kubelet.ended().await;
            if kubelet.handle(name, status) {
                return;
            }
        }
    };
    tokio::time::timeout(Duration::from_mins(2), to_the_end).await.unwrap();
    let last = report(&submission.archive).await.unwrap();
    assert!(last.is_final && last.eligible && last.entry_status == "Finished", "{last:?}");
    for begun in kubelet.begun() {
        assert_eq!(begun.len(), 6, "one route again: {begun:?}");
    }
    assert!(kubelet.end_logcopy().await.success());
    assert!(!results(&submission.archive).await["agent/agent_results.json"].contains("Simulation crashed"));
}

async fn until_reported(submission: &Submission, done: u32) {
    let asking = async {
        while report(&submission.archive).await.is_none_or(|report| report.done < done) {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    };
    tokio::time::timeout(Duration::from_mins(2), asking).await.unwrap();
}

