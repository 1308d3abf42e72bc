//! What the condition `Isolated` of a Leaderboard shows. Pure.

use super::view::Policy;
use leaderboard_api::conditions::Truth;
use leaderboard_api::{Enforcement, Leaderboard, reasons};
use leaderboard_contract::verdict::{WorkspaceReason, WorkspaceVerdict};

/// What `Isolated` shows.
pub fn condition(
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
        Policy::InPlace if leaderboard.spec.network.enforcement == Enforcement::Disabled => {
            let message = "The NetworkPolicy is in place. Whether it is enforced is not measured: network.enforcement is Disabled.";
            (Truth::Unknown, reasons::NOT_MEASURED, message.into())
        }
        Policy::InPlace => measured.map_or_else(
            || {
                let message = "The NetworkPolicy is in place. The next run measures whether it is enforced.";
                (Truth::Unknown, reasons::NOT_MEASURED, message.into())
            },
            |found| {
                let (truth, reason) = shown(found.reason);
                (truth, reason, found.message.clone())
            },
        ),
    }
}

fn shown(found: WorkspaceReason) -> (Truth, &'static str) {
    match found {
        WorkspaceReason::Enforced => (Truth::True, reasons::ENFORCED),
        WorkspaceReason::NotMeasured | WorkspaceReason::NotKnownIsolated => (Truth::Unknown, reasons::NOT_MEASURED),
        _ => (Truth::False, reasons::NOT_ENFORCED),
    }
}
