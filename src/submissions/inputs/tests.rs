//! The copy of a file, from EvalAI's row to the bucket, against servers of the test's own.

use std::sync::{Arc, Mutex};
use std::time::Duration;

use axum::body::to_bytes;
use axum::extract::Request;
use axum::http::Method;
use axum::response::{IntoResponse, Response};
use jiff::Timestamp;
use serde_json::json;
use tokio::sync::mpsc;

use super::*;
use crate::ask::state::State;
use crate::fixtures;
use leaderboard_api::{Attempt, SubmittedFile};
use leaderboard_base::lock::lock;
use leaderboard_base::object_key::ObjectKey;
use leaderboard_base::shutdown::Stop;
use leaderboard_base::spans::LogSpan;
use leaderboard_base::tasks::Tasks;
use leaderboard_evalai::token::Token;
use leaderboard_evalai::types::Metrics;
use leaderboard_evalai::{Options, Run, Subject, Target};
use leaderboard_policy::ask::{Answered, Ask};

const CONTENT: &[u8] = b"id,label\n1,7\n";

fn key(name: &str) -> ObjectKey {
    ObjectKey {
        namespace: "ns".into(),
        name: name.into(),
        uid: name.into(),
    }
}

/// Objects by their paths.
type Objects = Vec<(String, Vec<u8>)>;

/// EvalAI, its storage and a bucket.
#[derive(Clone, Default)]
struct Server {
    url: Arc<Mutex<String>>,
    /// The path and the content of each object that was stored.
    stored: Arc<Mutex<Objects>>,
}

impl Server {
    async fn start() -> Self {
        let server = Self::default();
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        *lock(&server.url) = format!("http://{}", listener.local_addr().unwrap());
        let serving = server.clone();
        let router = axum::Router::new().fallback(move |request: Request| serving.clone().answer(request));
        tokio::spawn(async move { axum::serve(listener, router).await });
        server
    }

    fn url(&self) -> String {
        lock(&self.url).clone()
    }

    async fn answer(self, request: Request) -> Response {
        let (head, body) = request.into_parts();
        let path = head.uri.path();
        if head.method == Method::PUT {
            let content = to_bytes(body, usize::MAX).await.unwrap().to_vec();
            lock(&self.stored).push((path.to_owned(), content));
            return ([("etag", "\"e\"")], "").into_response();
        }
        match path {
            "/api/jobs/submission/77" => {
                let file = format!("{}/media/file.csv", self.url());
                let row = json!({"id": 77, "status": "submitted", "challenge_phase": 1, "input_file": file});
                row.to_string().into_response()
            }
            "/media/file.csv" => CONTENT.into_response(),
            _ => "[]".into_response(),
        }
    }

    fn subject(&self) -> Subject {
        let target = Target {
            leaderboard: key("board"),
            api_server: self.url(),
            challenge: 1,
            split: "leaderboard".into(),
            token: Arc::new(Token::parse("x").unwrap()),
            requests_per_minute: 6000,
            sweep: Duration::from_mins(1),
            period: Duration::from_secs(10),
            phases: [1].into(),
            metrics: Metrics::Fixed([].into()),
            inbox: None,
            is_observed: false,
            takes_files: true,
            since: Timestamp::UNIX_EPOCH,
        };
        let run = Run {
            attempt: Attempt(1),
            job: "submission-77-1".into(),
            by_hand: false,
            has_job: false,
            ended: None,
            log: LogSpan::default(),
        };
        let target = Arc::new(target);
        Subject {
            target,
            key: key("submission-77"),
            pk: 77,
            run,
        }
    }
}

fn asked(endpoint: &str, limit: u64, last: Option<Result<Fetched, Failure>>) -> Asked<Input> {
    let question = Input {
        attempt: Attempt(1),
        server: "https://evalai.example".into(),
        run_id: "77".parse().unwrap(),
        storage: serde_json::from_value(json!({"bucket": "results", "prefix": "v2/", "endpoint": endpoint})).unwrap(),
        submission: 77,
        limit,
    };
    let answered = |result| Answered {
        question: question.clone(),
        sent_ago: Duration::ZERO,
        result: Arc::new(result),
    };
    Asked {
        about: key("submission-77"),
        last: last.map(answered),
        question,
        waited: Duration::ZERO,
    }
}

#[tokio::test]
async fn a_file_goes_from_the_address_of_its_row_to_the_prefix_of_its_run() {
    let server = Server::start().await;
    let (_stop, signal) = Stop::new();
    let (changed, mut changes) = mpsc::unbounded_channel();
    let hub = Hub::new(Options {
        changed,
        ..Options::unheard(&Tasks::new(signal), || true)
    });
    let url = server.url();
    let aws = Box::pin(fixtures::aws(&url)).await;
    let (size, subject) = (CONTENT.len() as u64, server.subject());
    let asked_within = |limit| asked(&url, limit, None);
    let failure = fetch(&aws, &hub, &asked_within(size)).await.unwrap_err();
    assert!(!failure.is_refused, "its row has not been read: {failure:?}");

    hub.ask(&subject, false).unwrap();
    while hub.input_address(&subject.key).is_none() {
        changes.recv().await.unwrap();
    }
    let too_small = fetch(&aws, &hub, &asked_within(size - 1)).await;
    assert_eq!(too_small, Ok(Fetched::TooLarge));
    assert_eq!(*lock(&server.stored), []);
    let file = SubmittedFile {
        sha256: "6cb241301a6b9b28b5322dcd1664100f35c67a374be853870ba76d5355133d70".into(),
        size: i64::try_from(size).unwrap(),
    };
    let fetched = fetch(&aws, &hub, &asked_within(size)).await;
    assert_eq!(fetched, Ok(Fetched::Stored(file)));
    let expected = ("/results/v2/77/input/file".to_owned(), CONTENT.to_vec());
    assert_eq!(*lock(&server.stored), [expected]);
}

#[tokio::test(start_paused = true)]
async fn a_file_that_never_ends_is_given_up_also_where_the_bucket_is_slow() {
    let begun = Instant::now();
    let end = begun + INPUT_LIMIT;
    let never: InputStream = stream::pending().boxed();
    let late = Some(Err(None));
    assert_eq!(until(never, end).next().await, late);
    assert!(begun.elapsed() >= INPUT_LIMIT);
    let ready: InputStream = stream::repeat_with(|| Ok(Bytes::from_static(b"x"))).boxed();
    assert_eq!(until(ready, end).next().await, late);
    // The last part, its join and the abort have their own limits.
    let left = Input::LONGEST.checked_sub(INPUT_LIMIT);
    assert!(left.is_some_and(|left| left >= Duration::from_mins(15)), "{left:?}");
}

#[test]
fn files_of_one_server_leave_room_for_those_of_another_in_the_same_bucket() {
    let (mut state, now) = (State::default(), Instant::now());
    let mut want = |name: &str, server: &str, at| {
        let question = Input {
            server: server.into(),
            ..asked("http://s3", 1, None).question
        };
        state.want(&key(name), question, LogSpan::default(), at);
    };
    for number in 0..9 {
        want(&format!("submission-{number}"), "https://slow.example", now);
    }
    let later = now + Duration::from_millis(1);
    want("other", "https://evalai.example", later);
    let begun = std::iter::from_fn(|| state.next(later)).map(|work| work.asked.about.name);
    let begun: Vec<String> = begun.collect();
    assert!(begun.contains(&"other".to_owned()), "{begun:?}");
    assert!(begun.len() > 2, "{begun:?}");
}

#[test]
fn what_is_not_given_out_is_counted_until_another_answer() {
    let missing = |why, times| Ok(Fetched::Missing { why, times });
    let gone = |times| missing(Absence::Status(404), times);
    let silent = || Err(Failure::silent("no answer"));
    let refused = || {
        let why = "no URL".to_owned();
        Err(Failure { is_refused: true, why })
    };
    for (last, error, expected) in [
        (None, InputError::Gone(404).into(), gone(1)),
        (Some(gone(1)), InputError::Gone(404).into(), gone(2)),
        (Some(gone(2)), InputError::Gone(404).into(), gone(3)),
        (Some(refused()), InputError::Gone(404).into(), gone(1)),
        (Some(gone(1)), InputError::NoFile.into(), missing(Absence::NoFile, 2)),
        (Some(missing(Absence::Late, 2)), None, missing(Absence::Late, 3)),
        (Some(gone(1)), InputError::Silent("no answer".into()).into(), silent()),
        (None, InputError::Refused("no URL".into()).into(), refused()),
    ] {
        assert_eq!(unread(error, &asked("http://s3", 1, last)), expected);
    }
    let mut later = asked("http://s3", 1, Some(gone(2)));
    later.question.attempt = Attempt(2);
    let error = InputError::Gone(404).into();
    assert_eq!(unread(error, &later), gone(1), "an attempt counts anew");
}
