//! The passes: one queue for Submissions, one for Leaderboards; each object by one pass at a time, a bounded number at once.

use std::sync::Arc;
use std::time::{Duration, Instant};

use futures::StreamExt;
use kube::runtime::controller::{Action, Config, applier};
use kube::runtime::reflector::ObjectRef;
use kube::{Resource, ResourceExt};
use tokio::sync::mpsc;

use super::{Touched, key};
use crate::backoff::jittered;
use crate::controller::act::{ActError, act};
use crate::controller::backoff::BackoffMap;
use crate::controller::context::Context;
use crate::controller::decide::decide;
use crate::controller::leaderboards::{self, LeaderboardError};
use crate::controller::memory::waits_for_leaderboard;
use crate::controller::observe::{observe, uid_of};
use crate::observability::Observability;
use leaderboard_api::{Leaderboard, Submission};

/// A pass takes at most this long.
const PASS_LIMIT: Duration = Duration::from_secs(90);
/// Events of one object that come together are one pass.
const DEBOUNCE: Duration = Duration::from_millis(50);
/// A pass that could not write to a bucket which hangs is made again so soon.
const BUCKET_AGAIN: Duration = Duration::from_secs(10);
/// An object without any other cause is looked at this often.
const RESYNC: Duration = Duration::from_mins(10);

/// Why a pass ended early.
#[derive(thiserror::Error, Debug)]
enum PassError {
    #[error(transparent)]
    Act(#[from] ActError),
    #[error(transparent)]
    Leaderboard(#[from] LeaderboardError),
    #[error("the pass took longer than {} s", PASS_LIMIT.as_secs())]
    TooLong,
}

impl PassError {
    fn label(&self) -> &'static str {
        match self {
            Self::Act(error) => error.label(),
            Self::Leaderboard(_) => "leaderboard",
            Self::TooLong => "timeout",
        }
    }
}

struct Shared {
    context: Arc<Context>,
    backoff: BackoffMap,
    seen: Observability,
}

/// Runs passes until the stop; then finishes those that have begun.
pub(super) async fn run(context: Arc<Context>, inbox: mpsc::UnboundedReceiver<Touched>, seen: Observability) {
    let (submissions, submission_queue) = mpsc::unbounded_channel();
    let (boards, board_queue) = mpsc::unbounded_channel();
    let shared = Arc::new(Shared {
        context: Arc::clone(&context),
        backoff: BackoffMap::default(),
        seen,
    });
    let sorting = sort(inbox, submissions, boards, Arc::clone(&shared));
    let config = Config::default()
        .concurrency(context.settings.concurrency)
        .debounce(DEBOUNCE);
    let of_submissions = applier(
        |object, shared: Arc<Shared>| Box::pin(submission_pass(object, shared)),
        |object: Arc<Submission>, error: &PassError, shared| after_error(object.as_ref(), error, &shared),
        Arc::clone(&shared),
        context.stores.submissions.clone(),
        stream(submission_queue),
        config.clone(),
    );
    let of_boards = applier(
        |object, shared: Arc<Shared>| Box::pin(board_pass(object, shared)),
        |object: Arc<Leaderboard>, error: &PassError, shared| after_error(object.as_ref(), error, &shared),
        Arc::clone(&shared),
        context.stores.leaderboards.clone(),
        stream(board_queue),
        config.concurrency(4),
    );
    // What passes return was counted and logged by them.
    let drained = async { tokio::join!(of_submissions.for_each(|_| async {}), of_boards.for_each(|_| async {})) };
    tokio::join!(sorting, drained);
}

fn stream<K>(
    mut queue: mpsc::UnboundedReceiver<ObjectRef<K>>,
) -> impl futures::Stream<Item = Result<ObjectRef<K>, std::convert::Infallible>>
where
    K: Resource,
    K::DynamicType: Eq + std::hash::Hash + Clone,
{
    futures::stream::poll_fn(move |cx| queue.poll_recv(cx).map(|item| item.map(Ok)))
}

/// Sorts what was touched to the two queues; its end closes both.
async fn sort(
    mut inbox: mpsc::UnboundedReceiver<Touched>,
    submissions: mpsc::UnboundedSender<ObjectRef<Submission>>,
    boards: mpsc::UnboundedSender<ObjectRef<Leaderboard>>,
    shared: Arc<Shared>,
) {
    loop {
        let touched = tokio::select! {
            () = shared.seen.stop.wait() => return,
            touched = inbox.recv() => match touched { Some(touched) => touched, None => return },
        };
        match touched {
            Touched::Submission(reference) => {
                let _ = submissions.send(reference);
            }
            Touched::Leaderboard(reference) => {
                wake_waiting(&shared.context, &reference, &submissions);
                let _ = boards.send(reference);
            }
            Touched::Gone(key) => {
                shared.context.forget(&key.uid);
                shared.context.desk.forget(&key.uid);
                shared.context.sync.gone(&key);
                shared.backoff.dropped(&key.uid);
            }
        }
    }
}

/// A Leaderboard, or the line before it, has changed: those that have no Job may now start.
fn wake_waiting(
    context: &Context,
    board: &ObjectRef<Leaderboard>,
    submissions: &mpsc::UnboundedSender<ObjectRef<Submission>>,
) {
    let waits = |s: &Submission| s.status.as_ref().is_none_or(waits_for_leaderboard);
    for submission in context.stores.submissions.state() {
        let mine = submission.spec.leaderboard_name == board.name && submission.namespace() == board.namespace;
        if mine && waits(&submission) && context.memory.is_waiting(&submission) {
            let _ = submissions.send(ObjectRef::from_obj(submission.as_ref()));
        }
    }
}

async fn submission_pass(submission: Arc<Submission>, shared: Arc<Shared>) -> Result<Action, PassError> {
    let started = Instant::now();
    let name = key(submission.as_ref()).to_string();
    let work = async {
        let view = observe(&shared.context, Arc::clone(&submission)).await;
        let plan = decide(&view);
        let requeue = plan.requeue;
        shared.context.board.settle(&uid_of(submission.as_ref()), &plan.status);
        let held_back = act(&shared.context, &view, plan).await?;
        Ok([requeue, held_back].into_iter().flatten().min())
    };
    let result = tokio::time::timeout(PASS_LIMIT, work)
        .await
        .unwrap_or(Err(PassError::TooLong));
    finish(
        "submission",
        &name,
        &uid_of(submission.as_ref()),
        started,
        &shared,
        result,
    )
}

async fn board_pass(leaderboard: Arc<Leaderboard>, shared: Arc<Shared>) -> Result<Action, PassError> {
    let started = Instant::now();
    let (name, uid) = (key(leaderboard.as_ref()).to_string(), uid_of(leaderboard.as_ref()));
    let work = leaderboards::reconcile(leaderboard, Arc::clone(&shared.context));
    let result = match tokio::time::timeout(PASS_LIMIT, work).await {
        Ok(result) => result.map(Some).map_err(PassError::from),
        Err(_) => Err(PassError::TooLong),
    };
    finish("leaderboard", &name, &uid, started, &shared, result)
}

fn finish(
    kind: &'static str,
    name: &str,
    uid: &str,
    started: Instant,
    shared: &Shared,
    result: Result<Option<Duration>, PassError>,
) -> Result<Action, PassError> {
    match result {
        Ok(requeue) => {
            shared.backoff.succeeded(uid);
            shared.seen.metrics.reconciled(kind, "ok", started.elapsed());
            Ok(Action::requeue(requeue.unwrap_or_else(jittered_resync)))
        }
        Err(error) => {
            shared.seen.metrics.reconciled(kind, "error", started.elapsed());
            shared.seen.metrics.reconcile_failed(kind, error.label());
            tracing::warn!(kind, object = name, "{error}");
            Err(error)
        }
    }
}

/// Spreads the resync of many objects.
fn jittered_resync() -> Duration {
    jittered(RESYNC, 0.2)
}

fn after_error(object: &impl Resource, error: &PassError, shared: &Shared) -> Action {
    // It fails at once, so that the pauses would be minutes long before the bucket is back.
    if matches!(error, PassError::Act(error) if error.is_of_a_silent_bucket()) {
        return Action::requeue(BUCKET_AGAIN);
    }
    Action::requeue(shared.backoff.failed(&uid_of(object)))
}

#[cfg(test)]
#[path = "passes_tests.rs"]
mod tests;
