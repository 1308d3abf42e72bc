//! Which request is next: one order of all that is due.
//!
//! Owned by `queue`. Pure.

use std::time::Duration;

use jiff::Timestamp;

use super::poll::{Challenge, Poll};
use super::sub::{Sub, Write};
use super::{Busy, Lane, MAX_IN_FLIGHT, Next, Now, Queue, Ticket};
use crate::request::{Purpose, Request, SubmissionRef};
use crate::types::Key;

/// Age at which a question goes before ends.
const LATE: Duration = Duration::from_mins(1);
/// Reads of live submissions take one request in so many.
const REFRESH_SHARE: u32 = 2;
/// While writes are not allowed they are checked again so often: no event reports that they are.
const RECHECK: Duration = Duration::from_secs(1);

/// A payload is read at most so long before the budget allows its write.
const AHEAD: Duration = Duration::from_secs(10);

/// The order of all requests. What is due and comes first is sent next; all that comes after it waits for the budget.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Class {
    /// Not of the API.
    Free,
    /// A write whose read has just been answered: that read is worth nothing a moment later.
    Write,
    /// The list of cancelled submissions. One request in each of its periods is its own.
    Cancelled,
    /// A question that ends have kept waiting: nothing can start before its answer.
    LateQuestion,
    /// The oldest end first.
    End,
    /// Which submissions ask to run, whether one may, and what a challenge's leaderboards and queue hold.
    Question,
    Progress,
    /// Partial results, and reads of what runs.
    Rest,
}

impl Class {
    /// Place of the read that a write follows.
    fn of(write: Write) -> Self {
        match write {
            Write::End => Self::End,
            Write::Progress => Self::Progress,
            Write::Partial => Self::Rest,
        }
    }
}

/// Less comes first: whether it has failed twice, its class, when its end came to be, and since when it is due.
type Rank = (bool, Class, Option<Timestamp>, Duration);

/// A failing list of cancelled submissions keeps its place: it waits by itself, and after an outage runs are to stop before ends are
/// published.
fn rank(class: Class, failures: u32, ended: Option<Timestamp>, since: Duration) -> Rank {
    (failures > 1 && class > Class::Cancelled, class, ended, since)
}

fn question(since: Duration, now: &Now) -> Class {
    if now.at.saturating_sub(since) < LATE {
        Class::Question
    } else {
        Class::LateQuestion
    }
}

#[derive(Clone, Copy, Debug)]
enum What<'a> {
    Sub(&'a Key, Step),
    /// Not a request: what the next write of a submission is sent with.
    Payload(&'a Key),
    List(i64, Purpose),
    Check(i64),
    /// A request that others wait for.
    Passing,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Step {
    Get,
    /// A read that is worth nothing without the write that follows it.
    GetForWrite,
    Image,
    Write(Write),
}

/// A request that is due at `ready`.
#[derive(Clone, Copy, Debug)]
struct Offer<'a> {
    rank: Rank,
    ready: Duration,
    what: What<'a>,
}

impl Queue {
    /// The next request, and marks it as sent. Without `may_write` every write is kept back.
    pub fn next(&mut self, now: Now, may_write: bool) -> Next {
        self.open_writes(&now);
        self.tidy_payloads(&now);
        let (due, later): (Vec<_>, Vec<_>) = self
            .offers(&now, may_write)
            .into_iter()
            .partition(|offer| offer.ready <= now.at);
        let best = due.into_iter().min_by_key(|offer| offer.rank);
        let affordable = best.map(|best| match best.what {
            What::Payload(_) => self.affordable_at(&now, best.rank).saturating_sub(AHEAD),
            _ => self.affordable_at(&now, best.rank),
        });
        let Some(best) = best.filter(|_| affordable <= Some(now.at)) else {
            let opens = (!self.open).then_some(self.not_before);
            let again = (!may_write).then(|| now.at + RECHECK);
            let waits = later.iter().map(|offer| offer.ready).chain(affordable);
            return Next::Wait(waits.chain(again).chain(opens).min());
        };
        let mut number = None;
        let started = match best.what {
            What::Sub(key, step) => {
                let key = key.clone();
                self.start_sub(&key, step)
            }
            What::List(id, purpose) => self.start_list(id, purpose).map(|list| (list, None)),
            What::Check(id) => self.start_check(id).map(|check| (check, None)),
            What::Payload(key) => {
                let key = key.clone();
                return self.start_payload(&key).unwrap_or(Next::Wait(Some(now.at + RECHECK)));
            }
            What::Passing => self.passing.start(now.at).map(|(started, other)| {
                number = Some(started);
                (other, None)
            }),
        };
        let Some((request, leave_by)) = started else {
            return Next::Wait(Some(now.at + RECHECK));
        };
        if request.counts() {
            self.share.budget(|budget| budget.take(now.at));
        }
        Next::Send(Ticket {
            request,
            requested: now.at,
            leave_by,
            number,
        })
    }

    /// When the budget allows a request, and the token is not refused. Each class leaves requests for those before it, so that the order holds
    /// between the queues of one user too: all but writes leave one for each write that follows a read on its way. Only writes and lists
    /// of cancelled submissions use what is kept of each minute.
    fn affordable_at(&self, now: &Now, (has_failed, class, ..): Rank) -> Duration {
        let reads = self.lanes.values().filter(|lane| lane.busy == Some(Busy::ReadForWrite));
        let reserved = u32::try_from(reads.count()).unwrap_or(u32::MAX);
        let token = self.token_refused.as_ref().map_or(now.at, |(_, until)| *until);
        self.share.budget(|budget| {
            let (count, keep) = match class {
                Class::Free => return now.at,
                Class::Write => (1, 0),
                Class::Cancelled => (reserved.saturating_add(1), 0),
                Class::LateQuestion | Class::End | Class::Question if !has_failed => {
                    (reserved.saturating_add(2), budget.kept())
                }
                _ => (reserved.saturating_add(3), budget.kept()),
            };
            budget.ready_at(now.at, count, keep).max(token)
        })
    }

    fn offers(&self, now: &Now, may_write: bool) -> Vec<Offer<'_>> {
        let mut offers = Vec::new();
        let in_flight = self.lanes.values().filter(|lane| lane.busy.is_some()).count();
        if in_flight < MAX_IN_FLIGHT {
            let refresh = self.refresh();
            for (key, sub) in &self.subs {
                offers.extend(self.offers_of(key, sub, now, may_write, refresh));
            }
        }
        for (id, challenge) in &self.challenges {
            offers.extend(self.offers_of_challenge(*id, challenge, now));
        }
        // Only a leader makes objects of messages.
        let passing = self.passing.next(now.at).filter(|_| may_write);
        offers.extend(passing.map(|(since, ready)| Offer {
            rank: rank(question(since, now), 0, None, since),
            ready,
            what: What::Passing,
        }));
        offers
    }

    /// Time after which a live submission is read again.
    fn refresh(&self) -> Duration {
        let live = self.subs.values().filter(|sub| sub.live.is_some()).count();
        let live = u32::try_from(live).unwrap_or(u32::MAX);
        let interval = self.share.budget(|budget| budget.interval());
        self.timing
            .refresh
            .max(interval.saturating_mul(live.saturating_mul(REFRESH_SHARE)))
    }

    /// Requests that a submission waits for. One read serves all that wants one, at the first place of these.
    fn offers_of<'a>(
        &self,
        key: &'a Key,
        sub: &Sub,
        now: &Now,
        may_write: bool,
        refresh: Duration,
    ) -> impl Iterator<Item = Offer<'a>> + use<'a> {
        let idle = Lane::default();
        let lane = self.lanes.get(&sub.pk).unwrap_or(&idle);
        let failures = sub.failures.max(sub.write_failures);
        let offer_of = |class, since, ready: Duration, what| Offer {
            rank: rank(class, failures, sub.end_since().filter(|_| class == Class::End), since),
            ready: ready.max(lane.hold_until),
            what,
        };
        let write = sub.next_write().filter(|_| may_write && now.at >= self.not_before);
        let lacks = write.is_some() && self.lacks_payload(key, sub);
        // As long as its payload may not be read, the row is read for other reasons alone.
        let free = if lacks {
            self.payload_free_at(key, now)
        } else {
            Some(now.at)
        };
        let later = write.zip(free.filter(|free| *free > now.at));
        let later = later.map(|((write, since), free)| offer_of(Class::of(write), since, free, What::Payload(key)));
        let write = write.filter(|_| free.is_some_and(|free| free <= now.at));
        let is_checked = lane.checked.is_some_and(|at| now.at <= at + self.timing.fresh);
        let next = match write {
            Some((write, since)) if !lacks && is_checked && sub.may_write(write) => {
                let what = What::Sub(key, Step::Write(write));
                Some(offer_of(Class::Write, since, sub.retry_at, what))
            }
            _ => {
                let what = match write {
                    Some(_) if lacks => What::Payload(key),
                    Some(_) => What::Sub(key, Step::GetForWrite),
                    None => What::Sub(key, Step::Get),
                };
                let first = self.wants(sub, write, now, refresh);
                first.map(|(class, since, due)| offer_of(class, since, due.max(sub.retry_at), what))
            }
        };
        let image = sub.wants_image() && sub.asked.is_none();
        let image = image.then(|| offer_of(Class::Free, now.at, sub.image_at, What::Sub(key, Step::Image)));
        let is_free = lane.busy.is_none();
        let offers = [next, later, image].into_iter().flatten();
        offers.filter(move |_| is_free)
    }

    /// Why the row of a submission is to be read, since when, and from when on: the first reason in the order.
    fn wants(
        &self,
        sub: &Sub,
        write: Option<(Write, Duration)>,
        now: &Now,
        refresh: Duration,
    ) -> Option<(Class, Duration, Duration)> {
        let known = sub.read.filter(|_| !sub.outdated);
        let read = known.map_or(Duration::ZERO, |read| read + refresh);
        // A list that is on its way may answer it.
        let challenge = self.challenges.get(&sub.target.challenge);
        let sweep = challenge.and_then(|challenge| challenge.lists.get(&Purpose::SweepSubmitted));
        let asked = sub.asked.filter(|_| !sweep.is_some_and(|sweep| sweep.busy));
        let wants = [
            write.map(|(write, since)| (Class::of(write), since, now.at)),
            asked.map(|since| (question(since, now), since, now.at)),
            sub.live.map(|_| (Class::Rest, read, read)),
        ];
        wants.into_iter().flatten().min()
    }

    fn offers_of_challenge(&self, id: i64, challenge: &Challenge, now: &Now) -> Vec<Offer<'static>> {
        let offer = |poll: Poll, class, what| {
            (!poll.busy).then_some(Offer {
                rank: rank(class, poll.failures, None, poll.due),
                ready: poll.due,
                what,
            })
        };
        let list = |purpose| challenge.lists.get(&purpose).copied().unwrap_or_default();
        let is_live = self
            .subs
            .values()
            .any(|sub| sub.target.challenge == id && sub.live.is_some());
        let cancelled = is_live.then(|| {
            let purpose = Purpose::Cancel;
            offer(list(purpose), Class::Cancelled, What::List(id, purpose))
        });
        let sweeps = [Purpose::SweepSubmitted, Purpose::SweepResuming].map(|purpose| {
            let poll = list(purpose);
            offer(poll, question(poll.due, now), What::List(id, purpose))
        });
        let check = challenge.check.poll;
        let check = offer(check, question(check.due, now), What::Check(id));
        let served = sweeps.into_iter().chain([check]);
        let served = served.filter(|_| challenge.sweep.is_some());
        cancelled.into_iter().chain(served).flatten().collect()
    }

    fn start_list(&mut self, challenge: i64, purpose: Purpose) -> Option<Request> {
        let after = self.list_after(challenge, purpose)?;
        self.challenges.get_mut(&challenge)?.poll(purpose).busy = true;
        Some(Request::List {
            challenge,
            purpose,
            after,
        })
    }

    fn start_check(&mut self, challenge: i64) -> Option<Request> {
        let check = &mut self.challenges.get_mut(&challenge)?.check;
        let request = check.request(challenge)?;
        check.poll.busy = true;
        Some(request)
    }

    /// A request about a submission, and by when it has to leave.
    fn start_sub(&mut self, key: &Key, step: Step) -> Option<(Request, Option<Duration>)> {
        let sub = self.subs.get(key)?;
        let subject = SubmissionRef {
            key: key.clone(),
            challenge: sub.target.challenge,
            pk: sub.pk,
            attempt: sub.run.attempt,
            log: sub.run.log.clone(),
        };
        let request = match step {
            Step::Get | Step::GetForWrite => Request::Get(subject),
            Step::Image => Request::Image(subject, sub.view.row.as_ref()?.input_file.clone()?),
            Step::Write(Write::Progress) => {
                let progress = sub.progress.as_ref()?.what;
                let named = sub.view.row.as_ref().is_some_and(|row| row.names(&sub.run.job));
                Request::Progress(subject, progress, (!named).then(|| sub.run.job.clone()))
            }
            Step::Write(Write::Partial) => Request::Partial(subject, self.payload(key, &sub.partial.as_ref()?.what)?),
            Step::Write(Write::End) => {
                let payload = self.payload(key, &sub.end.as_ref()?.what.1)?;
                Request::Final(subject, sub.outcome()?, payload)
            }
        };
        let lane = self.lanes.entry(sub.pk).or_default();
        let checked = lane.checked.take().filter(|_| request.is_write());
        lane.busy = Some(match step {
            Step::GetForWrite => Busy::ReadForWrite,
            Step::Write(_) => Busy::Write,
            Step::Get | Step::Image => Busy::Read,
        });
        Some((request, checked.map(|at| at + self.timing.fresh)))
    }
}
