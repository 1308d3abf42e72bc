//! Which installation of the operator drives a Leaderboard: `status.operator` names it, and every other one leaves that Leaderboard
//! and its Submissions alone.
//!
//! An installation is named by its Lease, `<namespace>/<name>`. It claims a Leaderboard that nobody drives before it does anything
//! else for it, by a write that fails if another one was faster. It takes over from one whose Lease is gone, or has not changed for
//! long. Clocks are not compared: what counts is how long this process has observed the same Lease.

use std::sync::Arc;
use std::time::Duration;

use k8s_openapi::api::coordination::v1::Lease;
use kube::api::Patch;
use kube::{Api, Client, ResourceExt};
use serde_json::json;
use tokio::time::Instant;

use super::foreign::Foreign;
use super::state::{LeaderboardState, SOONEST};
use crate::controller::objects::{key_of, uid_of};
use crate::controller::writes::patch_by;
use crate::kubernetes::{CallError, call};
use leaderboard_api::{Leaderboard, names, reasons};

/// The Lease of another installation is read this often.
const LOOK_AGAIN: Duration = Duration::from_secs(10);
/// A Submission waits so long for the claim of its Leaderboard, which also wakes those that are pending.
const UNCLAIMED: Duration = Duration::from_secs(2);
/// A Submission of another installation's Leaderboard is decided on again after this long.
const OF_ANOTHER: Duration = Duration::from_mins(1);

/// Who drives a Leaderboard.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Driver<'a> {
    Us,
    Nobody,
    Other(&'a str),
}

fn driver<'a>(leaderboard: &'a Leaderboard, us: &str) -> Driver<'a> {
    let named = leaderboard
        .status
        .as_ref()
        .and_then(|status| status.operator.as_deref());
    match named {
        None => Driver::Nobody,
        Some(operator) if operator == us => Driver::Us,
        Some(operator) => Driver::Other(operator),
    }
}

/// Whether this installation drives a Leaderboard.
pub fn is_ours(leaderboard: &Leaderboard, us: &str) -> bool {
    driver(leaderboard, us) == Driver::Us
}

/// How long a Submission of this Leaderboard is left alone. None: this installation drives it, or there is none, and then none can
/// start anything.
pub fn left_alone(leaderboard: Option<&Leaderboard>, us: &str) -> Option<Duration> {
    match driver(leaderboard?, us) {
        Driver::Us => None,
        Driver::Nobody => Some(UNCLAIMED),
        Driver::Other(_) => Some(OF_ANOTHER),
    }
}

/// The Leaderboard, if this installation drives it, else when to ask again. One that nobody drives any more is taken over.
pub(super) async fn ours(
    client: &Client,
    state: &LeaderboardState,
    leaderboard: Arc<Leaderboard>,
    us: &str,
) -> Result<Result<Arc<Leaderboard>, Duration>, CallError> {
    match driver(&leaderboard, us) {
        Driver::Us => return Ok(Ok(leaderboard)),
        Driver::Nobody => {}
        Driver::Other(other) => {
            if is_driven(client, state, &leaderboard, other).await {
                return Ok(Err(LOOK_AGAIN));
            }
            let leaderboard = key_of(leaderboard.as_ref()).to_string();
            tracing::info!(
                leaderboard,
                other,
                "the other installation is gone, and this one takes the Leaderboard over"
            );
        }
    }
    claim(client, &leaderboard, us).await
}

/// Whether another installation holds its Lease, as far as it can be known.
async fn is_driven(client: &Client, state: &LeaderboardState, leaderboard: &Leaderboard, other: &str) -> bool {
    let uid = uid_of(leaderboard);
    let (namespace, name) = other.split_once('/').unwrap_or_default();
    let api: Api<Lease> = Api::namespaced(client.clone(), namespace);
    let known = state.read(&uid, |entry| entry.foreign.clone());
    let is_new = known.as_ref().is_none_or(|known| known.operator != other);
    let lease = match call("the Lease", other, api.get_opt(name)).await {
        Ok(Some(lease)) => lease,
        Ok(None) => return false,
        Err(error) => {
            let leaderboard = key_of(leaderboard).to_string();
            tracing::warn!(leaderboard, %error, "the Lease of the installation that drives this Leaderboard cannot be read");
            return true;
        }
    };
    let now = Instant::now();
    let found = Foreign::of(other, &lease, now).after(known.as_ref());
    let is_given_up = found.is_given_up(now);
    state.change(&uid, |entry| entry.foreign = Some(found));
    if is_new {
        let leaderboard = key_of(leaderboard).to_string();
        tracing::warn!(
            leaderboard,
            other,
            reason = reasons::OTHER_OPERATOR,
            "not ready here: another installation of the operator drives this Leaderboard, and this one leaves it and its \
             submissions alone; uninstall one of the two, or let them serve different namespaces"
        );
    }
    !is_given_up
}

/// Writes our name, unless the Leaderboard has changed since it was read, by another installation perhaps.
async fn claim(
    client: &Client,
    leaderboard: &Leaderboard,
    us: &str,
) -> Result<Result<Arc<Leaderboard>, Duration>, CallError> {
    let name = leaderboard.name_any();
    let api: Api<Leaderboard> = Api::namespaced(client.clone(), &leaderboard.namespace().unwrap_or_default());
    let patch = Patch::Merge(json!({
        "metadata": { "uid": uid_of(leaderboard), "resourceVersion": leaderboard.metadata.resource_version },
        "status": { "operator": us },
    }));
    let params = patch_by(names::MANAGER_STATUS);
    let object = format!("Leaderboard {name}");
    match call("the claim", &object, api.patch_status(&name, &params, &patch)).await {
        Ok(claimed) => Ok(Ok(Arc::new(claimed))),
        Err(error) if error.is_conflict() || error.is_gone() => Ok(Err(SOONEST)),
        Err(error) => Err(error),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn lease(version: &str, seconds: i32) -> Lease {
        let lease = json!({"metadata": {"resourceVersion": version}, "spec": {"leaseDurationSeconds": seconds}});
        serde_json::from_value(lease).unwrap()
    }

    #[test]
    fn a_lease_is_given_up_when_it_has_not_changed_for_long() {
        let begin = Instant::now();
        let at = |second| begin + Duration::from_secs(second);
        let first = Foreign::of("a/b", &lease("1", 15), begin).after(None);
        let read = |operator, version, seconds, second| {
            let found = Foreign::of(operator, &lease(version, seconds), at(second)).after(Some(&first));
            found.is_given_up(at(second))
        };
        for (operator, version, seconds, second, is_given_up) in [
            ("a/b", "1", 15, 29, false),
            ("a/b", "1", 15, 30, true),
            ("a/b", "2", 15, 30, false),
            ("a/c", "1", 15, 30, false),
            ("a/b", "1", 60, 119, false),
            ("a/b", "1", 60, 120, true),
            ("a/b", "1", -1, 30, true),
        ] {
            assert_eq!(
                read(operator, version, seconds, second),
                is_given_up,
                "{operator} {version} {seconds} {second}"
            );
        }
    }

    #[test]
    fn only_the_named_installation_acts() {
        let spec = json!({
            "tracks": [{"name": "sensors", "codename": "SENSORS"}], "leaderboardVersion": "V2",
            "contents": {"image": "c"}, "simulator": {"image": "s"}, "storage": {"bucket": "bbb"},
        });
        let mut board = Leaderboard::new("board", serde_json::from_value(spec).unwrap());
        assert_eq!(left_alone(None, "a/b"), None);
        assert_eq!(left_alone(Some(&board), "a/b"), Some(UNCLAIMED));
        for (named, is_ours, left) in [("a/b", true, None), ("a/c", false, Some(OF_ANOTHER))] {
            board.status.get_or_insert_default().operator = Some(named.into());
            assert_eq!(super::is_ours(&board, "a/b"), is_ours);
            assert_eq!(left_alone(Some(&board), "a/b"), left);
        }
    }
}
