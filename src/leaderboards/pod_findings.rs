//! Findings about a Leaderboard's Pods before there are any.

use leaderboard_policy::leaderboards::view::Claims;

/// The findings about a Leaderboard's Pods.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct TriedPods {
    /// Why they would be refused.
    pub(super) refused: Option<String>,
    /// Notes for their host, one sentence each.
    pub(super) notes: Vec<String>,
    /// How the template of their claims stands.
    pub(super) claims: Claims,
    /// They depend on objects that may change.
    pub(super) may_change: bool,
}
