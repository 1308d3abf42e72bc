//! Checkpoints of the largest size, of the most pairs, and larger ones, next to 24,000 files with long names and sparse ones. The program
//! `logcopy` reads, merges and stores them, and stays below its memory limit.

use std::fs::{self, File};
use std::path::Path;
use std::sync::atomic::Ordering;
use std::time::Duration;

use fastrand::Rng;
use leaderboard_api::{LeaderboardVersion, RouteSlice};
use leaderboard_contract::report::Report;
use leaderboard_contract::run::STATUS_FOLDER;
use leaderboard_evaluation::carla::gather::results_plan;
use serde_json::json;
use tokio::time::timeout;

use super::kubelet::Kubelet;
use super::measure::{Sink, most_memory, serve};
use super::submission::{Submission, carla, make_volumes};

const PAIRS: usize = 16;
/// Seven eighths of what the Pod gives to logcopy.
const MEMORY: u64 = 896 << 20;
const LIMIT: Duration = Duration::from_mins(3);

/// Files of each agent, of which more than are looked at, and of the simulators.
const AGENT_FILES: usize = 1_250;
const SIMULATOR_FILES: usize = 4_000;
/// Sparse files of each agent, next to a sparse leaderboard.log.
const SPARSE_FILES: usize = 4;

/// Fills the folders of all containers.
fn flood(logs: &Path) {
    let folder = |of: &str| {
        let folder = logs.join(of).join("x".repeat(150));
        fs::create_dir_all(&folder).unwrap();
        folder
    };
    let name = |number: usize| format!("{}{number}", "y".repeat(200));
    for pair in 1..=PAIRS {
        let (own, folder) = (format!("agent/agent{pair}"), folder(&format!("agent/agent{pair}")));
        for number in 0..AGENT_FILES {
            File::create(folder.join(name(number))).unwrap();
        }
        let sparse = |name: &str, size: u64| File::create(logs.join(&own).join(name)).unwrap().set_len(size).unwrap();
        for number in 0..SPARSE_FILES {
            sparse(&format!("sparse-{number}"), 60 << 20);
        }
        sparse("leaderboard.log", 4 << 40);
    }
    let folder = folder("simulator");
    for number in 0..SIMULATOR_FILES {
        File::create(folder.join(name(number))).unwrap();
    }
}

/// The checkpoint of a pair that has finished one of its two routes, filled up to `bytes` with small objects and long texts.
fn checkpoint(pair: usize, bytes: usize, values: usize, fill: &str) -> String {
    let infractions = [
        "collisions_pedestrian",
        "collisions_vehicle",
        "collisions_layout",
        "red_light",
        "stop_infraction",
        "outside_route_lanes",
        "min_speed_infractions",
        "yield_emergency_vehicle_infractions",
        "scenario_timeouts",
        "route_dev",
        "vehicle_blocked",
        "route_timeout",
    ];
    let infractions: serde_json::Map<_, _> = infractions
        .map(|name| (name.to_owned(), json!([])))
        .into_iter()
        .collect();
    let small = vec!["{\"\":0}"; values.saturating_sub(200) / 2].join(",");
    let file = |texts: &[String]| {
        let record = json!({
            "index": 0,
            "route_id": format!("RouteScenario_{}_rep0", 2 * pair),
            "status": "Completed",
            "num_infractions": 0,
            "infractions": infractions,
            "scores": {"score_route": 100.0, "score_penalty": 1.0, "score_composed": 100.0},
            "meta": {"route_length": 100.0, "duration_game": 10.0, "duration_system": 20.0},
            "texts": texts,
            "small": ["small"],
        });
        let checkpoint = json!({"global_record": {}, "progress": [1, 2], "records": [record]});
        json!({
            "_checkpoint": checkpoint,
            "entry_status": "Started",
            "eligible": false,
            "sensors": ["carla_camera"],
            "values": [],
            "labels": [],
        })
        .to_string()
        .replacen("[\"small\"]", &format!("[{small}]"), 1)
    };
    let mut left = bytes - file(&[]).len();
    let mut texts = Vec::new();
    while left > 3 {
        texts.push(fill.repeat((left - 3).min(1 << 20)));
        left -= texts.last().map_or(0, String::len) + 3;
    }
    file(&texts)
}

fn put(logs: &Path, pair: usize, text: &str) {
    let folder = logs.join(format!("agent/agent{}", pair + 1));
    fs::create_dir_all(&folder).unwrap();
    let next = logs.join("next");
    fs::write(&next, text).unwrap();
    fs::rename(next, folder.join("agent_results.json")).unwrap();
}

/// Waits for a report that shows it, while logcopy stays below its memory.
async fn reported(sink: &Sink, pid: u32, what: impl Fn(&Report) -> bool) -> Report {
    let mut reports = sink.report.subscribe();
    let found = async {
        loop {
            let memory = most_memory(pid);
            assert!(memory < MEMORY, "{} MiB", memory >> 20);
            let report = Report::parse(&reports.borrow_and_update());
            match report {
                Ok(report) if what(&report) => return report,
                _ => reports.changed().await.unwrap(),
            }
        }
    };
    let found = timeout(LIMIT, found).await;
    found.unwrap_or_else(|_| panic!("{:?}", Report::parse(&sink.report.borrow())))
}

fn two_routes(pair: usize) -> RouteSlice {
    let first = u32::try_from(2 * pair).unwrap();
    RouteSlice { first, last: first + 1 }
}

/// Size and digest of the merged file.
fn merged(report: &Report) -> Option<(u64, String)> {
    let file = report.files.get("evalai/metadata.json")?;
    Some((file.size, file.sha256.clone()))
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn sixteen_pairs_with_the_largest_checkpoints_stay_below_logcopys_memory() {
    let (sink, endpoint, serving) = serve().await;
    let mut submission = Submission::on(&endpoint, "bucket", LeaderboardVersion::V2, &mut Rng::new()).await;
    let plan = carla(&mut submission.run);
    plan.slices = (0..PAIRS).map(two_routes).collect();
    plan.routes = i32::try_from(2 * PAIRS).unwrap();
    // Half of it is for the agents' files, so the sparse ones are sent in part.
    submission.run.plan.storage.s3.size_limit = leaderboard_api::ByteQuantity::gibibytes(1);
    let limits = results_plan(&submission.run).unwrap().limits_of(0);
    // With more values the merged file, which has a line for each, would be larger than it may be.
    let (most, values) = (limits.bytes, limits.values / 4);
    let kubelet = Kubelet::new(&submission);
    let root = kubelet.folder().join("pod-1");
    make_volumes(&root);
    let logs = root.join("logs");
    fs::create_dir_all(logs.join(STATUS_FOLDER)).unwrap();
    flood(&logs);
    let mut logcopy = submission
        .own("logcopy", &root, "pod-1")
        .kill_on_drop(true)
        .spawn()
        .unwrap();
    let pid = logcopy.id().unwrap();

    for pair in 0..PAIRS {
        put(&logs, pair, &checkpoint(pair, most, values, "x"));
    }
    let first = reported(&sink, pid, |report| report.done == 16).await;
    let size = merged(&first).map_or(0, |(size, _)| size);
    assert!(size > 40 << 20, "{size} bytes are merged");
    for pair in 0..PAIRS {
        put(&logs, pair, &checkpoint(pair, most, values, "y"));
    }
    reported(&sink, pid, |report| {
        report.done == 16 && merged(report) != merged(&first)
    })
    .await;
    for pair in 0..4 {
        put(&logs, pair, &checkpoint(pair, 63 << 20, 0, "z"));
    }
    reported(&sink, pid, |report| {
        report
            .refused
            .as_ref()
            .is_some_and(|refused| refused.why.contains("that are read"))
    })
    .await;
    println!(
        "{PAIRS} pairs of {most} bytes and {values} values, merged {} MiB, next to {} files: {} MiB of memory, {} MiB sent",
        size >> 20,
        PAIRS * AGENT_FILES + SIMULATOR_FILES,
        most_memory(pid) >> 20,
        sink.bytes.load(Ordering::Relaxed) >> 20
    );
    logcopy.kill().await.unwrap();
    serving.abort();
}
