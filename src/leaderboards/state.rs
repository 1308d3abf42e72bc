//! What is remembered of each Leaderboard between two reconciles, by UID.

use std::collections::HashMap;
use std::sync::Mutex;
use std::time::Duration;

use jiff::Timestamp;

use leaderboard_base::lock::lock;
use leaderboard_contract::verdict::WorkspaceVerdict;
use leaderboard_policy::leaderboards::view::Policy;

/// A status whose counts alone have changed is written at most this often.
pub(super) const COUNTS_EVERY: Duration = Duration::from_secs(5);
/// The next reconcile that something is due for is at least so far away.
pub(super) const SOONEST: Duration = Duration::from_secs(1);
/// The cache shows a status that was written within this time, or not for a long while.
const SHOWS: Duration = Duration::from_secs(15);
/// A policy that the API server did not take is applied again after this long.
pub(super) const POLICY_AGAIN: Duration = Duration::from_secs(10);
/// A Leaderboard is reconciled this often without any cause.
pub(super) const RESYNC: Duration = Duration::from_mins(1);

/// The last apply.
#[derive(Clone, Debug)]
pub(super) struct Applied {
    pub(super) at: Timestamp,
    /// Of which spec.
    pub(super) generation: Option<i64>,
    pub(super) policy: Policy,
    /// Since when applies are answered well and the cache does not show it.
    pub(super) unseen: Option<Timestamp>,
}

impl Applied {
    pub(super) fn has_failed(&self) -> bool {
        matches!(self.policy, Policy::Refused(_) | Policy::NotApplied(_))
    }
}

/// What a Pod has found of its isolation, made from which generation, and when.
#[derive(Clone, Debug)]
pub(super) struct Found {
    pub(super) generation: i64,
    pub(super) at: Option<Timestamp>,
    pub(super) verdict: WorkspaceVerdict,
}

/// One entry for each Leaderboard.
#[derive(Default)]
pub struct LeaderboardState(Mutex<HashMap<String, Entry>>);

#[derive(Default)]
pub(super) struct Entry {
    /// When its status was written, and the version of it that the API server has made.
    pub(super) written: Option<(Timestamp, u64)>,
    pub(super) applied: Option<Applied>,
    /// What was measured last, of which generation.
    pub(super) measured: Option<(Option<i64>, WorkspaceVerdict)>,
    /// What its Pods have found.
    pub(super) found: Option<Found>,
    /// The other installation that drives it, once that was reported.
    pub(super) other: Option<String>,
}

impl LeaderboardState {
    /// Drops a Leaderboard that is gone.
    pub fn forget(&self, uid: &str) {
        lock(&self.0).remove(uid);
    }

    pub(super) fn read<T>(&self, uid: &str, read: impl FnOnce(&Entry) -> T) -> T {
        read(lock(&self.0).get(uid).unwrap_or(&Entry::default()))
    }

    pub(super) fn change(&self, uid: &str, change: impl FnOnce(&mut Entry)) {
        change(lock(&self.0).entry(uid.to_owned()).or_default());
    }

    /// The cache shows the policy as it should be.
    pub(super) fn note_seen(&self, uid: &str) {
        self.change(uid, |entry| {
            if let Some(applied) = &mut entry.applied {
                applied.unseen = None;
            }
        });
    }

    pub(super) fn found(&self, uid: &str, generation: Option<i64>) -> Option<WorkspaceVerdict> {
        let found = self.read(uid, |entry| entry.found.clone())?;
        (Some(found.generation) == generation).then_some(found.verdict)
    }

    pub(super) fn note_found(&self, uid: &str, found: Found) {
        let order = |found: &Found| (found.generation, found.at);
        self.change(uid, |entry| {
            if entry.found.as_ref().is_none_or(|known| order(known) <= order(&found)) {
                entry.found = Some(found);
            }
        });
    }

    /// Whether its status was not written for so long.
    pub(super) fn is_older(&self, uid: &str, now: Timestamp, age: Duration) -> bool {
        self.read(uid, |entry| entry.written)
            .is_none_or(|(at, _)| now.duration_since(at).unsigned_abs() >= age)
    }

    /// Whether the status that was written last may not be in the cache yet, which shows this version.
    pub(super) fn awaits_write(&self, uid: &str, shown: u64, now: Timestamp) -> bool {
        let written = self.read(uid, |entry| entry.written);
        written.is_some_and(|(_, version)| shown < version) && !self.is_older(uid, now, SHOWS)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counts_are_written_at_once_and_then_once_in_five_seconds() {
        let state = LeaderboardState::default();
        let at = |second| Timestamp::from_second(second).unwrap();
        // Each second another submission starts or ends.
        let written = (0..60).filter(|second| {
            let may = state.is_older("u", at(*second), COUNTS_EVERY);
            if may {
                state.change("u", |entry| entry.written = Some((at(*second), 1)));
            }
            may
        });
        assert_eq!(written.take(3).collect::<Vec<_>>(), [0, 5, 10]);
    }
}
