//! A pass of one Leaderboard: the policy of its Pods, its token and checks, its status and finalizer.
//!
//! Applies the policy before it waits for anything else, since no Job is made without it. Reads the token (every five minutes,
//! or when EvalAI refuses it), looks whether bucket, table and queues answer, and hands the way to EvalAI to `external`. `decide`
//! and `reach` are pure.

pub mod decide;
pub mod isolation;
mod places;
pub mod probe;
mod reach;
pub mod state;

use std::sync::Arc;
use std::time::Duration;

use jiff::Timestamp;
use kube::api::{Patch, PatchParams};
use kube::{Api, Client, Resource, ResourceExt};
use serde_json::json;

use super::objects::{key_of, uid_of};
use super::settings::Settings;
use super::slots::SlotAllocator;
use crate::controller::submissions::external::ExternalSystems;
use crate::kubernetes::{CallError, call};
use crate::services::aws::Aws;
use decide::{LeaderboardPlan, LeaderboardView, decide};
use isolation::Policies;
use leaderboard_api::{Leaderboard, names};
use probe::Probe;
use state::{COUNTS_EVERY, LeaderboardState, Policy, RESYNC, SOONEST};

/// What a reconcile of a Leaderboard uses.
#[derive(Clone, Copy)]
pub struct Uses<'a> {
    pub policies: Policies<'a>,
    pub settings: &'a Settings,
    pub slots: &'a SlotAllocator,
    pub external: &'a ExternalSystems,
    pub aws: &'a Aws,
}

/// One reconcile.
pub async fn reconcile(leaderboard: Arc<Leaderboard>, uses: Uses<'_>) -> Result<Duration, CallError> {
    let uid = uid_of(leaderboard.as_ref());
    let now = Timestamp::now();
    let Policies {
        client, stores, state, ..
    } = uses.policies;
    // One that is being deleted keeps it too: its submissions may still run.
    let policy = isolation::keep(uses.policies, &leaderboard, now).await;
    let probe = state.probe(&uid).refresh(uses, &leaderboard, now).await;
    if let Some(target) = probe.target() {
        uses.external.set_target(&leaderboard, Some(target));
    }
    state.keep(&uid, probe.clone());
    let view = observe(uses, &leaderboard, policy, &probe, now);
    let plan = decide(&view);
    set_finalizer(client, &leaderboard, &plan).await?;
    if plan.finalizer == Some(false) {
        uses.external.set_target(&leaderboard, None);
        uses.external.hub.retire(&key_of(leaderboard.as_ref()));
        return Ok(RESYNC);
    }
    let again = write_status(client, state, &leaderboard, &plan, now).await?;
    let probed = probe.next(now).map(|at| at.duration_since(now).unsigned_abs());
    let policy = isolation::again(&view.policy, stores.shows_policy(&view.leaderboard));
    let next = probed.map_or(policy, |probed| probed.min(policy));
    Ok(next.max(SOONEST).min(again))
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
    LeaderboardView {
        now,
        leaderboard: Arc::clone(leaderboard),
        all: stores.leaderboards.state(),
        counts,
        in_use,
        pods: isolation::pods_left(stores, leaderboard),
        policy,
        measured: isolation::measured(stores, uses.policies.state, leaderboard),
        invalid_pod: probe.invalid_pod(),
        unreachable: probe.unreachable(now),
        evalai: probe.evalai_standing(hub, leaderboard, &key, now),
        evalai_writes_from: hub.writes_from(),
        usage: hub.usage(&key),
    }
}

async fn set_finalizer(client: &Client, leaderboard: &Leaderboard, plan: &LeaderboardPlan) -> Result<(), CallError> {
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
    let object = format!("Leaderboard {name}");
    let api = api(client, leaderboard);
    let result = call("the finalizer", &object, api.patch(&name, &params, &patch)).await;
    result.map(|_| ())
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
        ..plan.status.clone()
    } == old;
    let uid = uid_of(leaderboard);
    if only_numbers && !state.counts_may_be_written(&uid, now) {
        return Ok(COUNTS_EVERY);
    }
    if only_numbers && old.counts == plan.status.counts && !state.budget_may_be_written(&uid, now) {
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
    let object = format!("Leaderboard {name}");
    let api = api(client, leaderboard);
    let body = Patch::Apply(&patch);
    let result = call("the status", &object, api.patch_status(&name, &params, &body)).await;
    result?;
    state.wrote(&uid, now);
    Ok(RESYNC)
}

fn api(client: &Client, leaderboard: &Leaderboard) -> Api<Leaderboard> {
    Api::namespaced(client.clone(), &leaderboard.namespace().unwrap_or_default())
}
