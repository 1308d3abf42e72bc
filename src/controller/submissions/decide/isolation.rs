//! No Job without the NetworkPolicy of its Leaderboard, as the Leaderboard's present spec asks for it.

use super::status::PlanBuilder;
use leaderboard_api::PolicySource;
use leaderboard_api::conditions;
use leaderboard_api::text::sentence;

/// A policy that is not in place.
pub(super) struct Missing {
    /// Why no Job may be made.
    pub(super) message: String,
    /// It could not be applied, so waiting alone does not help.
    pub(super) is_refused: bool,
}

/// Why no Job may be made, if the policy is not in place. It is restored by the Leaderboard's reconcile, which wakes the
/// submission.
pub(super) fn missing(draft: &PlanBuilder<'_>) -> Option<Missing> {
    let leaderboard = draft.view.leaderboard.as_ref()?;
    let is_managed = leaderboard.spec.network.policy == PolicySource::Managed;
    if !is_managed || draft.view.is_policy_in_place {
        return None;
    }
    let name = &draft.spec().leaderboard_name;
    let isolated = leaderboard.condition(conditions::ISOLATED);
    let why = isolated.filter(|c| c.status == "False" && c.observed_generation == leaderboard.metadata.generation);
    let is_refused = why.is_some();
    let message = match why {
        Some(c) => format!(
            "The NetworkPolicy of Leaderboard {name} is not in place ({}): {} The submission goes on once it is.",
            c.reason,
            sentence(&c.message)
        ),
        None => format!(
            "The NetworkPolicy of Leaderboard {name} is not in place yet; the submission goes on once it is. If this lasts, look \
             at the Leaderboard's condition Isolated; `helm test` names a missing right."
        ),
    };
    Some(Missing { message, is_refused })
}
