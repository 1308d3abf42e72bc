//! `kubectl leaderboard check` on a real cluster: a good Leaderboard, and one that is broken in each of several ways.

use std::path::Path;
use std::process::Stdio;
use std::time::Duration;

use leaderboard_api::{Leaderboard, Submission};
use leaderboard_aws::clients::Aws;
use serde_json::{Value, json};
use tokio::process::Command;
use tokio::time::timeout;

use crate::operator::controller;
use crate::scene::{Scene, scenario};

/// A check pulls, prepares, drives one route and stores it; a broken one ends by its deadline, or is given up.
const LIMIT: Duration = Duration::from_mins(8);

/// The default command, and a line of output.
const COPIES: &str = "cp -r ${LEADERBOARD_ROOT}/* /tmp/leaderboard/ && cp -r ${SCENARIO_RUNNER_ROOT}/* /tmp/scenario_runner/ && \
                      cp -r ${CARLA_PYTHON_API_ROOT}/* /tmp/CARLA/ && echo copied";

/// Runs `kubectl leaderboard` in the scene's namespace; its exit code, and what it printed.
pub(super) async fn plugin(scene: &Scene, words: &[&str]) -> (Option<i32>, String) {
    let program = Path::new(env!("CARGO_BIN_EXE_leaderboard-operator")).with_file_name("kubectl-leaderboard");
    let mut command = Command::new(program);
    command.args(words).args(["-n", &scene.namespace]);
    command.env("PATH", "").stdin(Stdio::null()).kill_on_drop(true);
    let output = timeout(LIMIT, command.output()).await.expect("it ends").unwrap();
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    (
        output.status.code(),
        format!("{}{}", text(&output.stdout), text(&output.stderr)),
    )
}

/// Runs a check of this Leaderboard for so many seconds at most.
async fn check(scene: &Scene, board: &str, agent: &str, seconds: &str) -> (Option<i32>, String) {
    let image = scene.lab.challenge(agent);
    plugin(scene, &["check", board, "--timeout", seconds, "--image", &image]).await
}

/// The streams of a log group, without the run before the slash.
async fn streams(logs: &aws_sdk_cloudwatchlogs::Client, group: &str) -> Vec<String> {
    let found = logs.describe_log_streams().log_group_name(group).send().await.unwrap();
    let name = |stream: &aws_sdk_cloudwatchlogs::types::LogStream| {
        Some(stream.log_stream_name()?.split_once('/')?.1.to_owned())
    };
    found.log_streams().iter().filter_map(name).collect()
}

fn has(text: &str, expected: &[&str]) {
    for part in expected {
        assert!(text.contains(part), "{part}\n\n{text}");
    }
}

#[tokio::test]
async fn a_good_leaderboard_passes_while_it_is_paused() {
    scenario("check-good", async |scene: &Scene| {
        let table = json!({"name": scene.cloud.table, "region": crate::aws::REGION, "endpoint": scene.gate.url});
        let (region, endpoint) = (crate::aws::REGION, scene.cloud.endpoint.as_str());
        let logs = Aws::load("tests").await.logs(Some(region), Some(endpoint));
        let group = &scene.namespace;
        logs.create_log_group().log_group_name(group).send().await.unwrap();
        let log_group = json!({"name": group, "region": region, "endpoint": endpoint});
        let contents = json!({"command": ["/bin/bash", "-c", COPIES]});
        let change = json!({"table": {"dynamoDB": table}, "paused": true, "logs": {"cloudWatch": log_group}, "evaluation": {"carla": {"contents": contents}}});
        scene.leaderboard("lb", change).await;
        let _controller = controller(scene);
        scene.ready("lb").await;
        let (code, text) = check(scene, "lb", "agent:standard", "400").await;
        assert_eq!(code, Some(0), "{text}");
        has(
            &text,
            &[
                "is Finished since",
                "1/1 routes done",
                "Delivered:   S3.",
                "Ready:       True, Ready",
                "The check passed.",
            ],
        );
        let names = streams(&logs, group).await;
        for container in ["contents", "workspace", "logcopy", "agent-1"] {
            assert!(names.contains(&container.to_owned()), "{container}: {names:?}");
        }
        assert_eq!(scene.all::<Submission>().await.len(), 0, "it is deleted");
        let rows = scene.cloud.rows(&scene.cloud.table).await;
        assert_eq!(rows.len(), 0, "the table has no row");
        let board = scene.api::<Leaderboard>().get("lb").await.unwrap();
        let counts = board.status.unwrap().counts.unwrap_or_default();
        assert_eq!(counts.finished, 0, "a check is in no count");
        println!("{text}");
    })
    .await;
}

/// A name, what of the Leaderboard is broken, the agent of its check, and what the check shows.
fn broken_parts(missing: &str) -> [(&'static str, Value, &'static str, &'static [&'static str]); 4] {
    let root = json!([{"name": "LEADERBOARD_ROOT", "value": "/nothing"}]);
    [
        (
            "image",
            json!({"evaluation": {"carla": {"simulator": {"image": missing}}}}),
            "agent:standard",
            &["ImagePull: ", "The image of simulator-1 cannot be pulled"],
        ),
        (
            "bucket",
            json!({"storage": {"s3": {"bucket": "leaderboard-tests-none"}}}),
            "agent:standard",
            &["Ready:       False, BucketUnreachable:"],
        ),
        (
            "contents",
            json!({"evaluation": {"carla": {"contents": {"env": root}}}}),
            "agent:standard",
            &["StartDeadline: ", "ontents"],
        ),
        (
            "agent",
            json!({}),
            "agent:print-routes",
            &["AgentCrashed: ", "agent1/leaderboard.log"],
        ),
    ]
}

/// Each case breaks one part, and the check must name it. The deadline for the start is short, because some parts keep a Pod from
/// starting.
#[tokio::test]
async fn each_broken_part_is_named() {
    scenario("check-broken", async |scene: &Scene| {
        let _controller = controller(scene);
        let missing = scene.lab.challenge("simulator:does-not-exist");
        let cases = broken_parts(&missing);
        let runs = cases.into_iter().map(async |(name, mut change, agent, expected)| {
            change["deadlines"] = json!({"startSeconds": 60});
            scene.leaderboard(name, change).await;
            // An end waits for the bucket, which a person has to make.
            let seconds = if name == "bucket" { "90" } else { "400" };
            let (code, text) = check(scene, name, agent, seconds).await;
            assert_eq!(code, Some(1), "{name}: {text}");
            has(&text, expected);
            println!("{name}:\n{text}");
        });
        futures::future::join_all(runs).await;
        assert_eq!(scene.all::<Submission>().await.len(), 0, "all are deleted");
    })
    .await;
}
