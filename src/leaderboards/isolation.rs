//! The NetworkPolicy of a Leaderboard's Pods: applied before all else, restored, and measured by each run.
//!
//! `keep` writes it, `restore` as soon as somebody else has changed it; `measured` reads what the Pods found.

use std::sync::Arc;
use std::time::Duration;

use futures::StreamExt;
use futures::stream::select;
use jiff::Timestamp;
use k8s_openapi::api::networking::v1::NetworkPolicy;
use kube::api::{Patch, PatchParams};
use kube::runtime::reflector::ObjectRef;
use kube::{Api, Client, ResourceExt};

use super::state::{Applied, Entry, Found, LeaderboardState, POLICY_AGAIN, RESYNC, SOONEST};
use crate::kubernetes::objects::Pod;
use crate::kubernetes::{WatchEvents, call};
use crate::runtime::objects::{Wake, key_of, uid_of};
use crate::runtime::stores::Stores;
use crate::slots::Slots;
use leaderboard_api::text::sentence;
use leaderboard_api::{Enforcement, Leaderboard, PolicySource, Reason, conditions, names};
use leaderboard_base::clock::Clock;
use leaderboard_contract::verdict::{NotAVerdict, WorkspaceReason, WorkspaceVerdict};
use leaderboard_pod_spec::network_policy::{is_in_place, network_policy};
use leaderboard_policy::leaderboards::view::Policy;

/// Policies that are restored at once.
const RESTORED_AT_ONCE: usize = 16;

/// The parts that keep the policies in place.
#[derive(Clone, Copy)]
pub struct Policies<'a> {
    pub clock: &'a Clock,
    pub client: &'a Client,
    pub stores: &'a Stores,
    pub state: &'a LeaderboardState,
    pub slots: &'a Slots,
    pub wake: &'a Wake<Leaderboard>,
}

impl Policies<'_> {
    /// True if Jobs may be made: the watch shows the policy of the present spec, and the last apply did not fail.
    pub fn is_in_place(&self, leaderboard: &Leaderboard) -> bool {
        let uid = uid_of(leaderboard);
        let has_failed = |entry: &Entry| entry.applied.as_ref().is_some_and(Applied::has_failed);
        self.stores.shows_policy(leaderboard) && !self.state.read(&uid, has_failed)
    }
}

/// How long after an apply another one is due. `is_shown`: the cache shows the policy as it should be.
pub(super) fn again(policy: &Policy, is_shown: bool) -> Duration {
    match policy {
        Policy::External => RESYNC,
        Policy::InPlace if is_shown => RESYNC,
        // A person has to change something.
        Policy::Refused(_) => POLICY_AGAIN,
        Policy::NotApplied(_) if !is_shown => POLICY_AGAIN,
        // The cache lags behind an apply, and a program that undoes each one must not cost a request each moment.
        Policy::InPlace | Policy::NotApplied(_) => SOONEST,
    }
}

/// Puts the policy in place if it is not, and once in a while all the same. Never fails: what is wrong is shown.
pub(super) async fn keep(policies: Policies<'_>, leaderboard: &Leaderboard, now: Timestamp) -> Policy {
    if leaderboard.spec.network.policy == PolicySource::External {
        return Policy::External;
    }
    let uid = uid_of(leaderboard);
    let generation = leaderboard.metadata.generation;
    let is_shown = policies.stores.shows_policy(leaderboard);
    if is_shown {
        policies.state.note_seen(&uid);
    }
    let last = policies.state.read(&uid, |entry| entry.applied.clone());
    if let Some(last) = last.as_ref().filter(|last| last.generation == generation)
        && now.duration_since(last.at).unsigned_abs() < again(&last.policy, is_shown)
    {
        return last.policy.clone();
    }
    let answer = apply(policies.client, leaderboard).await;
    let is_shown = policies.stores.shows_policy(leaderboard);
    let is_unseen = answer == Policy::InPlace && !is_shown;
    let unseen = is_unseen.then(|| last.as_ref().and_then(|last| last.unseen).unwrap_or(now));
    let is_blind = !policies.stores.policies_synced.is_true()
        || unseen.is_some_and(|since| now.duration_since(since).unsigned_abs() >= POLICY_AGAIN);
    let policy = settled(answer, is_shown, is_blind);
    let applied = Applied {
        at: now,
        generation,
        policy: policy.clone(),
        unseen,
    };
    log(leaderboard, last.as_ref(), &applied);
    policies.state.change(&uid, |entry| entry.applied = Some(applied));
    if policy == Policy::InPlace && last.is_some_and(|last| last.has_failed()) {
        // An apply that changes nothing is no event.
        let reference = ObjectRef::from_obj(leaderboard);
        policies.slots.wake(&reference);
        (policies.wake)(reference);
    }
    policy
}

/// The meaning of the API server's answer, given the cache.
fn settled(answer: Policy, is_shown: bool, is_blind: bool) -> Policy {
    match answer {
        // It stands as it should; only the look at it failed, which is made again.
        Policy::NotApplied(_) if is_shown => Policy::InPlace,
        Policy::InPlace if !is_shown && is_blind => Policy::NotApplied(
            "The operator does not observe NetworkPolicies, so it would not notice if this one was edited or deleted. Give its \
             role list and watch of networkpolicies in this namespace; if it has both, look for a program that undoes each \
             apply. It is tried again."
                .to_owned(),
        ),
        other => other,
    }
}

/// Logs what has changed.
fn log(leaderboard: &Leaderboard, last: Option<&Applied>, new: &Applied) {
    if last.is_some_and(|last| last.policy == new.policy) {
        return;
    }
    let leaderboard = key_of(leaderboard).to_string();
    match &new.policy {
        Policy::Refused(why) | Policy::NotApplied(why) => {
            tracing::warn!(leaderboard, why, "the NetworkPolicy is not in place");
        }
        Policy::InPlace if last.is_some() => tracing::info!(leaderboard, "the NetworkPolicy is in place"),
        Policy::InPlace | Policy::External => {}
    }
}

/// Restores edited and deleted policies, and applies those of a new spec, until the process stops. It is a task of its own, because the
/// reconcile of a Leaderboard may wait for a bucket or a token meanwhile. `keep` is `keep_missing`.
pub async fn restore<F: Future<Output = ()>>(
    policies: WatchEvents<NetworkPolicy>,
    leaderboards: WatchEvents<Leaderboard>,
    keep: impl Fn(ObjectRef<Leaderboard>) -> F,
) {
    // The reconcile of a Leaderboard has a moment to do it itself.
    let of_spec = leaderboards.map(|event| (Some(ObjectRef::from_obj(event.object.as_ref())), false));
    let of_policy = policies.map(|event| (Stores::leaderboard_of_policy(&event.object), true));
    let keep = &keep;
    let restored =
        select(of_spec, of_policy).for_each_concurrent(RESTORED_AT_ONCE, |(reference, at_once)| async move {
            let Some(reference) = reference else { return };
            if at_once {
                keep(reference.clone()).await;
            }
            // The edit may have come a moment after an apply, which is then left to this second one.
            tokio::time::sleep(SOONEST).await;
            keep(reference).await;
        });
    restored.await;
}

/// Applies the policy of a Leaderboard if the watch does not show it.
pub async fn keep_missing(policies: Policies<'_>, reference: &ObjectRef<Leaderboard>) {
    let Some(leaderboard) = policies.stores.leaderboards.get(reference) else {
        return;
    };
    if policies.stores.shows_policy(&leaderboard) {
        policies.state.note_seen(&uid_of(leaderboard.as_ref()));
    } else {
        keep(policies, &leaderboard, policies.clock.now()).await;
    }
}

async fn apply(client: &Client, leaderboard: &Leaderboard) -> Policy {
    let wanted = network_policy(leaderboard);
    let name = wanted.name_any();
    let namespace = leaderboard.namespace().unwrap_or_default();
    let api: Api<NetworkPolicy> = Api::namespaced(client.clone(), &namespace);
    let params = PatchParams::apply(names::MANAGER_CHILDREN).force();
    let patch = Patch::Apply(&wanted);
    match call("the NetworkPolicy", &name, api.patch(&name, &params, &patch)).await {
        Ok(answer) if is_in_place(&answer, leaderboard) => Policy::InPlace,
        Ok(_) => Policy::NotApplied(format!(
            "The API server has changed the NetworkPolicy {name} while it was applied. Look for an admission webhook that \
             does so."
        )),
        Err(error) => match error.refusal() {
            Some(status) => Policy::Refused(format!(
                "The API server refuses the NetworkPolicy {name}: {} Give the operator's role create and patch of \
                 networkpolicies in this namespace, or correct what the admission webhook says; where the cluster has policies \
                 of its own, set network.policy to External.",
                sentence(&status.message)
            )),
            None => Policy::NotApplied(format!(
                "The NetworkPolicy {name} could not be applied: {} It is tried again.",
                sentence(&error.cause())
            )),
        },
    }
}

/// The last measurement for this generation: that of a Pod which this process has seen, or else that of the condition. It is remembered while
/// the condition shows something else. None if there is none, or the condition does not show any.
pub(super) fn measured(state: &LeaderboardState, leaderboard: &Leaderboard) -> Option<WorkspaceVerdict> {
    let network = &leaderboard.spec.network;
    if network.policy == PolicySource::External || network.enforcement == Enforcement::Disabled {
        // The condition does not show it.
        return None;
    }
    let (uid, generation) = (uid_of(leaderboard), leaderboard.metadata.generation?);
    if let Some(verdict) = known(leaderboard) {
        let found = Found {
            generation,
            at: None,
            verdict,
        };
        state.note_found(&uid, found);
    }
    let found = state.read(&uid, |entry| entry.found.clone())?;
    (found.generation == generation).then_some(found.verdict)
}

/// Remembers what a Pod has found. That of the newest spec counts, and of its Pods that of the one that ended its `workspace` last.
pub fn note_finding(state: &LeaderboardState, leaderboard: &Leaderboard, pod: &Pod) -> bool {
    let generation = pod.metadata.annotations.leaderboard_generation.as_deref();
    let Some((at, verdict)) = finding(pod) else {
        return false;
    };
    if let Some(generation) = generation.and_then(|generation| generation.parse().ok()) {
        let found = Found {
            generation,
            at: Some(at),
            verdict,
        };
        state.note_found(&uid_of(leaderboard), found);
    }
    true
}

/// Pods of a Leaderboard that have not ended, counted only once it is being deleted: the policy goes with it.
pub(super) fn pods_left(stores: &Stores, leaderboard: &Leaderboard) -> usize {
    if leaderboard.metadata.deletion_timestamp.is_none() {
        return 0;
    }
    let is_left = |pod: &&Arc<Pod>| {
        let meta = &pod.metadata;
        meta.labels.leaderboard.as_deref() == leaderboard.metadata.name.as_deref()
            && meta.namespace.as_deref() == leaderboard.metadata.namespace.as_deref()
            && !matches!(pod.status.phase.as_deref(), Some("Succeeded" | "Failed"))
    };
    stores.pods.state().iter().filter(is_left).count()
}

/// The isolation that a Pod has found, and when; that is the beginning of time if the kubelet reports none.
fn finding(pod: &Pod) -> Option<(Timestamp, WorkspaceVerdict)> {
    let mut containers = pod.status.init_container_statuses.iter();
    let end = containers.find(|c| &*c.name == names::CONTAINER_WORKSPACE)?.ended()?;
    let verdict = match WorkspaceVerdict::parse(end.message.as_deref()?) {
        Ok(verdict) => verdict,
        Err(error @ NotAVerdict::Schema(_)) => {
            tracing::warn!(pod = &*pod.metadata.name, %error, "what a Pod has found of its isolation is not used");
            return None;
        }
        Err(_) => return None,
    };
    let is_finding = matches!(
        verdict.reason,
        WorkspaceReason::Enforced
            | WorkspaceReason::NotEnforced
            | WorkspaceReason::NotMeasured
            | WorkspaceReason::NotIsolated
            | WorkspaceReason::NotKnownIsolated
    );
    is_finding.then_some((end.finished_at.as_ref().map_or(Timestamp::MIN, |at| at.0), verdict))
}

/// The condition's measurement for this generation, which a Pod made that is gone.
fn known(leaderboard: &Leaderboard) -> Option<WorkspaceVerdict> {
    let known = leaderboard.condition(conditions::ISOLATED)?;
    if known.observed_generation != leaderboard.metadata.generation {
        return None;
    }
    let reason = match known.reason.known()? {
        Reason::Enforced => WorkspaceReason::Enforced,
        Reason::NotEnforced => WorkspaceReason::NotEnforced,
        _ => return None,
    };
    Some(WorkspaceVerdict::new(reason, known.message.to_string()))
}

#[cfg(test)]
mod tests;
