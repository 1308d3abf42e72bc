//! Which request is next: what is due, what may be sent, what comes first.
//!
//! Owned by `queue`. Pure.

use std::collections::BTreeMap;
use std::time::Duration;

use jiff::Timestamp;

use super::poll::{Challenge, Poll};
use super::purse::{Price, Rank};
use super::sub::{Sub, Write};
use super::{Busy, Lane, MAX_IN_FLIGHT, Next, Now, Queue, Ticket};
use crate::services::evalai::request::{Purpose, Request, SubmissionRef};
use crate::services::evalai::status::{Outcome, Progress, Status};
use crate::services::evalai::types::Key;

/// More submissions than these that wait for acceptance are asked for by one list.
const ASKED_ONE_BY_ONE: usize = 5;
/// More live submissions than these that one list holds are read again by that list.
const READ_ONE_BY_ONE: usize = 5;
/// After so long a question whether a submission may run comes before ends.
const OVERDUE: Duration = Duration::from_mins(1);
/// While writes are not allowed they are checked again so often: no event reports that they are.
const RECHECK: Duration = Duration::from_secs(1);

/// First comes first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Priority {
    /// Not of the API.
    Free,
    /// A write whose read has just been answered: it would be worth nothing a moment later.
    Write,
    /// A question that ends have kept waiting: nothing can start before its answer.
    Overdue,
    End,
    CancelList,
    Acceptance,
    Sweep,
    /// The next request about a challenge's queue.
    Inbox,
    Progress,
    /// An end that EvalAI knows already, or refused several times.
    Cancelled,
    /// What is left.
    Rest,
}

#[derive(Clone, Copy, Debug)]
enum What<'a> {
    Sub(&'a Key, Step),
    List(i64, Purpose),
    Check(i64),
    Inbox(&'a str),
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
    priority: Priority,
    /// Of an end: when it came to be.
    ended: Option<Timestamp>,
    since: Duration,
    ready: Duration,
    what: What<'a>,
}

impl Offer<'_> {
    /// Less comes first.
    fn rank(&self) -> Rank {
        (self.priority, self.ended, self.since)
    }
}

impl Queue {
    /// The next request, and marks it as sent. Without `may_write` every write is kept back.
    pub fn next(&mut self, now: Now, may_write: bool) -> Next {
        self.open_writes(&now);
        let (due, later): (Vec<_>, Vec<_>) = self
            .offers(&now, may_write)
            .into_iter()
            .partition(|offer| offer.ready <= now.at);
        let best = due.iter().min_by_key(|offer| offer.rank());
        // Writes wait until the budget has two requests left; the list of the runs that are to stop goes in between.
        let list = due
            .iter()
            .filter(|offer| offer.priority == Priority::CancelList)
            .min_by_key(|offer| offer.rank());
        let chosen = [best, list].into_iter().flatten();
        let (now_affordable, not_yet): (Vec<_>, Vec<_>) = chosen
            .map(|offer| (self.affordable_at(&now, offer), offer))
            .partition(|(at, _)| *at <= now.at);
        self.claim(&now, not_yet.first().map(|(_, offer)| *offer));
        let Some((_, best)) = now_affordable.first() else {
            let waits = later
                .iter()
                .map(|offer| offer.ready)
                .chain(not_yet.iter().map(|(at, _)| *at));
            let opens = (!self.open).then_some(self.not_before);
            return Next::Wait(waits.chain((!may_write).then(|| now.at + RECHECK)).chain(opens).min());
        };
        let mut leave_by = None;
        let started = match best.what {
            What::Sub(key, step) => {
                let key = key.clone();
                leave_by = self.leave_by(&key, step);
                self.start_sub(&key, step)
            }
            What::List(id, purpose) => self.start_list(id, purpose, &now),
            What::Check(id) => self.start_check(id),
            What::Inbox(name) => {
                let name = name.to_owned();
                self.inboxes.start(&name, now.at)
            }
        };
        match started {
            Some(request) => {
                if request.counts() {
                    self.share.take(now.at);
                }
                Next::Send(Ticket {
                    request,
                    requested: now.at,
                    leave_by,
                })
            }
            None => Next::Wait(Some(now.at + RECHECK)),
        }
    }

    /// When the budget allows it, and the token is not refused.
    fn affordable_at(&self, now: &Now, offer: &Offer<'_>) -> Duration {
        if offer.priority == Priority::Free {
            return now.at;
        }
        let token = self.token_refused.as_ref().map_or(now.at, |(_, until)| *until);
        self.share.ready_at(self.price(offer), now.at).max(token)
    }

    /// What it takes: every read for a write keeps one request back for the write that follows it.
    fn price(&self, offer: &Offer<'_>) -> Price {
        let is_write = offer.priority == Priority::Write;
        let count = match offer.what {
            _ if is_write => 1,
            What::Sub(_, Step::GetForWrite) => self.reserved().saturating_add(2),
            _ => self.reserved().saturating_add(1),
        };
        // A list that is due, and a write whose read is made, may use what the others leave.
        let is_urgent = is_write || offer.priority == Priority::CancelList;
        Price {
            rank: offer.rank(),
            count,
            keep: if is_urgent {
                0
            } else {
                self.share.budget(|budget| budget.kept())
            },
            is_after_reserved: !is_write,
        }
    }

    /// Writes that follow the reads on their way.
    fn reserved(&self) -> u32 {
        let reads = self.lanes.values().filter(|lane| lane.busy == Some(Busy::ReadForWrite));
        u32::try_from(reads.count()).unwrap_or(u32::MAX)
    }

    /// Tells the other queues of the same user what waits for the budget here. A refused token needs nothing of it.
    fn claim(&self, now: &Now, waits: Option<&Offer<'_>>) {
        let is_refused = self.token_refused.as_ref().is_some_and(|(_, until)| *until > now.at);
        let waits = waits.filter(|_| !is_refused).map(|offer| {
            let price = self.price(offer);
            (price.rank, price.count)
        });
        self.share.claim(self.reserved(), waits);
    }

    fn offers(&self, now: &Now, may_write: bool) -> Vec<Offer<'_>> {
        let (asked, live) = (self.asked_by_list(), self.live_by_list());
        let in_flight = self.lanes.values().filter(|lane| lane.busy.is_some()).count();
        let mut offers = Vec::new();
        if in_flight < MAX_IN_FLIGHT {
            let subs = self.subs.iter().filter_map(|(key, sub)| {
                let is_listed = |list| live.contains_key(&(sub.challenge, list));
                let terms = Terms {
                    may_write,
                    acceptance: match asked.contains_key(&sub.challenge) {
                        true if self.fails_to_list(sub.challenge) => AskedBy::FailingList,
                        true => AskedBy::List,
                        false => AskedBy::Itself,
                    },
                    live_by_list: list_of_live(sub).is_some_and(is_listed) || self.is_swept(sub),
                };
                self.offer_of(key, sub, now, terms)
            });
            offers.extend(subs);
        }
        for (id, challenge) in &self.challenges {
            offers.extend(self.offers_of(*id, challenge, asked.get(id).copied(), now));
        }
        let lists = live.keys().filter_map(|(id, purpose)| {
            let challenge = self.challenges.get(id)?;
            offer_of_list(Priority::Sweep, challenge, *id, *purpose)
        });
        offers.extend(lists);
        // Only a leader makes objects of messages.
        if may_write {
            offers.extend(self.inboxes.offers(now.at).map(|(name, due)| Offer {
                priority: Priority::Inbox,
                ended: None,
                since: due,
                ready: due,
                what: What::Inbox(name),
            }));
        }
        offers
    }

    /// Whether the sweep's lists hold it, going by its last row.
    fn is_swept(&self, sub: &Sub) -> bool {
        let row = sub.view.row.as_ref();
        row.is_some_and(|row| matches!(row.status, Status::Submitted | Status::Resuming))
            && self.challenges.get(&sub.challenge).is_some_and(|c| c.sweep.is_some())
    }

    /// Challenges with so many waiting submissions that one list is asked for all, and since when the first of them waits.
    fn asked_by_list(&self) -> BTreeMap<i64, Duration> {
        let mut counts = BTreeMap::new();
        for sub in self.subs.values() {
            if let Some(asked) = sub.asked.as_ref().filter(|asked| !asked.listed) {
                let (count, since) = counts.entry(sub.challenge).or_insert((0, asked.since));
                (*count, *since) = (*count + 1, asked.since.min(*since));
            }
        }
        counts.retain(|_, (count, _)| *count > ASKED_ONE_BY_ONE);
        counts.into_iter().map(|(id, (_, since))| (id, since)).collect()
    }

    /// Whether the list of those that wait for acceptance has failed too often to wait for it.
    fn fails_to_list(&self, challenge: i64) -> bool {
        let known = self.challenges.get(&challenge);
        known
            .and_then(|known| known.lists.get(&Purpose::Accept))
            .is_some_and(Poll::fails_for_long)
    }

    /// Lists of live submissions that hold so many that one request is made for all.
    fn live_by_list(&self) -> BTreeMap<(i64, Purpose), usize> {
        let mut counts = BTreeMap::new();
        for sub in self.subs.values() {
            if let Some(list) = list_of_live(sub) {
                *counts.entry((sub.challenge, list)).or_insert(0) += 1;
            }
        }
        counts.retain(|_, count| *count > READ_ONE_BY_ONE);
        counts
    }

    fn offer_of<'a>(&self, key: &'a Key, sub: &Sub, now: &Now, terms: Terms) -> Option<Offer<'a>> {
        let idle = Lane::default();
        let lane = self.lanes.get(&sub.pk).unwrap_or(&idle);
        if lane.busy.is_some() {
            return None;
        }
        let (priority, since, write, step) = self.step_of(sub, lane, now, terms)?;
        let again = if step == Step::Image {
            sub.image_at
        } else {
            sub.retry_at
        };
        let pause = again.max(lane.hold_until);
        let is_end = matches!(priority, Priority::End | Priority::Cancelled);
        Some(Offer {
            priority,
            ended: sub.end_since().filter(|_| is_end),
            since,
            ready: if write { pause.max(self.not_before) } else { pause },
            what: What::Sub(key, step),
        })
    }

    /// What a submission wants first: priority, since when, whether it leads to a write, and the request.
    fn step_of(&self, sub: &Sub, lane: &Lane, now: &Now, terms: Terms) -> Option<(Priority, Duration, bool, Step)> {
        let write = if terms.may_write {
            self.step_to_write(sub, lane, now)
        } else {
            None
        };
        if write.is_some_and(|(priority, ..)| priority != Priority::Rest) {
            return write;
        }
        if let Some(asked) = &sub.asked {
            let priority = match terms.acceptance {
                AskedBy::List if !asked.listed => None,
                // One row that EvalAI breaks down over must not keep all others from being asked for. Ends go first: EvalAI may as
                // well be away.
                AskedBy::FailingList if !asked.listed => Some(Priority::Acceptance),
                _ => Some(acceptance(asked.since, now)),
            };
            return priority.map(|priority| (priority, asked.since, false, Step::Get));
        }
        let refresh = self.refresh_of(sub, now, terms);
        // A file that is not there must not keep its submission from being read.
        if sub.wants_image() && (sub.image_at <= now.at || refresh.is_none()) {
            return Some((Priority::Free, now.at, false, Step::Image));
        }
        write.or(refresh)
    }

    /// A live submission is read again now and then.
    fn refresh_of(&self, sub: &Sub, now: &Now, terms: Terms) -> Option<(Priority, Duration, bool, Step)> {
        // One that its list has missed has another status by now.
        let refresh = self.timing.refresh * if terms.live_by_list { 2 } else { 1 };
        let due = sub.read.unwrap_or_default() + refresh;
        let stale = sub.read.is_none() || sub.outdated || due <= now.at;
        (sub.live.is_some() && stale).then_some((Priority::Rest, due, false, Step::Get))
    }

    /// What the next write needs: a read, then at once the write, if the read allows it.
    fn step_to_write(&self, sub: &Sub, lane: &Lane, now: &Now) -> Option<(Priority, Duration, bool, Step)> {
        let (write, since) = sub.next_write()?;
        let is_checked = lane
            .checked
            .is_some_and(|at| now.at <= at + self.fresh(sub, lane, write));
        if is_checked && sub.may_write(write) {
            return Some((Priority::Write, since, true, Step::Write(write)));
        }
        let is_cancel = sub.end.as_ref().is_some_and(|end| end.what.0 == Outcome::Cancelled);
        let priority = match write {
            // Ends that EvalAI breaks down over must not keep it from being asked for cancellations.
            Write::End if is_cancel || sub.write_failures > 1 => Priority::Cancelled,
            Write::End => Priority::End,
            Write::Progress => Priority::Progress,
            Write::Partial => Priority::Rest,
        };
        Some((priority, since, true, Step::GetForWrite))
    }

    /// How old the read of a write may be. A run that just begins is cancelled more often than any other, and `running` is little to lose.
    fn fresh(&self, sub: &Sub, lane: &Lane, write: Write) -> Duration {
        let is_running = sub
            .progress
            .as_ref()
            .is_some_and(|wanted| wanted.what == Progress::Running);
        if write == Write::Progress && is_running && !lane.reread {
            self.timing.fresh_running
        } else {
            self.timing.fresh
        }
    }

    /// When the read of a write that is about to be sent gets too old.
    fn leave_by(&self, key: &Key, step: Step) -> Option<Duration> {
        let Step::Write(write) = step else { return None };
        let sub = self.subs.get(key)?;
        let lane = self.lanes.get(&sub.pk)?;
        Some(lane.checked? + self.fresh(sub, lane, write))
    }

    fn offers_of(&self, id: i64, challenge: &Challenge, asked: Option<Duration>, now: &Now) -> Vec<Offer<'static>> {
        let list = |priority, purpose| offer_of_list(priority, challenge, id, purpose);
        let mut offers = Vec::new();
        if self.subs.values().any(|sub| sub.challenge == id && sub.live.is_some()) {
            offers.extend(list(Priority::CancelList, Purpose::Cancel));
        }
        if let Some(since) = asked {
            offers.extend(list(acceptance(since, now), Purpose::Accept));
        }
        if challenge.sweep.is_some() {
            offers.extend(list(Priority::Sweep, Purpose::SweepSubmitted));
            offers.extend(list(Priority::Sweep, Purpose::SweepResuming));
            if !challenge.check.poll.busy {
                offers.push(Offer {
                    priority: Priority::Sweep,
                    ended: None,
                    since: challenge.check.poll.due,
                    ready: challenge.check.poll.due,
                    what: What::Check(id),
                });
            }
        }
        offers
    }

    fn start_list(&mut self, challenge: i64, purpose: Purpose, now: &Now) -> Option<Request> {
        let after = self.list_after(challenge, purpose, now.wall)?;
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

    fn start_sub(&mut self, key: &Key, step: Step) -> Option<Request> {
        let sub = self.subs.get_mut(key)?;
        let subject = SubmissionRef {
            key: key.clone(),
            challenge: sub.challenge,
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
            Step::Write(Write::Partial) => Request::Partial(subject, sub.partial.as_ref()?.what.clone()),
            Step::Write(Write::End) => Request::Final(subject, sub.outcome()?, sub.end.as_ref()?.what.1.clone()),
        };
        let lane = self.lanes.entry(sub.pk).or_default();
        let was_checked = lane.checked.take().is_some();
        lane.reread = step == Step::GetForWrite && (was_checked || lane.reread);
        lane.busy = Some(match step {
            Step::GetForWrite => Busy::ReadForWrite,
            _ if request.is_write() => Busy::Write,
            _ => Busy::Read,
        });
        Some(request)
    }
}

/// How EvalAI is asked whether a submission may run.
#[derive(Clone, Copy)]
enum AskedBy {
    /// By a request of its own.
    Itself,
    /// With all others of its challenge.
    List,
    /// The same, but that list fails, and goes on failing.
    FailingList,
}

/// What holds for the next request of a submission.
#[derive(Clone, Copy)]
struct Terms {
    /// Writes are allowed.
    may_write: bool,
    acceptance: AskedBy,
    /// A list is asked whether it was ended in a way that changes no status.
    live_by_list: bool,
}

/// The priority of a question that waits since then.
fn acceptance(since: Duration, now: &Now) -> Priority {
    if now.at.saturating_sub(since) < OVERDUE {
        Priority::Acceptance
    } else {
        Priority::Overdue
    }
}

/// The list that holds a live submission, going by its last row.
pub(super) fn list_of_live(sub: &Sub) -> Option<Purpose> {
    let row = sub.view.row.as_ref().filter(|_| sub.live.is_some())?;
    Purpose::of_live(row.status)
}

fn offer_of_list(priority: Priority, challenge: &Challenge, id: i64, purpose: Purpose) -> Option<Offer<'static>> {
    let poll = challenge.lists.get(&purpose).copied().unwrap_or_default();
    (!poll.busy).then_some(Offer {
        priority,
        ended: None,
        since: poll.due,
        ready: poll.due,
        what: What::List(id, purpose),
    })
}

impl Progress {
    /// The status it leads to.
    pub(super) fn status(self) -> Status {
        match self {
            Self::Queued => Status::Queued,
            Self::Running => Status::Running,
        }
    }
}
