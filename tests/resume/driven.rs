//! Pods that have nothing left to drive.

use std::time::Duration;

use fastrand::Rng;
use leaderboard_api::LeaderboardVersion;
use leaderboard_protocol::files::{Mark, Side, StatusFile};

use super::kubelet::{Kubelet, Name, members};
use super::results::{report, results};
use super::submission::Submission;
use crate::ministack::server;

const LIMIT: Duration = Duration::from_mins(2);

/// The node was lost after the last route: another Pod restores what is complete, starts no evaluator, and stores the same results.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_pod_that_replaces_one_after_all_routes_drives_nothing_and_stores_the_same() {
    let bucket = server().await.bucket().await;
    for format in [LeaderboardVersion::V1, LeaderboardVersion::V2] {
        let submission = Submission::new(&bucket, format, &mut Rng::new()).await;
        let mut kubelet = Kubelet::new(&submission);
        kubelet.make_pod();
        to_the_end(&mut kubelet).await;
        let (before, begun) = (results(&submission.archive).await, kubelet.begun());

        kubelet.make_pod();
        to_the_end(&mut kubelet).await;
        assert_eq!(kubelet.begun(), begun, "{format:?}: a route is begun again");
        for agent in members().filter(|member| member.side == Side::Agent) {
            let mark = |mark| kubelet.has(StatusFile::Of(agent, mark));
            assert!(mark(Mark::Done) && !mark(Mark::Start(0)), "{format:?} {agent}");
        }
        let after = results(&submission.archive).await;
        for (key, text) in &before {
            assert!(&after[key] == text, "{format:?}: {key} is another one");
        }
        let last = report(&submission.archive).await.unwrap();
        assert!(
            last.is_final && last.eligible && last.pod_uid == kubelet.pod_uid(),
            "{last:?}"
        );
    }
}

/// Runs the Pod to its end, logcopy included.
async fn to_the_end(kubelet: &mut Kubelet<'_>) {
    let end = async {
        loop {
            let (name, status) = kubelet.ended().await;
            assert!(
                name != Name::Workspace || status.success(),
                "workspace ends with {status}"
            );
            if kubelet.handle(name, status) {
                return;
            }
        }
    };
    let in_time = tokio::time::timeout(LIMIT, end).await;
    assert!(in_time.is_ok(), "it does not end\n{}", kubelet.story());
    assert!(kubelet.end_logcopy().await.success());
}
