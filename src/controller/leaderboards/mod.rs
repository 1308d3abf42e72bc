//! The reconcile of one Leaderboard: the policy of its Pods, its token and checks, its status and finalizer.
//!
//! Does nothing for a Leaderboard that another installation drives. Applies the policy before it waits for anything else, since no
//! Job is made without it. Reads the token (every five minutes, or when EvalAI refuses it), checks whether bucket, table and queues
//! answer, and gives the way to EvalAI to `external`. `decide` and `reach` are pure.

mod check;
pub mod claims;
pub mod decide;
mod foreign;
pub mod isolation;
pub mod operator;
mod places;
mod pod_notes;
mod priority;
pub mod probe;
mod queue_readers;
mod reach;
mod refusal;
pub mod shared_queue;
pub mod state;

use std::sync::Arc;
use std::time::Duration;

use jiff::Timestamp;
use kube::Client;

use super::objects::{key_of, uid_of};
use super::settings::Settings;
use super::slots::SlotAllocator;
use super::writes::{apply_status, set_finalizer};
use crate::controller::stores::Stores;
use crate::controller::submissions::external::ExternalSystems;
use crate::controller::submissions::{team_history, team_use};
use crate::kubernetes::CallError;
use crate::observability::metrics::{LimitsState, Metrics};
use crate::services::aws::Aws;
use decide::{LeaderboardPlan, LeaderboardView, decide};
use isolation::Policies;
use leaderboard_api::{Leaderboard, Submission, names};
use probe::Probe;
use refusal::Refusal;
use state::{COUNTS_EVERY, LeaderboardState, Policy, RESYNC, SOONEST};

/// What a reconcile of a Leaderboard uses.
#[derive(Clone, Copy)]
pub struct Uses<'a> {
    pub policies: Policies<'a>,
    pub settings: &'a Settings,
    pub slots: &'a SlotAllocator,
    pub external: &'a ExternalSystems,
    pub aws: &'a Aws,
    pub metrics: &'a Metrics,
}

/// What a reconcile came to.
pub enum Reconciled {
    /// When to look again.
    Done(Duration),
    /// Another installation of the operator drives it; when to look again.
    LeftAlone(Duration),
}

/// One reconcile.
pub async fn reconcile(leaderboard: Arc<Leaderboard>, uses: Uses<'_>) -> Result<Reconciled, CallError> {
    let Policies { client, state, .. } = uses.policies;
    match operator::ours(client, state, Arc::clone(&leaderboard), &uses.settings.operator).await? {
        Ok(ours) => drive(ours, uses).await.map(Reconciled::Done),
        Err(wait) => {
            uses.external.retire(&leaderboard);
            Ok(Reconciled::LeftAlone(wait))
        }
    }
}

/// One reconcile of a Leaderboard that this installation drives.
async fn drive(leaderboard: Arc<Leaderboard>, uses: Uses<'_>) -> Result<Duration, CallError> {
    let uid = uid_of(leaderboard.as_ref());
    let now = Timestamp::now();
    let Policies {
        client, stores, state, ..
    } = uses.policies;
    // One that is being deleted keeps it too: its submissions may still run.
    let policy = isolation::keep(uses.policies, &leaderboard, now).await;
    let refusal = refusal::of(&uses.settings.allowed, &leaderboard);
    let probe = probed(uses, &leaderboard, refusal.as_ref(), now).await;
    state.keep(&uid, probe.clone());
    let view = LeaderboardView {
        refusal,
        ..observe(uses, &leaderboard, policy, &probe, now)
    };
    show_limits(uses, &view, &probe);
    let plan = decide(&view);
    if let Some(wanted) = plan.finalizer {
        set_finalizer(client, leaderboard.as_ref(), names::FINALIZER_LEADERBOARD, wanted).await?;
    }
    if plan.finalizer == Some(false) {
        uses.external.retire(&leaderboard);
        return Ok(RESYNC);
    }
    let again = write_status(client, state, &leaderboard, &plan, now).await?;
    let probed = probe.next(now).map(|at| at.duration_since(now).unsigned_abs());
    let policy = isolation::again(&view.policy, stores.shows_policy(&view.leaderboard));
    let next = probed.map_or(policy, |probed| probed.min(policy));
    Ok(next.max(SOONEST).min(again))
}

/// Shows what it has left, in metrics.
fn show_limits(uses: Uses<'_>, view: &LeaderboardView, probe: &Probe) {
    let total = view.leaderboard.spec.concurrency.total;
    let state = LimitsState {
        slots_in_use: view.in_use,
        slots: total.and_then(|total| usize::try_from(total).ok()),
        ..probe.limits()
    };
    let name = key_of(view.leaderboard.as_ref()).to_string();
    uses.metrics.set_limits(&name, state);
}

/// What was tried of it. Where it names what it may not, nothing is asked, and EvalAI is no longer spoken to.
async fn probed(uses: Uses<'_>, leaderboard: &Arc<Leaderboard>, refusal: Option<&Refusal>, now: Timestamp) -> Probe {
    if refusal.is_some() {
        uses.external.retire(leaderboard);
        return Probe::default();
    }
    let known = uses.policies.state.probe(&uid_of(leaderboard.as_ref()));
    let probe = known.refresh(uses, leaderboard, now).await;
    if let Some(target) = probe.target() {
        uses.external.set_target(leaderboard, target);
    }
    probe
}

fn observe(
    uses: Uses<'_>,
    leaderboard: &Arc<Leaderboard>,
    policy: Policy,
    probe: &Probe,
    now: Timestamp,
) -> LeaderboardView {
    let (counts, in_use) = uses.slots.census(leaderboard);
    let (stores, hub) = (uses.policies.stores, &uses.external.hub);
    let key = key_of(leaderboard.as_ref());
    let ended = ended(stores, leaderboard);
    LeaderboardView {
        now,
        leaderboard: Arc::clone(leaderboard),
        all: stores.leaderboards.state(),
        counts,
        check: uses.slots.last_check(leaderboard),
        teams: team_history::teams(&ended),
        gpu_use: team_use::teams(&ended),
        in_use,
        pods: isolation::pods_left(stores, leaderboard),
        policy,
        measured: isolation::measured(stores, uses.policies.state, leaderboard),
        refusal: None,
        invalid_pod: probe.invalid_pod(),
        pod_notes: probe.pod_notes(),
        claims: probe.claims(),
        unreachable: probe.unreachable(now),
        place_notes: probe.place_notes(now),
        shared_queue: probe.shared_queue(),
        evalai: probe.evalai_standing(hub, leaderboard, &key, now),
        evalai_writes_from: hub.writes_from(),
        usage: hub.usage(&key),
    }
}

/// Its Submissions that have an end of some attempt, or of a Job.
fn ended(stores: &Stores, leaderboard: &Leaderboard) -> Vec<Arc<Submission>> {
    let namespace = leaderboard.metadata.namespace.as_deref().unwrap_or_default();
    let name = leaderboard.metadata.name.as_deref().unwrap_or_default();
    stores.submissions.indexed(&team_history::key_of(namespace, name))
}

/// Writes the status if it says something new; returns when to look again.
async fn write_status(
    client: &Client,
    state: &LeaderboardState,
    leaderboard: &Leaderboard,
    plan: &LeaderboardPlan,
    now: Timestamp,
) -> Result<Duration, CallError> {
    let old = leaderboard.status.clone().unwrap_or_default();
    if old == plan.status {
        return Ok(RESYNC);
    }
    let only_numbers = leaderboard_api::LeaderboardStatus {
        counts: old.counts,
        evalai: old.evalai.clone(),
        gpu_use: old.gpu_use.clone(),
        ..plan.status.clone()
    } == old;
    let uid = uid_of(leaderboard);
    if only_numbers && !state.is_older(&uid, now, COUNTS_EVERY) {
        return Ok(COUNTS_EVERY);
    }
    // The number of requests moves with each of them; alone it is worth a write a minute.
    if only_numbers && old.counts == plan.status.counts && !state.is_older(&uid, now, RESYNC) {
        return Ok(RESYNC);
    }
    apply_status(client, leaderboard, &plan.status).await?;
    state.wrote(&uid, now);
    Ok(RESYNC)
}
