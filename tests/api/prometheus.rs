//! A real Prometheus scrapes two controllers and a bridge while submissions come, run, fail and end. It has the alerts and the dashboard
//! of the chart, which renders both as they are (`local/lab chart-test`).
#![cfg(test)]

mod server;

use std::collections::BTreeSet;
use std::fs;
use std::net::SocketAddr;
use std::path::Path;
use std::time::Duration;

use leaderboard_api::{State, SubmissionStatus, conditions, names};
use serde_json::{Value, json};
use tokio::process::Child;

use super::boards::make_table;
use super::bridge::eventually;
use super::process::operator;
use super::world::World;
use crate::support::apiserver;
use crate::support::player::ROUTES;
use crate::support::tools::loopback;
use server::{Prometheus, Target};

const FILES: &str = "charts/leaderboard-operator/files";
const PAGE: &str = "docs/metrics.md";

/// Queries about two lives, with their answers.
const SEEN: [(&str, &str); 8] = [
    (r#"max(leaderboard_submissions{state="Finished"})"#, "1"),
    (r#"max(leaderboard_submissions{state="Failed"})"#, "1"),
    ("sum(leaderboard_is_leader)", "1"),
    ("count(leaderboard_is_leader)", "2"),
    ("count(leaderboard_leader_term)", "1"),
    (r#"sum(leaderboard_queue_messages_total{outcome="created"})"#, "1"),
    ("sum(leaderboard_submission_failures_total)", "1"),
    (
        "count(increase(leaderboard_submission_phase_duration_seconds_count[1h]) > 0)",
        "10",
    ),
];

/// Prefixes of the metrics of a standby; the wait of messages shows that none has waited.
const OF_STANDBY: [&str; 6] = [
    "leaderboard_build_",
    "leaderboard_is_leader",
    "leaderboard_lease_",
    "leaderboard_queue_message_wait_",
    "leaderboard_runtime_",
    "leaderboard_watch_",
];

/// Metrics of which two lives may leave no sample, with the reason. Everything else in docs/metrics.md must be there, and every other
/// query of the dashboard must have an answer.
const ABSENT: [(&str, &str); 8] = [
    (
        "leaderboard_evalai_token_expiry_timestamp_seconds",
        "the token does not say when it ends",
    ),
    ("leaderboard_gpu_seconds_total", "the Leaderboard gives no GPU"),
    ("leaderboard_team_gpu_seconds_total", "the Leaderboard gives no GPU"),
    ("leaderboard_submission_gpu_seconds", "the Leaderboard gives no GPU"),
    ("leaderboard_lease_errors_total", "nothing disturbs the Lease"),
    (
        "leaderboard_queue_oldest_message_timestamp_seconds",
        "every message is deleted",
    ),
    ("leaderboard_reconcile_errors_total", "no reconcile need fail"),
    ("leaderboard_trace_spans_total", "no collector is named"),
];

/// Parts of queries for what is wrong or under way, of which there is nothing in the end.
const QUIET: [(&str, &str); 2] = [
    (r#"state=~"Pending|Running|Resumed""#, "both have ended"),
    (
        "max by (leaderboard) (leaderboard_ready) == 0",
        "the Leaderboard is ready",
    ),
];

/// A program of the operator, and where its metrics are.
struct Program {
    target: Target,
    _child: Child,
    _folder: tempfile::TempDir,
}

impl Program {
    async fn start(program: &'static str, name: &str, namespace: &str) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let log = folder.path().join("log");
        let kubeconfig = apiserver::server().await.kubeconfig();
        let mut command = operator(program, name, namespace, &kubeconfig, &log);
        let child = command.env("POD_UID", name).env("RUST_LOG", "info").spawn().unwrap();
        eventually("it serves /metrics", async || address(&log).is_some()).await;
        Self {
            target: Target {
                job: program,
                pod: name.to_owned(),
                namespace: namespace.to_owned(),
                address: address(&log).unwrap(),
            },
            _child: child,
            _folder: folder,
        }
    }
}

fn address(log: &Path) -> Option<SocketAddr> {
    let text = fs::read_to_string(log).unwrap_or_default();
    let line = text.lines().find(|line| line.contains("serving /livez"))?;
    loopback(line)
}

/// A Leaderboard with what has metrics of its own: queue, table and slots.
async fn make_board(world: &World, queue: &str) {
    let table = world.aws.name("prometheus");
    make_table(&world.aws, &table).await;
    let dead = world.aws.queue("prometheus-dead").await;
    let more = json!({
        "evaluation": {"carla": {"routes": ROUTES}},
        "queue": {"sqs": {"url": queue, "deadLetterURL": dead, "endpoint": world.aws.endpoint, "unknownAfterSeconds": 0}},
        "table": {"dynamoDB": {"name": table, "endpoint": world.aws.endpoint}},
        "concurrency": {"total": 2},
    });
    world.leaderboard_with("lb", 1, "Hosts", &more).await;
}

/// One submission crashes, one goes from its message to its score, and one message is of no use.
async fn live(world: &World, queue: &str) {
    let (pk, name) = world.submit("lb", 1).await;
    world.run_that_crashes(pk, &name).await;
    let failed = |status: &SubmissionStatus| status.state == Some(State::Failed);
    world.until(&name, "it fails", failed).await;
    world.aws.send(queue, "no JSON").await;
    let pk = world.push(1, &json!("r/team-a:1"));
    let message =
        json!({"challenge_pk": "1", "phase_pk": "1", "submission_pk": pk, "submitted_image_uri": "r/team-a:1"});
    world.aws.send(queue, &message.to_string()).await;
    let name = names::submission(i64::try_from(pk).unwrap());
    let player = world.play(Duration::from_secs(1));
    let runs = |status: &SubmissionStatus| status.state == Some(State::Running);
    world.until(&name, "it runs", runs).await;
    player.fall_the_curtain();
    let is_everywhere = |status: &SubmissionStatus| {
        let is = |name: &str| conditions::is_true(&status.conditions, name);
        is(conditions::FINISHED) && is(conditions::PUBLISHED) && is(conditions::RECORDED)
    };
    world.until(&name, "every system has its end", is_everywhere).await;
}

/// The programs are up, and Prometheus has no complaint about what they expose.
async fn check_targets(prometheus: &Prometheus, count: usize) {
    eventually("no target has an error", async || {
        let targets = prometheus.get("targets", &[]).await["activeTargets"].clone();
        let targets = targets.as_array().unwrap();
        let is_well = |target: &Value| target["health"] == "up" && target["lastError"] == "";
        targets.len() == count && targets.iter().all(is_well)
    })
    .await;
    let families = prometheus.get("metadata", &[]).await;
    for (name, about) in families.as_object().unwrap() {
        assert!(
            about[0]["type"] != "unknown" && about[0]["help"] != "",
            "{name}: {about}"
        );
    }
}

/// Each alert is loaded and evaluated; what `fires` names fires, and nothing else.
async fn check_alerts(prometheus: &Prometheus, file: &Path, fires: &[&str]) {
    let text = fs::read_to_string(file).unwrap();
    let written = text
        .lines()
        .filter_map(|line| line.trim_start().strip_prefix("- alert: "));
    let names = |rules: &[Value], holds: &dyn Fn(&Value) -> bool| -> Vec<String> {
        let chosen = rules.iter().filter(|rule| holds(rule));
        chosen.map(|rule| rule["name"].as_str().unwrap().to_owned()).collect()
    };
    eventually("each alert is evaluated, and those fire that must", async || {
        let rules = prometheus.rules().await;
        let fire = names(&rules, &|rule| rule["state"] == "firing");
        fire == fires && rules.iter().all(|rule| rule["health"] != "unknown")
    })
    .await;
    let rules = prometheus.rules().await;
    assert_eq!(
        names(&rules, &|rule| rule["health"] == "ok"),
        written.collect::<Vec<_>>(),
        "{rules:?}"
    );
}

/// The queries of the dashboard as Grafana would send them, and those of docs/metrics.md.
fn queries() -> Vec<String> {
    let dashboard = text(&format!("{FILES}/dashboard.json"));
    let dashboard: Value = serde_json::from_str(&dashboard).unwrap();
    let panels = dashboard["panels"].as_array().unwrap().iter();
    let targets = panels.flat_map(|panel| panel["targets"].as_array().into_iter().flatten());
    let filled = targets.map(|target| {
        let text = target["expr"].as_str().unwrap();
        text.replace("$namespace", ".*").replace("$__rate_interval", "1m")
    });
    let page = text(PAGE);
    let table = page.split("## Questions and queries").nth(1).unwrap();
    let table = table.split("\n## ").next().unwrap();
    let asked = table
        .lines()
        .filter_map(|line| line.split('`').nth(1).map(str::to_owned));
    filled.chain(asked).collect()
}

fn text(file: &str) -> String {
    fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join(file)).unwrap()
}

/// The metrics that docs/metrics.md lists.
fn documented() -> BTreeSet<String> {
    let page = text(PAGE);
    let table = page.split("\n## All metrics\n").nth(1).unwrap();
    let table = table.split("\n## ").next().unwrap();
    let rows = table
        .lines()
        .filter_map(|line| line.strip_prefix("| `")?.split('`').next().map(str::to_owned));
    rows.collect()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_real_prometheus_reads_each_metric_and_evaluates_each_alert_and_each_panel() {
    let world = World::new().await;
    let queue = world.aws.queue("prometheus").await;
    make_board(&world, &queue).await;
    let start = async |program, name| Program::start(program, name, &world.namespace).await;
    let programs = [
        start("controller", "controller-0").await,
        start("controller", "controller-1").await,
        start("bridge", "bridge-0").await,
    ];
    let alerts = Path::new(env!("CARGO_MANIFEST_DIR")).join(FILES).join("alerts.yaml");
    let prometheus = Prometheus::start(&alerts, programs.iter().map(|program| &program.target)).await;
    // From here on each event is an increase.
    prometheus
        .until("count(leaderboard_submission_phase_duration_seconds_count)", "10")
        .await;
    prometheus.until("count(leaderboard_queue_messages_total)", "11").await;
    live(&world, &queue).await;
    for (query, value) in SEEN {
        prometheus.until(query, value).await;
    }
    check_targets(&prometheus, programs.len()).await;
    check_alerts(&prometheus, &alerts, &["LeaderboardDeadLetters"]).await;
    check_standby(&prometheus).await;
    check_queries(&prometheus).await;
    let known = prometheus.names().await;
    let is_expected = |name: &String| ABSENT.iter().any(|(absent, _)| name == absent);
    // The page has histograms without their three endings.
    let is_known = |name: &String| known.contains(name) || known.contains(&format!("{name}_bucket"));
    let mut missing = documented();
    missing.retain(|name| !is_known(name) && !is_expected(name));
    assert_eq!(missing, BTreeSet::new());
}

/// The controller that does not lead shows nothing that the leader counts.
async fn check_standby(prometheus: &Prometheus) {
    let all = r#"count by (__name__) ({__name__=~"leaderboard_.+"} and on (pod) (leaderboard_is_leader == 0))"#;
    let mut found = Vec::new();
    eventually("a standby is seen", async || {
        found = prometheus.query(all).await;
        found.len() > OF_STANDBY.len()
    })
    .await;
    let names = found.iter().map(|one| one["metric"]["__name__"].as_str().unwrap());
    let others: Vec<_> = names
        .filter(|name| !OF_STANDBY.iter().any(|own| name.starts_with(own)))
        .collect();
    assert_eq!(others, Vec::<&str>::new());
}

/// Each has an answer, but for those whose answer is that there is none. A scrape that was missed leaves a gap of a second.
async fn check_queries(prometheus: &Prometheus) {
    for query in queries() {
        let may_be_empty = ABSENT.iter().chain(&QUIET).any(|(part, _)| query.contains(part));
        let what = format!("{query} has an answer");
        eventually(&what, async || {
            !prometheus.query(&query).await.is_empty() || may_be_empty
        })
        .await;
    }
}
