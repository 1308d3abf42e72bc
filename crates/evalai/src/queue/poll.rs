//! What is polled for a whole challenge: lists, and what its leaderboards are.
//!
//! Owned by `queue`. Pure.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use jiff::Timestamp;

use crate::labels::Catalog;
use crate::request::{Purpose, Request};
use crate::row::{Phase, Split};
use leaderboard_base::backoff::Backoff;

/// Waits after failures in a row. Without jitter: one task makes all requests of a token.
const RETRY: Backoff = Backoff::new(Duration::from_secs(5), Duration::from_mins(1));

/// A request that is repeated, one at a time.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Poll {
    pub busy: bool,
    pub due: Duration,
    /// Failures in a row.
    pub failures: u32,
}

impl Poll {
    /// One that is due then.
    pub fn due(due: Duration) -> Self {
        Self { due, ..Self::default() }
    }

    /// It succeeded: next time `every` after the request, however long its answer took. A server that needs the whole time
    /// for its answer is given a rest.
    pub fn done(&mut self, requested: Duration, now: Duration, every: Duration) {
        *self = Self {
            busy: false,
            due: (requested + every).max(now + every / 4),
            failures: 0,
        };
    }

    /// It failed: again later, and later each time.
    pub fn failed(&mut self, now: Duration, every: Duration) {
        self.busy = false;
        self.due = now + pause(self.failures).max(every);
        self.failures = self.failures.saturating_add(1);
    }
}

/// The wait after a failure that follows so many in a row.
pub(super) fn pause(failures: u32) -> Duration {
    RETRY.bound(failures.saturating_add(1))
}

/// A challenge, as far as it is asked about as a whole.
#[derive(Debug)]
pub(super) struct Challenge {
    /// Time between two lists of cancelled submissions.
    pub period: Duration,
    /// Time between two sweeps, and from when on their lists reach, that of the oldest Leaderboard; none while none serves it.
    pub sweep: Option<(Duration, Timestamp)>,
    /// When each of its lists is due. One that was never asked for is due at once.
    pub lists: BTreeMap<Purpose, Poll>,
    pub check: ChallengeCheck,
    /// What the sweep has handed out, so that it is handed out once: when it asked to be run, and when it was handed out.
    pub swept: BTreeMap<i64, (Timestamp, Duration)>,
    /// Ids that the last list of cancelled submissions had and that have their end here, and when it was asked for.
    pub cancelled: (Timestamp, BTreeSet<i64>),
}

impl Challenge {
    pub fn new(period: Duration) -> Self {
        Self {
            period,
            sweep: None,
            lists: BTreeMap::new(),
            check: ChallengeCheck::default(),
            swept: BTreeMap::new(),
            cancelled: (Timestamp::MIN, BTreeSet::new()),
        }
    }

    /// The same challenge with what was read of it, and nothing on its way.
    pub fn known(&self) -> Self {
        let check = ChallengeCheck {
            wanted: self.check.wanted.clone(),
            catalog: self.check.catalog.clone(),
            ..ChallengeCheck::default()
        };
        Self {
            check,
            swept: self.swept.clone(),
            ..Self::new(self.period)
        }
    }

    pub fn poll(&mut self, purpose: Purpose) -> &mut Poll {
        self.lists.entry(purpose).or_default()
    }
}

/// Reading what a challenge's leaderboards are, request by request.
#[derive(Debug, Default)]
pub(super) struct ChallengeCheck {
    pub poll: Poll,
    /// Phases whose splits are of interest.
    pub wanted: Vec<i64>,
    pub phases: Option<Vec<Phase>>,
    pub splits: Option<Vec<Split>>,
    pub codenames: BTreeMap<i64, Option<String>>,
    /// The last whole reading.
    pub catalog: Option<Catalog>,
    /// Why there is no newer one.
    pub error: Option<String>,
    /// It is that the token's user is no host of the challenge.
    pub is_forbidden: bool,
}

impl ChallengeCheck {
    /// Starts anew.
    pub fn restart(&mut self) {
        (self.phases, self.splits) = (None, None);
        self.codenames.clear();
    }

    /// Starts anew at once: a list was refused as if the token's user were no host of the challenge.
    pub fn hurry(&mut self, now: Duration) {
        if !self.is_forbidden {
            self.restart();
            self.poll.due = now;
        }
    }

    /// The next request of a reading; none when it is whole.
    pub fn request(&self, challenge: i64) -> Option<Request> {
        if self.phases.is_none() {
            return Some(Request::Phases(challenge));
        }
        let Some(splits) = &self.splits else {
            return Some(Request::Splits(challenge));
        };
        let open = splits
            .iter()
            .filter(|split| self.wanted.contains(&split.phase))
            .map(|split| split.dataset_split);
        open.into_iter()
            .find(|id| !self.codenames.contains_key(id))
            .map(|id| Request::DatasetSplit(challenge, id))
    }

    /// Closes a whole reading.
    pub fn close(&mut self, at: Timestamp) {
        let (Some(phases), Some(splits)) = (self.phases.take(), self.splits.take()) else {
            return;
        };
        let codenames = std::mem::take(&mut self.codenames);
        (self.error, self.is_forbidden) = (None, false);
        self.catalog = Some(Catalog {
            at,
            phases,
            splits,
            codenames,
        });
    }
}
