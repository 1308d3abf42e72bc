//! Reconciles against caches of the test's own, under a paused clock.

use futures::stream;
use http::Method;
use jiff::Timestamp;
use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;
use kube::core::Status;
use tokio::sync::mpsc;

use super::*;
use crate::fixtures::{Cluster, leaderboard, surroundings, with_job};
use crate::kubernetes::call;
use crate::observability::Observability;
use crate::runtime::backoff::BackoffMap;
use leaderboard_base::shutdown::Stop;

/// Submissions that wait for a bucket which takes connections and never answers.
const BEHIND: usize = 300;
/// Cancels of others.
const CANCELS: usize = 6;

#[test]
fn a_question_outlasts_the_longest_pause_between_two_reconciles() {
    assert!(crate::ask::state::KEPT > RESYNC.mul_f64(1.0 + SPREAD));
}

/// First the submissions that wait for the bucket, then the cancelled ones.
fn crowd(endpoint: &str) -> Cluster {
    let (hanging, other) = (leaderboard("hanging", endpoint), leaderboard("other", endpoint));
    let mut cluster = Cluster::default();
    for number in 0..BEHIND {
        let (mut submission, job) = with_job(&format!("behind-{number}"), &hanging);
        let status = submission.status.as_mut().unwrap();
        status.times.scheduled = Some(Time(Timestamp::now()));
        cluster.submissions.push(submission);
        cluster.jobs.push(job);
    }
    for number in 0..CANCELS {
        let (mut cancelled, job) = with_job(&format!("cancelled-{number}"), &other);
        cancelled.spec.cancel = true;
        cluster.submissions.push(cancelled);
        cluster.jobs.push(job);
    }
    cluster.leaderboards = vec![hanging, other];
    cluster
}

#[tokio::test(start_paused = true)]
async fn cancels_do_not_wait_for_a_bucket_that_hangs() {
    let silent = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let endpoint = format!("http://{}", silent.local_addr().unwrap());
    let cluster = crowd(&endpoint);
    let (queue, mut queued) = mpsc::unbounded_channel();
    let event = |submission: &ObjectRef<Submission>, class| queue.send((submission.clone(), class)).unwrap();
    let mut all: Vec<_> = cluster.submissions.iter().map(ObjectRef::from_obj).collect();
    let cancelled = all.split_off(BEHIND);
    let mut around = surroundings(cluster, &endpoint).await;
    let (_stop, signal) = Stop::new();
    let telemetry = Observability::new(signal);
    let shared = Arc::new(Shared {
        context: Arc::new(around.context),
        queues: Queues::new(16, &telemetry.metrics),
        backoff: BackoffMap::default(),
        telemetry,
    });
    let of_submissions = stream::poll_fn(move |cx| queued.poll_recv(cx)).boxed();
    let reconciles = tokio::spawn(run(of_submissions, stream::pending().boxed(), shared));
    for submission in &all {
        event(submission, Class::Refresh);
    }
    // As many reconciles as there may be at once have begun, and the others wait.
    tokio::time::sleep(Duration::from_secs(1)).await;
    let began = tokio::time::Instant::now();
    for submission in &cancelled {
        event(submission, Class::Urgent);
    }
    let mut stopped = Vec::new();
    while stopped.len() < CANCELS {
        let request = around.requests.recv().await.unwrap();
        if request.method == Method::DELETE && request.path.contains("/jobs/cancelled-") {
            stopped.push(request.at - began);
        }
    }
    reconciles.abort();
    assert!(
        stopped.iter().all(|took| *took <= Duration::from_secs(1)),
        "their Jobs were deleted after {stopped:?}"
    );
}

#[tokio::test(start_paused = true)]
async fn a_reconcile_that_panics_or_hangs_is_an_error_of_its_own() {
    let panics = limited::<()>(async { panic!("no row {}", 7) }).await.unwrap_err();
    assert_eq!(
        (panics.label(), panics.to_string().as_str()),
        ("panic", "the reconcile has panicked: no row 7")
    );
    let hangs = limited(std::future::pending::<Result<(), _>>()).await.unwrap_err();
    assert_eq!(hangs.label(), "timeout");
}

#[tokio::test]
async fn a_failed_call_is_counted_by_the_answer_of_the_api_server() {
    let refused = async || {
        let status = Status::failure("No.", "Forbidden").with_code(403).boxed();
        let refused = async { Err::<(), _>(kube::Error::Api(status)) };
        call("the status", "one", refused).await.unwrap_err()
    };
    let of_leaderboard = ReconcileError::from(refused().await);
    let of_submission = ReconcileError::from(ActError::from(refused().await));
    assert_eq!([of_leaderboard.label(), of_submission.label()], ["forbidden"; 2]);
}
