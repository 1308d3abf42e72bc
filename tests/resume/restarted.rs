//! Evaluators that are started again when little or nothing is left to drive. The original of 2.0 writes its complete file anew then,
//! without the sensors: a run is not to lose by it what it had.

use std::time::{Duration, Instant};

use fastrand::Rng;

use super::kubelet::{Kubelet, members};
use super::results::{report, results};
use super::singles::{rounds_past, until_reported};
use super::submission::{FASTER, PAIRS, ROUTES_OF_PAIR, Submission, carla};
use crate::ministack::server;
use leaderboard_api::LeaderboardVersion;
use leaderboard_contract::report::{Outcome, Report};
use leaderboard_evaluation::judge::Pace;
use leaderboard_protocol::files::{Mark, Side, StatusFile};

const LIMIT: Duration = Duration::from_mins(1);
const ROUTES: u32 = 20;
/// Once after the last route and before the global record, in every pair.
const DIES_LATE: &str = "dies-after@5:once";

async fn submission(format: LeaderboardVersion, agent_knobs: &str) -> Submission {
    let bucket = server().await.bucket().await;
    let mut submission = Submission::new(&bucket, format, &mut Rng::new()).await;
    agent_knobs.clone_into(&mut submission.agent_knobs);
    submission
}

/// Until the Pod is complete. Returns the last report.
async fn to_the_end(submission: &Submission, kubelet: &mut Kubelet<'_>) -> Report {
    let end = async {
        loop {
            let (name, status) = kubelet.ended().await;
            if kubelet.handle(name, status) {
                return;
            }
        }
    };
    let in_time = tokio::time::timeout(LIMIT, end).await;
    assert!(in_time.is_ok(), "it does not end\n{}", kubelet.story());
    assert!(kubelet.end_logcopy().await.success());
    report(&submission.archive).await.unwrap()
}

/// Until each agent has crashed twice.
async fn until_crashed_twice(kubelet: &mut Kubelet<'_>) {
    let crashed = async {
        loop {
            let has_crashed = |member| kubelet.has(StatusFile::Of(member, Mark::Crash(1)));
            if members().filter(|member| member.side == Side::Agent).all(has_crashed) {
                return;
            }
            let ended = tokio::time::timeout(Duration::from_millis(20), kubelet.ended()).await;
            if let Ok((name, status)) = ended {
                kubelet.handle(name, status);
            }
        }
    };
    let in_time = tokio::time::timeout(LIMIT, crashed).await;
    assert!(in_time.is_ok(), "they do not all crash\n{}", kubelet.story());
}

fn assert_complete(last: &Report, kubelet: &Kubelet<'_>) {
    let is_complete = last.is_final && last.eligible && last.done == ROUTES && last.refused.is_none();
    assert!(is_complete, "{last:?}\n{}", kubelet.story());
    for begun in kubelet.begun() {
        assert_eq!(
            begun.len(),
            usize::from(ROUTES_OF_PAIR),
            "none is driven twice: {begun:?}"
        );
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn evaluators_that_die_between_their_last_route_and_the_global_record_lose_nothing() {
    for format in [LeaderboardVersion::V2, LeaderboardVersion::V1] {
        let submission = submission(format, DIES_LATE).await;
        let mut kubelet = Kubelet::new(&submission);
        kubelet.make_pod();
        let last = to_the_end(&submission, &mut kubelet).await;
        assert_complete(&last, &kubelet);
        assert_eq!(last.outcome, Outcome::Finished);
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn evaluators_that_write_their_complete_files_once_more_lose_nothing() {
    let submission = submission(LeaderboardVersion::V2, "once-more").await;
    let mut kubelet = Kubelet::new(&submission);
    kubelet.make_pod();
    let last = to_the_end(&submission, &mut kubelet).await;
    assert_complete(&last, &kubelet);
    assert_eq!(last.outcome, Outcome::Finished);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_pod_that_is_replaced_after_all_routes_finishes_with_what_is_stored() {
    for knobs in [DIES_LATE, "once-more,noexit"] {
        let submission = submission(LeaderboardVersion::V2, knobs).await;
        let mut kubelet = Kubelet::new(&submission);
        kubelet.held_back = members().collect();
        kubelet.make_pod();
        let stored = async {
            let until_stored = until_reported(&submission, ROUTES);
            tokio::pin!(until_stored);
            loop {
                tokio::select! {
                    () = &mut until_stored => return,
                    (name, status) = kubelet.ended() => { kubelet.handle(name, status); }
                }
            }
        };
        let in_time = tokio::time::timeout(LIMIT, stored).await;
        assert!(in_time.is_ok(), "{knobs}: not all is stored\n{}", kubelet.story());
        kubelet.kill_all().await;
        kubelet.lose_volumes();
        kubelet.held_back.clear();
        kubelet.make_pod();
        let last = to_the_end(&submission, &mut kubelet).await;
        assert_complete(&last, &kubelet);
        assert_eq!(last.outcome, Outcome::Finished, "{knobs}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_resume_whose_last_routes_are_not_set_up_keeps_the_sensors_of_before() {
    let submission = submission(LeaderboardVersion::V2, "dies-after@4:once,no-setup@5").await;
    let mut kubelet = Kubelet::new(&submission);
    kubelet.make_pod();
    let last = to_the_end(&submission, &mut kubelet).await;
    let is_complete = last.is_final && last.eligible && last.done == ROUTES;
    assert!(
        is_complete && last.outcome == Outcome::Finished,
        "{last:?}\n{}",
        kubelet.story()
    );
}

/// Stopping a route can fail when its simulator is gone: the route has progress and no record then. It is driven again with the one
/// before it.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_last_route_without_a_record_is_driven_although_the_progress_counts_it() {
    // A server that crashes would end its evaluator before that has written.
    let submission = submission(LeaderboardVersion::V2, "no-world@5:once,no-record@5:once").await;
    let mut kubelet = Kubelet::new(&submission);
    kubelet.make_pod();
    let last = to_the_end(&submission, &mut kubelet).await;
    let is_complete = last.is_final && last.eligible && last.done == ROUTES;
    assert!(
        is_complete && last.outcome == Outcome::Finished,
        "{last:?}\n{}",
        kubelet.story()
    );
    for begun in kubelet.begun() {
        assert_eq!(
            begun.len(),
            usize::from(ROUTES_OF_PAIR) + 1,
            "the fourth again, and the fifth: {begun:?}"
        );
    }
}

/// The agents leave files of the original's own writer: 16 routes, and one start more on the complete files.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn complete_files_of_a_real_evaluator_without_sensors_finish_with_the_originals_merge() {
    let mut submission = submission(LeaderboardVersion::V2, "replay=real/done-{pair}.json").await;
    let plan = carla(&mut submission.run);
    (plan.slices, plan.routes) = (leaderboard_api::effective::slices(16, PAIRS.into()), 16);
    let mut kubelet = Kubelet::new(&submission);
    kubelet.make_pod();
    let last = to_the_end(&submission, &mut kubelet).await;
    let is_complete = last.is_final && last.eligible && last.done == 16;
    assert!(
        is_complete && last.outcome == Outcome::Finished,
        "{last:?}\n{}",
        kubelet.story()
    );
    let stored = results(&submission.archive).await;
    assert_eq!(
        stored["agent/agent_results.json"],
        include_str!("../../local/challenge/expected-again.json")
    );
}

/// The simulation crashes in each pair's last route. Each further process dies while it loads the world of that route: it leaves the
/// record of the crash, with a progress of one less.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_route_that_is_being_repeated_counts_as_not_done() {
    let bucket = server().await.bucket().await;
    let proxy = server().await.proxy().await;
    let mut submission = Submission::on(&proxy.endpoint(), &bucket, LeaderboardVersion::V2, &mut Rng::new()).await;
    submission.agent_knobs = "no-world@5".to_owned();
    let mut kubelet = Kubelet::new(&submission);
    kubelet.make_pod();
    until_crashed_twice(&mut kubelet).await;
    kubelet.held_back = members().collect();
    let settled = Instant::now() + 2 * Pace::default().faster(FASTER).settle;
    let in_time = tokio::time::timeout(LIMIT, rounds_past(&proxy, settled)).await;
    assert!(in_time.is_ok(), "logcopy makes no more rounds\n{}", kubelet.story());
    let waiting = report(&submission.archive).await.unwrap();
    assert_eq!(
        (waiting.done, waiting.is_final, waiting.partial_results.is_some()),
        (ROUTES - 4, false, true),
        "{waiting:?}"
    );
}
