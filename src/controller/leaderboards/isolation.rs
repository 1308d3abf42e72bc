//! The NetworkPolicy of a Leaderboard's Pods: applied before all else, restored, and measured by each run.
//!
//! `keep` writes it, `restore` as soon as somebody else has changed it; `measured` reads what the Pods found; `condition` is pure and says what follows for `Isolated`.

use std::sync::Arc;

use futures::StreamExt;
use jiff::Timestamp;
use k8s_openapi::api::core::v1::{ContainerStateTerminated, ContainerStatus, Pod};
use k8s_openapi::api::networking::v1::NetworkPolicy;
use kube::api::{Patch, PatchParams};
use kube::{Api, ResourceExt};

use super::{RESYNC, SOONEST};
use crate::api::conditions::{self, Truth};
use crate::api::{Enforcement, Leaderboard, PolicySource, names, reasons};
use crate::controller::context::{CALL_TIMEOUT, Context, Stores};
use crate::controller::network_policy::{is_in_place, network_policy};
use crate::controller::observe::uid_of;
use crate::controller::watches::Touches;
use crate::observability::text;
use crate::pod::workspace::{WorkspaceReason, WorkspaceVerdict};
use crate::text::sentence;

/// Policies that are restored at once.
const RESTORED_AT_ONCE: usize = 16;

/// How the policy of a Leaderboard stands.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Policy {
    InPlace,
    /// The cluster has its own.
    External,
    /// The API server refuses it, and why.
    Refused(String),
    /// It could not be applied, or came out otherwise, and why.
    NotApplied(String),
}

/// The last apply.
#[derive(Clone, Debug)]
pub(super) struct Applied {
    at: Timestamp,
    policy: Policy,
}

/// Puts the policy in place if it is not, and once in a while all the same. Never fails: what is wrong is shown.
pub(super) async fn keep(context: &Context, leaderboard: &Leaderboard, now: Timestamp) -> Policy {
    if leaderboard.spec.network.policy == PolicySource::External {
        return Policy::External;
    }
    let uid = uid_of(leaderboard);
    let is_in_place = context.stores.is_policy_in_place(leaderboard);
    if let Some(last) = context.desk.applied(&uid) {
        let age = now.duration_since(last.at).unsigned_abs();
        if is_in_place && age < RESYNC {
            return Policy::InPlace;
        }
        // The cache lags behind an apply, and a program that undoes each one must not cost a request each moment.
        if age < SOONEST {
            return last.policy;
        }
    }
    let policy = apply(context, leaderboard).await;
    if let Policy::Refused(why) | Policy::NotApplied(why) = &policy {
        tracing::warn!(leaderboard = %leaderboard.name_any(), why, "the NetworkPolicy is not in place");
    }
    let applied = Applied {
        at: now,
        policy: policy.clone(),
    };
    context.desk.note_applied(&uid, applied);
    policy
}

/// Restores what somebody has edited or deleted, until the process stops: a task of its own, because the reconcile of a
/// Leaderboard may wait for a bucket or a token meanwhile.
pub async fn restore(touches: Touches<NetworkPolicy>, context: Arc<Context>) {
    let restored = touches.for_each_concurrent(RESTORED_AT_ONCE, |touch| {
        let context = Arc::clone(&context);
        async move {
            let reference = Stores::leaderboard_of(touch.object.as_ref());
            let leaderboard = reference.and_then(|reference| context.stores.leaderboards.get(&reference));
            let Some(leaderboard) = leaderboard else { return };
            if context.stores.is_policy_in_place(&leaderboard) {
                return;
            }
            keep(&context, &leaderboard, Timestamp::now()).await;
            // The edit may have come a moment after an apply, which is then left to this second one.
            tokio::time::sleep(SOONEST).await;
            if !context.stores.is_policy_in_place(&leaderboard) {
                keep(&context, &leaderboard, Timestamp::now()).await;
            }
        }
    });
    restored.await;
}

async fn apply(context: &Context, leaderboard: &Leaderboard) -> Policy {
    let wanted = network_policy(leaderboard);
    let name = wanted.name_any();
    let namespace = leaderboard.namespace().unwrap_or_default();
    let api: Api<NetworkPolicy> = Api::namespaced(context.client.clone(), &namespace);
    let params = PatchParams::apply(names::MANAGER_CHILDREN).force();
    let patch = Patch::Apply(&wanted);
    match tokio::time::timeout(CALL_TIMEOUT, api.patch(&name, &params, &patch)).await {
        Ok(Ok(answer)) if is_in_place(&answer, leaderboard) => Policy::InPlace,
        Ok(Ok(_)) => Policy::NotApplied(format!(
            "The API server has changed the NetworkPolicy {name} while it was applied. Look for an admission webhook that \
             does so."
        )),
        Ok(Err(kube::Error::Api(status))) if is_refusal(status.code) => Policy::Refused(format!(
            "The API server refuses the NetworkPolicy {name}: {} Give the operator's role create and patch of \
             networkpolicies in this namespace, or correct what the admission webhook says; where the cluster has policies \
             of its own, set network.policy to External.",
            sentence(&status.message)
        )),
        Ok(Err(error)) => Policy::NotApplied(format!(
            "The NetworkPolicy {name} could not be applied: {} It is tried again.",
            sentence(&text::kube(&error))
        )),
        Err(_) => Policy::NotApplied(format!(
            "The NetworkPolicy {name} could not be applied: the API server did not answer. It is tried again."
        )),
    }
}

/// No right, or a webhook or a policy of admission that says no; not a conflict, and not too many requests.
fn is_refusal(code: u16) -> bool {
    (400..500).contains(&code) && ![408, 409, 429].contains(&code)
}

/// What the Pod that ended its `workspace` last has found, of those that this generation's Jobs made.
pub(super) fn measured(stores: &Stores, leaderboard: &Leaderboard) -> Option<WorkspaceVerdict> {
    let (name, namespace) = (leaderboard.name_any(), leaderboard.namespace());
    let generation = leaderboard.metadata.generation.unwrap_or_default().to_string();
    let is_ours = |pod: &Arc<Pod>| {
        pod.namespace() == namespace
            && pod.labels().get(names::LABEL_LEADERBOARD) == Some(&name)
            && pod.annotations().get(names::ANNOTATION_GENERATION) == Some(&generation)
    };
    let pods = stores.pods.state();
    let found = pods.iter().filter(|pod| is_ours(pod)).filter_map(|pod| finding(pod));
    found.max_by_key(|(at, _)| *at).map(|(_, verdict)| verdict)
}

/// What a Pod has found of its isolation, and when.
pub fn finding(pod: &Pod) -> Option<(Option<Timestamp>, WorkspaceVerdict)> {
    let status = pod.status.as_ref()?;
    let mut containers = status.init_container_statuses.iter().flatten();
    let end = last_end(containers.find(|c| c.name == names::CONTAINER_WORKSPACE)?)?;
    let verdict = WorkspaceVerdict::parse(end.message.as_deref()?)?;
    let is_finding = matches!(
        verdict.reason,
        WorkspaceReason::Enforced
            | WorkspaceReason::NotEnforced
            | WorkspaceReason::NotMeasured
            | WorkspaceReason::NotIsolated
    );
    is_finding.then_some((end.finished_at.as_ref().map(|at| at.0), verdict))
}

fn last_end(status: &ContainerStatus) -> Option<&ContainerStateTerminated> {
    let states = [status.state.as_ref(), status.last_state.as_ref()];
    states.into_iter().flatten().find_map(|state| state.terminated.as_ref())
}

/// What `Isolated` says.
pub(super) fn condition(
    leaderboard: &Leaderboard,
    policy: &Policy,
    measured: Option<&WorkspaceVerdict>,
) -> (Truth, &'static str, String) {
    match policy {
        Policy::External => {
            let message = "network.policy is External: no NetworkPolicy is applied, and the cluster's own are trusted.";
            (Truth::Unknown, reasons::EXTERNAL, message.into())
        }
        Policy::Refused(why) => (Truth::False, reasons::FORBIDDEN, why.clone()),
        Policy::NotApplied(why) => (Truth::False, reasons::NOT_APPLIED, why.clone()),
        Policy::InPlace if leaderboard.spec.network.enforcement == Enforcement::Off => {
            let message =
                "The NetworkPolicy is in place. Whether it is enforced is not measured: network.enforcement is Off.";
            (Truth::Unknown, reasons::NOT_MEASURED, message.into())
        }
        Policy::InPlace => match measured {
            Some(verdict) => (truth(verdict.reason), reason(verdict.reason), verdict.message.clone()),
            None => known(leaderboard).unwrap_or_else(|| {
                let message = "The NetworkPolicy is in place. The next run measures whether it is enforced.";
                (Truth::Unknown, reasons::NOT_MEASURED, message.into())
            }),
        },
    }
}

/// What a Pod that is gone had found, for this generation.
fn known(leaderboard: &Leaderboard) -> Option<(Truth, &'static str, String)> {
    let status = leaderboard.status.as_ref()?;
    let known = conditions::get(&status.conditions, conditions::ISOLATED)
        .filter(|known| known.observed_generation == leaderboard.metadata.generation)?;
    let (truth, reason) = match known.reason.as_str() {
        reasons::ENFORCED => (Truth::True, reasons::ENFORCED),
        reasons::NOT_ENFORCED => (Truth::False, reasons::NOT_ENFORCED),
        _ => return None,
    };
    Some((truth, reason, known.message.clone()))
}

fn truth(found: WorkspaceReason) -> Truth {
    match found {
        WorkspaceReason::Enforced => Truth::True,
        WorkspaceReason::NotMeasured => Truth::Unknown,
        _ => Truth::False,
    }
}

fn reason(found: WorkspaceReason) -> &'static str {
    match found {
        WorkspaceReason::Enforced => reasons::ENFORCED,
        WorkspaceReason::NotMeasured => reasons::NOT_MEASURED,
        _ => reasons::NOT_ENFORCED,
    }
}

#[cfg(test)]
mod tests {
    use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;
    use serde_json::{Value, json};

    use super::*;

    fn leaderboard(network: &Value, generation: i64) -> Leaderboard {
        let spec = json!({
            "tracks": [{"name": "sensors", "codename": "SENSORS"}], "results": "V2", "contents": {"image": "c"},
            "simulator": {"image": "s"}, "storage": {"bucket": "bucket"}, "network": network,
        });
        let mut object = Leaderboard::new("carla", serde_json::from_value(spec).unwrap());
        object.metadata.generation = Some(generation);
        object
    }

    fn verdict(reason: WorkspaceReason) -> WorkspaceVerdict {
        WorkspaceVerdict {
            reason,
            message: "It was tried.".into(),
        }
    }

    /// A Leaderboard whose condition says this of this generation.
    fn shown(reason: &str, of: i64) -> Leaderboard {
        let mut object = leaderboard(&json!({}), 2);
        let mut conditions = Vec::new();
        let now = Time(Timestamp::UNIX_EPOCH);
        conditions::set(
            &mut conditions,
            conditions::ISOLATED,
            Truth::False,
            reason,
            "As before.",
            Some(of),
            &now,
        );
        object.status.get_or_insert_default().conditions = conditions;
        object
    }

    #[test]
    fn only_what_was_measured_is_called_enforced() {
        use WorkspaceReason::{Enforced, NotEnforced, NotIsolated, NotMeasured};
        let (on, off) = (
            leaderboard(&json!({}), 2),
            leaderboard(&json!({"enforcement": "Off"}), 2),
        );
        let in_place = || Policy::InPlace;
        let cases = [
            (&on, Policy::External, Some(Enforced), Truth::Unknown, reasons::EXTERNAL),
            (
                &on,
                Policy::Refused("no".into()),
                Some(Enforced),
                Truth::False,
                reasons::FORBIDDEN,
            ),
            (
                &on,
                Policy::NotApplied("no".into()),
                None,
                Truth::False,
                reasons::NOT_APPLIED,
            ),
            (&on, in_place(), None, Truth::Unknown, reasons::NOT_MEASURED),
            (
                &on,
                in_place(),
                Some(NotMeasured),
                Truth::Unknown,
                reasons::NOT_MEASURED,
            ),
            (&on, in_place(), Some(Enforced), Truth::True, reasons::ENFORCED),
            (&on, in_place(), Some(NotEnforced), Truth::False, reasons::NOT_ENFORCED),
            (&on, in_place(), Some(NotIsolated), Truth::False, reasons::NOT_ENFORCED),
            (&off, in_place(), Some(Enforced), Truth::Unknown, reasons::NOT_MEASURED),
        ];
        for (leaderboard, policy, found, truth, reason) in cases {
            let (is, why, message) = condition(leaderboard, &policy, found.map(verdict).as_ref());
            assert_eq!((is, why), (truth, reason), "{policy:?} {found:?}");
            assert!(!message.is_empty());
        }
    }

    #[test]
    fn what_a_pod_found_outlives_it_until_the_spec_changes() {
        let said = |leaderboard: &Leaderboard| condition(leaderboard, &Policy::InPlace, None);
        let (truth, reason, message) = said(&shown(reasons::NOT_ENFORCED, 2));
        assert_eq!(
            (truth, reason, message.as_str()),
            (Truth::False, reasons::NOT_ENFORCED, "As before.")
        );
        assert_eq!(said(&shown(reasons::ENFORCED, 2)).0, Truth::True);
        for (reason, of) in [
            (reasons::NOT_ENFORCED, 1),
            (reasons::ENFORCED, 1),
            (reasons::FORBIDDEN, 2),
        ] {
            assert_eq!(said(&shown(reason, of)).1, reasons::NOT_MEASURED, "{reason} of {of}");
        }
        let (truth, ..) = condition(
            &shown(reasons::NOT_ENFORCED, 2),
            &Policy::InPlace,
            Some(&verdict(WorkspaceReason::Enforced)),
        );
        assert_eq!(truth, Truth::True, "what was found last counts");
    }

    #[test]
    fn a_finding_is_read_from_workspace_alone() {
        let pod = |container: &str, message: &str| -> Pod {
            let ended =
                json!({"terminated": {"exitCode": 0, "message": message, "finishedAt": "2026-11-01T12:00:00Z"}});
            let status = json!({"name": container, "image": "i", "imageID": "", "ready": false, "restartCount": 0, "state": ended});
            serde_json::from_value(json!({"metadata": {}, "status": {"initContainerStatuses": [status]}})).unwrap()
        };
        let said = verdict(WorkspaceReason::NotEnforced);
        let found = finding(&pod("workspace", &said.to_json()));
        assert_eq!(
            found.map(|(at, verdict)| (at.is_some(), verdict)),
            Some((true, said.clone()))
        );
        assert!(finding(&pod("contents", &said.to_json())).is_none());
        assert!(finding(&pod("workspace", &verdict(WorkspaceReason::StorageFailed).to_json())).is_none());
        assert!(finding(&pod("workspace", "Error")).is_none());
    }

    #[test]
    fn what_a_person_has_to_change_is_a_refusal() {
        for (code, expected) in [
            (400, true),
            (403, true),
            (422, true),
            (409, false),
            (429, false),
            (500, false),
        ] {
            assert_eq!(is_refusal(code), expected, "{code}");
        }
    }
}
