//! The cancelled results in a Leaderboard's stored standings, as EvalAI's client knows them. Reads memory alone.

use std::collections::BTreeSet;

use leaderboard_api::{Leaderboard, names};
use leaderboard_base::object_key::ObjectKey;
use leaderboard_evalai::Hub;

/// Submissions of stored rows that EvalAI shows as cancelled, deleted ones included: retention takes those out of the cache.
pub(super) fn cancelled(hub: &Hub, key: &ObjectKey, leaderboard: &Leaderboard) -> BTreeSet<String> {
    if leaderboard.spec.evalai.is_none() {
        return BTreeSet::new();
    }
    let tracks = leaderboard.status.iter().flat_map(|status| &status.tracks);
    let names = tracks
        .flat_map(|track| &track.standings)
        .map(|row| row.submission.as_str());
    let is_cancelled =
        |name: &&str| names::id_of_submission(name).is_some_and(|id| hub.cancelled_as_of(key, id).is_some());
    names.filter(is_cancelled).map(str::to_owned).collect()
}
