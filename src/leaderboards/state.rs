//! Memory of each Leaderboard between two reconciles, by UID.

use std::collections::{BTreeSet, HashMap};
use std::sync::Mutex;
use std::time::Duration;

use jiff::Timestamp;

use leaderboard_api::{LeaderboardStatus, TrackStatus};
use leaderboard_base::lock::lock;
use leaderboard_contract::verdict::WorkspaceVerdict;
use leaderboard_policy::leaderboards::standings::Named;
use leaderboard_policy::leaderboards::view::Policy;

/// A status whose counts alone have changed is written at most this often.
pub(super) const COUNTS_EVERY: Duration = Duration::from_secs(5);
/// The next reconcile that something is due for is at least so far away.
pub(super) const SOONEST: Duration = Duration::from_secs(1);
/// A status of which the standings alone have changed is written at most this often.
pub(super) const STANDINGS_EVERY: Duration = Duration::from_secs(30);
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
    /// Generation of the applied spec.
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

/// A Pod's finding about its isolation, with the generation of the Leaderboard that the Pod was made from, and the time.
#[derive(Clone, Debug)]
pub(super) struct Found {
    pub(super) generation: i64,
    /// None: the condition shows it, and its Pod is gone.
    pub(super) at: Option<Timestamp>,
    pub(super) verdict: WorkspaceVerdict,
}

/// The sources of standings: equal sources make equal standings.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Made {
    /// The census's mark of the results.
    pub(super) results: u64,
    pub(super) named: Named,
    /// Generation of the spec.
    pub(super) generation: Option<i64>,
    pub(super) cancelled: BTreeSet<String>,
}

/// One entry for each Leaderboard.
#[derive(Default)]
pub struct LeaderboardState(Mutex<HashMap<String, Entry>>);

#[derive(Default)]
pub(super) struct Entry {
    /// When its status was written, and the version of it that the API server has made.
    pub(super) written: Option<(Timestamp, u64)>,
    /// The sources of its stored standings, and the time of their write.
    pub(super) standings: (Option<Made>, Option<Timestamp>),
    pub(super) applied: Option<Applied>,
    /// The last finding of its Pods, or else of the condition.
    pub(super) found: Option<Found>,
    /// The other installation that drives it, once that was reported.
    pub(super) other: Option<String>,
}

impl LeaderboardState {
    /// True if the stored standings were made of other results than those of this mark. False before the first reconcile.
    pub fn lacks_results(&self, uid: &str, mark: u64) -> bool {
        self.read(uid, |entry| {
            entry.standings.0.as_ref().is_some_and(|made| made.results != mark)
        })
    }

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

    pub(super) fn note_found(&self, uid: &str, found: Found) {
        let order = |found: &Found| (found.generation, found.at);
        self.change(uid, |entry| {
            if entry.found.as_ref().is_none_or(|known| order(known) <= order(&found)) {
                entry.found = Some(found);
            }
        });
    }

    /// Time until a changed status is written: new numbers alone wait, any other change is written at once.
    pub(super) fn time_to_write(
        &self,
        uid: &str,
        old: &LeaderboardStatus,
        new: &LeaderboardStatus,
        now: Timestamp,
    ) -> Duration {
        let only_numbers = LeaderboardStatus {
            counts: old.counts,
            evalai: old.evalai.clone(),
            table: old.table.clone(),
            gpu_use: old.gpu_use.clone(),
            tracks: with_standings_of(old, &new.tracks),
            ..new.clone()
        } == *old;
        if !only_numbers {
            return Duration::ZERO;
        }
        let left = |since: Option<Timestamp>, every: Duration| {
            let passed = since.map_or(every, |since| now.duration_since(since).unsigned_abs());
            every.saturating_sub(passed)
        };
        let (written, ranked) = self.read(uid, |entry| (entry.written.map(|(at, _)| at), entry.standings.1));
        // The number of requests moves with each of them; alone it is worth a write a minute.
        let of_counts = (old.counts != new.counts).then(|| left(written, COUNTS_EVERY));
        let of_standings =
            (old.tracks != new.tracks).then(|| left(ranked, STANDINGS_EVERY).max(left(written, COUNTS_EVERY)));
        let first = of_counts.into_iter().chain(of_standings).min();
        first.unwrap_or_else(|| left(written, RESYNC))
    }

    /// Its status was written, in this version.
    pub(super) fn note_written(&self, uid: &str, now: Timestamp, version: u64, has_new_standings: bool) {
        self.change(uid, |entry| {
            entry.written = Some((now, version));
            if has_new_standings {
                entry.standings.1 = Some(now);
            }
        });
    }

    /// The stored standings are made of this.
    pub(super) fn note_made(&self, uid: &str, made: &Made) {
        self.change(uid, |entry| entry.standings.0 = Some(made.clone()));
    }

    /// True if the cache, which shows the version `shown`, may lack the last write of the status.
    pub(super) fn awaits_write(&self, uid: &str, shown: u64, now: Timestamp) -> bool {
        let written = self.read(uid, |entry| entry.written);
        written.is_some_and(|(at, version)| shown < version && now.duration_since(at).unsigned_abs() < SHOWS)
    }
}

/// Tracks with the standings that a status has of them.
fn with_standings_of(status: &LeaderboardStatus, tracks: &[TrackStatus]) -> Vec<TrackStatus> {
    let mut tracks = tracks.to_vec();
    for track in &mut tracks {
        let stored = status.tracks.iter().find(|stored| stored.name == track.name);
        track.standings = stored.map(|stored| stored.standings.clone()).unwrap_or_default();
    }
    tracks
}

#[cfg(test)]
mod tests {
    use super::*;

    fn status(finished: i32, leader: &str, requests: i32) -> LeaderboardStatus {
        let status = serde_json::json!({
            "counts": {"pending": 0, "running": 0, "finished": finished, "failed": 0, "cancelled": 0},
            "evalai": {"requestsLastMinute": requests, "requestsPerMinute": 54},
            "tracks": [{
                "name": "sensors", "carla": {"pairs": 1, "routes": 1, "repetitions": 1},
                "ranking": {"metric": "Driving score", "order": "Descending"},
                "standings": [{"rank": 1, "submission": leader, "score": {"name": "Driving score", "value": "1", "text": "1"}}],
            }],
        });
        serde_json::from_value(status).unwrap()
    }

    /// Moments of writes when each second has this status.
    fn written(seconds: i64, status: impl Fn(i64) -> LeaderboardStatus) -> Vec<i64> {
        let state = LeaderboardState::default();
        let at = |second| Timestamp::from_second(second).unwrap();
        let mut shown = status(0);
        let mut moments = Vec::new();
        for second in 1..=seconds {
            let new = status(second);
            if new == shown || !state.time_to_write("u", &shown, &new, at(second)).is_zero() {
                continue;
            }
            let has_new_standings = new.tracks != shown.tracks;
            state.note_written("u", at(second), 1, has_new_standings);
            shown = new;
            moments.push(second);
        }
        moments
    }

    #[test]
    fn counts_are_written_at_once_and_then_once_in_five_seconds() {
        let found = written(12, |second| status(i32::try_from(second).unwrap(), "a", 1));
        assert_eq!(found, [1, 6, 11]);
    }

    #[test]
    fn standings_alone_are_written_at_once_and_then_once_in_thirty_seconds() {
        let found = written(70, |second| status(1, &format!("s-{second}"), 1));
        assert_eq!(found, [1, 31, 61]);
    }

    #[test]
    fn new_standings_go_with_a_write_of_the_counts_and_cost_none_of_their_own() {
        let one_in_ten = |second: i64| i32::try_from(second / 10).unwrap();
        let found = written(60, |second| {
            status(one_in_ten(second), &format!("s-{}", second / 10), 1)
        });
        assert_eq!(found, [10, 20, 30, 40, 50, 60]);
    }

    #[test]
    fn the_number_of_requests_alone_is_written_once_a_minute_and_all_else_at_once() {
        let found = written(130, |second| status(1, "a", i32::try_from(second).unwrap()));
        assert_eq!(found, [1, 61, 121]);
        let observed = |second| LeaderboardStatus {
            observed_generation: Some(second),
            ..status(1, "a", 1)
        };
        assert_eq!(written(3, observed), [1, 2, 3]);
    }
}
