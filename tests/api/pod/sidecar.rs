//! The sidecar, from the first round to SIGTERM.

use leaderboard_api::WorkerState;
use leaderboard_contract::report::Outcome;

use super::*;

#[tokio::test]
async fn a_whole_run_ends_with_the_final_report_and_the_original_layout() {
    let pod = Pod::new().await;
    pod.prepare().await.unwrap();
    let logcopy = pod.logcopy();
    pod.reported(|report| report.round >= 1).await;
    for pair in [1, 2] {
        pod.mark(SIMULATOR, pair, Mark::Start(0));
        pod.mark(Side::Agent, pair, Mark::Start(0));
    }
    pod.append("agent/agent1/leaderboard.log", b"one\n");
    pod.append("agent/agent2/leaderboard.log", b"two\n");
    pod.append("simulator/Logs/CarlaUE4.log", b"simulator\n");
    pod.append("logcopy/logcopy.log", b"{}\n");
    pod.checkpoint(1, 1);
    let report = pod.reported(|report| report.done == 1).await;
    assert_eq!(
        (
            report.score.as_ref().map(|score| score.value.as_str()),
            report.is_final,
            report.workers[0].state
        ),
        (Some("100.00"), false, WorkerState::Running)
    );
    let stored = pod.stored("evalai/results.json").await.unwrap();
    assert_eq!(stored, report.results.as_bytes(), "what is stored stays the original's");
    assert_eq!(driving_score(&report.results), 0);
    assert_eq!(driving_score(report.partial_results.as_ref().unwrap()), 100.0);
    pod.checkpoint(1, 2);
    pod.checkpoint(2, 2);
    for pair in [1, 2] {
        pod.mark(Side::Agent, pair, Mark::Done);
        pod.mark(SIMULATOR, pair, Mark::Done);
    }
    pod.append("agent/agent1/leaderboard.log", b"last line\n");
    pod.until_has(StatusFile::Stored).await;
    // It was stored before logcopy.done was written.
    let report = pod.report().await.unwrap();
    assert!(report.is_final && report.eligible && report.stopped.is_none() && report.refused.is_none());
    assert_eq!(report.partial_results, None);
    assert_eq!((report.done, report.total, report.outcome), (4, 4, Outcome::Finished));
    assert!(report.workers.iter().all(|pair| pair.state == WorkerState::Done));
    assert_eq!(
        pod.stored("evalai/results.json").await.unwrap(),
        report.results.as_bytes()
    );
    assert!(!pod.has(StatusFile::Cancel));
    logcopy.end().await;
    assert_layout(&pod, &report).await;
}

fn driving_score(results: &str) -> serde_json::Value {
    let results: serde_json::Value = serde_json::from_str(results).unwrap();
    results[0]["accuracies"]["Driving score"].clone()
}

async fn assert_layout(pod: &Pod, report: &Report) {
    let expected = [
        "agent/agent1/agent_results.json",
        "agent/agent1/leaderboard.log",
        "agent/agent2/agent_results.json",
        "agent/agent2/leaderboard.log",
        "agent/agent_results.json",
        "containers-status/agent-1.done",
        "containers-status/agent-1.start0",
        "containers-status/agent-2.done",
        "containers-status/agent-2.start0",
        "containers-status/logcopy.done",
        "containers-status/simulator-1.done",
        "containers-status/simulator-1.start0",
        "containers-status/simulator-2.done",
        "containers-status/simulator-2.start0",
        "evalai/metadata.json",
        "evalai/results.json",
        "evalai/stdout.txt",
        "logcopy/logcopy.log",
        "logcopy/owner",
        "logcopy/report.json",
        "simulator/Logs/CarlaUE4.log",
    ];
    assert_eq!(pod.keys().await, expected);
    let key = "agent/agent1/leaderboard.log";
    assert_eq!(pod.stored(key).await.unwrap(), fs::read(pod.path(key)).unwrap());
    assert_eq!(
        pod.stored("agent/agent_results.json").await.unwrap(),
        pod.stored("evalai/metadata.json").await.unwrap()
    );
    let digests: BTreeMap<&str, u64> = report
        .files
        .iter()
        .map(|(key, file)| (key.as_str(), file.size))
        .collect();
    assert_eq!(digests.keys().copied().collect::<Vec<_>>(), &expected[14..17]);
    for (key, size) in digests {
        assert_eq!(pod.stored(key).await.unwrap().len() as u64, size, "{key}");
    }
}

#[tokio::test]
async fn rounds_without_a_change_store_nothing() {
    let pod = Pod::new().await;
    pod.prepare().await.unwrap();
    pod.checkpoint(1, 1);
    let logcopy = pod.logcopy();
    let report = pod.reported(|report| report.done == 1).await;
    let etag = pod.archive.get(REPORT_KEY, LIMIT).await.unwrap().unwrap().etag;
    // A later round is one that has noticed the next file.
    pod.put("simulator/late", b"x");
    until(|| async { pod.stored("simulator/late").await }).await;
    let after = pod
        .archive
        .get_if_none_match(REPORT_KEY, etag.as_deref(), LIMIT)
        .await
        .unwrap();
    assert_eq!(
        (after, pod.report().await.unwrap().round),
        (Fetched::NotModified, report.round)
    );
    logcopy.end().await;
}

#[tokio::test]
async fn a_pod_that_lost_the_fence_stores_nothing_more_and_stops_its_containers() {
    let pod = Pod::new().await;
    pod.prepare().await.unwrap();
    let logcopy = pod.logcopy();
    pod.reported(|report| report.round >= 1).await;
    pod.archive.put(OWNER_KEY, Owner::new("pod-2").to_json()).await.unwrap();
    pod.until_has(StatusFile::Cancel).await;
    pod.until_has(StatusFile::Stored).await;
    let before = pod.keys().await;
    pod.checkpoint(1, 1);
    logcopy.end().await;
    assert_eq!(pod.keys().await, before);
    assert_eq!(pod.report().await.unwrap().done, 0);
}

#[tokio::test]
async fn the_results_wait_for_s3_to_come_back() {
    let bucket = server().await.bucket().await;
    let proxy = server().await.proxy().await;
    let pod = Pod::on(&proxy.endpoint(), &bucket, run(&bucket)).await;
    let direct = Pod::on(&server().await.endpoint(), &bucket, run(&bucket)).await;
    pod.prepare().await.unwrap();
    let logcopy = pod.logcopy();
    direct.reported(|report| report.round >= 1).await;
    proxy.set_away(true);
    for pair in [1, 2] {
        pod.checkpoint(pair, 2);
        pod.mark(Side::Agent, u16::try_from(pair).unwrap(), Mark::Done);
    }
    // Several rounds have read the results and could not store them.
    let before = proxy.counts().refused;
    proxy.until(|counts| counts.refused > before + 20).await;
    assert!(!pod.has(StatusFile::Stored) && !direct.report().await.unwrap().is_final);
    proxy.set_away(false);
    pod.until_has(StatusFile::Stored).await;
    let report = direct.report().await.unwrap();
    assert!(report.is_final && report.eligible);
    logcopy.end().await;
}

#[tokio::test]
async fn a_stop_cancels_stores_what_there_is_and_reports_it() {
    for stop in [Stop::Retries, Stop::Interruption] {
        is_stopped(stop).await;
    }
}

async fn is_stopped(stop: Stop) {
    let pod = Pod::new().await;
    pod.prepare().await.unwrap();
    pod.checkpoint(1, 1);
    pod.mark(Side::Agent, 1, Mark::Start(0));
    let logcopy = pod.logcopy();
    pod.reported(|report| report.done == 1).await;
    // As the kubelet does it: the name never holds half of the text.
    fs::write(pod.setting.places.podinfo.join("next"), stop.as_str()).unwrap();
    fs::rename(pod.setting.places.podinfo.join("next"), pod.setting.places.stop()).unwrap();
    pod.until_has(StatusFile::Cancel).await;
    pod.append("agent/agent1/leaderboard.log", b"stopped\n");
    pod.until_has(StatusFile::Stored).await;
    let report = pod.report().await.unwrap();
    assert!(report.is_final && !report.eligible && report.done == 1);
    assert_eq!(report.stopped, Some(stop));
    assert_eq!(pod.stored("agent/agent1/leaderboard.log").await.unwrap(), b"stopped\n");
    assert!(
        pod.keys()
            .await
            .contains(&"containers-status/simulation.cancel".to_owned())
    );
    logcopy.end().await;
}

#[tokio::test]
async fn a_pair_that_ends_with_refused_results_ends_the_run_as_invalid() {
    let pod = Pod::new().await;
    pod.prepare().await.unwrap();
    pod.mark(Side::Agent, 2, Mark::Start(0));
    let bad = checkpoint(0, 2, 2).replace("RouteScenario_1_", "RouteScenario_3_");
    pod.put("agent/agent1/agent_results.json", bad.as_bytes());
    let logcopy = pod.logcopy();
    let report = pod.reported(|report| report.refused.is_some()).await;
    assert!(!report.is_final);
    pod.mark(Side::Agent, 1, Mark::Done);
    pod.until_has(StatusFile::Stored).await;
    let report = pod.report().await.unwrap();
    assert!(report.is_final && !report.eligible && report.stopped.is_none());
    let why = report.refused.unwrap().why;
    assert!(why.contains("outside this pair's routes 0-1"), "{why}");
    assert!(pod.has(StatusFile::Cancel), "the other pair is stopped");
    logcopy.end().await;
}

#[tokio::test]
async fn a_killed_logcopy_goes_on_where_it_was() {
    let pod = Pod::new().await;
    pod.prepare().await.unwrap();
    pod.checkpoint(1, 2);
    let logcopy = pod.logcopy();
    pod.reported(|report| report.done == 2).await;
    logcopy.kill().await;
    fs::write(pod.setting.places.stop(), "Cancel").unwrap();
    pod.checkpoint(2, 2);
    let logcopy = pod.logcopy();
    pod.until_has(StatusFile::Stored).await;
    let report = pod.report().await.unwrap();
    assert_eq!((report.done, report.stopped), (4, Some(Stop::Cancel)));
    assert!(pod.has(StatusFile::Cancel));
    logcopy.kill().await;
    // The next one finds everything done, and ends when it is asked to.
    let etag = pod.archive.get(REPORT_KEY, LIMIT).await.unwrap().unwrap().etag;
    pod.logcopy().end().await;
    let after = pod
        .archive
        .get_if_none_match(REPORT_KEY, etag.as_deref(), LIMIT)
        .await
        .unwrap();
    assert_eq!(after, Fetched::NotModified);
}

#[tokio::test]
async fn a_sigterm_in_the_middle_stores_what_there_is_without_an_end() {
    let pod = Pod::new().await;
    pod.prepare().await.unwrap();
    let logcopy = pod.logcopy();
    pod.reported(|report| report.round >= 1).await;
    pod.append("simulator/x.log", b"x");
    pod.checkpoint(1, 1);
    logcopy.end().await;
    let report = pod.report().await.unwrap();
    assert!(!report.is_final && report.done == 1);
    assert_eq!(pod.stored("simulator/x.log").await.unwrap(), b"x");
    assert!(!pod.has(StatusFile::Stored));
}
