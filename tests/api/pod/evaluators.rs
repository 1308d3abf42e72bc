//! The Pod of a host's own evaluators: what it stores, reports and takes up.

use leaderboard_api::{EvaluationMode, MergeMethod};
use leaderboard_contract::report::{Outcome, RefusedResults};
use leaderboard_evaluation::fixtures::{container_run, merging_run, put_result, result};

use super::*;

const EVALUATOR: Side = Side::Host(Host::Evaluator);

/// Two workers.
async fn evaluated() -> Pod {
    Box::pin(prepared(container_run().plan.evaluation)).await
}

/// Two workers, whose results a command merges.
async fn merging() -> Pod {
    Box::pin(prepared(merging_run(EvaluationMode::Interactive).plan.evaluation)).await
}

/// A Pod that is prepared for these evaluators.
async fn prepared(evaluation: PlannedEvaluation) -> Pod {
    let bucket = server().await.bucket().await;
    let mut run = run(&bucket);
    run.plan.evaluation = evaluation;
    let pod = Pod::on(&server().await.endpoint(), &bucket, run).await;
    pod.prepare().await.unwrap();
    pod
}

/// Both workers come to their end with these results.
async fn ended(results: [&str; 2]) -> Report {
    let pod = evaluated().await;
    let logcopy = pod.logcopy();
    pod.reported(|report| report.round >= 1).await;
    for (worker, text) in (1..).zip(results) {
        put_result(pod.logs(), worker, text);
        pod.mark(EVALUATOR, u16::try_from(worker).unwrap(), Mark::Done);
    }
    pod.until_has(StatusFile::Stored).await;
    logcopy.end().await;
    pod.report().await.unwrap()
}

#[tokio::test]
async fn a_whole_run_of_evaluators_ends_with_the_final_report_and_all_of_their_files() {
    let pod = evaluated().await;
    let logcopy = pod.logcopy();
    pod.reported(|report| report.round >= 1).await;
    for worker in [1, 2] {
        pod.mark(EVALUATOR, worker, Mark::Start(0));
        pod.mark(Side::Agent, worker, Mark::Start(0));
    }
    pod.append("evaluators/1/console.log", b"one\n");
    pod.append("evaluators/2/episodes/1.json", b"{}");
    put_result(pod.logs(), 1, &result(1, 2, 0.5));
    let report = pod.reported(|report| report.done == 1).await;
    let score = |report: &Report| {
        report
            .score
            .as_ref()
            .map(|score| (score.name.clone(), score.value.clone()))
    };
    let accuracy = |value: &str| Some(("accuracy".to_owned(), value.to_owned()));
    assert_eq!(
        (score(&report), report.is_final, report.unit.as_str()),
        (accuracy("0.5"), false, "units")
    );
    let so_far = r#"[{"split":"test","show_to_participant":true,"accuracies":{"accuracy":0.5}}]"#;
    assert_eq!(
        (report.results.as_str(), report.partial_results.as_deref()),
        ("[]", Some(so_far))
    );
    put_result(pod.logs(), 1, &result(2, 2, 1.0));
    put_result(pod.logs(), 2, &result(2, 2, 0.25));
    for worker in [1, 2] {
        pod.mark(Side::Agent, worker, Mark::Done);
        pod.mark(EVALUATOR, worker, Mark::Done);
    }
    pod.until_has(StatusFile::Stored).await;
    let report = pod.report().await.unwrap();
    assert!(report.is_final && report.eligible && report.refused.is_none() && report.unusable.is_none());
    assert_eq!((report.done, report.total, report.outcome), (4, 4, Outcome::Finished));
    assert_eq!(score(&report), accuracy("0.625"));
    let stored = pod.stored("evalai/results.json").await.unwrap();
    assert_eq!(stored, report.results.as_bytes());
    logcopy.end().await;
    let keys = pod.keys().await;
    for key in [
        "containers-status/evaluator-1.done",
        "containers-status/agent-2.done",
        "evaluators/1/console.log",
        "evaluators/1/result.json",
        "evaluators/2/episodes/1.json",
        "evaluators/2/result.json",
    ] {
        assert!(keys.iter().any(|known| known == key), "{key}: {keys:?}");
    }
}

#[tokio::test]
async fn a_replaced_pod_gives_each_evaluator_its_own_files_back() {
    let lost = evaluated().await;
    let good = result(1, 2, 0.5);
    for (key, bytes) in [
        ("evaluators/1/result.json", good.as_bytes()),
        ("evaluators/2/episodes/1.json", b"{}"),
        ("evaluators/../escaped", b"x"),
    ] {
        lost.archive.put(key, bytes.to_vec()).await.unwrap();
    }
    let next = lost.replaced("pod-2").await;
    next.prepare().await.unwrap();
    let read = |path: &str| fs::read(next.path(path)).unwrap();
    assert_eq!(read("evaluators/1/result.json"), good.as_bytes());
    assert_eq!(read("evaluators/2/episodes/1.json"), b"{}");
    assert!(!next.path("escaped").exists());
}

#[tokio::test]
async fn what_a_command_has_merged_of_results_that_are_refused_does_not_come_back() {
    let early = r#"{"schema": 1, "done": 7, "total": 10, "final": true, "splits": []}"#;
    let lost = merging().await;
    let logcopy = lost.logcopy();
    lost.reported(|report| report.round >= 1).await;
    for (worker, text) in [(3, &*result(1, 1, 0.7)), (2, &*result(2, 2, 0.5)), (1, early)] {
        lost.append(&format!("evaluators/{worker}/console.log"), b"a line\n");
        put_result(lost.logs(), worker.into(), text);
        lost.mark(EVALUATOR, worker, Mark::Done);
    }
    lost.until_has(StatusFile::Stored).await;
    logcopy.end().await;
    let unusable = lost.report().await.unwrap().unusable.unwrap();
    assert_eq!(unusable.worker, Some(1), "{unusable}");
    assert!(lost.stored("evaluators/3/result.json").await.is_some());

    let next = lost.replaced("pod-2").await;
    next.prepare().await.unwrap();
    for (path, is_there) in [
        ("evaluators/1/result.json", false),
        ("evaluators/2/result.json", true),
        ("evaluators/3/result.json", false),
        ("evaluators/3/console.log", true),
    ] {
        assert_eq!(next.path(path).exists(), is_there, "{path}");
    }
}

/// The plan of so many workers.
fn planned(workers: i32, merge: MergeMethod) -> PlannedEvaluation {
    let mut evaluation = container_run().plan.evaluation;
    if let PlannedEvaluation::Container(container) = &mut evaluation {
        (container.workers, container.merge) = (workers, merge);
    }
    evaluation
}

#[tokio::test]
async fn what_evaluators_with_other_shares_have_left_comes_back_in_no_later_pod() {
    use MergeMethod::{Command, Mean};
    for (before, after) in [
        ((2, Mean), (3, Mean)),
        ((3, Mean), (2, Mean)),
        // Both have three workers.
        ((3, Mean), (2, Command)),
        ((2, Command), (3, Mean)),
    ] {
        let what = format!("{before:?} {after:?}");
        let lost = prepared(planned(before.0, before.1)).await;
        for worker in 1..=3 {
            let key = format!("evaluators/{worker}/half.json");
            lost.archive.put(&key, b"{}".to_vec()).await.unwrap();
        }
        let mut next = lost.replaced("pod-2").await;
        next.setting.run.plan.evaluation = planned(after.0, after.1);
        next.prepare().await.unwrap();
        let logcopy = next.logcopy();
        next.append("evaluators/2/console.log", b"a line\n");
        until(|| async { next.stored("evaluators/2/console.log").await }).await;
        logcopy.end().await;

        let last = next.replaced("pod-3").await;
        last.prepare().await.unwrap();
        assert!(last.path("evaluators/2/console.log").exists(), "{what}");
        for worker in 1..=3 {
            for pod in [&next, &last] {
                let path = pod.path(&format!("evaluators/{worker}/half.json"));
                assert!(!path.exists(), "{what}: {}", path.display());
            }
        }
    }
}

#[tokio::test]
async fn only_where_results_were_refused_a_new_attempt_goes_on_without_the_final_ones() {
    let first = merging().await.report().await.unwrap();
    let ended = Report {
        is_final: true,
        unusable: Some(RefusedResults::new(Some(2), "torn")),
        ..first.clone()
    };
    let by_participant = Report {
        refused: ended.unusable.clone(),
        unusable: None,
        ..ended.clone()
    };
    let stopped = Report {
        stopped: Some(Stop::Interruption),
        ..ended.clone()
    };
    let lost = Report {
        is_final: false,
        ..by_participant.clone()
    };
    let by_merger = Report {
        unusable: Some(RefusedResults::new(Some(3), "torn")),
        ..ended.clone()
    };
    for (what, attempt, report, is_kept) in [
        ("unusable", 2, &ended, false),
        ("refused", 2, &by_participant, false),
        ("the command that merges", 2, &by_merger, true),
        ("another Job of the attempt", 1, &ended, true),
        ("a stop", 2, &stopped, true),
        ("a lost node", 2, &lost, true),
        ("a lost node at the beginning", 2, &first, true),
    ] {
        let before = merging().await;
        for (key, bytes) in [
            ("evaluators/1/result.json", result(2, 2, 0.5).into_bytes()),
            ("evaluators/1/games.json", b"{}".to_vec()),
            ("evaluators/2/result.json", result(1, 2, 0.5).into_bytes()),
            (REPORT_KEY, serde_json::to_vec(report).unwrap()),
        ] {
            before.archive.put(key, bytes).await.unwrap();
        }
        let mut next = before.replaced("pod-2").await;
        next.setting.run.attempt = Attempt(attempt);
        next.prepare().await.unwrap();
        let path = "evaluators/1/result.json";
        assert_eq!(next.path(path).exists(), is_kept, "{what}");
        assert_eq!(next.stored(path).await.is_some(), is_kept, "{what}");
        for other in ["evaluators/1/games.json", "evaluators/2/result.json"] {
            assert!(next.path(other).exists(), "{what}: {other}");
        }
    }
}

#[tokio::test]
async fn a_stored_file_that_is_too_large_to_be_ours_stops_no_pod() {
    let before = evaluated().await;
    let ended = Report {
        is_final: true,
        unusable: Some(RefusedResults::new(Some(2), "torn")),
        ..before.report().await.unwrap()
    };
    let ended = serde_json::to_vec(&ended).unwrap();
    let large = vec![b' '; MAX_BYTES + 1];
    for (key, report) in [("evaluators/1/result.json", &ended), (REPORT_KEY, &large)] {
        before.archive.put(REPORT_KEY, report.clone()).await.unwrap();
        before.archive.put(key, large.clone()).await.unwrap();
        let mut next = before.replaced("pod-2").await;
        next.setting.run.attempt = Attempt(2);
        next.prepare().await.unwrap();
    }
}

#[tokio::test]
async fn results_that_no_reader_takes_are_the_hosts_fault_and_refused_ones_the_participants() {
    let good = result(2, 2, 0.5);
    let broken = Box::pin(ended([&good, r#"{"schema": 1, "done": 3, "total": 2}"#])).await;
    assert!(
        broken.is_final && !broken.eligible && broken.refused.is_none(),
        "{broken:?}"
    );
    assert_eq!(broken.unusable.and_then(|unusable| unusable.worker), Some(2));
    let refusal =
        r#"{"schema": 1, "done": 0, "total": 2, "final": false, "splits": [], "refused": "It never answered."}"#;
    let refused = Box::pin(ended([&good, refusal])).await;
    assert!(
        refused.is_final && !refused.eligible && refused.unusable.is_none(),
        "{refused:?}"
    );
    let why = refused.refused.unwrap();
    assert!(
        why.worker == Some(2) && why.why.contains("It never answered."),
        "{why:?}"
    );
}
