//! Limits of a run: every byte and every object that it stores or sends counts, over restarts too. An agent cannot hide a log or keep a
//! report back.

use std::time::Instant;

use leaderboard_contract::keys::{COLLECTED, known_logs};

use super::shelf::Shelf;
use super::*;

/// Most files of one page for the agents: their own files get half of the limit of 1 MiB.
const AGENT_FILES: usize = 128;

/// A Pod whose run may store 1 MiB.
async fn small_pod() -> Pod {
    let mut pod = Pod::new().await;
    pod.setting.run.plan.storage.s3.size_limit = "1Mi".parse().unwrap();
    pod
}

/// Waits for two rounds of which the first began after now: what is there now was looked at and sent, or left out.
async fn two_rounds(pod: &Pod, name: &str) {
    for number in 1..=2 {
        let path = format!("simulator/{name}-{number}");
        pod.put(&path, b"a round");
        until(|| async { pod.stored(&path).await }).await;
    }
}

/// Empty files that are under other names in each generation.
fn flood(pod: &Pod, generation: usize) {
    let folder = pod.path("agent/agent1/flood");
    fs::create_dir_all(&folder).unwrap();
    for number in 0..2 * AGENT_FILES {
        let name = |generation: usize| folder.join(format!("{generation}-{number}"));
        let before = generation.checked_sub(1).map(name).filter(|before| before.exists());
        match before {
            Some(before) => fs::rename(before, name(generation)).unwrap(),
            None => fs::write(name(generation), "").unwrap(),
        }
    }
}

async fn flooded(pod: &Pod) -> usize {
    let keys = pod.keys().await;
    keys.iter().filter(|key| key.starts_with("agent/agent1/flood/")).count()
}

#[tokio::test]
async fn endless_names_of_empty_files_end_at_a_number_that_a_restart_and_another_pod_keep() {
    let pod = small_pod().await;
    pod.prepare().await.unwrap();
    flood(&pod, 0);
    let logcopy = pod.logcopy();
    two_rounds(&pod, "first").await;
    assert_eq!(flooded(&pod).await, AGENT_FILES);
    flood(&pod, 1);
    two_rounds(&pod, "second").await;
    assert_eq!(flooded(&pod).await, AGENT_FILES, "names of another round");
    logcopy.kill().await;
    flood(&pod, 2);
    let logcopy = pod.logcopy();
    two_rounds(&pod, "third").await;
    assert_eq!(flooded(&pod).await, AGENT_FILES, "names after a restart");
    logcopy.end().await;
    let next = pod.replaced("pod-2").await;
    next.prepare().await.unwrap();
    flood(&next, 3);
    let logcopy = next.logcopy();
    two_rounds(&next, "fourth").await;
    logcopy.end().await;
    assert_eq!(flooded(&next).await, AGENT_FILES, "names in another Pod");
}

#[tokio::test]
async fn an_agent_that_fills_everything_hides_no_log() {
    let pod = small_pod().await;
    pod.prepare().await.unwrap();
    let sparse = |path: &str| {
        pod.put(path, b"");
        let file = OpenOptions::new().write(true).open(pod.path(path));
        file.unwrap().set_len(4 << 40).unwrap();
    };
    sparse("agent/agent1/leaderboard.log");
    sparse("agent/agent1/sparse");
    for number in 0..4 {
        pod.put(&format!("agent/agent1/{number}"), &noise(MIB / 4, number));
    }
    let first = "agent/agent1/leaderboard.log";
    let logs: Vec<String> = known_logs(2, Host::Simulator).filter(|log| log != first).collect();
    let others = logs.iter().map(String::as_str).chain(["simulator/Logs/CarlaUE4.log"]);
    let others: Vec<&str> = others.collect();
    for log in &others {
        pod.append(log, b"a line\n");
    }
    pod.checkpoint(1, 1);
    let logcopy = pod.logcopy();
    pod.reported(|report| report.done == 1).await;
    two_rounds(&pod, "filled").await;
    for log in &others {
        pod.append(log, &noise(40_000, 9));
    }
    logcopy.end().await;
    for log in &others {
        let stored = pod.stored(log).await.unwrap();
        assert!(
            stored == fs::read(pod.path(log)).unwrap(),
            "{log}: {} bytes",
            stored.len()
        );
    }
    let beginning = pod.stored(first).await.unwrap().len();
    assert!(
        (50_000..600_000).contains(&beginning),
        "{beginning} bytes of the sparse log"
    );
    let all = pod.archive.list("", 1000).await.unwrap();
    let bytes: u64 = all.objects.iter().map(|object| object.size).sum();
    assert!(bytes < 1 << 20, "{bytes} bytes are stored");
}

#[tokio::test]
async fn status_files_without_end_are_not_all_stored() {
    let pod = Pod::new().await;
    pod.prepare().await.unwrap();
    for round in 0..150 {
        pod.mark(Side::Agent, 1, Mark::Crash(round));
    }
    let logcopy = pod.logcopy();
    let report = pod.reported(|report| report.round >= 1).await;
    assert_eq!(report.workers[0].crashes, 150, "they count all the same");
    logcopy.end().await;
    let keys = pod.keys().await;
    let stored = keys
        .iter()
        .filter(|key| key.starts_with("containers-status/agent-1.crash"));
    assert_eq!(stored.count(), 64);
}

#[tokio::test]
async fn what_has_sent_enough_today_waits_for_the_end_also_after_a_restart() {
    const OTHER: &str = "agent/agent1/rewritten";
    const LOG: &str = "agent/agent1/leaderboard.log";
    let pod = Pod::new().await;
    let tree = Arc::new(Tree::open(pod.logs()).unwrap());
    let mut quota = Quota::new(LIMIT, 2, Host::Simulator);
    quota.files_a_day.requests = 3;
    let uploader = || Uploader::new(pod.archive.clone(), Arc::clone(&tree), quota.clone());
    let mut first = uploader();
    let rewrite = |round: usize| {
        for path in [OTHER, LOG] {
            pod.put(path, &b"round"[..].repeat(round));
        }
        [OTHER, LOG].map(|path| Wanted::new(path, tree.file(path).unwrap().unwrap().1, Haste::Now))
    };
    for round in 1..=5 {
        let sent = first.sync(&rewrite(round), Window::default()).await.unwrap();
        let expected = if round <= 3 { (2, 0) } else { (1, 1) };
        assert_eq!((sent.objects, sent.left_out), expected, "round {round}");
    }
    assert_eq!(pod.stored(OTHER).await.unwrap(), b"round".repeat(3));
    assert_eq!(
        pod.stored(LOG).await.unwrap(),
        b"round".repeat(5),
        "a known log has a purse of its own"
    );
    let mut restarted = uploader();
    let sent = restarted.sync(&rewrite(6), Window::default()).await.unwrap();
    assert_eq!((sent.objects, sent.left_out), (1, 1));
    let last = Window {
        is_last: true,
        ..Window::default()
    };
    let sent = restarted.sync(&rewrite(7), last).await.unwrap();
    assert_eq!((sent.objects, sent.left_out), (2, 0));
    assert_eq!(pod.stored(OTHER).await.unwrap(), b"round".repeat(7));
}

/// A Pod before an S3 in memory, with times for a test.
async fn shelved() -> (Shelf, Pod) {
    let (shelf, endpoint) = Shelf::start().await;
    let mut pod = Pod::on(&endpoint, "bucket", run("bucket")).await;
    pod.setting.pace.logs = Duration::from_millis(200);
    pod.setting.pace.in_air = Duration::from_millis(300);
    pod.setting.run.flush_seconds = 4;
    pod.prepare().await.unwrap();
    (shelf, pod)
}

#[tokio::test]
async fn a_file_that_never_arrives_keeps_no_report_back() {
    const LOST: [&str; 2] = ["agent/agent1/large", "agent/agent1/small"];
    let (shelf, pod) = shelved().await;
    pod.put(LOST[0], &noise(20 * MIB, 1));
    pod.put(LOST[1], b"x");
    for key in LOST {
        shelf.lose(key);
    }
    pod.put("agent/agent2/arrives", b"x");
    let logcopy = pod.logcopy();
    shelf.until(|shelf| shelf.aborted(LOST[0]) == 1).await;
    pod.checkpoint(1, 1);
    pod.reported(|report| report.done == 1).await;
    assert!(shelf.order().iter().any(|key| key == "agent/agent2/arrives"));
    for pair in [1, 2] {
        pod.checkpoint(pair, 2);
        pod.mark(Side::Agent, u16::try_from(pair).unwrap(), Mark::Done);
    }
    pod.until_has(StatusFile::Stored).await;
    assert!(pod.report().await.unwrap().is_final);
    assert_eq!(
        shelf.aborted(LOST[0]),
        2,
        "it was tried again at the end, and only there"
    );
    logcopy.end().await;
    assert!(!shelf.order().iter().any(|key| LOST.contains(&key.as_str())));
}

#[tokio::test]
async fn what_the_evaluators_read_arrives_however_long_it_takes_and_keeps_no_report_back() {
    const LARGE: &str = "input/large";
    const CUT: &str = "agent/agent1/large";
    let (shelf, pod) = shelved().await;
    for key in [LARGE, CUT] {
        pod.put(key, &noise(20 * MIB, 1));
        shelf.lose(key);
    }
    pod.put("input/small", b"x");
    pod.put(COLLECTED, b"{}");
    let logcopy = pod.logcopy();
    // Both have had the time of a round's files then.
    shelf.until(|shelf| shelf.aborted(CUT) == 1).await;
    pod.checkpoint(1, 1);
    pod.reported(|report| report.done == 1).await;
    let is_stored = |shelf: &Shelf, key: &str| shelf.order().iter().any(|stored| stored == key);
    shelf.until(|shelf| is_stored(shelf, "input/small")).await;
    assert!(!is_stored(&shelf, LARGE));
    shelf.find(LARGE);
    shelf.until(|shelf| is_stored(shelf, LARGE)).await;
    assert_eq!(shelf.aborted(LARGE), 0);
    logcopy.end().await;
}

/// The last files of a run, in the order in which they are stored: the first of what the evaluators read is on its way beside the rounds,
/// and arrives if it is found. Returns what was sent, too.
async fn last_files(is_found: bool, time: Duration) -> (Vec<String>, Sent) {
    const LARGE: &str = "input/large";
    const LOG: &str = "agent/agent1/leaderboard.log";
    let (shelf, pod) = shelved().await;
    pod.put(LARGE, &noise(20 * MIB, 1));
    pod.put("input/late", b"x");
    pod.put(LOG, b"x");
    let tree = Tree::open(pod.logs()).unwrap();
    let wanted = |path: &str| Wanted::new(path, tree.file(path).unwrap().unwrap().1, Haste::Now);
    let (mut uploader, before) = (pod.uploader(), shelf.order().len());
    shelf.lose(LARGE);
    uploader.sync(&[wanted(LARGE)], Window::default()).await.unwrap();
    shelf.until(|shelf| shelf.begun(LARGE) == 1).await;

    let until = Instant::now().checked_add(time);
    let last = Window {
        begin_until: until,
        cut_at: until,
        is_last: true,
        ..Window::default()
    };
    let files = [LARGE, "input/late", LOG].map(wanted);
    let finding = async {
        shelf.until(|shelf| shelf.order().len() > before).await;
        if is_found {
            shelf.find(LARGE);
        }
    };
    let (sent, ()) = tokio::join!(uploader.sync(&files, last), finding);
    assert_eq!(shelf.begun(LARGE), 1, "it is not begun again");
    (shelf.order().split_off(before), sent.unwrap())
}

#[tokio::test]
async fn what_the_evaluators_read_goes_on_to_arrive_at_the_end_while_there_is_time() {
    let (order, sent) = Box::pin(last_files(true, PATIENCE)).await;
    assert_eq!(order, ["agent/agent1/leaderboard.log", "input/large", "input/late"]);
    assert_eq!((sent.objects, sent.late, sent.left_out), (3, 0, 0));
    let (order, sent) = Box::pin(last_files(false, Duration::from_secs(3))).await;
    assert_eq!(order, ["agent/agent1/leaderboard.log"]);
    assert_eq!((sent.objects, sent.late, sent.left_out), (1, 2, 0));
}

#[tokio::test]
async fn the_final_report_comes_before_the_logs() {
    const LOG: &str = "agent/agent1/leaderboard.log";
    let (shelf, pod) = shelved().await;
    pod.append(LOG, &noise(10_000, 1));
    let logcopy = pod.logcopy();
    shelf.until(|shelf| shelf.order().iter().any(|key| key == LOG)).await;
    // Too little to be stored before the end.
    pod.append(LOG, b"last line\n");
    for pair in [1, 2] {
        pod.checkpoint(pair, 2);
        pod.mark(Side::Agent, u16::try_from(pair).unwrap(), Mark::Done);
    }
    pod.until_has(StatusFile::Stored).await;
    let order = shelf.order();
    let last = |key: &str| order.iter().rposition(|stored| stored == key).unwrap();
    assert!(last(REPORT_KEY) < last(LOG), "{order:?}");
    assert!(last("evalai/results.json") < last(REPORT_KEY), "{order:?}");
    assert_eq!(pod.stored(LOG).await.unwrap(), fs::read(pod.path(LOG)).unwrap());
    logcopy.end().await;
}
