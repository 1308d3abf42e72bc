//! The condition `Isolated` of a Leaderboard. Pure.

use super::view::Policy;
use leaderboard_api::conditions::Truth;
use leaderboard_api::{Enforcement, Leaderboard, Reason};
use leaderboard_contract::verdict::{WorkspaceReason, WorkspaceVerdict};

/// Truth, reason and message of the condition `Isolated`.
pub fn condition(
    leaderboard: &Leaderboard,
    policy: &Policy,
    measured: Option<&WorkspaceVerdict>,
) -> (Truth, Reason, String) {
    match policy {
        Policy::External => {
            let message = "network.policy is External: no NetworkPolicy is applied, and the cluster's own are trusted.";
            (Truth::Unknown, Reason::External, message.into())
        }
        Policy::Refused(why) => (Truth::False, Reason::Forbidden, why.clone()),
        Policy::NotApplied(why) => (Truth::False, Reason::NotApplied, why.clone()),
        Policy::InPlace if leaderboard.spec.network.enforcement == Enforcement::Disabled => {
            let message = "The NetworkPolicy is in place. Whether it is enforced is not measured: network.enforcement is Disabled.";
            (Truth::Unknown, Reason::NotMeasured, message.into())
        }
        Policy::InPlace => match measured {
            None => {
                let message = "The NetworkPolicy is in place. The next run measures whether it is enforced.";
                (Truth::Unknown, Reason::NotMeasured, message.into())
            }
            Some(found) => {
                let (truth, reason) = match found.reason {
                    WorkspaceReason::Enforced => (Truth::True, Reason::Enforced),
                    WorkspaceReason::NotMeasured | WorkspaceReason::NotKnownIsolated => {
                        (Truth::Unknown, Reason::NotMeasured)
                    }
                    _ => (Truth::False, Reason::NotEnforced),
                };
                (truth, reason, found.message.clone())
            }
        },
    }
}
