//! Each line once.

use tokio::sync::watch;

use super::*;
use crate::support::throttle::Throttle;
use leaderboard_aws::logs::Miss;
use leaderboard_contract::keys::{COLLECT_LOG, CONTENTS_LOG, WORKSPACE_LOG};
use leaderboard_contract::report::Logs;

/// A Pod whose logs go to a group of its own, and the group's name.
async fn pod_with_logs() -> (Pod, String) {
    let group = format!("group-{}", fastrand::u64(..));
    let mut pod = Pod::new().await;
    pod.setting.run.logs = serde_json::from_value(serde_json::json!({"cloudWatch": {"name": group}})).unwrap();
    let logs = pod.aws.logs(None, None);
    logs.create_log_group().log_group_name(&group).send().await.unwrap();
    (pod, group)
}

/// The sender of a logcopy that has just started.
fn shipper(pod: &Pod, a_day: u64) -> ship::Shipper {
    let client = LogClient::of_group(&pod.aws, pod.setting.run.log_group().unwrap());
    let tree = Arc::new(Tree::open(pod.logs()).unwrap());
    let memory = pod.uploader().memory().clone();
    ship::Shipper::new(
        client,
        tree,
        &"77".parse().unwrap(),
        (2, Host::Simulator),
        &memory,
        a_day,
    )
}

#[tokio::test]
async fn each_line_arrives_once_and_in_order() {
    let (pod, group) = pod_with_logs().await;
    let logs = pod.aws.logs(None, None);
    let shipper = || shipper(&pod, ship::STREAM_A_DAY);
    let lines = |from: usize, to: usize| {
        let lines: Vec<String> = (from..to).map(|i| format!("line {i}\n")).collect();
        lines.concat()
    };
    let log = "agent/agent2/leaderboard.log";
    pod.append(log, lines(0, 12_000).as_bytes());
    pod.append(log, b"half a ");
    let mut first = shipper();
    first.pass(false).await.unwrap();
    first.pass(false).await.unwrap();
    pod.append(log, b"line\n");
    pod.append(log, lines(12_000, 12_010).as_bytes());
    pod.append(log, b"no end");
    let mut second = shipper();
    second.pass(true).await.unwrap();
    second.pass(true).await.unwrap();
    let mut expected: Vec<String> = lines(0, 12_000).lines().map(str::to_owned).collect();
    expected.push("half a line".to_owned());
    expected.extend(lines(12_000, 12_010).lines().map(str::to_owned));
    expected.push("no end".to_owned());
    assert_eq!(all(&logs, &group, "77/agent-2").await, expected);
}

#[tokio::test]
async fn logcopy_sends_the_logs_of_its_run() {
    let (pod, group) = pod_with_logs().await;
    let logs = pod.aws.logs(None, None);
    pod.prepare().await.unwrap();
    pod.append("agent/agent1/leaderboard.log", b"first\n");
    let logcopy = pod.logcopy();
    pod.reported(|report| report.round >= 1).await;
    pod.append("agent/agent1/leaderboard.log", b"last");
    pod.append("simulator/console-1.log", b"listening\n");
    logcopy.end().await;
    assert_eq!(all(&logs, &group, "77/agent-1").await, ["first", "last"]);
    assert_eq!(all(&logs, &group, "77/simulator-1").await, ["listening"]);
}

#[tokio::test]
async fn a_log_that_is_replaced_all_the_time_ends_its_stream_for_the_day_also_after_a_restart() {
    const A_DAY: u64 = 3000;
    let (pod, group) = pod_with_logs().await;
    let logs = pod.aws.logs(None, None);
    let shipper = || shipper(&pod, A_DAY);
    let replace = |round: usize| {
        pod.put(
            "agent/agent1/next",
            format!("round {round} {}\n", "x".repeat(500)).as_bytes(),
        );
        fs::rename(pod.path("agent/agent1/next"), pod.path("agent/agent1/leaderboard.log")).unwrap();
    };
    let mut first = shipper();
    for round in 0..10 {
        replace(round);
        first.pass(false).await.unwrap();
    }
    let sent = all(&logs, &group, "77/agent-1").await;
    // Each line counts 534 bytes or so: five of them fit.
    assert_eq!(sent.len(), 6, "{sent:?}");
    assert!(sent[4].starts_with("round 4 "), "{sent:?}");
    let last = "logcopy: the daily limit of 3000 bytes of this stream is reached";
    assert!(sent[5].starts_with(last), "{sent:?}");
    let mut restarted = shipper();
    replace(10);
    pod.append("agent/agent2/leaderboard.log", b"another agent\n");
    restarted.pass(true).await.unwrap();
    assert_eq!(all(&logs, &group, "77/agent-1").await, sent);
    assert_eq!(all(&logs, &group, "77/agent-2").await, ["another agent"]);
}

#[tokio::test]
async fn what_cloudwatch_throttles_is_sent_later_and_the_end_waits_for_it() {
    let (mut pod, group) = pod_with_logs().await;
    let logs = pod.aws.logs(None, None);
    let throttle = Throttle::start(&server().await.endpoint(), "ThrottlingException").await;
    pod.setting.run.logs.as_mut().unwrap().cloud_watch.endpoint = Some(throttle.endpoint().to_owned());
    pod.append("agent/agent1/leaderboard.log", b"one\n");
    pod.append("agent/agent2/leaderboard.log", b"of another\n");
    let mut shipper = shipper(&pod, ship::STREAM_A_DAY);
    for refused in 1..=2 {
        throttle.refuse(1);
        let error = shipper.pass(false).await.unwrap_err();
        assert_eq!(error.miss, Miss::Throttled, "{error}");
        assert_eq!(throttle.refused(), refused);
    }
    shipper.pass(false).await.unwrap();
    pod.append("agent/agent1/leaderboard.log", b"two\nno end");
    throttle.refuse(3);
    // The run is over: no round follows.
    let (_sender, is_over) = watch::channel(true);
    let (told, _) = watch::channel(None);
    shipper.run(Duration::from_secs(1), is_over, told).await;
    assert_eq!(throttle.refused(), 5);
    assert_eq!(all(&logs, &group, "77/agent-1").await, ["one", "two", "no end"]);
    assert_eq!(all(&logs, &group, "77/agent-2").await, ["of another"]);
}

#[tokio::test]
async fn what_becomes_of_the_lines_is_known() {
    let (mut pod, group) = pod_with_logs().await;
    for (name, sent) in [(group, true), ("no-such-group".to_owned(), false)] {
        pod.setting.run.logs.as_mut().unwrap().cloud_watch.name = name;
        // Without a new line nothing is sent, and nothing is known.
        pod.append("agent/agent1/leaderboard.log", b"one\n");
        let (done, is_over) = watch::channel(false);
        let (told, mut heard) = watch::channel(None);
        let shipper = shipper(&pod, ship::STREAM_A_DAY);
        let listening = async {
            let logs = heard.wait_for(Option::is_some).await.unwrap().clone();
            done.send_replace(true);
            logs
        };
        let ((), logs) = tokio::join!(shipper.run(Duration::from_secs(1), is_over, told), listening);
        match logs.unwrap() {
            Logs::Sent => assert!(sent),
            Logs::Refused(why) => assert!(!sent && why.contains("no-such-group"), "{why}"),
        }
    }
}

#[tokio::test]
async fn what_is_stored_and_was_refused_until_a_restart_is_sent_after_it() {
    let (mut pod, group) = pod_with_logs().await;
    let log = "agent/agent1/leaderboard.log";
    pod.append(log, b"one\n");
    pod.setting.run.logs.as_mut().unwrap().cloud_watch.name = "no-such-group".to_owned();
    let (_sender, is_over) = watch::channel(true);
    let (told, _) = watch::channel(None);
    let refused = shipper(&pod, ship::STREAM_A_DAY);
    refused.run(Duration::from_secs(1), is_over, told).await;
    let stamp = Tree::open(pod.logs()).unwrap().file(log).unwrap().unwrap().1;
    let wanted = [Wanted::new(log, stamp, Haste::Now)];
    let stored = pod.uploader().sync(&wanted, Window::default()).await.unwrap();
    assert_eq!(stored.objects, 1);
    pod.setting
        .run
        .logs
        .as_mut()
        .unwrap()
        .cloud_watch
        .name
        .clone_from(&group);
    shipper(&pod, ship::STREAM_A_DAY).pass(true).await.unwrap();
    let logs = pod.aws.logs(None, None);
    assert_eq!(all(&logs, &group, "77/agent-1").await, ["one"]);
}

#[tokio::test]
async fn the_containers_before_the_evaluators_have_streams_of_their_own() {
    let (pod, group) = pod_with_logs().await;
    let logs = pod.aws.logs(None, None);
    pod.append(WORKSPACE_LOG, b"{\"message\":\"restored what was stored\"}\n");
    pod.append(CONTENTS_LOG, b"copied 20 routes\n");
    pod.append(COLLECT_LOG, b"copied 2 files\n");
    shipper(&pod, ship::STREAM_A_DAY).pass(true).await.unwrap();
    assert_eq!(all(&logs, &group, "77/contents").await, ["copied 20 routes"]);
    assert_eq!(all(&logs, &group, "77/collect").await, ["copied 2 files"]);
    let sent = all(&logs, &group, "77/workspace").await;
    assert_eq!(sent, ["{\"message\":\"restored what was stored\"}"]);
}

async fn all(logs: &aws_sdk_cloudwatchlogs::Client, group: &str, stream: &str) -> Vec<String> {
    let (mut texts, mut token) = (Vec::new(), None);
    loop {
        let request = logs.get_log_events().log_group_name(group).log_stream_name(stream);
        let request = request.start_from_head(true).set_next_token(token.clone());
        let page = request.send().await.unwrap();
        texts.extend(
            page.events()
                .iter()
                .filter_map(|event| event.message().map(str::to_owned)),
        );
        let next = page.next_forward_token().map(str::to_owned);
        if next == token || page.events().is_empty() {
            return texts;
        }
        token = next;
    }
}
