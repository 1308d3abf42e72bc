//! Real files of an evaluator of Leaderboard 2.0 that was started again.

use leaderboard_api::RouteSlice;
use leaderboard_contract::report::Outcome;

use super::*;

/// The mean driving score of the real files.
const SCORE: &str = "29.49";

fn real(name: &str) -> Vec<u8> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("crates/results/tests/restarted");
    fs::read(folder.join(name)).unwrap()
}

/// A Pod with the plan of the real files, and the complete ones of its pairs.
async fn four_pairs() -> Pod {
    let bucket = server().await.bucket().await;
    let mut run = run(&bucket);
    let first = [0, 4, 8, 12];
    let plan = carla(&mut run);
    plan.slices = first.map(|first| RouteSlice { first, last: first + 3 }).to_vec();
    plan.routes = 16;
    let pod = Pod::on(&server().await.endpoint(), &bucket, run).await;
    pod.prepare().await.unwrap();
    for pair in 1..=4 {
        put(&pod, pair, &format!("done/in{pair}.json"));
    }
    pod
}

fn put(pod: &Pod, pair: u32, name: &str) {
    pod.put(&format!("agent/agent{pair}/agent_results.json"), &real(name));
}

#[tokio::test]
async fn a_complete_run_whose_evaluators_were_all_started_once_more_is_finished() {
    let pod = four_pairs().await;
    for pair in 1..=4 {
        pod.mark(Side::Agent, pair, Mark::Done);
    }
    let logcopy = pod.logcopy();
    pod.until_has(StatusFile::Stored).await;
    let report = pod.report().await.unwrap();
    assert!(
        report.is_final && report.eligible && report.refused.is_none(),
        "{report:?}"
    );
    let score = report.score.as_ref().map(|score| score.value.as_str());
    assert_eq!((report.done, report.total, score), (16, 16, Some(SCORE)));
    assert_eq!(report.outcome, Outcome::Finished);
    logcopy.end().await;
    for key in ["agent/agent_results.json", "evalai/metadata.json"] {
        assert!(
            pod.stored(key).await.unwrap() == real("done/merged.json"),
            "{key} differs"
        );
    }
}

#[tokio::test]
async fn an_evaluator_that_dies_at_loading_the_world_of_a_repeated_route_leaves_15_of_16() {
    let pod = four_pairs().await;
    put(&pod, 4, "crashed.json");
    let logcopy = pod.logcopy();
    pod.reported(|report| report.done == 15).await;
    logcopy.end().await;

    // It is resumed in another Pod, and its first write is its last.
    let next = pod.replaced("pod-2").await;
    next.prepare().await.unwrap();
    put(&next, 4, "resumed.json");
    let logcopy = next.logcopy();
    next.reported(|report| report.pod_uid == "pod-2" && report.done == 15)
        .await;
    fs::write(next.setting.places.podinfo.join("stop"), Stop::Retries.as_str()).unwrap();
    next.until_has(StatusFile::Stored).await;
    let report = next.report().await.unwrap();
    assert!(report.is_final && !report.eligible, "{report:?}");
    assert_eq!((report.done, report.total, report.workers[3].done), (15, 16, 3));
    assert_eq!(report.stopped, Some(Stop::Retries));
    logcopy.end().await;
    let stdout = String::from_utf8(next.stored("evalai/stdout.txt").await.unwrap()).unwrap();
    assert!(stdout.contains("- Completed 15 out of the 16 routes\n"), "{stdout}");
}
