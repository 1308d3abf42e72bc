//! The reconciles: one queue for Submissions, one for Leaderboards; each object by one reconcile at a time, a bounded number
//! at once.

use std::convert::Infallible;
use std::sync::Arc;
use std::time::{Duration, Instant};

use futures::stream::{BoxStream, StreamExt};
use kube::Resource;
use kube::runtime::controller::{Action, Config, applier};
use kube::runtime::reflector::ObjectRef;

use super::Shared;
use crate::backoff::jittered;
use crate::controller::leaderboards;
use crate::controller::objects::{key_of, uid_of};
use crate::controller::slots::SlotAllocator;
use crate::controller::submissions::act::{ActError, act};
use crate::controller::submissions::decide::{self, Plan, decide};
use crate::controller::submissions::observe::observe;
use crate::kubernetes::CallError;
use leaderboard_api::conditions::{self, FINISHED};
use leaderboard_api::{Leaderboard, Submission};

/// A reconcile takes at most this long.
const TIME_LIMIT: Duration = Duration::from_secs(90);
/// Events of one object that come together are one reconcile.
const DEBOUNCE: Duration = Duration::from_millis(50);
/// An object without any other cause is reconciled this often.
const RESYNC: Duration = Duration::from_mins(10);

/// Why a reconcile ended early.
#[derive(thiserror::Error, Debug)]
enum ReconcileError {
    #[error(transparent)]
    Act(#[from] ActError),
    #[error(transparent)]
    Leaderboard(#[from] CallError),
    #[error("the reconcile took longer than {} s", TIME_LIMIT.as_secs())]
    TooLong,
}

impl ReconcileError {
    fn label(&self) -> &'static str {
        match self {
            Self::Act(error) => error.label(),
            Self::Leaderboard(_) => "leaderboard",
            Self::TooLong => "timeout",
        }
    }
}

/// Runs reconciles until the stop; then finishes those that have begun.
pub(super) async fn run(
    submissions: BoxStream<'static, ObjectRef<Submission>>,
    leaderboards: BoxStream<'static, ObjectRef<Leaderboard>>,
    shared: Arc<Shared>,
) {
    let (stop, stores) = (&shared.telemetry.stop, &shared.context.stores);
    let config = Config::default()
        .concurrency(shared.context.settings.concurrency)
        .debounce(DEBOUNCE);
    let of_submissions = applier(
        |object, shared: Arc<Shared>| Box::pin(reconcile_submission(object, shared)),
        |object: Arc<Submission>, _: &ReconcileError, shared| after_error(object.as_ref(), &shared),
        Arc::clone(&shared),
        stores.submissions.clone(),
        submissions.take_until(Box::pin(stop.wait())).map(Ok::<_, Infallible>),
        config.clone(),
    );
    let of_leaderboards = applier(
        |object, shared: Arc<Shared>| Box::pin(reconcile_leaderboard(object, shared)),
        |object: Arc<Leaderboard>, _: &ReconcileError, shared| after_error(object.as_ref(), &shared),
        Arc::clone(&shared),
        stores.leaderboards.clone(),
        leaderboards.take_until(Box::pin(stop.wait())).map(Ok::<_, Infallible>),
        config.concurrency(4),
    );
    // What a reconcile returns was counted and logged by it.
    tokio::join!(
        of_submissions.for_each(|_| async {}),
        of_leaderboards.for_each(|_| async {})
    );
}

async fn reconcile_submission(submission: Arc<Submission>, shared: Arc<Shared>) -> Result<Action, ReconcileError> {
    let started = Instant::now();
    let name = key_of(submission.as_ref()).to_string();
    let slots = &shared.context.slots;
    let work = async {
        let policies = shared.context.policies();
        let view = observe(shared.context.for_observe(), Arc::clone(&submission), |board| {
            policies.is_in_place(board)
        });
        let plan = decide(&view);
        let requeue = plan.requeue;
        settle(slots, &submission, &plan);
        let held_back = act(shared.context.for_act(), &view, plan).await?;
        Ok([requeue, held_back].into_iter().flatten().min())
    };
    let result = tokio::time::timeout(TIME_LIMIT, work)
        .await
        .unwrap_or(Err(ReconcileError::TooLong));
    if result.is_err() {
        slots.did_not_start(&submission);
    }
    finish(
        "submission",
        &name,
        &uid_of(submission.as_ref()),
        started,
        &shared,
        result,
    )
}

/// Gives the slot back of a submission that does not start after all, or has come to its end: a later attempt stands in line
/// like anyone. One that stays in line renews its place in `act`.
fn settle(slots: &SlotAllocator, submission: &Submission, plan: &Plan) {
    let is_over = conditions::is_true(&plan.status.conditions, FINISHED);
    if plan.status.job_name.is_some() && !is_over {
        slots.starts(submission);
    } else if !plan.actions.iter().any(|a| matches!(a, decide::Action::JoinLine(_))) {
        slots.leaves(submission);
    }
}

async fn reconcile_leaderboard(leaderboard: Arc<Leaderboard>, shared: Arc<Shared>) -> Result<Action, ReconcileError> {
    let started = Instant::now();
    let (name, uid) = (key_of(leaderboard.as_ref()).to_string(), uid_of(leaderboard.as_ref()));
    let work = leaderboards::reconcile(leaderboard, shared.context.for_leaderboards());
    let result = match tokio::time::timeout(TIME_LIMIT, work).await {
        Ok(result) => result.map(Some).map_err(ReconcileError::from),
        Err(_) => Err(ReconcileError::TooLong),
    };
    finish("leaderboard", &name, &uid, started, &shared, result)
}

fn finish(
    kind: &'static str,
    name: &str,
    uid: &str,
    started: Instant,
    shared: &Shared,
    result: Result<Option<Duration>, ReconcileError>,
) -> Result<Action, ReconcileError> {
    match result {
        Ok(requeue) => {
            shared.backoff.succeeded(uid);
            shared.telemetry.metrics.reconciled(kind, "ok", started.elapsed());
            Ok(Action::requeue(requeue.unwrap_or_else(jittered_resync)))
        }
        Err(error) => {
            shared.telemetry.metrics.reconciled(kind, "error", started.elapsed());
            shared.telemetry.metrics.reconcile_failed(kind, error.label());
            tracing::warn!(kind, object = name, "{error}");
            Err(error)
        }
    }
}

/// Spreads the resync of many objects.
fn jittered_resync() -> Duration {
    jittered(RESYNC, 0.2)
}

fn after_error(object: &impl Resource, shared: &Shared) -> Action {
    Action::requeue(shared.backoff.failed(&uid_of(object)))
}

#[cfg(test)]
#[path = "reconciles_tests.rs"]
mod tests;
