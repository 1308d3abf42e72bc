//! Where `network.dns` is `Pinned`, no Job without the addresses of the services that its own containers need.

use std::time::Duration;

use super::plan::Action;
use super::plan_builder::PlanBuilder;
use crate::controller::submissions::addresses::{question, usable};
use crate::controller::submissions::view::ObservedAddresses;
use crate::services::names::GOOD_FOR;
use leaderboard_api::{Dns, LeaderboardSpec, reasons};

/// Whether a Job may be made.
pub(super) enum Step {
    Go,
    /// Nothing new is known.
    Wait,
    /// And why not.
    Refuse(String),
}

/// Asks for the addresses, also while there are some: they are to be young when a Job is made.
pub(super) fn decide(draft: &mut PlanBuilder<'_>, leaderboard: &LeaderboardSpec) -> Step {
    if leaderboard.network.dns != Dns::Pinned {
        return Step::Go;
    }
    let attempt = draft.status.attempt.unwrap_or_default();
    let storage = draft
        .status
        .plan
        .as_ref()
        .map_or(&leaderboard.storage, |plan| &plan.storage);
    let question = question(leaderboard, storage, attempt);
    draft.act(Action::LookUpNames(Box::new(question.clone())));
    let view = draft.view;
    let waited = match &view.addresses {
        ObservedAddresses::Answered(looked) if looked.answers(&question, draft.now()) => {
            let Err(why) = usable(&leaderboard.network, looked) else {
                return Step::Go;
            };
            draft.requeue_in(GOOD_FOR + Duration::from_secs(1));
            draft.stall_with(reasons::NAME_NOT_RESOLVED, &why);
            return Step::Refuse(why);
        }
        // What is known was asked for another bucket or log group, or long ago.
        ObservedAddresses::Answered(_) | ObservedAddresses::NotAsked => Duration::ZERO,
        ObservedAddresses::Asked(waited) => *waited,
    };
    if draft.waits_quietly(waited) {
        return Step::Wait;
    }
    draft.requeue_in(GOOD_FOR);
    Step::Refuse("The names of the services that the Pod needs are being looked up.".to_owned())
}
