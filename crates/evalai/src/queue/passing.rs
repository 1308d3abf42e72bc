//! Requests that somebody else waits for: those about the challenges' queues in EvalAI's own account.
//!
//! Owned by `queue`. Pure. All of a token's have a third of its requests. A message takes three: it is received, the row of its submission is
//! read, and it is deleted.

use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

use tokio::sync::oneshot;

use super::{Now, Queue, Ticket};
use crate::answer::{About, Answer};
use crate::budget::Budget;
use crate::request::{Reply, Request};
use crate::types::{InboxTrouble, Key};

/// These requests are one in so many of a token's.
const SHARE: u32 = 3;
/// A queue that fails for so long is reported.
const FAILING: Duration = Duration::from_mins(5);

/// See the module's text.
#[derive(Debug)]
pub(super) struct Passing {
    share: Budget,
    /// Each with its number and since when it waits, the oldest first.
    waiting: VecDeque<(u64, Duration, Request)>,
    /// Number of the last one.
    last: u64,
    /// The waiters for answers, by the numbers of their requests.
    waiters: BTreeMap<u64, oneshot::Sender<Reply>>,
    /// Queues that cannot be received from, since when, and EvalAI's answer.
    troubles: BTreeMap<String, (Duration, InboxTrouble)>,
}

impl Passing {
    pub(super) fn new(requests_per_minute: u32, now: Duration) -> Self {
        Self {
            share: Budget::new(share_of(requests_per_minute), now),
            waiting: VecDeque::new(),
            last: 0,
            waiters: BTreeMap::new(),
            troubles: BTreeMap::new(),
        }
    }

    pub(super) fn set_limit(&mut self, requests_per_minute: u32, now: Duration) {
        self.share.set_limit(share_of(requests_per_minute), now);
    }

    /// Since when the next request waits, and when it may be sent.
    pub(super) fn next(&self, now: Duration) -> Option<(Duration, Duration)> {
        let (_, since, _) = self.waiting.front()?;
        Some((*since, self.share.ready_at(now, 1, 0)))
    }

    /// Takes the next request out, with its number.
    pub(super) fn start(&mut self, now: Duration) -> Option<(u64, Request)> {
        let (number, _, request) = self.waiting.pop_front()?;
        self.share.take(now);
        Some((number, request))
    }

    /// Notes whether a queue can be received from. True if people are shown something else from now on.
    fn received(&mut self, queue: &str, answer: &Answer<()>, now: Duration) -> bool {
        let is_refused = matches!(answer, Answer::Refused(_));
        let Some(why) = answer.error() else {
            let ended = self.troubles.remove(queue);
            return ended.is_some_and(|(since, trouble)| is_shown(since, &trouble, now));
        };
        let since = self.troubles.get(queue).map_or(now, |(since, _)| *since);
        let trouble = InboxTrouble { is_refused, why };
        let is_long = now.saturating_sub(since) >= FAILING;
        let before = self.troubles.insert(queue.to_owned(), (since, trouble.clone()));
        is_long || before.is_none_or(|(_, before)| before != trouble)
    }
}

fn is_shown(since: Duration, trouble: &InboxTrouble, now: Duration) -> bool {
    trouble.is_refused || now.saturating_sub(since) >= FAILING
}

fn share_of(requests_per_minute: u32) -> u32 {
    (requests_per_minute / SHARE).max(2)
}

impl Queue {
    /// Makes a request for another. No answer comes if the queue ends before.
    pub fn pass(&mut self, request: Request, now: Now) -> oneshot::Receiver<Reply> {
        let (waiter, answer) = oneshot::channel();
        let passing = &mut self.passing;
        passing.last += 1;
        passing.waiting.push_back((passing.last, now.at, request));
        passing.waiters.retain(|_, waiter| !waiter.is_closed());
        passing.waiters.insert(passing.last, waiter);
        answer
    }

    /// Gives no other an answer any more.
    pub fn pass_nothing(&mut self) {
        self.passing.waiters.clear();
    }

    /// Takes the answer to a request of another in. Where it is about the token, the budget waits, and the same request is made again.
    pub(super) fn passed(&mut self, number: u64, ticket: &Ticket, reply: Reply, now: &Now) {
        let answer = reply.answer();
        let is_of_token = matches!(&answer, Answer::Refused(refusal) if refusal.about == About::Token);
        if is_of_token || matches!(answer, Answer::Throttled(_)) {
            let again = (number, ticket.requested, ticket.request.clone());
            self.passing.waiting.push_front(again);
            return;
        }
        if let Request::Receive(name) = &ticket.request
            && self.passing.received(name, &answer, now.at)
        {
            self.wake_leaderboards(|target| target.inbox.as_ref() == Some(name));
        }
        if let Some(waiter) = self.passing.waiters.remove(&number) {
            // A waiter that is gone has no use for it.
            let _ = waiter.send(reply);
        }
    }

    /// Why the queue of a Leaderboard is not read; none while it is, or has failed for a short time only.
    pub fn inbox_trouble(&self, leaderboard: &Key, now: Now) -> Option<InboxTrouble> {
        let name = self.served.get(leaderboard)?.inbox.as_ref()?;
        let (since, trouble) = self.passing.troubles.get(name)?;
        is_shown(*since, trouble, now.at).then(|| trouble.clone())
    }
}
