//! A hostile agent puts other things in place of its checkpoint, and volumes take nothing. Results stay, no link is followed, and logcopy
//! goes on.

use std::os::unix::fs::symlink;
use std::process::Command;

use super::*;

const CHECKPOINT: &str = "agent/agent2/agent_results.json";

/// Puts something in the place of pair 2's checkpoint. Returns whether that was possible.
fn put(pod: &Pod, what: &str) -> bool {
    let path = pod.path(CHECKPOINT);
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    let _ = fs::remove_dir(&path).or_else(|_| fs::remove_file(&path));
    let made = |program: &mut Command| program.arg(&path).status().unwrap().success();
    match what {
        "link" => symlink("/etc/passwd", &path).is_ok(),
        "link to a device" => symlink("/dev/zero", &path).is_ok(),
        "folder" => fs::create_dir(&path).is_ok(),
        "pipe" => made(&mut Command::new("mkfifo")),
        "sparse file" => File::create(&path).unwrap().set_len(10 << 30).is_ok(),
        // Only root may make one, and so may no agent; a node's own mistake could.
        "device" => Command::new("mknod")
            .arg(&path)
            .args(["c", "1", "5"])
            .stderr(std::process::Stdio::null())
            .status()
            .unwrap()
            .success(),
        "nonsense" => fs::write(&path, r#"{"_checkpoint": {"records": "all", "global_record": 7}}"#).is_ok(),
        "deep" => fs::write(&path, "[".repeat(200_000)).is_ok(),
        other => panic!("{other}"),
    }
}

#[tokio::test]
async fn whatever_is_in_the_place_of_a_checkpoint_the_last_good_one_stays_and_the_run_ends_with_a_reason() {
    let kinds = [
        ("link", "not a regular file"),
        ("link to a device", "not a regular file"),
        ("folder", "not a regular file"),
        ("pipe", "not a regular file"),
        ("device", "not a regular file"),
        ("sparse file", "more than the 17825792 that are read"),
        ("nonsense", "pair 2"),
        ("deep", "pair 2"),
    ];
    for (what, why) in kinds {
        let pod = Pod::new().await;
        pod.prepare().await.unwrap();
        pod.checkpoint(1, 2);
        pod.checkpoint(2, 1);
        pod.mark(Side::Agent, 1, Mark::Done);
        let logcopy = pod.logcopy();
        pod.reported(|report| report.done == 3).await;
        pod.put(&format!("{CHECKPOINT}.refused"), b"an agent's own");
        if !put(&pod, what) {
            println!("left out, as only root makes one: {what}");
            logcopy.end().await;
            continue;
        }
        let report = pod.reported(|report| report.refused.is_some()).await;
        let reason = report.refused.unwrap().why;
        assert!(reason.contains(why), "{what}: {reason}");
        assert_eq!((report.done, report.is_final), (3, false), "{what}");
        // Its runner never reports done; a host or the retries end it.
        fs::write(pod.setting.places.stop(), "Retries").unwrap();
        pod.until_has(StatusFile::Stored).await;
        let report = pod.report().await.unwrap();
        assert!(report.is_final && !report.eligible, "{what}");
        let stored = pod.stored(CHECKPOINT).await.unwrap();
        assert_eq!(stored, checkpoint(2, 1, 2).as_bytes(), "{what}: the last good one");
        let evidence = pod.stored(&format!("logcopy/refused/{CHECKPOINT}")).await;
        let refused = matches!(what, "nonsense" | "deep").then(|| fs::read(pod.path(CHECKPOINT)).unwrap());
        assert!(evidence == refused, "{what}: the evidence is the refused file");
        let own = pod.stored(&format!("{CHECKPOINT}.refused")).await;
        assert_eq!(own.as_deref(), Some(&b"an agent's own"[..]), "{what}");
        logcopy.end().await;
    }
}

#[tokio::test]
async fn a_status_file_with_content_is_stored_empty_and_holds_nothing_up() {
    let mut pod = Pod::new().await;
    pod.setting.run.plan.storage.s3.size_limit = "16Mi".parse().unwrap();
    pod.prepare().await.unwrap();
    pod.append("agent/agent1/leaderboard.log", b"a line\n");
    let content = noise(MIB, 1);
    pod.put("containers-status/agent-1/agent-1.start0", &content);
    let logcopy = pod.logcopy();
    let key = "containers-status/agent-1.start0";
    let stored = until(|| async { pod.stored(key).await }).await;
    assert!(stored.is_empty(), "{} bytes of an agent's status file", stored.len());
    // More than any bucket takes, and than logcopy has memory for the parts of.
    pod.put("containers-status/agent-2/agent-2.start0", b"");
    let sparse = OpenOptions::new()
        .write(true)
        .open(pod.path("containers-status/agent-2/agent-2.start0"));
    sparse.unwrap().set_len(4 << 40).unwrap();
    pod.checkpoint(1, 1);
    pod.reported(|report| report.done == 1).await;
    logcopy.end().await;
    assert_eq!(pod.stored("containers-status/agent-2.start0").await.unwrap(), b"");
    assert_eq!(pod.stored("agent/agent1/leaderboard.log").await.unwrap(), b"a line\n");
}

#[tokio::test]
async fn a_checkpoint_that_is_torn_when_the_pod_is_lost_is_whole_in_the_next_one() {
    let pod = Pod::new().await;
    pod.prepare().await.unwrap();
    pod.checkpoint(1, 1);
    let logcopy = pod.logcopy();
    pod.reported(|report| report.done == 1).await;
    let torn = &checkpoint(0, 2, 2)[..300];
    pod.put("agent/agent1/agent_results.json", torn.as_bytes());
    pod.append("agent/agent1/leaderboard.log", b"later\n");
    // SIGTERM stores everything, and so would a round.
    logcopy.end().await;
    assert_eq!(pod.stored("agent/agent1/leaderboard.log").await.unwrap(), b"later\n");
    let next = pod.replaced("pod-2").await;
    next.prepare().await.unwrap();
    let restored = fs::read_to_string(next.path("agent/agent1/agent_results.json")).unwrap();
    assert_eq!(restored, checkpoint(0, 1, 2));
}

#[tokio::test]
async fn s3_that_comes_back_in_the_last_flush_gets_everything() {
    let bucket = server().await.bucket().await;
    let proxy = server().await.proxy().await;
    let pod = Pod::on(&proxy.endpoint(), &bucket, run(&bucket)).await;
    let direct = Pod::on(&server().await.endpoint(), &bucket, run(&bucket)).await;
    pod.prepare().await.unwrap();
    let logcopy = pod.logcopy();
    direct.reported(|report| report.round >= 1).await;
    proxy.set_away(true);
    pod.checkpoint(1, 1);
    pod.append("agent/agent1/leaderboard.log", b"last\n");
    let before = proxy.counts().refused;
    let ending = tokio::spawn(logcopy.end());
    // It was asked to end, and has tried more than once.
    proxy.until(|counts| counts.refused > before + 20).await;
    assert!(!ending.is_finished());
    proxy.set_away(false);
    ending.await.unwrap();
    assert_eq!(direct.report().await.unwrap().done, 1);
    assert_eq!(direct.stored("agent/agent1/leaderboard.log").await.unwrap(), b"last\n");
}

#[tokio::test]
async fn s3_that_stays_away_holds_the_end_no_longer_than_it_may() {
    let bucket = server().await.bucket().await;
    let proxy = server().await.proxy().await;
    let mut pod = Pod::on(&proxy.endpoint(), &bucket, run(&bucket)).await;
    pod.setting.run.flush_seconds = 3;
    pod.prepare().await.unwrap();
    let logcopy = pod.logcopy();
    until(|| async { pod.report().await.filter(|report| report.round >= 1) }).await;
    proxy.set_away(true);
    pod.checkpoint(1, 1);
    // `end` fails if it is not over in minutes.
    logcopy.end().await;
    assert!(!pod.has(StatusFile::Stored));
    proxy.set_away(false);
    assert_eq!(pod.report().await.unwrap().done, 0, "nothing came through");
}
