//! The memory that storing a log of 5 GB takes. Asked for by name:
//! `cargo test --profile local --test resume -- --ignored --nocapture a_log_of_5_gb`.

use std::fs::{self, OpenOptions};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use axum::extract::Request;
use axum::http::{Method, StatusCode};
use axum::response::{IntoResponse, Response};
use fastrand::Rng;
use futures::StreamExt;
use leaderboard_api::LeaderboardVersion;
use leaderboard_contract::report::Owner;
use tokio::sync::watch;
use tokio::task::JoinHandle;
use tokio::time::timeout;

use super::kubelet::Kubelet;
use super::submission::{Submission, make_volumes};
use crate::ministack::server;

const LOG: u64 = 5 << 30;
const GROWTH: u64 = 10 << 20;
const LIMIT: Duration = Duration::from_mins(10);

/// An S3 that takes every object, keeps the last report alone, and counts.
#[derive(Default)]
pub struct Sink {
    pub bytes: AtomicU64,
    pub report: watch::Sender<Vec<u8>>,
    largest: AtomicU64,
    joined: watch::Sender<u64>,
}

async fn answer(sink: Arc<Sink>, request: Request) -> Response {
    const JOINED: &str = "<CompleteMultipartUploadResult><ETag>\"x\"</ETag></CompleteMultipartUploadResult>";
    const BEGUN: &str = "<InitiateMultipartUploadResult><UploadId>1</UploadId></InitiateMultipartUploadResult>";
    const COPIED: &str = "<CopyPartResult><ETag>\"x\"</ETag></CopyPartResult>";
    const NONE: &str = "<Error><Code>NoSuchKey</Code></Error>";
    let query = request.uri().query().unwrap_or_default().to_owned();
    let is_owner = request.uri().path().ends_with("/logcopy/owner");
    let is_report = request.uri().path().ends_with("/logcopy/report.json");
    let is_copy = request.headers().contains_key("x-amz-copy-source");
    let method = request.method().clone();
    let mut body = request.into_body().into_data_stream();
    let (mut size, mut report) = (0, Vec::new());
    while let Some(Ok(chunk)) = body.next().await {
        size += chunk.len() as u64;
        if is_report {
            report.extend_from_slice(&chunk);
        }
    }
    if is_report && method == Method::PUT {
        sink.report.send_replace(report);
    }
    sink.bytes.fetch_add(size, Ordering::Relaxed);
    sink.largest.fetch_max(size, Ordering::Relaxed);
    match method {
        Method::GET if is_owner => Owner::new("pod-1").to_json().into_response(),
        Method::GET => (StatusCode::NOT_FOUND, NONE).into_response(),
        Method::POST if query.contains("uploadId=") => {
            sink.joined.send_modify(|joined| *joined += 1);
            JOINED.into_response()
        }
        Method::POST => BEGUN.into_response(),
        _ if is_copy => COPIED.into_response(),
        _ => ([("etag", "\"x\"")], "").into_response(),
    }
}

/// Starts one. Returns what it counts, where it is, and its task.
pub async fn serve() -> (Arc<Sink>, String, JoinHandle<()>) {
    let sink = Arc::new(Sink::default());
    let counting = Arc::clone(&sink);
    let router = axum::Router::new().fallback(move |request: Request| answer(Arc::clone(&counting), request));
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let endpoint = format!("http://{}", listener.local_addr().unwrap());
    let serving = tokio::spawn(async move { axum::serve(listener, router).await.unwrap() });
    (sink, endpoint, serving)
}

/// The most bytes of memory that a process has ever had.
pub fn most_memory(pid: u32) -> u64 {
    let status = fs::read_to_string(format!("/proc/{pid}/status")).unwrap();
    let line = status.lines().find(|line| line.starts_with("VmHWM:")).unwrap();
    let kib: u64 = line.split_whitespace().nth(1).unwrap().parse().unwrap();
    kib << 10
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "measures for minutes"]
async fn a_log_of_5_gb_is_stored_in_bounded_memory() {
    let (sink, endpoint, serving) = serve().await;
    let bucket = server().await.bucket().await;
    let mut submission = Submission::on(&endpoint, &bucket, LeaderboardVersion::V2, &mut Rng::new()).await;
    submission.run.plan.storage.s3.size_limit = leaderboard_api::ByteQuantity::gibibytes(16);
    // After this time and a minute, an upload under way is cut.
    submission.run.period_seconds = 60;
    let kubelet = Kubelet::new(&submission);
    let root = kubelet.folder().join("pod-1");
    make_volumes(&root);
    let path = root.join("logs/agent/agent1/leaderboard.log");
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    let log = OpenOptions::new()
        .write(true)
        .create(true)
        .truncate(true)
        .open(&path)
        .unwrap();
    let began = Instant::now();
    let mut logcopy = submission
        .own("logcopy", &root, "pod-1")
        .kill_on_drop(true)
        .spawn()
        .unwrap();
    for (size, joins) in [(LOG, 1), (LOG + GROWTH, 2)] {
        let before = sink.bytes.load(Ordering::Relaxed);
        log.set_len(size).unwrap();
        let mut joined = sink.joined.subscribe();
        tokio::select! {
            in_time = timeout(LIMIT, joined.wait_for(|joined| *joined >= joins)) => drop(in_time.unwrap().unwrap()),
            ended = logcopy.wait() => panic!("logcopy ends: {ended:?}"),
        }
        let most = most_memory(logcopy.id().unwrap());
        println!(
            "5 GB: {} MiB sent in {:?}, largest body {} MiB; {} MiB of memory",
            (sink.bytes.load(Ordering::Relaxed) - before) >> 20,
            began.elapsed(),
            sink.largest.load(Ordering::Relaxed) >> 20,
            most >> 20
        );
        assert!(most < 256 << 20, "{most} bytes");
    }
    logcopy.kill().await.unwrap();
    serving.abort();
}
