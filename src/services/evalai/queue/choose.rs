//! Which request is next: what is due, what may be sent, what comes first.
//!
//! Owned by `queue`. Pure.

use std::collections::BTreeMap;
use std::time::Duration;

use jiff::{SignedDuration, Timestamp};

use super::poll::Challenge;
use super::sub::Sub;
use super::{Busy, Lane, MAX_IN_FLIGHT, Next, Now, Queue, Ticket};
use crate::services::evalai::guard::{End, Verdict};
use crate::services::evalai::request::{Purpose, Request, Subject};
use crate::services::evalai::status::{Outcome, Progress};
use crate::services::evalai::types::Key;

/// More submissions than these that wait for acceptance are asked for by one list.
const ASKED_ONE_BY_ONE: usize = 5;
/// How far back a list of new submissions reaches: the queue's messages live four days.
const ACCEPT_REACH: SignedDuration = SignedDuration::from_hours(5 * 24);
/// How far before its Leaderboard a re-run or resumed submission may first have been submitted: it keeps that time.
const SWEEP_REACH: SignedDuration = SignedDuration::from_hours(180 * 24);
/// While writes are not allowed they are looked at again so often: nobody says when they are.
const RECHECK: Duration = Duration::from_secs(1);

/// First comes first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Priority {
    /// Not of the API.
    Free,
    /// An end whose read has just been answered.
    EndNow,
    /// A partial result whose read has: it would be worth nothing a moment later.
    PartialNow,
    End,
    CancelList,
    Acceptance,
    Sweep,
    Progress,
    /// An end that EvalAI knows already, or did not take again and again.
    Cancelled,
    /// What is left.
    Rest,
}

#[derive(Clone, Debug)]
enum What {
    Sub(Key, Step),
    List(i64, Purpose),
    Look(i64),
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Step {
    Get,
    /// A read that is worth nothing without the write that follows it.
    GetForEnd,
    /// The same for a partial result.
    GetForPartial,
    Image,
    Progress,
    Partial,
    End,
}

/// A request that is due at `ready`.
#[derive(Clone, Debug)]
struct Offer {
    priority: Priority,
    since: Duration,
    ready: Duration,
    what: What,
}

impl Queue {
    /// The next request, and marks it as sent. `may_write` is the fence: false keeps every write back.
    pub fn next(&mut self, now: Now, may_write: bool) -> Next {
        self.open_writes(&now);
        let (due, later): (Vec<_>, Vec<_>) = self
            .offers(&now, may_write)
            .into_iter()
            .partition(|offer| offer.ready <= now.at);
        let first = |one: &&Offer, other: &&Offer| (one.priority, one.since).cmp(&(other.priority, other.since));
        let best = due.iter().min_by(first);
        // Ends wait for room for two requests; the list of the runs that are to stop goes in between.
        let list = due
            .iter()
            .filter(|offer| offer.priority == Priority::CancelList)
            .min_by(first);
        let chosen = [best, list].into_iter().flatten();
        let (now_affordable, not_yet): (Vec<_>, Vec<_>) = chosen
            .map(|offer| (self.affordable_at(&now, offer), offer))
            .partition(|(at, _)| *at <= now.at);
        let Some((_, best)) = now_affordable.first() else {
            let waits = later
                .iter()
                .map(|offer| offer.ready)
                .chain(not_yet.iter().map(|(at, _)| *at));
            let opens = (!self.open).then_some(self.not_before);
            return Next::Wait(waits.chain((!may_write).then(|| now.at + RECHECK)).chain(opens).min());
        };
        match self.start(&best.what, &now) {
            Some(request) => {
                if request.counts() {
                    self.budget.take(now.at);
                }
                Next::Send(Ticket {
                    request,
                    requested: now.at,
                })
            }
            None => Next::Wait(Some(now.at + RECHECK)),
        }
    }

    /// When the budget has room: every read for an end keeps one request back for the write that follows it.
    fn affordable_at(&self, now: &Now, offer: &Offer) -> Duration {
        let reserved = self
            .lanes
            .values()
            .filter(|lane| lane.busy == Some(Busy::ReadForEnd))
            .count();
        let reserved = u32::try_from(reserved).unwrap_or(u32::MAX);
        let count = match (&offer.what, offer.priority) {
            (_, Priority::Free) => return now.at,
            (_, Priority::EndNow | Priority::PartialNow) => 1,
            (What::Sub(_, Step::GetForEnd | Step::GetForPartial), _) => reserved.saturating_add(2),
            _ => reserved.saturating_add(1),
        };
        let token = self.token_refused.as_ref().map_or(now.at, |(_, until)| *until);
        // A list that is due, and a write whose read is made, may use what the others leave.
        let urgent = [Priority::EndNow, Priority::PartialNow, Priority::CancelList].contains(&offer.priority);
        let keep = if urgent { 0 } else { self.budget.kept() };
        self.budget.ready_keeping(now.at, count, keep).max(token)
    }

    fn offers(&self, now: &Now, may_write: bool) -> Vec<Offer> {
        let asked = self.asked_by_list();
        let in_flight = self.lanes.values().filter(|lane| lane.busy.is_some()).count();
        let mut offers = Vec::new();
        if in_flight < MAX_IN_FLIGHT {
            let subs = self.subs.iter().filter_map(|(key, sub)| {
                let by_list = asked.contains_key(&sub.challenge);
                self.offer_of(key, sub, now, may_write, by_list)
            });
            offers.extend(subs);
        }
        for (id, challenge) in &self.challenges {
            offers.extend(self.offers_of(*id, challenge, asked.contains_key(id)));
        }
        offers
    }

    /// Challenges with so many waiting submissions that one list is asked for all.
    fn asked_by_list(&self) -> BTreeMap<i64, usize> {
        let mut counts = BTreeMap::new();
        for sub in self
            .subs
            .values()
            .filter(|sub| sub.asked.as_ref().is_some_and(|asked| !asked.listed))
        {
            *counts.entry(sub.challenge).or_insert(0) += 1;
        }
        counts.retain(|_, count| *count > ASKED_ONE_BY_ONE);
        counts
    }

    fn offer_of(&self, key: &Key, sub: &Sub, now: &Now, may_write: bool, by_list: bool) -> Option<Offer> {
        let idle = Lane::default();
        let lane = self.lanes.get(&sub.pk).unwrap_or(&idle);
        if lane.busy.is_some() {
            return None;
        }
        let (priority, since, write, step) = self.step_of(sub, lane, now, may_write, by_list)?;
        let pause = sub.retry_at.max(lane.hold_until);
        Some(Offer {
            priority,
            since,
            ready: if write { pause.max(self.not_before) } else { pause },
            what: What::Sub(key.clone(), step),
        })
    }

    /// What a submission wants first: priority, since when, whether it leads to a write, and the request.
    fn step_of(
        &self,
        sub: &Sub,
        lane: &Lane,
        now: &Now,
        may_write: bool,
        by_list: bool,
    ) -> Option<(Priority, Duration, bool, Step)> {
        if may_write {
            if let Some(want) = &sub.end {
                return Some(self.step_to_end(sub, lane, now, want.what.0, want.since));
            }
            if let Some(step) = self.step_to_progress(sub, lane, now) {
                return Some(step);
            }
        }
        if let Some(asked) = &sub.asked {
            let alone = asked.listed || !by_list;
            return alone.then_some((Priority::Acceptance, asked.since, false, Step::Get));
        }
        if sub.wants_image() {
            return Some((Priority::Free, now.at, false, Step::Image));
        }
        let read_at = sub.read.map_or(Duration::ZERO, |read| read.requested);
        if may_write && let Some(partial) = &sub.partial {
            if lane.unsure || sub.outdated || sub.read.is_none() {
                return Some((Priority::Rest, partial.since, true, Step::Get));
            }
            let window = self.timing.window;
            if sub.partial_verdict() == Some(Verdict::Send) {
                if within(sub.clear_at, window, now) {
                    let is_read = within(sub.read.map(|read| read.answered), window, now);
                    let priority = if is_read && sub.read_for_partial {
                        Priority::PartialNow
                    } else {
                        Priority::Rest
                    };
                    return Some((priority, partial.since, true, Step::Partial));
                }
                if self.lists_are_late(sub, window) || partial.since + self.timing.patience <= now.at {
                    return Some((Priority::Rest, partial.since, true, Step::GetForPartial));
                }
            }
        }
        let stale = sub.read.is_none() || sub.outdated || read_at + self.timing.refresh <= now.at;
        (sub.live.is_some() && stale).then_some((Priority::Rest, read_at, false, Step::Get))
    }

    fn step_to_end(
        &self,
        sub: &Sub,
        lane: &Lane,
        now: &Now,
        outcome: Outcome,
        since: Duration,
    ) -> (Priority, Duration, bool, Step) {
        let fresh = within(sub.read.map(|read| read.answered), self.fresh(), now);
        if !lane.unsure && fresh && sub.end_verdict() == Some(End::Put) {
            return (Priority::EndNow, since, true, Step::End);
        }
        // Ends that EvalAI breaks down over must not keep it from being asked for cancellations.
        let priority = if outcome == Outcome::Cancelled || sub.write_failures > 1 {
            Priority::Cancelled
        } else {
            Priority::End
        };
        (priority, since, true, Step::GetForEnd)
    }

    /// Progress waits for the next list of cancelled ones where that comes soon; else it is worth a read of its own.
    fn step_to_progress(&self, sub: &Sub, lane: &Lane, now: &Now) -> Option<(Priority, Duration, bool, Step)> {
        let since = sub.progress.as_ref()?.since;
        let get = Some((Priority::Progress, since, true, Step::Get));
        let verdict = sub.progress_verdict();
        if lane.unsure || sub.outdated || verdict.is_none() {
            return get;
        }
        let late = self.lists_are_late(sub, self.timing.slow_list);
        let seen = if late {
            sub.read.map(|read| read.answered)
        } else {
            sub.fresh_at
        };
        if verdict == Some(Verdict::Send) && within(seen, self.fresh(), now) {
            return Some((Priority::Progress, since, true, Step::Progress));
        }
        if late {
            return Some((Priority::Progress, since, true, Step::GetForEnd));
        }
        let soon = |challenge: &Challenge| challenge.period <= self.timing.fresh * 2 && !challenge.cancel.is_failing();
        let listed = sub.live.is_some() && self.challenges.get(&sub.challenge).is_some_and(soon);
        if listed { None } else { get }
    }

    /// Whether lists take so long that somebody may have cancelled since they were asked for: a read of one's own tells of
    /// a past that is nearer.
    fn lists_are_late(&self, sub: &Sub, window: Duration) -> bool {
        let late = |challenge: &Challenge| challenge.cancel.is_late_for(window);
        sub.live.is_some() && self.challenges.get(&sub.challenge).is_some_and(late)
    }

    /// How old a read may be when an end or progress follows it: a small budget needs its time.
    fn fresh(&self) -> Duration {
        self.timing.fresh + self.budget.interval() * 2
    }

    fn offers_of(&self, id: i64, challenge: &Challenge, by_list: bool) -> Vec<Offer> {
        let list = |priority, poll: &super::poll::Poll, purpose| {
            (!poll.busy).then_some(Offer {
                priority,
                since: poll.due,
                ready: poll.due,
                what: What::List(id, purpose),
            })
        };
        let mut offers = Vec::new();
        if self.subs.values().any(|sub| sub.challenge == id && sub.live.is_some()) {
            offers.extend(list(Priority::CancelList, &challenge.cancel, Purpose::Cancel));
        }
        if by_list {
            offers.extend(list(Priority::Acceptance, &challenge.accept, Purpose::Accept));
        }
        if challenge.sweep.is_some() {
            offers.extend(list(Priority::Sweep, &challenge.submitted, Purpose::SweepSubmitted));
            offers.extend(list(Priority::Sweep, &challenge.resuming, Purpose::SweepResuming));
            if !challenge.look.poll.busy {
                offers.push(Offer {
                    priority: Priority::Sweep,
                    since: challenge.look.poll.due,
                    ready: challenge.look.poll.due,
                    what: What::Look(id),
                });
            }
        }
        offers
    }

    /// Marks a request as sent.
    fn start(&mut self, what: &What, now: &Now) -> Option<Request> {
        match what {
            What::Sub(key, step) => self.start_sub(key, *step),
            What::List(id, purpose) => {
                let after = self.list_after(*id, *purpose, now.wall)?;
                self.challenges.get_mut(id)?.poll(*purpose).busy = true;
                Some(Request::List {
                    challenge: *id,
                    purpose: *purpose,
                    after,
                })
            }
            What::Look(id) => {
                let look = &mut self.challenges.get_mut(id)?.look;
                let request = look.request(*id)?;
                look.poll.busy = true;
                Some(request)
            }
        }
    }

    fn start_sub(&mut self, key: &Key, step: Step) -> Option<Request> {
        let sub = self.subs.get_mut(key)?;
        sub.read_for_partial = step == Step::GetForPartial;
        let subject = Subject {
            key: key.clone(),
            challenge: sub.challenge,
            pk: sub.pk,
            attempt: sub.run.attempt,
        };
        let request = match step {
            Step::Get | Step::GetForEnd | Step::GetForPartial => Request::Get(subject),
            Step::Image => Request::Image(subject, sub.view.row.as_ref()?.input_file.clone()?),
            Step::Progress => {
                let progress = sub.progress.as_ref()?.what;
                let named = sub.view.row.as_ref().is_some_and(|row| row.names(&sub.run.job));
                Request::Progress(subject, progress, (!named).then(|| sub.run.job.clone()))
            }
            Step::Partial => Request::Partial(subject, sub.partial.as_ref()?.what.clone()),
            Step::End => {
                let (outcome, payload) = sub.end.as_ref()?.what.clone();
                Request::Final(subject, outcome, payload)
            }
        };
        let busy = match step {
            Step::GetForEnd | Step::GetForPartial => Busy::ReadForEnd,
            _ if request.is_write() => Busy::Write,
            _ => Busy::Read,
        };
        self.lanes.entry(sub.pk).or_default().busy = Some(busy);
        Some(request)
    }

    /// From when on a list reaches: never the whole table, which is costly for the server.
    fn list_after(&self, id: i64, purpose: Purpose, wall: Timestamp) -> Option<Timestamp> {
        match purpose {
            Purpose::Cancel => {
                let live = self
                    .subs
                    .values()
                    .filter(|sub| sub.challenge == id && sub.live.is_some());
                let first = live.filter_map(Sub::submitted_at).min()?;
                Some(back(first, SignedDuration::from_secs(1)))
            }
            Purpose::Accept => Some(back(wall, ACCEPT_REACH)),
            Purpose::SweepSubmitted | Purpose::SweepResuming => {
                let (_, since) = self.challenges.get(&id)?.sweep?;
                Some(back(since, SWEEP_REACH))
            }
        }
    }
}

/// Earlier, or as it is at the beginning of time.
fn back(at: Timestamp, by: SignedDuration) -> Timestamp {
    at.checked_sub(by).unwrap_or(at)
}

fn within(answered: Option<Duration>, limit: Duration, now: &Now) -> bool {
    answered.is_some_and(|at| now.at.saturating_sub(at) <= limit)
}

impl Progress {
    /// The status it leads to.
    pub(super) fn status(self) -> crate::services::evalai::status::Status {
        match self {
            Self::Queued => crate::services::evalai::status::Status::Queued,
            Self::Running => crate::services::evalai::status::Status::Running,
        }
    }
}
