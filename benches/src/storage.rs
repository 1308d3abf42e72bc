//! S3 as the operator sees it: one bucket that answers from memory, at once. A run without a Pod has no report. A live one has a report of
//! real size, which changes once a minute. An ended one has its final report.

use std::collections::{BTreeMap, HashMap};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use axum::Router;
use axum::extract::{Request, State};
use axum::http::{Method, StatusCode, header};
use axum::response::{IntoResponse, Response};
use leaderboard_api::{Attempt, Metric, WorkerState};
use leaderboard_contract::report::{Outcome as RunOutcome, REPORT_KEY, Report, ReportWorker, SCHEMA, StoredFile};
use tokio::net::TcpListener;
use tokio::task::JoinHandle;

use crate::bench::Outcome;

/// Name of the bucket.
pub const BUCKET: &str = "bench-results";
/// Routes of a run, shared out among its pairs.
pub const ROUTES: u32 = 20;
/// Pairs of a run.
pub const PAIRS: u32 = 4;
/// A route takes minutes, and each pair drives one.
const NEWS: Duration = Duration::from_mins(1);
/// Placeholders for the numbers of a run in the two texts.
const SUBMISSION: &str = "00000000-0000-0000-0000-000000000001";
const POD: &str = "00000000-0000-0000-0000-000000000002";
const ROUND: u64 = 987_654_321;
/// The results that the evaluator's own merge renders for EvalAI.
const RESULTS: &str = include_str!("../../crates/results/tests/cases/v2/case01/results.json");
const EMPTY_LIST: &str = "<?xml version=\"1.0\" encoding=\"UTF-8\"?><ListBucketResult \
    xmlns=\"http://s3.amazonaws.com/doc/2006-03-01/\"><Name>bench-results</Name><Prefix></Prefix><KeyCount>0</KeyCount>\
    <MaxKeys>1</MaxKeys><IsTruncated>false</IsTruncated></ListBucketResult>";

/// The running stand-in.
pub struct Storage {
    pub url: String,
    shelf: Arc<Shelf>,
    server: JoinHandle<()>,
}

struct Shelf {
    runs: Mutex<HashMap<String, Run>>,
    requests: AtomicU64,
    live: String,
    ended: String,
}

struct Run {
    submission: String,
    pod: String,
    began: Instant,
    is_over: bool,
}

impl Drop for Storage {
    fn drop(&mut self) {
        self.server.abort();
    }
}

impl Storage {
    pub async fn start() -> Outcome<Self> {
        let shelf = Arc::new(Shelf {
            runs: Mutex::default(),
            requests: AtomicU64::new(0),
            live: serde_json::to_string(&report(false))?,
            ended: serde_json::to_string(&report(true))?,
        });
        let listener = TcpListener::bind("127.0.0.1:0").await?;
        let url = format!("http://{}", listener.local_addr()?);
        let router = Router::new().fallback(answer).with_state(Arc::clone(&shelf));
        let server = tokio::spawn(async move { axum::serve(listener, router).await.unwrap_or_default() });
        Ok(Self { url, shelf, server })
    }

    /// A Pod of the run reports from now on.
    pub fn begin(&self, run: &str, submission: &str, pod: &str) {
        let begun = Run {
            submission: submission.to_owned(),
            pod: pod.to_owned(),
            began: Instant::now(),
            is_over: false,
        };
        self.runs().insert(run.to_owned(), begun);
    }

    /// The run's final report is stored.
    pub fn end(&self, run: &str) {
        if let Some(run) = self.runs().get_mut(run) {
            run.is_over = true;
        }
    }

    pub fn requests(&self) -> u64 {
        self.shelf.requests.load(Ordering::Relaxed)
    }

    fn runs(&self) -> std::sync::MutexGuard<'_, HashMap<String, Run>> {
        self.shelf.runs.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

async fn answer(State(shelf): State<Arc<Shelf>>, request: Request) -> Response {
    shelf.requests.fetch_add(1, Ordering::Relaxed);
    let path = request.uri().path().trim_start_matches('/');
    let key = path.split_once('/').map_or("", |(_, key)| key);
    if request.method() == Method::PUT {
        return [(header::ETAG, "\"stored\"")].into_response();
    }
    if key.is_empty() {
        return ([(header::CONTENT_TYPE, "application/xml")], EMPTY_LIST).into_response();
    }
    let known = request
        .headers()
        .get(header::IF_NONE_MATCH)
        .and_then(|tag| tag.to_str().ok());
    let found = key
        .strip_suffix(REPORT_KEY)
        .and_then(|run| shelf.report(run.trim_end_matches('/')));
    match found {
        None => (StatusCode::NOT_FOUND, "<Error><Code>NoSuchKey</Code></Error>").into_response(),
        Some((tag, _)) if known == Some(&tag) => StatusCode::NOT_MODIFIED.into_response(),
        Some((tag, text)) => ([(header::ETAG, tag)], text).into_response(),
    }
}

impl Shelf {
    fn report(&self, name: &str) -> Option<(String, String)> {
        let runs = self.runs.lock().unwrap_or_else(PoisonError::into_inner);
        let run = runs.get(name)?;
        let text = if run.is_over { &self.ended } else { &self.live };
        let round = run.began.elapsed().as_secs() / NEWS.as_secs() + 1;
        let tag = format!("\"{}-{}-{round}\"", run.pod, u8::from(run.is_over));
        let text = text.replace(SUBMISSION, &run.submission).replace(POD, &run.pod);
        Some((tag, text.replace(&ROUND.to_string(), &round.to_string())))
    }
}

/// A report as logcopy writes it.
fn report(is_final: bool) -> Report {
    let share = ROUTES / PAIRS;
    let done = if is_final { share } else { share / 2 };
    let state = if is_final {
        WorkerState::Done
    } else {
        WorkerState::Running
    };
    let worker = |id| ReportWorker {
        id,
        done,
        total: share,
        crashes: 0,
        state,
        names_crash: false,
    };
    let file = |name: &str, size| {
        let stored = StoredFile {
            size,
            sha256: "5e884898da28047151d0e56f8dc6292773603d0d6aabbdd62a11ef721d1542d8".into(),
        };
        (format!("evalai/{name}"), stored)
    };
    let files = [
        ("agent_results.json", 31_615),
        ("results.json", 752),
        ("stdout.txt", 9_200),
        ("metadata.json", 410),
    ];
    let files: BTreeMap<_, _> = files.into_iter().map(|(name, size)| file(name, size)).collect();
    Report {
        schema: SCHEMA,
        submission_uid: SUBMISSION.into(),
        attempt: Attempt(1),
        pod_uid: POD.into(),
        round: ROUND,
        done: done * PAIRS,
        total: ROUTES,
        unit: "routes".into(),
        workers: (1..=PAIRS).map(worker).collect(),
        merger: None,
        score: Some(Metric::new("Driving score", 41.25, 2)),
        metrics: vec![
            Metric::new("Route completion", 75.5, 2),
            Metric::new("Infraction penalty", 0.55, 3),
        ],
        is_final,
        eligible: true,
        outcome: if is_final {
            RunOutcome::Finished
        } else {
            RunOutcome::Running
        },
        stopped: None,
        refused: None,
        unusable: None,
        warnings: Vec::new(),
        logs: None,
        results: RESULTS.into(),
        partial_results: (!is_final).then(|| RESULTS.into()),
        agents_fill_disk: false,
        files,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn the_operator_reads_what_is_stored() {
        let storage = Storage::start().await.unwrap();
        assert!(storage.shelf.report("run-1").is_none());
        storage.begin("run-1", "the-submission", "the-pod");
        for is_final in [false, true] {
            let (_, text) = storage.shelf.report("run-1").unwrap();
            let report = Report::parse(text.as_bytes()).unwrap();
            assert!(report.belongs_to("the-submission", Attempt(1)));
            assert_eq!(
                (report.pod_uid.as_str(), report.is_final, report.round),
                ("the-pod", is_final, 1)
            );
            storage.end("run-1");
        }
    }
}
