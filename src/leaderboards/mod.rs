//! The reconcile of one Leaderboard: the policy of its Pods, its token and checks, its status and finalizer.
//!
//! Does nothing for a Leaderboard that another installation drives. Applies the policy before all else, since no Job is made without
//! it. Asks for its token, its bucket, table and queues and its Pods by `probe`, whose answers wake it. It waits for the API server alone,
//! and gives the way to EvalAI to `external`. `decide` and `reach` are pure.

pub mod claims;
mod data_claims;
pub mod isolation;
pub mod operator;
mod places;
mod pod_findings;
mod priority;
pub mod probe;
mod reach;
pub mod standing;
pub mod state;
pub mod token;
mod tried_pods;

use std::sync::Arc;
use std::time::Duration;

use jiff::Timestamp;
use kube::runtime::events::Recorder;
use kube::runtime::reflector::ObjectRef;

use super::slots::Slots;
use crate::kubernetes::{CallError, Writer};
use crate::metrics::leader::{self, Gauge, Samples};
use crate::runtime::objects::{key_of, uid_of, version, version_number};
use crate::runtime::settings::Settings;
use crate::runtime::writes::{apply_status, set_finalizer};
use crate::submissions::external::ExternalSystems;
use crate::submissions::records;
use isolation::Policies;
use leaderboard_api::{Leaderboard, names};
use leaderboard_policy::ask::Service;
use leaderboard_policy::census::Census;
use leaderboard_policy::leaderboards::decide::{LeaderboardPlan, LeaderboardView, decide};
use leaderboard_policy::leaderboards::refusal::{self, Refusal};
use leaderboard_policy::leaderboards::standings::Results;
use leaderboard_policy::leaderboards::view::Policy;
use probe::{Asks, Looked};
use state::{Entry, LeaderboardState, Made, RESYNC, SOONEST};

/// Time that the first look at a spec gets before the status shows it as under way. Most take less, which saves a write.
const FIRST_LOOK: Duration = Duration::from_secs(2);

/// The parts that a reconcile of a Leaderboard uses.
#[derive(Clone, Copy)]
pub struct Uses<'a> {
    pub policies: Policies<'a>,
    pub writer: &'a Writer,
    pub recorder: &'a Recorder,
    pub settings: &'a Settings,
    pub slots: &'a Slots,
    pub external: &'a ExternalSystems,
    pub asks: &'a Asks,
}

/// The end of a reconcile.
pub enum Reconciled {
    /// When to look again.
    Done(Duration),
    /// Another installation of the operator drives it; when to look again.
    LeftAlone(Duration),
}

/// One reconcile.
pub async fn reconcile(leaderboard: Arc<Leaderboard>, uses: Uses<'_>) -> Result<Reconciled, CallError> {
    let Policies { client, state, .. } = uses.policies;
    match operator::ours(
        client,
        uses.recorder,
        state,
        Arc::clone(&leaderboard),
        &uses.settings.operator,
    )
    .await?
    {
        Ok(ours) => drive(ours, uses).await.map(Reconciled::Done),
        Err(wait) => {
            uses.external.retire(&leaderboard);
            Ok(Reconciled::LeftAlone(wait))
        }
    }
}

/// One reconcile of a Leaderboard that this installation drives.
async fn drive(leaderboard: Arc<Leaderboard>, uses: Uses<'_>) -> Result<Duration, CallError> {
    let now = uses.policies.clock.now();
    let (writer, Policies { stores, state, .. }) = (uses.writer, uses.policies);
    // One that is being deleted keeps it too: its submissions may still run.
    let policy = isolation::keep(uses.policies, &leaderboard, now).await;
    let refusal = refusal::of(&uses.settings.allowed, &leaderboard);
    // Where a Leaderboard names what it may not, nothing is asked.
    let looked = match refusal {
        Some(_) => Looked::default(),
        None => uses.asks.ask(&leaderboard, is_refused(uses, &leaderboard)),
    };
    let (view, made) = observe(uses, &leaderboard, (policy, refusal), &looked, now);
    let plan = decide(&view);
    serve(uses, &view, &plan, &looked);
    let mut version = leaderboard.metadata.resource_version.clone();
    if let Some(wanted) = plan.finalizer {
        version = set_finalizer(writer, leaderboard.as_ref(), names::FINALIZER_LEADERBOARD, wanted).await?;
    }
    if plan.finalizer == Some(false) {
        return Ok(RESYNC);
    }
    let left = looked.waits().map(|waited| FIRST_LOOK.saturating_sub(waited));
    let again = if let Some(left) = left.filter(|left| !left.is_zero()) {
        left
    } else {
        let shown = (&plan, &made);
        write_status(writer, state, &leaderboard, version.as_deref(), shown, now).await?
    };
    let patience = looked.reach.patience().unwrap_or(RESYNC);
    let policy = isolation::again(&view.policy, stores.shows_policy(&view.leaderboard));
    Ok(policy.min(patience).max(SOONEST).min(again))
}

/// Shows what a Leaderboard has left: its slots, the time of its token, and what lies in its queues. Nothing is shown of what is not known.
pub fn show_limits(samples: &mut Samples, uses: Uses<'_>, leaderboard: &Arc<Leaderboard>) {
    let name = key_of(leaderboard.as_ref()).to_string();
    let mut show = |gauge: &Gauge<1>, value: Option<i64>| {
        if let Some(value) = value {
            samples.set(gauge, [&name], value);
        }
    };
    show(&leader::SLOTS_LIMIT, leaderboard.spec.concurrency.total.map(i64::from));
    let rows = rows_waiting(uses, leaderboard).map(|rows| i64::try_from(rows).unwrap_or(i64::MAX));
    show(&leader::ROWS_WAITING, rows);
    if refusal::of(&uses.settings.allowed, leaderboard).is_none() {
        uses.asks.known(leaderboard).show(leaderboard, show);
    }
}

/// Hands the way to EvalAI to `external`; takes it back if the Leaderboard is being deleted or names a place that it may not.
fn serve(uses: Uses<'_>, view: &LeaderboardView, plan: &LeaderboardPlan, looked: &Looked) {
    let leaderboard = &view.leaderboard;
    if view.refusal.is_some() || plan.finalizer == Some(false) {
        uses.external.retire(leaderboard);
    } else if let Some(target) = looked.target(leaderboard) {
        uses.external.serve(leaderboard, target);
    }
}

/// True while EvalAI refuses the token that is used now.
fn is_refused(uses: Uses<'_>, leaderboard: &Leaderboard) -> bool {
    uses.external.hub.token_refused(&key_of(leaderboard)).is_some()
}

fn observe(
    uses: Uses<'_>,
    leaderboard: &Arc<Leaderboard>,
    (policy, refusal): (Policy, Option<Refusal>),
    looked: &Looked,
    now: Timestamp,
) -> (LeaderboardView, Made) {
    let (Policies { stores, state, .. }, hub) = (uses.policies, &uses.external.hub);
    let key = key_of(leaderboard.as_ref());
    let submissions = stores.submissions_for(&ObjectRef::from_obj(leaderboard.as_ref()));
    let tried = looked.pods();
    let census = Census::of(submissions.iter().map(AsRef::as_ref));
    let made = Made {
        results: census.results,
        named: hub.labels(&key).0.map(|labels| labels.rankings),
        generation: leaderboard.metadata.generation,
        cancelled: standing::cancelled(hub, &key, leaderboard),
    };
    let is_stored = |entry: &Entry| entry.standings.0.as_ref() == Some(&made);
    let is_new = !state.read(&uid_of(leaderboard.as_ref()), is_stored);
    let view = LeaderboardView {
        now,
        leaderboard: Arc::clone(leaderboard),
        all: stores.leaderboards.state(),
        counts: census.counts,
        gpu_use: census.gpu_use(),
        named: made.named.clone(),
        results: is_new.then(|| Results {
            submissions,
            cancelled: made.cancelled.clone(),
        }),
        in_use: census.in_use,
        image_note: census.image_note(),
        pods: isolation::pods_left(stores, leaderboard),
        policy,
        measured: isolation::measured(state, leaderboard),
        refusal,
        is_looked_at: looked.waits().is_none(),
        invalid_pod: tried.refused,
        pod_notes: tried.notes,
        claims: tried.claims,
        unreachable: looked.reach.unreachable(),
        place_notes: looked.reach.notes(),
        evalai: standing::standing(hub, leaderboard, looked.token(leaderboard), now),
        evalai_writes_from: hub.writes_from(),
        usage: hub.usage(&key).map(standing::evalai_use),
        rows_waiting: rows_waiting(uses, leaderboard),
    };
    (view, made)
}

/// None without a table.
fn rows_waiting(uses: Uses<'_>, leaderboard: &Leaderboard) -> Option<usize> {
    let table = leaderboard.spec.dynamo_table()?;
    let (service, longer) = (Service::table(table), records::ON_ITS_WAY);
    Some(uses.external.records.waiting(&service, longer))
}

/// Writes the status if it shows something new; returns when to look again. On top of a status that the cache does not show yet
/// nothing is written: conditions would get the time of the second write.
async fn write_status(
    writer: &Writer,
    state: &LeaderboardState,
    leaderboard: &Leaderboard,
    version_now: Option<&str>,
    (plan, made): (&LeaderboardPlan, &Made),
    now: Timestamp,
) -> Result<Duration, CallError> {
    let uid = uid_of(leaderboard);
    if state.awaits_write(&uid, version(leaderboard), now) {
        return Ok(SOONEST);
    }
    let old = leaderboard.status.clone().unwrap_or_default();
    let has_new_standings = old.tracks != plan.status.tracks;
    if old == plan.status {
        state.note_made(&uid, made);
        return Ok(RESYNC);
    }
    let left = state.time_to_write(&uid, &old, &plan.status, now);
    if !left.is_zero() {
        return Ok(left);
    }
    let written = apply_status(writer, leaderboard, version_now, &plan.status).await?;
    state.note_written(&uid, now, version_number(&written), has_new_standings);
    state.note_made(&uid, made);
    Ok(RESYNC)
}

#[cfg(test)]
mod tests;
