//! What the evaluators read: it is stored whole, brought back whole, and otherwise not at all.

use leaderboard_api::{EvaluationMode, SubmittedFile};
use leaderboard_contract::collected::Collected;
use leaderboard_contract::keys::{COLLECTED, INPUT_FILE};
use leaderboard_evaluation::fixtures::{result, run_of_mode};
use leaderboard_pod::collect;

use super::*;

/// The files of an agent, by path.
const FILES: [(&str, &[u8]); 2] = [("a.csv", b"hello"), ("frames/1.json", b"{}")];
const SUBMITTED: &[u8] = b"id,label\n1,cat\n";

/// Two evaluators of a mode, with nothing stored yet.
async fn pod_of(mode: EvaluationMode) -> Pod {
    let bucket = server().await.bucket().await;
    let mut run = run(&bucket);
    run.plan.evaluation = run_of_mode(mode).plan.evaluation;
    if mode == EvaluationMode::Predictions {
        let digest = Object::new(SUBMITTED).digest;
        run.input = Some(SubmittedFile {
            sha256: digest.sha256,
            size: i64::try_from(digest.size).unwrap(),
        });
    }
    Pod::on(&server().await.endpoint(), &bucket, run).await
}

/// The list of some files.
fn list(files: &[(&str, &[u8])]) -> Vec<u8> {
    let files = files
        .iter()
        .map(|(path, bytes)| ((*path).to_owned(), Object::new(bytes.to_vec()).digest));
    Collected::new(files.collect()).to_json()
}

fn agent_is_done(pod: &Pod) -> bool {
    pod.has(StatusFile::Of(Pair::new(1).unwrap().agent(), Mark::Done))
}

async fn collect(pod: &Pod) {
    let (run, places) = (pod.setting.run.clone(), pod.setting.places.clone());
    collect::main(run, places).await.unwrap();
}

async fn etag(pod: &Pod, key: &str) -> Option<String> {
    pod.archive.get(key, LIMIT).await.unwrap().unwrap().etag
}

#[tokio::test]
async fn what_an_agent_has_left_is_stored_and_a_replaced_pod_has_it_without_the_agent() {
    let lost = pod_of(EvaluationMode::Batch).await;
    lost.prepare().await.unwrap();
    let logcopy = lost.logcopy();
    for (path, bytes) in FILES {
        lost.put(&format!("submission/{path}"), bytes);
    }
    collect(&lost).await;
    lost.put("evaluators/2/games.json", b"{}");
    for key in [
        "input/a.csv",
        "input/frames/1.json",
        COLLECTED,
        "evaluators/2/games.json",
    ] {
        until(|| async { lost.stored(key).await }).await;
    }
    logcopy.end().await;
    assert_eq!(lost.stored(COLLECTED).await.unwrap(), list(&FILES));
    let keys = lost.keys().await;
    assert!(!keys.iter().any(|key| key.starts_with("submission")), "{keys:?}");
    let before = etag(&lost, "input/a.csv").await;

    let next = lost.replaced("pod-2").await;
    next.prepare().await.unwrap();
    assert!(agent_is_done(&next));
    for (path, bytes) in FILES {
        assert_eq!(fs::read(next.path(&format!("input/{path}"))).unwrap(), bytes, "{path}");
    }
    assert_eq!(fs::read(next.path("evaluators/2/games.json")).unwrap(), b"{}");
    collect(&next).await;
    assert_eq!(fs::read(next.path("input/a.csv")).unwrap(), b"hello");
    let logcopy = next.logcopy();
    next.put("evaluators/2/late.json", b"{}");
    until(|| async { next.stored("evaluators/2/late.json").await }).await;
    logcopy.end().await;
    assert_eq!(etag(&next, "input/a.csv").await, before, "it is not sent again");
}

/// A Pod that is lost once an agent's files are stored, and some of each evaluator.
async fn lost() -> Pod {
    let lost = pod_of(EvaluationMode::Batch).await;
    lost.prepare().await.unwrap();
    for (key, bytes) in [
        (COLLECTED, list(&FILES)),
        ("input/a.csv", FILES[0].1.to_vec()),
        ("input/frames/1.json", FILES[1].1.to_vec()),
        ("input/../x", b"x".to_vec()),
        ("x", b"x".to_vec()),
        ("evaluators/1/result.json", result(1, 2, 0.5).into_bytes()),
        ("evaluators/2/console.log", b"a line\n".to_vec()),
        ("agent/agent1/leaderboard.log", b"a line\n".to_vec()),
    ] {
        lost.archive.put(key, bytes).await.unwrap();
    }
    lost
}

#[tokio::test]
async fn without_every_file_as_it_was_the_agent_and_the_evaluators_run_anew() {
    let hostile = |path: &str| list(&[FILES[0], FILES[1], (path, b"x")]);
    let newer = String::from_utf8(list(&FILES)).unwrap();
    let newer = newer.replacen("\"schema\":1", "\"schema\":2", 1);
    let table: [(&str, &str, Option<Vec<u8>>); 8] = [
        ("no list", COLLECTED, None),
        ("a missing file", "input/a.csv", None),
        ("a wrong digest", "input/a.csv", Some(b"hallo".to_vec())),
        ("a wrong size", "input/frames/1.json", Some(b"{ }".to_vec())),
        ("a path that leads elsewhere", COLLECTED, Some(hostile("../x"))),
        ("an absolute path", COLLECTED, Some(hostile("/x"))),
        ("a list of another version", COLLECTED, Some(newer.into_bytes())),
        ("no list at all", COLLECTED, Some(b"{".to_vec())),
    ];
    for (what, key, bytes) in table {
        let lost = lost().await;
        match bytes {
            Some(bytes) => drop(lost.archive.put(key, bytes).await.unwrap()),
            None => lost.archive.delete(&[key.to_owned()]).await.unwrap(),
        }
        let next = lost.replaced("pod-2").await;
        // An earlier try in this Pod has found all of it.
        next.put(COLLECTED, &list(&FILES));
        fs::create_dir(next.path(STATUS_FOLDER)).unwrap();
        next.mark(Side::Agent, 1, Mark::Done);
        next.prepare().await.unwrap();
        assert!(!agent_is_done(&next), "{what}");
        assert_eq!(fs::read_dir(next.path("input")).unwrap().count(), 0, "{what}");
        for gone in [
            COLLECTED,
            "evaluators/1/result.json",
            "evaluators/2/console.log",
            "x",
            "../x",
        ] {
            assert!(!next.path(gone).exists(), "{what}: {gone}");
        }
        assert!(next.path("agent/agent1/leaderboard.log").exists(), "{what}");
        let keys = next.keys().await;
        let gone = ["evaluators/", "input/", COLLECTED];
        assert!(
            !keys.iter().any(|key| gone.iter().any(|gone| key.starts_with(gone))),
            "{what}: {keys:?}"
        );
    }
}

#[tokio::test]
async fn a_submitted_file_is_there_before_the_pod_and_is_in_each_of_them() {
    let pod = pod_of(EvaluationMode::Predictions).await;
    pod.archive.put(INPUT_FILE, SUBMITTED.to_vec()).await.unwrap();
    pod.prepare().await.unwrap();
    assert_eq!(fs::read(pod.path(INPUT_FILE)).unwrap(), SUBMITTED);
    assert_eq!(pod.keys().await, [INPUT_FILE, OWNER_KEY, REPORT_KEY]);
    assert!(!agent_is_done(&pod));

    let next = pod.replaced("pod-2").await;
    next.prepare().await.unwrap();
    assert_eq!(fs::read(next.path(INPUT_FILE)).unwrap(), SUBMITTED);
    let logcopy = next.logcopy();
    next.put(INPUT_FILE, b"changed on the volume");
    next.put("evaluators/1/late.json", b"{}");
    until(|| async { next.stored("evaluators/1/late.json").await }).await;
    logcopy.end().await;
    assert_eq!(next.stored(INPUT_FILE).await.unwrap(), SUBMITTED, "it is never sent");
}

#[tokio::test]
async fn another_file_than_the_submitted_one_is_not_evaluated() {
    let mut swapped = SUBMITTED.to_vec();
    swapped[0] = b'x';
    let table: [(&str, Option<&[u8]>, &str); 4] = [
        ("no file", None, "/77/input/file is not there."),
        ("a swapped file", Some(&swapped), "another size or SHA-256"),
        (
            "a longer file",
            Some(b"id,label\n1,cat\n2,cat\n"),
            "another size or SHA-256",
        ),
        ("an empty file", Some(b""), "another size or SHA-256"),
    ];
    for (what, bytes, why) in table {
        let pod = pod_of(EvaluationMode::Predictions).await;
        if let Some(bytes) = bytes {
            pod.archive.put(INPUT_FILE, bytes.to_vec()).await.unwrap();
        }
        // In the first Pod, and in one that takes up what is stored.
        for pod in [&pod, &pod.replaced("pod-2").await] {
            let verdict = pod.prepare().await.unwrap_err().verdict();
            assert_eq!(verdict.reason, WorkspaceReason::InputMissing, "{what}");
            assert!(verdict.message.contains(why), "{what}: {}", verdict.message);
        }
        pod.archive.put(INPUT_FILE, SUBMITTED.to_vec()).await.unwrap();
        pod.prepare().await.unwrap();
    }
    let mut pod = pod_of(EvaluationMode::Predictions).await;
    pod.archive.put(INPUT_FILE, SUBMITTED.to_vec()).await.unwrap();
    pod.setting.run.input = None;
    let verdict = pod.prepare().await.unwrap_err().verdict();
    assert_eq!(verdict.reason, WorkspaceReason::InputMissing, "{}", verdict.message);
}

#[tokio::test]
async fn an_input_is_no_foreign_prefix_and_hides_none() {
    for (mode, key, is_ours) in [
        (EvaluationMode::Predictions, "input/file", true),
        (EvaluationMode::Predictions, "evalai/results.json", false),
        (EvaluationMode::Predictions, "z", false),
        (EvaluationMode::Batch, "input/frames/1.json", true),
        (EvaluationMode::Batch, COLLECTED, true),
        (EvaluationMode::Batch, "evaluators/1/result.json", false),
        (EvaluationMode::Interactive, "input/file", false),
    ] {
        let pod = pod_of(mode).await;
        let owner = Owner::new("nobody").to_json();
        pod.archive.put(OWNER_KEY, owner).await.unwrap();
        if mode == EvaluationMode::Predictions {
            pod.archive.put(INPUT_FILE, SUBMITTED.to_vec()).await.unwrap();
        }
        if key != INPUT_FILE || mode != EvaluationMode::Predictions {
            pod.archive.put(key, b"{}".to_vec()).await.unwrap();
        }
        let prepared = pod.prepare().await;
        assert_eq!(prepared.is_ok(), is_ours, "{mode:?}: {key}: {prepared:?}");
        assert!(
            is_ours || matches!(prepared, Err(WorkspaceError::PrefixInUse(_))),
            "{key}"
        );
        if is_ours && mode == EvaluationMode::Batch {
            assert_eq!(
                pod.keys().await,
                [OWNER_KEY, REPORT_KEY],
                "{key} is of no agent of this run"
            );
        }
    }
}
