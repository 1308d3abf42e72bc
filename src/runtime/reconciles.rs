//! The reconciles: one queue for Submissions, one for Leaderboards. Each object has one reconcile at a time, and each reconcile is a task
//! of its own. The number at once is bounded.

use std::future::Future;
use std::panic::AssertUnwindSafe;
use std::sync::Arc;
use std::time::{Duration, Instant};

use futures::stream::StreamExt;
use futures::{FutureExt, Stream};
use kube::Resource;
use kube::runtime::reflector::ObjectRef;
use tracing::Instrument;

use super::Shared;
use super::events::Events;
use super::queue::{After, Class, Limits, Queue, Turn, urgency};
use crate::kubernetes::CallError;
use crate::leaderboards::{self, Reconciled, operator};
use crate::metrics::Metrics;
use crate::runtime::objects::{span_of, uid_of};
use crate::slots::Slots;
use crate::submissions::act::{ActError, act};
use crate::submissions::observe::observe;
use leaderboard_api::{Leaderboard, Reason, Submission};
use leaderboard_base::backoff::jittered;
use leaderboard_base::tasks::panic_message;
use leaderboard_policy::submissions::{SlotUse, decide};

/// The kinds as their watches call them, for metrics.
pub(super) const SUBMISSION: &str = "Submission";
pub(super) const LEADERBOARD: &str = "Leaderboard";
/// A reconcile takes at most this long.
const TIME_LIMIT: Duration = Duration::from_secs(90);
/// An object without any other cause is reconciled this often.
const RESYNC: Duration = Duration::from_mins(10);
/// The share by which the time of each object differs, so that they come apart.
const SPREAD: f64 = 0.2;
/// Jobs that are created at once, and in one namespace: an admission webhook may take ten seconds for each.
const CREATES: usize = 8;
const CREATES_PER_NAMESPACE: usize = 4;
/// Leaderboards that are reconciled at once.
const LEADERBOARDS: usize = 4;

/// One for each kind. Clones are the same.
#[derive(Clone)]
pub(super) struct Queues {
    pub(super) submissions: Arc<Queue>,
    pub(super) leaderboards: Arc<Queue>,
}

impl Queues {
    /// Empty ones; `concurrency` is of Submissions.
    pub(super) fn new(concurrency: u16, metrics: &Metrics) -> Self {
        let queue = |kind, reconciles: usize| {
            let limits = Limits {
                reconciles: reconciles.max(1),
                creates: CREATES,
                creates_per_namespace: CREATES_PER_NAMESPACE,
            };
            Queue::new(
                limits,
                Class::ALL.map(|class| metrics.work.reconcile_wait.of([kind, class.as_str()])),
            )
        };
        Self {
            submissions: queue(SUBMISSION, concurrency.into()),
            leaderboards: queue(LEADERBOARD, LEADERBOARDS),
        }
    }
}

/// Why a reconcile ended early.
#[derive(thiserror::Error, Debug)]
enum ReconcileError {
    #[error(transparent)]
    Act(#[from] ActError),
    #[error(transparent)]
    Leaderboard(#[from] CallError),
    #[error("the reconcile took longer than {} s", TIME_LIMIT.as_secs())]
    TooLong,
    #[error("the reconcile has panicked: {0}")]
    Panicked(String),
}

impl ReconcileError {
    fn label(&self) -> &'static str {
        match self {
            Self::Act(error) => error.label(),
            Self::Leaderboard(error) => error.reason(),
            Self::TooLong => "timeout",
            Self::Panicked(_) => "panic",
        }
    }
}

/// Runs reconciles until the stop; then finishes those that have begun.
pub(super) async fn run(submissions: Events<Submission>, leaderboards: Events<Leaderboard>, shared: Arc<Shared>) {
    let (stop, queues) = (&shared.telemetry.stop, &shared.queues);
    let events = async {
        tokio::join!(
            add(&queues.submissions, submissions),
            add(&queues.leaderboards, leaderboards)
        )
    };
    let events = async {
        tokio::select! { biased; () = stop.wait() => {}, _ = events => {} }
    };
    let of_submission = |turn| reconcile_submission(turn, Arc::clone(&shared));
    let of_leaderboard = |turn| reconcile_leaderboard(turn, Arc::clone(&shared));
    tokio::join!(
        events,
        queues.submissions.run(stop, of_submission),
        queues.leaderboards.run(stop, of_leaderboard),
    );
}

async fn add<K>(queue: &Queue, events: impl Stream<Item = (ObjectRef<K>, Class)>)
where
    K: Resource<DynamicType = ()>,
{
    events
        .for_each(|(object, class)| {
            queue.add(&object, class);
            std::future::ready(())
        })
        .await;
}

async fn reconcile_submission(turn: Turn, shared: Arc<Shared>) -> After {
    let Some(submission) = shared.context.stores.submissions.get(&(&turn.key).into()) else {
        return After::Gone;
    };
    let span = span_of(&submission);
    reconcile_known(turn, submission, shared).instrument(span).await
}

async fn reconcile_known(turn: Turn, submission: Arc<Submission>, shared: Arc<Shared>) -> After {
    let started = Instant::now();
    let context = &shared.context;
    let slots = &context.slots;
    let board = context.stores.leaderboard_for(&submission);
    if let Some(wait) = operator::left_alone(board.as_deref(), &context.settings.operator) {
        let metrics = &shared.telemetry.metrics;
        metrics.reconciled(SUBMISSION, Reason::OtherOperator.as_str(), started.elapsed());
        return After::In(jittered(wait, SPREAD), Class::Refresh);
    }
    let work = async {
        let policies = shared.context.policies();
        let view = observe(shared.context.for_observe(), Arc::clone(&submission), |board| {
            policies.is_in_place(board)
        });
        let plan = decide(&view);
        if !turn.may_continue(plan.creates_job()) {
            return Ok(None);
        }
        let (requeue, class) = (plan.requeue, urgency::after(&submission, &plan));
        settle(slots, &submission, plan.slot());
        let held_back = act(shared.context.for_act(), &view, plan).await?;
        let requeue = [requeue, held_back].into_iter().flatten().min();
        Ok(Some((requeue, class)))
    };
    let result = Box::pin(limited(work)).await;
    if result.is_err() {
        slots.did_not_start(&submission);
    }
    let Some(result) = result.transpose() else {
        return After::WithPermit;
    };
    let result = result.map_err(|error| {
        tracing::warn!("{error}");
        (error, urgency::of_submission(&submission))
    });
    finish(SUBMISSION, submission.as_ref(), started, &shared, result)
}

/// A reconcile within its limit of time; a panic of it is its own error.
async fn limited<T>(work: impl Future<Output = Result<T, ReconcileError>>) -> Result<T, ReconcileError> {
    match AssertUnwindSafe(tokio::time::timeout(TIME_LIMIT, work))
        .catch_unwind()
        .await
    {
        Ok(Ok(result)) => result,
        Ok(Err(_)) => Err(ReconcileError::TooLong),
        Err(panic) => Err(ReconcileError::Panicked(panic_message(panic.as_ref()).to_owned())),
    }
}

/// Does with the slot what was decided. One that stays in line renews its place in `act`.
fn settle(slots: &Slots, submission: &Submission, slot: SlotUse) {
    match slot {
        SlotUse::Holds => slots.starts(submission),
        SlotUse::Waits => {}
        SlotUse::Leaves => slots.leaves(submission),
    }
}

async fn reconcile_leaderboard(turn: Turn, shared: Arc<Shared>) -> After {
    let context = &shared.context;
    let Some(leaderboard) = context.stores.leaderboards.get(&(&turn.key).into()) else {
        return After::Gone;
    };
    let started = Instant::now();
    let work = leaderboards::reconcile(Arc::clone(&leaderboard), context.for_leaderboards());
    let result = match limited(work.map(|result| result.map_err(ReconcileError::from))).await {
        Ok(Reconciled::LeftAlone(wait)) => {
            let metrics = &shared.telemetry.metrics;
            metrics.reconciled(LEADERBOARD, Reason::OtherOperator.as_str(), started.elapsed());
            return After::In(wait, Class::Refresh);
        }
        Ok(Reconciled::Done(wait)) => Ok((Some(wait), Class::Refresh)),
        Err(error) => {
            tracing::warn!(leaderboard = %turn.key, "{error}");
            Err((error, Class::Refresh))
        }
    };
    finish(LEADERBOARD, leaderboard.as_ref(), started, &shared, result)
}

fn finish(
    kind: &'static str,
    object: &impl Resource,
    started: Instant,
    shared: &Shared,
    result: Result<(Option<Duration>, Class), (ReconcileError, Class)>,
) -> After {
    let (uid, metrics) = (uid_of(object), &shared.telemetry.metrics);
    match result {
        Ok((requeue, class)) => {
            shared.backoff.forget(&uid);
            metrics.reconciled(kind, "ok", started.elapsed());
            After::In(requeue.unwrap_or_else(|| jittered(RESYNC, SPREAD)), class)
        }
        Err((error, class)) => {
            metrics.reconciled(kind, "error", started.elapsed());
            metrics.work.reconcile_errors.of([kind, error.label()]).inc();
            After::In(shared.backoff.failed(&uid), class)
        }
    }
}

#[cfg(test)]
mod tests;
