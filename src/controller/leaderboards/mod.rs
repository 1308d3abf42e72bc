//! A pass of one Leaderboard: the policy of its Pods, its token and checks, its status and finalizer.
//!
//! Applies the policy before it waits for anything else, since no Job is made without it. Reads the token (every five minutes,
//! or when EvalAI refuses it), looks whether bucket, table and queues answer, and hands the way to EvalAI to `sync`. `decide`
//! and `reach` are pure.

pub mod decide;
pub mod isolation;
mod places;
mod probe;
mod reach;

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use jiff::Timestamp;
use kube::api::{Patch, PatchParams};
use kube::{Api, Resource, ResourceExt};
use serde_json::json;

use super::context::{CALL_TIMEOUT, Context};
use super::observe::uid_of;
use crate::services::ObjectKey;
use decide::{LeaderboardPlan, LeaderboardView, decide};
use isolation::{Applied, Measured, Policy};
use leaderboard_api::client_errors;
use leaderboard_api::{Leaderboard, names};
use probe::Probe;

/// A status whose counts alone have changed is written at most this often.
const COUNTS_EVERY: Duration = Duration::from_secs(5);
/// A pass that something is due for is at least so far away.
const SOONEST: Duration = Duration::from_secs(1);
/// A policy that the API server did not take is applied again after this long.
const POLICY_AGAIN: Duration = Duration::from_secs(10);
/// A Leaderboard is looked at this often without any cause.
const RESYNC: Duration = Duration::from_mins(1);

/// What could not be done for a Leaderboard.
#[derive(thiserror::Error, Debug)]
pub enum LeaderboardError {
    #[error("{what} of Leaderboard {name} failed: {}", client_errors::kube(source))]
    Kubernetes {
        what: &'static str,
        name: String,
        source: Box<kube::Error>,
    },
    #[error("{what} of Leaderboard {name}: the API server did not answer")]
    Silent { what: &'static str, name: String },
}

/// What is kept between passes, by UID.
#[derive(Default)]
pub struct Desk {
    probes: Mutex<HashMap<String, Probe>>,
    written: Mutex<HashMap<String, Timestamp>>,
    policies: Mutex<HashMap<String, Applied>>,
    measured: Mutex<HashMap<String, Measured>>,
}

impl Desk {
    /// Drops a Leaderboard that is gone.
    pub fn forget(&self, uid: &str) {
        self.probes.lock().unwrap_or_else(PoisonError::into_inner).remove(uid);
        self.written.lock().unwrap_or_else(PoisonError::into_inner).remove(uid);
        self.policies.lock().unwrap_or_else(PoisonError::into_inner).remove(uid);
        self.measured.lock().unwrap_or_else(PoisonError::into_inner).remove(uid);
    }

    fn probe(&self, uid: &str) -> Probe {
        self.probes
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .get(uid)
            .cloned()
            .unwrap_or_default()
    }

    fn keep(&self, uid: &str, probe: Probe) {
        self.probes
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .insert(uid.to_owned(), probe);
    }

    fn counts_may_be_written(&self, uid: &str, now: Timestamp) -> bool {
        let written = self
            .written
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .get(uid)
            .copied();
        written.is_none_or(|at| now.duration_since(at).unsigned_abs() >= COUNTS_EVERY)
    }

    fn wrote(&self, uid: &str, now: Timestamp) {
        self.written
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .insert(uid.to_owned(), now);
    }
}

/// One pass.
pub async fn reconcile(leaderboard: Arc<Leaderboard>, context: Arc<Context>) -> Result<Duration, LeaderboardError> {
    let uid = uid_of(leaderboard.as_ref());
    let now = Timestamp::now();
    // One that is being deleted keeps it too: its submissions may still run.
    let policy = isolation::keep(&context, &leaderboard, now).await;
    let probe = context.desk.probe(&uid).refresh(&context, &leaderboard, now).await;
    context.desk.keep(&uid, probe.clone());
    let view = observe(&context, &leaderboard, policy, &probe, now);
    let plan = decide(&view);
    set_finalizer(&context, &leaderboard, &plan).await?;
    if plan.finalizer == Some(false) {
        context.sync.set_target(&leaderboard, None);
        context.sync.hub.retire(&key_of(&leaderboard));
        return Ok(RESYNC);
    }
    let again = write_status(&context, &leaderboard, &plan, now).await?;
    let probed = probe.next(now).map(|at| at.duration_since(now).unsigned_abs());
    let policy = isolation::again(&view.policy, context.stores.shows_policy(&view.leaderboard));
    let next = probed.map_or(policy, |probed| probed.min(policy));
    Ok(next.max(SOONEST).min(again))
}

fn observe(
    context: &Context,
    leaderboard: &Arc<Leaderboard>,
    policy: Policy,
    probe: &Probe,
    now: Timestamp,
) -> LeaderboardView {
    let (counts, in_use) = context.slots.census(leaderboard);
    let key = key_of(leaderboard);
    LeaderboardView {
        now,
        leaderboard: Arc::clone(leaderboard),
        all: context.stores.leaderboards.state(),
        counts,
        in_use,
        pods: isolation::pods_left(&context.stores, leaderboard),
        policy,
        measured: isolation::measured(context, leaderboard),
        invalid_pod: probe.invalid_pod(),
        unreachable: probe.unreachable(now),
        evalai: probe.evalai_standing(context, leaderboard, &key, now),
        evalai_writes_from: context.sync.hub.writes_from(),
        budget: context.sync.hub.budget_used(&key),
    }
}

async fn set_finalizer(
    context: &Context,
    leaderboard: &Leaderboard,
    plan: &LeaderboardPlan,
) -> Result<(), LeaderboardError> {
    let Some(wanted) = plan.finalizer else { return Ok(()) };
    let mut finalizers: Vec<String> = leaderboard
        .finalizers()
        .iter()
        .filter(|f| *f != names::FINALIZER_LEADERBOARD)
        .cloned()
        .collect();
    if wanted {
        finalizers.push(names::FINALIZER_LEADERBOARD.into());
    }
    let version = &leaderboard.metadata.resource_version;
    let patch = Patch::Merge(json!({ "metadata": { "resourceVersion": version, "finalizers": finalizers } }));
    let params = PatchParams {
        field_manager: Some(names::MANAGER_FINALIZER.into()),
        ..PatchParams::default()
    };
    let name = leaderboard.name_any();
    let api = api(context, leaderboard);
    let result = call("the finalizer", leaderboard, api.patch(&name, &params, &patch)).await;
    result.map(|_| ())
}

/// Writes the status if it says something new; returns when to look again.
async fn write_status(
    context: &Context,
    leaderboard: &Leaderboard,
    plan: &LeaderboardPlan,
    now: Timestamp,
) -> Result<Duration, LeaderboardError> {
    let old = leaderboard.status.clone().unwrap_or_default();
    if old == plan.status {
        return Ok(RESYNC);
    }
    let only_numbers = leaderboard_api::LeaderboardStatus {
        counts: old.counts,
        evalai: old.evalai,
        ..plan.status.clone()
    } == old;
    let uid = uid_of(leaderboard);
    if only_numbers && !context.desk.counts_may_be_written(&uid, now) {
        return Ok(COUNTS_EVERY);
    }
    if only_numbers && old.counts == plan.status.counts && !context.desk.budget_may_be_written(&uid, now) {
        return Ok(RESYNC);
    }
    let patch = json!({
        "apiVersion": Leaderboard::api_version(&()),
        "kind": Leaderboard::kind(&()),
        "metadata": { "name": leaderboard.name_any(), "uid": uid },
        "status": plan.status,
    });
    let params = PatchParams::apply(names::MANAGER_STATUS).force();
    let name = leaderboard.name_any();
    let api = api(context, leaderboard);
    let body = Patch::Apply(&patch);
    let result = call("the status", leaderboard, api.patch_status(&name, &params, &body)).await;
    result?;
    context.desk.wrote(&uid, now);
    Ok(RESYNC)
}

impl Desk {
    /// The budget moves with each request; alone it is worth a write a minute.
    fn budget_may_be_written(&self, uid: &str, now: Timestamp) -> bool {
        let written = self
            .written
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .get(uid)
            .copied();
        written.is_none_or(|at| now.duration_since(at).unsigned_abs() >= RESYNC)
    }
}

fn api(context: &Context, leaderboard: &Leaderboard) -> Api<Leaderboard> {
    Api::namespaced(context.client.clone(), &leaderboard.namespace().unwrap_or_default())
}

async fn call<T>(
    what: &'static str,
    leaderboard: &Leaderboard,
    call: impl Future<Output = Result<T, kube::Error>>,
) -> Result<T, LeaderboardError> {
    let name = leaderboard.name_any();
    match tokio::time::timeout(CALL_TIMEOUT, call).await {
        Ok(Ok(answer)) => Ok(answer),
        Ok(Err(source)) => Err(LeaderboardError::Kubernetes {
            what,
            name,
            source: Box::new(source),
        }),
        Err(_) => Err(LeaderboardError::Silent { what, name }),
    }
}

/// The key of a Leaderboard towards EvalAI's room.
fn key_of(leaderboard: &Leaderboard) -> ObjectKey {
    ObjectKey {
        namespace: leaderboard.namespace().unwrap_or_default(),
        name: leaderboard.name_any(),
        uid: uid_of(leaderboard),
    }
}
