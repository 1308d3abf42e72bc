//! Which installation of the operator drives a Leaderboard: `status.operator` names it, and every other one leaves that Leaderboard
//! and its Submissions alone.
//!
//! An installation is named by its Lease, `<namespace>/<name>`. It claims a Leaderboard without a name before it does anything else for
//! it. The claim is a write that fails if another installation was faster. A person hands a Leaderboard over by removing the name.

use std::sync::Arc;
use std::time::Duration;

use kube::api::Patch;
use kube::runtime::events::{Event, EventType, Recorder};
use kube::{Api, Client, Resource, ResourceExt};
use serde_json::json;

use super::state::{LeaderboardState, SOONEST};
use crate::kubernetes::{CallError, call};
use crate::runtime::objects::{key_of, uid_of};
use crate::runtime::writes::patch_by;
use leaderboard_api::{Leaderboard, Reason, names};

/// When a Leaderboard of another installation is looked at again, in the cache alone: a changed status is no event.
const LOOK_AGAIN: Duration = Duration::from_secs(10);
/// When a Submission of such a Leaderboard is decided on again.
const OF_ANOTHER: Duration = Duration::from_mins(1);
/// A Submission waits so long for the claim of its Leaderboard, which also wakes those that are pending.
const UNCLAIMED: Duration = Duration::from_secs(2);

/// The installation that drives a Leaderboard.
fn driver(leaderboard: &Leaderboard) -> Option<&str> {
    leaderboard.status.as_ref()?.operator.as_deref()
}

/// True if this installation drives a Leaderboard.
pub fn is_ours(leaderboard: &Leaderboard, us: &str) -> bool {
    driver(leaderboard) == Some(us)
}

/// How long a Submission of this Leaderboard is left alone. None: this installation drives it, or there is none, and then none can
/// start anything.
pub fn left_alone(leaderboard: Option<&Leaderboard>, us: &str) -> Option<Duration> {
    match driver(leaderboard?) {
        None => Some(UNCLAIMED),
        Some(driver) => (driver != us).then_some(OF_ANOTHER),
    }
}

/// The Leaderboard, if this installation drives it, else when to look again. One without a name is claimed.
pub(super) async fn ours(
    client: &Client,
    recorder: &Recorder,
    state: &LeaderboardState,
    leaderboard: Arc<Leaderboard>,
    us: &str,
) -> Result<Result<Arc<Leaderboard>, Duration>, CallError> {
    match driver(&leaderboard) {
        None => claim(client, &leaderboard, us).await,
        Some(driver) if driver == us => Ok(Ok(leaderboard)),
        Some(other) => {
            let uid = uid_of(leaderboard.as_ref());
            let is_known = state.read(&uid, |entry| entry.other.as_deref() == Some(other));
            if !is_known {
                report(recorder, &leaderboard, other, us).await;
                state.change(&uid, |entry| entry.other = Some(other.to_owned()));
            }
            Ok(Err(LOOK_AGAIN))
        }
    }
}

/// Says once in the log and by an event who drives it, and how a person hands it over.
async fn report(recorder: &Recorder, leaderboard: &Leaderboard, other: &str, us: &str) {
    let key = key_of(leaderboard);
    let note = format!(
        "Installation {us} leaves this Leaderboard and its submissions alone: installation {other} drives it. If that one is uninstalled, \
         hand the Leaderboard over: kubectl -n {} patch leaderboard {} --subresource=status --type=merge -p '{{\"status\":{{\"operator\":null}}}}'",
        leaderboard.namespace().unwrap_or_default(),
        leaderboard.name_any(),
    );
    tracing::warn!(leaderboard = %key, other, reason = %Reason::OtherOperator, "{note}");
    let event = Event {
        type_: EventType::Warning,
        reason: Reason::OtherOperator.as_str().to_owned(),
        note: Some(note),
        action: "LeaveAlone".to_owned(),
        secondary: None,
    };
    let reference = leaderboard.object_ref(&());
    let published = recorder.publish(&event, &reference);
    if let Err(error) = call("an event", &key.to_string(), published).await {
        tracing::warn!(leaderboard = %key, "{error}");
    }
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

    #[test]
    fn only_the_named_installation_acts() {
        let spec = json!({
            "tracks": [{"name": "sensors"}],
            "evaluation": {"carla": {
                "version": "V2", "contents": {"image": "c"}, "simulator": {"image": "s"},
            }}, "storage": {"s3": {"bucket": "bbb"}},
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
