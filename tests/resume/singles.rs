//! Single ends that need their own arrangement.

use std::time::{Duration, Instant};

use fastrand::Rng;
use nix::sys::signal::Signal;

use super::kubelet::{Kubelet, Name, SIMULATOR, members};
use super::results::{report, results};
use super::submission::{FASTER, Submission};
use crate::ministack::{Proxy, server};
use leaderboard_api::LeaderboardVersion;
use leaderboard_contract::report::Outcome;
use leaderboard_evaluation::judge::Pace;
use leaderboard_protocol::files::{Mark, Side, StatusFile};

const LIMIT: Duration = Duration::from_mins(1);

/// A simulator that dies in its pair's last route leaves a record of each route and no regular end. While the pair is in its
/// back-off, however long, nothing is final; then that route is run again.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_simulation_that_crashes_in_the_last_route_is_repeated_before_anything_is_final() {
    let mut random = Rng::new();
    let bucket = server().await.bucket().await;
    let proxy = server().await.proxy().await;
    let mut submission = Submission::on(&proxy.endpoint(), &bucket, LeaderboardVersion::V2, &mut random).await;
    // The fifth route of a server is its pair's last; the next server has one route left.
    submission.simulator_knobs = "crash@5".to_owned();
    submission.route_ms = 200;
    let mut kubelet = Kubelet::new(&submission);
    kubelet.held_back = members().collect();
    kubelet.make_pod();
    let in_time = tokio::time::timeout(LIMIT, all_crash(&mut kubelet)).await;
    assert!(in_time.is_ok(), "they do not all crash\n{}", kubelet.story());
    // A route in which the simulation crashed is not done.
    let agent = "agent/agent1/agent_results.json";
    let in_time = tokio::time::timeout(LIMIT, until_reported(&submission, 16)).await;
    assert!(in_time.is_ok(), "no report of it\n{}", kubelet.story());
    let settled = Instant::now() + 2 * Pace::default().faster(FASTER).settle;
    let in_time = tokio::time::timeout(LIMIT, rounds_past(&proxy, settled)).await;
    assert!(in_time.is_ok(), "logcopy makes no more rounds\n{}", kubelet.story());
    let waiting = report(&submission.archive).await.unwrap();
    assert!(!waiting.is_final && !kubelet.has(StatusFile::Stored), "{waiting:?}");
    assert!(
        std::fs::read_to_string(kubelet.path(agent))
            .unwrap()
            .contains("Simulation crashed")
    );

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
    let in_time = tokio::time::timeout(LIMIT, to_the_end).await;
    assert!(in_time.is_ok(), "it does not end\n{}", kubelet.story());
    let last = report(&submission.archive).await.unwrap();
    assert!(
        last.is_final && last.eligible && last.outcome == Outcome::Finished,
        "{last:?}"
    );
    for begun in kubelet.begun() {
        assert_eq!(begun.len(), 6, "one route again: {begun:?}");
    }
    assert!(kubelet.end_logcopy().await.success());
    assert!(!results(&submission.archive).await["agent/agent_results.json"].contains("Simulation crashed"));
}

/// Runs the Pod until each container has crashed once. The simulators' runners sleep meanwhile, so that the evaluators find out
/// by themselves and write their last record.
async fn all_crash(kubelet: &mut Kubelet<'_>) {
    let (name, status) = kubelet.ended().await;
    assert!(name == Name::Workspace && status.success(), "{name} ends with {status}");
    kubelet.handle(name, status);
    let of = |side, mark| {
        let members = members().filter(move |member| member.side == side);
        members.map(move |member| StatusFile::Of(member, mark))
    };
    for file in of(SIMULATOR, Mark::Start(0)) {
        kubelet.until_has(file).await;
    }
    let simulators: Vec<Name> = members().filter(|m| m.side == SIMULATOR).map(Name::Of).collect();
    for name in &simulators {
        kubelet.signal(*name, Signal::SIGSTOP);
    }
    for file in of(Side::Agent, Mark::Crash(0)) {
        kubelet.until_has(file).await;
    }
    for name in &simulators {
        kubelet.signal(*name, Signal::SIGCONT);
    }
    for _ in members() {
        let (name, status) = kubelet.ended().await;
        assert_eq!(status.code(), Some(1), "{name}: both sides count the crash");
        kubelet.handle(name, status);
    }
}

/// Awaits logcopy's rounds until one comes after `settled`, when complete results would be final. In each round logcopy asks the bucket
/// for the owner of the prefix.
pub(super) async fn rounds_past(proxy: &Proxy, settled: Instant) {
    while Instant::now() < settled {
        let known = proxy.counts().requests;
        proxy.until(|counts| counts.requests > known).await;
    }
}

/// S3 reports no changes, so it is asked.
pub(super) async fn until_reported(submission: &Submission, done: u32) {
    while report(&submission.archive)
        .await
        .is_none_or(|report| report.done < done)
    {
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
}

/// While S3 is away, SIGTERM ends logcopy when its time is over and not before, and it logs what that means.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_last_flush_that_finds_no_s3_ends_in_time_and_logs_it() {
    let bucket = server().await.bucket().await;
    let proxy = server().await.proxy().await;
    let mut submission = Submission::on(&proxy.endpoint(), &bucket, LeaderboardVersion::V2, &mut Rng::new()).await;
    // The SDK's own tries, with their pauses, take up to three seconds.
    submission.run.flush_seconds = 6;
    let mut kubelet = Kubelet::new(&submission);
    kubelet.make_pod();
    let begun = async {
        let (name, status) = kubelet.ended().await;
        assert!(name == Name::Workspace && status.success(), "{name} ends with {status}");
        kubelet.start(Name::Logcopy);
        until_reported(&submission, 0).await;
        proxy.set_away(true);
        kubelet.end_logcopy().await
    };
    let status = tokio::time::timeout(LIMIT, begun).await.unwrap();
    let said = kubelet.log(Name::Logcopy);
    assert!(status.success(), "{said}");
    assert!(said.contains("the last changes are not stored yet: "), "{said}");
    let last = said.lines().last().unwrap();
    assert!(
        last.contains("the last changes are not stored: ") && last.contains(r#""seconds":6"#),
        "{last}"
    );
}
