//! Requests of one token, and their order: all of it as a state machine without network and clock.
//!
//! `hub` puts updates in, `task` takes requests out ([`Queue::next`]) and brings their answers back ([`Queue::answered`]).
//! Each request has:
//!
//! - the budget of the token's user, and the one order of [`choose`];
//! - one request in flight for a submission, whatever it is, and [`MAX_IN_FLIGHT`] in all;
//! - after a write without an answer nothing for that submission until the server must have given up, then a read;
//! - each write follows at once a read of its own, judged by [`super::guard`]: the server overwrites whatever it has stored in
//!   between, a cancel above all.

mod answers;
mod choose;
mod lists;
mod passing;
mod payloads;
mod poll;
mod purse;
mod silence;
mod sub;
mod transfer;

#[cfg(test)]
mod tests;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use jiff::{SignedDuration, Timestamp};

use self::passing::Passing;
use self::payloads::Held;
pub use self::payloads::{PAYLOADS, Place};
use self::poll::{Challenge, Poll};
pub use self::purse::{Purse, Share};
use self::silence::Silent;
use self::sub::{Pending, Sub};
use super::budget::WINDOW;
use super::labels::{Labels, compare};
use super::request::{Purpose, Request};
use super::types::{Changed, DesiredUpdate, Ended, Key, Outline, Subject, SubmissionState, SweepRow, Target, Usage};
use leaderboard_api::evalai_status::{Outcome, Progress};

/// Requests about submissions that may wait for an answer at once; lists come on top, one of a kind.
const MAX_IN_FLIGHT: usize = 4;
/// A read for each, and the write that follows it, and in between a list of cancelled submissions.
const REQUESTS_OF_FOUR_ENDS: u32 = 9;
/// Requests among which one at most is a list of cancelled submissions, which may go before most others: a write takes two, and
/// would never get them if a short period asked for each.
const LIST_SHARE: u32 = 3;

/// The moment, on both clocks.
#[derive(Clone, Copy, Debug)]
pub struct Now {
    /// Since any fixed moment; never goes back.
    pub at: Duration,
    /// For people and for EvalAI.
    pub wall: Timestamp,
}

/// How long what holds.
#[derive(Clone, Copy, Debug)]
pub struct Timing {
    /// Nothing for a submission after a write without an answer: the server's own limit of 60 s, and a margin.
    pub hold: Duration,
    /// A write follows the answer to its read by no more; else it is read again.
    pub fresh: Duration,
    /// A message that has not come for so long is lost.
    pub lost: Duration,
    /// A live submission is read again: its participant may have deleted it, which no list shows. With many live submissions the
    /// time is longer: their reads take half of the requests at most.
    pub refresh: Duration,
    /// Between two checks of a challenge's leaderboards.
    pub check: Duration,
    /// A submission that EvalAI does not have is asked for again after so long: one answer may be of a server that is being replaced.
    pub missing: Duration,
}

impl Default for Timing {
    fn default() -> Self {
        Self {
            hold: Duration::from_secs(75),
            fresh: Duration::from_secs(1),
            lost: Duration::from_mins(2),
            // What is deleted is to be ended there within a minute, and its Pod takes some seconds to stop.
            refresh: Duration::from_secs(40),
            check: Duration::from_hours(1),
            missing: Duration::from_secs(30),
        }
    }
}

/// Next step of the task.
#[derive(Debug)]
pub enum Next {
    /// Send this, and hand it back with its answer.
    Send(Ticket),
    /// Read the payload of a submission's next write, and hand it to [`Queue::took_payload`].
    Read(Key, Arc<Outline>),
    /// Nothing before that moment, unless there is a new update or an answer; none is never.
    Wait(Option<Duration>),
}

/// A request on its way.
#[derive(Clone, Debug)]
pub struct Ticket {
    pub request: Request,
    /// When it was sent.
    pub requested: Duration,
    /// A write that is not sent by then is not sent: its read is too old.
    pub leave_by: Option<Duration>,
    /// Number of a request that another waits for.
    pub number: Option<u64>,
}

/// A submission's place on the wire, kept while its object comes and goes.
#[derive(Debug, Default)]
struct Lane {
    busy: Option<Busy>,
    hold_until: Duration,
    /// A write was not answered: read before anything is written.
    unsure: bool,
    /// Answer of a read that was made for a write, until anything else is sent.
    checked: Option<Duration>,
    /// EvalAI does not have the submission, as of this read, and had it before.
    missing_since: Option<Duration>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Busy {
    Read,
    ReadForWrite,
    Write,
}

/// See the module's text.
#[derive(Debug)]
pub struct Queue {
    timing: Timing,
    share: Share,
    /// No write before.
    not_before: Duration,
    /// That moment has come, and everything that waited for it knows.
    open: bool,
    subs: BTreeMap<Key, Sub>,
    pks: BTreeMap<i64, BTreeSet<Key>>,
    lanes: BTreeMap<i64, Lane>,
    challenges: BTreeMap<i64, Challenge>,
    served: BTreeMap<Key, Arc<Target>>,
    /// EvalAI's refusal of the token, and until when nothing is asked with it.
    token_refused: Option<(String, Duration)>,
    /// The server does not answer.
    silent: Option<Silent>,
    changes: BTreeSet<Changed>,
    sweep: Vec<SweepRow>,
    passing: Passing,
    /// The payloads of writes that come soon.
    held: BTreeMap<Key, Held>,
}

impl Queue {
    /// An empty queue of one token. Writes start at `not_before`.
    pub fn new(timing: Timing, share: Share, not_before: Duration, now: Now) -> Self {
        let requests_per_minute = share.budget(|budget| budget.limit());
        Self {
            timing,
            share,
            not_before,
            open: not_before <= now.at,
            subs: BTreeMap::new(),
            pks: BTreeMap::new(),
            lanes: BTreeMap::new(),
            challenges: BTreeMap::new(),
            served: BTreeMap::new(),
            token_refused: None,
            silent: None,
            changes: BTreeSet::new(),
            sweep: Vec::new(),
            passing: Passing::new(requests_per_minute, now.at),
            held: BTreeMap::new(),
        }
    }

    /// A Leaderboard serves its challenge from now on: sweep and check it.
    pub fn serve(&mut self, leaderboard: &Key, target: &Target, now: Now) -> bool {
        if self.served.get(leaderboard).is_some_and(|known| **known == *target) {
            return false;
        }
        let target = Arc::new(target.clone());
        self.served.insert(leaderboard.clone(), target.clone());
        self.challenges
            .entry(target.challenge)
            .or_insert_with(|| Challenge::new(target.period));
        self.arrange(now);
        let of = (self.subs.values_mut()).filter(|sub| sub.target.leaderboard == *leaderboard);
        of.for_each(|sub| sub.follow(&target, now.at));
        if let Some(challenge) = self.challenges.get_mut(&target.challenge) {
            for purpose in [Purpose::SweepSubmitted, Purpose::SweepResuming] {
                challenge.lists.entry(purpose).or_insert_with(|| Poll::due(now.at));
            }
            challenge.check.poll.due = now.at;
            challenge.check.restart();
        }
        true
    }

    /// A Leaderboard is gone.
    pub fn retire(&mut self, leaderboard: &Key, now: Now) {
        if let Some(target) = self.served.remove(leaderboard) {
            self.drop_unused(target.challenge);
            self.arrange(now);
        }
    }

    /// When the server must have given up every write that was not answered; none if it has.
    pub fn settled_at(&self, now: Now) -> Option<Duration> {
        let holds = self.lanes.values().map(|lane| lane.hold_until);
        holds.max().filter(|until| *until > now.at)
    }

    /// Wakes what waited for the first write, once, when it may be sent.
    fn open_writes(&mut self, now: &Now) {
        if self.open || now.at < self.not_before {
            return;
        }
        self.open = true;
        let waiting = self.subs.iter().filter(|(_, sub)| sub.next_write().is_some());
        self.changes
            .extend(waiting.map(|(key, _)| Changed::Submission(key.clone())));
        self.wake_leaderboards(|_| true);
    }

    /// Wakes the Leaderboards whose way to EvalAI is one of these.
    fn wake_leaderboards(&mut self, is_meant: impl Fn(&Target) -> bool) {
        let meant = self.served.iter().filter(|(_, target)| is_meant(target));
        self.changes
            .extend(meant.map(|(key, _)| Changed::Leaderboard(key.clone())));
    }

    /// Asks whether an attempt may run, and for its image where the object has none. This and the two below return whether
    /// they brought anything new.
    pub fn ask(&mut self, subject: &Subject, image: bool, now: Now) -> bool {
        let Some(sub) = self.enter(subject) else {
            return false;
        };
        let mut news = image && !sub.image;
        sub.image |= image;
        if sub.view.answered < Some(subject.run.attempt) && sub.asked.is_none() {
            news = true;
            sub.asked = Some(now.at);
        }
        news
    }

    /// From now on a cancellation of this attempt is checked for. `submitted_at` is EvalAI's own time.
    pub fn live(&mut self, subject: &Subject, submitted_at: Timestamp) -> bool {
        let Some(sub) = self.enter(subject) else {
            return false;
        };
        let news = !sub.has_end() && sub.live != Some(submitted_at);
        if news {
            sub.live = Some(submitted_at);
        }
        news
    }

    /// Requests an update; a newer one replaces an older one, an end all others.
    pub fn update(&mut self, subject: &Subject, update: DesiredUpdate, now: Now) -> bool {
        let Some(sub) = self.enter(subject) else {
            return false;
        };
        let before = sub.view.clone();
        let news = match update {
            DesiredUpdate::Queued => request_progress(sub, Progress::Queued, now),
            DesiredUpdate::Running => request_progress(sub, Progress::Running, now),
            DesiredUpdate::Partial(outline) => request_partial(sub, outline, now),
            DesiredUpdate::Final(outcome, outline) => request_end(sub, outcome, outline, now),
        };
        if sub.view != before {
            self.changes.insert(Changed::Submission(subject.key.clone()));
        }
        news
    }

    /// The object is gone, or needs no further update.
    pub fn forget(&mut self, key: &Key, now: Now) {
        self.remove(key, now);
    }

    fn remove(&mut self, key: &Key, now: Now) -> Option<Sub> {
        let sub = self.subs.remove(key)?;
        if let Some(keys) = self.pks.get_mut(&sub.pk) {
            keys.remove(key);
            if keys.is_empty() {
                self.pks.remove(&sub.pk);
            }
        }
        self.tidy_lanes(&now);
        self.drop_unused(sub.target.challenge);
        Some(sub)
    }

    /// A lane that nothing uses needs no memory.
    fn tidy_lanes(&mut self, now: &Now) {
        let pks = &self.pks;
        self.lanes
            .retain(|pk, lane| lane.busy.is_some() || lane.hold_until > now.at || pks.contains_key(pk));
    }

    /// A challenge that no Leaderboard serves and no submission is of needs no memory.
    fn drop_unused(&mut self, challenge: i64) {
        let is_served = self.served.values().any(|target| target.challenge == challenge);
        if !is_served && !self.subs.values().any(|sub| sub.target.challenge == challenge) {
            self.challenges.remove(&challenge);
        }
    }

    /// State of a submission, as far as it is known.
    pub fn view(&self, key: &Key) -> Option<SubmissionState> {
        self.subs.get(key).map(|sub| sub.view.clone())
    }

    /// True if partial results are on the leaderboards of a phase.
    pub fn shows_partial(&self, leaderboard: &Key, phase: i64) -> bool {
        let check = self.challenge_of(leaderboard).map(|challenge| &challenge.check);
        let phases = check.and_then(|check| Some(&check.catalog.as_ref()?.phases));
        phases.is_some_and(|phases| phases.iter().any(|known| known.id == phase && known.shows_partial))
    }

    /// The challenge that a Leaderboard serves.
    fn challenge_of(&self, leaderboard: &Key) -> Option<&Challenge> {
        self.challenges.get(&self.served.get(leaderboard)?.challenge)
    }

    /// How a Leaderboard fits its challenge; none before the first check. The error is why there was no newer check.
    pub fn labels(&self, leaderboard: &Key) -> (Option<Labels>, Option<String>) {
        let Some((target, challenge)) = self.served.get(leaderboard).zip(self.challenge_of(leaderboard)) else {
            return (None, None);
        };
        let labels = challenge.check.catalog.as_ref().map(|catalog| compare(target, catalog));
        (labels, challenge.check.error.clone())
    }

    /// Updates and questions that wait for a request.
    pub fn waiting(&self) -> usize {
        let of = |sub: &Sub| {
            usize::from(sub.asked.is_some())
                + usize::from(sub.progress.is_some())
                + usize::from(sub.partial.is_some())
                + usize::from(sub.end.is_some())
        };
        self.subs.values().map(of).sum()
    }

    /// Requests of the last minute, and the ends that wait for one.
    pub fn usage(&self, now: Now) -> Usage {
        let waiting = self.subs.values().filter(|sub| sub.has_end_to_publish()).count();
        let (used, limit, begin) =
            (self.share).budget(|budget| (budget.used(now.at), budget.limit(), budget.ready_at(now.at, 1, 0)));
        let token = self.token_refused.as_ref().map_or(now.at, |(_, until)| *until);
        let begin = begin.max(self.not_before).max(token).saturating_sub(now.at);
        let requests = u32::try_from(waiting)
            .unwrap_or(u32::MAX)
            .saturating_mul(REQUESTS_OF_FOUR_ENDS)
            / 4;
        Usage {
            used,
            limit,
            waiting,
            last_expected: (waiting > 0)
                .then(|| next_minute(now.wall, begin + WINDOW.saturating_mul(requests) / limit)),
        }
    }

    /// EvalAI's answer to the token, if it refused it.
    pub fn token_refused(&self) -> Option<&str> {
        self.token_refused.as_ref().map(|(why, _)| why.as_str())
    }

    /// EvalAI's answer about the token's rights on the challenge of a Leaderboard, if it has none.
    pub fn challenge_refused(&self, leaderboard: &Key) -> Option<&str> {
        let check = &self.challenge_of(leaderboard)?.check;
        check.error.as_deref().filter(|_| check.is_forbidden)
    }

    /// Objects to wake.
    pub fn take_changes(&mut self) -> BTreeSet<Changed> {
        std::mem::take(&mut self.changes)
    }

    /// Takes the finds of the sweep.
    pub fn take_sweep(&mut self) -> Vec<SweepRow> {
        std::mem::take(&mut self.sweep)
    }

    /// The submission's place, at this attempt; none if it is already further.
    fn enter(&mut self, subject: &Subject) -> Option<&mut Sub> {
        let Subject { target, key, pk, run } = subject;
        // The Leaderboard's own word is newer than that of a reconcile.
        let target = self.served.get(&target.leaderboard).unwrap_or(target).clone();
        self.challenges
            .entry(target.challenge)
            .or_insert_with(|| Challenge::new(target.period));
        let sub = self.subs.entry(key.clone()).or_insert_with(|| {
            self.pks.entry(*pk).or_default().insert(key.clone());
            Sub::new(*pk, target.clone(), run.clone())
        });
        if !Arc::ptr_eq(&sub.target, &target) {
            sub.target = target;
        }
        if run.attempt > sub.run.attempt {
            sub.begin(run.clone());
        }
        if run.attempt == sub.run.attempt {
            sub.run.has_job |= run.has_job;
            sub.run.ended = sub.run.ended.or(run.ended);
        }
        // An object's submission is immutable.
        (run.attempt == sub.run.attempt && *pk == sub.pk).then_some(sub)
    }

    /// Computes what depends on all Leaderboards served.
    fn arrange(&mut self, now: Now) {
        if let Some(limit) = self.served.values().map(|target| target.requests_per_minute).min() {
            self.share.set_limit(limit, now.at);
        }
        let served: BTreeSet<i64> = self.served.values().map(|target| target.challenge).collect();
        let lists = u32::try_from(served.len()).unwrap_or(u32::MAX).max(1);
        let least = self
            .share
            .budget(|budget| budget.interval())
            .saturating_mul(lists.saturating_mul(LIST_SHARE));
        for (id, challenge) in &mut self.challenges {
            let of = || self.served.values().filter(|target| target.challenge == *id);
            let period = of().map(|target| target.period).min().unwrap_or(challenge.period);
            challenge.period = period.max(least);
            let since = of().map(|target| target.since).min();
            challenge.sweep = of().map(|target| target.sweep).min().zip(since);
            challenge.check.want(of().map(Arc::as_ref));
        }
        let limit = self.share.budget(|budget| budget.limit());
        self.passing.set_limit(limit, now.at);
    }
}

/// The moment is given to the minute: what shifts it by less is no news.
fn next_minute(now: Timestamp, after: Duration) -> Timestamp {
    let after = SignedDuration::try_from(after).unwrap_or(SignedDuration::MAX);
    let at = now.checked_add(after).unwrap_or(Timestamp::MAX).as_second();
    let next = at.saturating_add(60 - at.rem_euclid(60));
    Timestamp::from_second(next).unwrap_or(Timestamp::MAX)
}

fn request_progress(sub: &mut Sub, wanted: Progress, now: Now) -> bool {
    let further = sub.view.progress >= Some(wanted) || sub.progress.as_ref().is_some_and(|p| p.what >= wanted);
    if further || sub.has_end() {
        return false;
    }
    let since = sub.progress.as_ref().map_or(now.at, |progress| progress.since);
    sub.progress = Some(Pending { what: wanted, since });
    sub.settle(&now);
    true
}

fn request_partial(sub: &mut Sub, outline: Arc<Outline>, now: Now) -> bool {
    let pending = sub.partial.as_ref().is_some_and(|partial| partial.what == outline);
    let done = outline.stored.as_ref().map(|stored| stored.done);
    if sub.has_end() || pending || sub.view.partial_done >= done {
        return false;
    }
    // The oldest unsent goes first, however often it was replaced.
    let since = sub.partial.as_ref().map_or(now.at, |partial| partial.since);
    sub.partial = Some(Pending { what: outline, since });
    true
}

fn request_end(sub: &mut Sub, outcome: Outcome, outline: Arc<Outline>, now: Now) -> bool {
    let closed = (sub.view.end.as_ref()).is_some_and(|end| !matches!(end, Ended::Refused(_)));
    let want = (outcome, outline);
    if closed || sub.end.as_ref().is_some_and(|end| end.what == want) {
        return false;
    }
    sub.misfit = None;
    let since = now.at;
    sub.end = Some(Pending { what: want, since });
    sub.run.ended.get_or_insert(now.wall);
    (sub.progress, sub.partial) = (None, None);
    sub.view.end = None;
    sub.retry_at = sub.retry_at.min(now.at);
    true
}
