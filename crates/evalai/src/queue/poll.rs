//! Polls of a whole challenge: lists, and its leaderboards.
//!
//! Owned by `queue`. Pure.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use jiff::Timestamp;

use crate::answer::{About, Answer};
use crate::labels::Catalog;
use crate::request::{Purpose, Reply, Request};
use crate::row::{self, Phase, Split};
use crate::types::Target;
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
    /// Finds of the sweep that were handed out, so that each is once: when it asked to be run, and when it was handed out.
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

    /// This challenge with what was read of it, and nothing on its way.
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
    /// Whether the highest value leads, by the ids of the leaderboards whose schemas leave it open.
    pub descending: BTreeMap<i64, Option<bool>>,
    /// True if a Leaderboard takes files: then the challenge's settings are read.
    pub takes_files: bool,
    pub settings: Option<row::Challenge>,
    /// The last whole reading.
    pub catalog: Option<Catalog>,
    /// Why there is no newer one.
    pub error: Option<String>,
    /// It is that the token's user is no host of the challenge.
    pub is_forbidden: bool,
}

impl ChallengeCheck {
    /// From now on all is read that these Leaderboards need.
    pub fn want<'a>(&mut self, served: impl Iterator<Item = &'a Target>) {
        (self.wanted, self.takes_files) = (Vec::new(), false);
        for target in served {
            self.wanted.extend(target.phases.iter());
            self.takes_files |= target.takes_files;
        }
    }

    /// Starts anew.
    pub fn restart(&mut self) {
        (self.phases, self.splits) = (None, None);
        self.codenames.clear();
        self.descending.clear();
        self.settings = None;
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
        let wanted = || splits.iter().filter(|split| self.wanted.contains(&split.phase));
        let unnamed = wanted().find(|split| !self.codenames.contains_key(&split.dataset_split));
        let codename = unnamed.map(|split| Request::DatasetSplit(challenge, split.dataset_split));
        codename.or_else(|| {
            let is_open = |split: &&Split| split.schema.leaves_order_open() && !self.descending.contains_key(&split.id);
            let open = wanted().find(is_open);
            let settings = (self.takes_files && self.settings.is_none()).then_some(Request::Challenge(challenge));
            open.map(|split| Request::PhaseSplit(challenge, split.id)).or(settings)
        })
    }

    /// Takes in what an answer shows, and returns its end. Not every host may read a split or the settings: the phase's only leaderboard is
    /// taken then, and what EvalAI usually says.
    pub fn take(&mut self, request: &Request, reply: Reply) -> Answer<()> {
        match (request, reply) {
            (_, Reply::Phases(answer)) => answer.map(|phases| self.phases = Some(phases)),
            (_, Reply::Splits(answer)) => answer.map(|splits| self.splits = Some(splits)),
            (Request::DatasetSplit(_, id), Reply::DatasetSplit(answer)) => or_hidden(answer).map(|split| {
                self.codenames.insert(*id, split.map(|split| split.codename));
            }),
            (Request::PhaseSplit(_, id), Reply::PhaseSplit(answer)) => or_hidden(answer).map(|split| {
                self.descending.insert(*id, split.map(|split| split.is_descending));
            }),
            (_, Reply::Challenge(answer)) => {
                or_hidden(answer).map(|settings| self.settings = Some(settings.unwrap_or_default()))
            }
            (_, reply) => reply.answer(),
        }
    }

    /// Closes a whole reading.
    pub fn close(&mut self, at: Timestamp) {
        let (Some(phases), Some(splits)) = (self.phases.take(), self.splits.take()) else {
            return;
        };
        let codenames = std::mem::take(&mut self.codenames);
        let descending = std::mem::take(&mut self.descending);
        let settings = self.settings.take();
        (self.error, self.is_forbidden) = (None, false);
        self.catalog = Some(Catalog {
            at,
            phases,
            splits,
            codenames,
            descending,
            settings: settings.unwrap_or_default(),
        });
    }
}

/// Content of an answer; none where EvalAI does not show it to this token's user.
fn or_hidden<T>(answer: Answer<T>) -> Answer<Option<T>> {
    match answer {
        Answer::Refused(refusal) if refusal.about != About::Token => Answer::Done(None),
        other => other.map(Some),
    }
}
