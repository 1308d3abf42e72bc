//! The challenges' queues in EvalAI's own account: when each is read, and what becomes of the message in hand.
//!
//! Owned by `queue`. Pure. One message of a queue is in hand at a time: received, its row read, handed to the controller, and deleted
//! once that has made its object. Whatever goes wrong before the deletion brings the message back after EvalAI's visibility of
//! 30 s. All queues of a token together have a share of its requests, so that ends, cancels and questions never wait for them.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use super::poll::pause;
use super::{Now, Queue};
use crate::backoff::Backoff;
use crate::services::evalai::answer::{About, Answer};
use crate::services::evalai::budget::Budget;
use crate::services::evalai::request::{Reply, Request};
use crate::services::evalai::row::{Received, Row};
use crate::services::evalai::types::{Arrival, Changed, InboxTrouble, Key, Origin, Settled};

/// The queues may use one in so many of a token's requests. A message takes three.
const SHARE: u32 = 3;
/// Waits before an empty queue is asked again. Three requests a minute at rest.
const IDLE: Backoff = Backoff::new(Duration::from_secs(5), Duration::from_secs(20));
/// After a message that stays in its queue: others are behind it, and it comes back by itself.
const LEFT: Duration = Duration::from_secs(5);
/// The controller has so long for a message; then it is taken for left.
const TAKEN_IN: Duration = Duration::from_mins(1);
/// EvalAI did not have a submission when its message came: a second message of it within so long shows that it is not there.
const MISSING: Duration = Duration::from_mins(10);
/// A queue that fails for so long is reported.
const FAILING: Duration = Duration::from_mins(5);

/// All queues of a token.
#[derive(Debug)]
pub(super) struct Inboxes {
    share: Budget,
    by_name: BTreeMap<String, Inbox>,
    /// What the controller is to take in.
    arrivals: Vec<(u64, Arrival)>,
    /// Of the last arrival.
    serial: u64,
}

#[derive(Debug)]
struct Inbox {
    /// Root of the server.
    server: String,
    hand: Hand,
    /// When the next request about it is due.
    due: Duration,
    /// Answers in a row without a message.
    empty: u32,
    /// Failures in a row, since when, and what EvalAI has answered.
    failures: u32,
    trouble: Option<(Duration, InboxTrouble)>,
    /// Submissions that EvalAI does not have, and since when.
    missing: BTreeMap<i64, Duration>,
}

/// The message in hand.
#[derive(Clone, Debug, PartialEq, Eq)]
enum Hand {
    /// There is none.
    Empty,
    /// A request is on its way.
    Busy(Box<Hand>),
    /// It is received, and the row of its submission is to be read.
    Unread {
        body: String,
        submission: i64,
        receipt: String,
    },
    /// The controller has it until then.
    Handed {
        serial: u64,
        receipt: String,
        until: Duration,
    },
    /// Its object exists, or it is of no use.
    Done { receipt: String },
}

/// The submission that a message names, as far as its row can be asked for. What else is wrong with it is the controller's.
fn submission_of(body: &serde_json::Value) -> Option<i64> {
    let id = body.get("submission_pk")?;
    let id = id.as_i64().or_else(|| id.as_str()?.parse().ok())?;
    (id > 0).then_some(id)
}

impl Inbox {
    fn new(server: &str, now: Duration) -> Self {
        Self {
            server: server.to_owned(),
            hand: Hand::Empty,
            due: now,
            empty: 0,
            failures: 0,
            trouble: None,
            missing: BTreeMap::new(),
        }
    }

    /// Nothing is in hand any more.
    fn let_go(&mut self, due: Duration) {
        (self.hand, self.due) = (Hand::Empty, due);
    }

    /// Notes that EvalAI does not have a submission. True if it was not asked for before.
    fn is_first_miss(&mut self, submission: i64, now: Duration) -> bool {
        self.missing.retain(|_, since| *since + MISSING > now);
        match self.missing.remove(&submission) {
            Some(_) => false,
            None => self.missing.insert(submission, now).is_none(),
        }
    }

    /// A request was answered. True if that ends a trouble that people have been shown.
    fn answered(&mut self, now: Duration) -> bool {
        self.failures = 0;
        let ended = self.trouble.take();
        ended.is_some_and(|(since, trouble)| is_shown(since, &trouble, now))
    }

    /// A request failed: the message comes back by itself. True if people are to be shown that from now on.
    fn failed(&mut self, now: Duration, is_refused: bool, why: String) -> bool {
        self.let_go(now + pause(self.failures));
        self.failures = self.failures.saturating_add(1);
        let since = self.trouble.as_ref().map_or(now, |(since, _)| *since);
        let before = self.trouble.replace((since, InboxTrouble { is_refused, why }));
        let is_news = before.as_ref() != self.trouble.as_ref();
        is_news || now.saturating_sub(since) >= FAILING
    }
}

fn is_shown(since: Duration, trouble: &InboxTrouble, now: Duration) -> bool {
    trouble.is_refused || now.saturating_sub(since) >= FAILING
}

impl Inboxes {
    pub(super) fn new(requests_per_minute: u32, now: Duration) -> Self {
        Self {
            share: Budget::new(share_of(requests_per_minute), now),
            by_name: BTreeMap::new(),
            arrivals: Vec::new(),
            serial: 0,
        }
    }

    /// From now on these are read, each on its server.
    pub(super) fn arrange(&mut self, wanted: &BTreeMap<String, String>, requests_per_minute: u32, now: Duration) {
        self.share.set_limit(share_of(requests_per_minute), now);
        self.by_name.retain(|name, _| wanted.contains_key(name));
        for (name, server) in wanted {
            self.by_name
                .entry(name.clone())
                .or_insert_with(|| Inbox::new(server, now));
        }
    }

    /// Each queue with something to ask, and when that is due.
    pub(super) fn offers(&self, now: Duration) -> impl Iterator<Item = (&str, Duration)> {
        let share = self.share.ready_at(now, 1, 0);
        self.by_name.iter().filter_map(move |(name, inbox)| {
            let due = match &inbox.hand {
                Hand::Busy(_) => return None,
                // It is never asked about, but given up then.
                Hand::Handed { until, .. } => return Some((name.as_str(), *until)),
                Hand::Empty | Hand::Unread { .. } | Hand::Done { .. } => inbox.due,
            };
            Some((name.as_str(), due.max(share)))
        })
    }

    /// The next request about a queue, marked as sent; none if there was only something to give up.
    pub(super) fn start(&mut self, name: &str, now: Duration) -> Option<Request> {
        let inbox = self.by_name.get_mut(name)?;
        let queue = name.to_owned();
        let request = match &inbox.hand {
            Hand::Busy(_) => return None,
            Hand::Handed { .. } => {
                tracing::warn!(
                    queue,
                    "a message of EvalAI was not taken in within a minute and comes back"
                );
                inbox.let_go(now + LEFT);
                return None;
            }
            Hand::Empty => Request::Receive(queue),
            Hand::Unread { submission, .. } => Request::MessageRow(queue, *submission),
            Hand::Done { receipt } => Request::DeleteMessage(queue, receipt.clone()),
        };
        let hand = std::mem::replace(&mut inbox.hand, Hand::Empty);
        inbox.hand = Hand::Busy(Box::new(hand));
        self.share.take(now);
        Some(request)
    }

    /// Takes an answer in. True if a Leaderboard shows something else from now on.
    fn answered(&mut self, name: &str, reply: Reply, now: Duration) -> bool {
        let Some(inbox) = self.by_name.get_mut(name) else {
            return false;
        };
        let hand = match std::mem::replace(&mut inbox.hand, Hand::Empty) {
            Hand::Busy(hand) => *hand,
            // It was taken out of the Leaderboards and put back meanwhile.
            other => {
                inbox.hand = other;
                return false;
            }
        };
        if is_of_token(&reply.answer()) {
            // The budget waits; then the same request is made.
            inbox.hand = hand;
            return false;
        }
        match (hand, reply) {
            (_, Reply::Message(Answer::Done(received))) => self.received(name, received, now),
            (
                Hand::Unread {
                    body,
                    receipt,
                    submission,
                },
                Reply::Row(answer),
            ) => {
                let is_missing = matches!(&answer, Answer::Refused(refusal) if refusal.about == About::Missing);
                if is_missing && inbox.is_first_miss(submission, now) {
                    // The message comes back.
                    inbox.let_go(now + LEFT);
                    return inbox.answered(now);
                }
                self.read(name, body, receipt, answer, now)
            }
            (Hand::Done { .. }, Reply::Written(Answer::Done(()))) => {
                inbox.empty = 0;
                inbox.let_go(now);
                inbox.answered(now)
            }
            (_, reply) => {
                let answer = reply.answer();
                let is_refused = matches!((&answer, &reply), (Answer::Refused(_), Reply::Message(_)));
                inbox.failed(now, is_refused, answer.error().unwrap_or_default())
            }
        }
    }

    fn received(&mut self, name: &str, received: Received, now: Duration) -> bool {
        let Some(inbox) = self.by_name.get_mut(name) else {
            return false;
        };
        let changed = inbox.answered(now);
        let (Some(receipt), false) = (received.receipt_handle, received.body.is_null()) else {
            inbox.empty = inbox.empty.saturating_add(1);
            inbox.let_go(now + IDLE.bound(inbox.empty));
            return changed;
        };
        let body = received.body.to_string();
        inbox.due = now;
        match submission_of(&received.body) {
            Some(submission) => {
                inbox.hand = Hand::Unread {
                    body,
                    submission,
                    receipt,
                }
            }
            None => self.hand_over(name, body, receipt, Origin::Hidden, now),
        }
        changed
    }

    fn read(&mut self, name: &str, body: String, receipt: String, answer: Answer<Row>, now: Duration) -> bool {
        let origin = match answer {
            Answer::Done(row) => row.wanted_at().map_or(Origin::Hidden, Origin::Wanted),
            Answer::Refused(refusal) if refusal.about == About::Missing => Origin::Missing,
            // A participant can give the row a phase of another challenge.
            Answer::Refused(refusal) if refusal.is_of_another_challenge() => Origin::Foreign,
            Answer::Refused(_) => Origin::Hidden,
            other => {
                let inbox = self.by_name.get_mut(name);
                let why = other.error().unwrap_or_default();
                return inbox.is_some_and(|inbox| inbox.failed(now, false, why));
            }
        };
        self.hand_over(name, body, receipt, origin, now);
        self.by_name.get_mut(name).is_some_and(|inbox| inbox.answered(now))
    }

    fn hand_over(&mut self, name: &str, body: String, receipt: String, origin: Origin, now: Duration) {
        let Some(inbox) = self.by_name.get_mut(name) else {
            return;
        };
        self.serial += 1;
        let (serial, until) = (self.serial, now + TAKEN_IN);
        inbox.hand = Hand::Handed { serial, receipt, until };
        let arrival = Arrival {
            server: inbox.server.clone(),
            queue: name.to_owned(),
            body,
            origin,
        };
        self.arrivals.push((serial, arrival));
    }

    /// The controller has decided on a message. What was given up meanwhile comes back.
    fn settle(&mut self, queue: &str, serial: u64, settled: Settled, now: Duration) {
        let Some(inbox) = self.by_name.get_mut(queue) else {
            return;
        };
        match &inbox.hand {
            Hand::Handed {
                serial: own, receipt, ..
            } if *own == serial => match settled {
                Settled::Delete => {
                    let receipt = receipt.clone();
                    (inbox.hand, inbox.due) = (Hand::Done { receipt }, now);
                }
                Settled::Leave => inbox.let_go(now + LEFT),
            },
            _ => {}
        }
    }
}

/// Requests a minute of a token's queues, out of all that it may make.
fn share_of(requests_per_minute: u32) -> u32 {
    (requests_per_minute / SHARE).max(2)
}

/// Whether an answer is about the token, whatever was asked.
fn is_of_token(answer: &Answer<()>) -> bool {
    match answer {
        Answer::Throttled(_) => true,
        Answer::Refused(refusal) => refusal.about == About::Token,
        _ => false,
    }
}

impl Queue {
    /// Reads the queues that the Leaderboards name, and no others.
    pub(super) fn arrange_inboxes(&mut self, now: &Now) {
        let named = self.served.values();
        let wanted = named.filter_map(|target| Some((target.inbox.clone()?, target.api_server.clone())));
        let wanted = wanted.collect();
        let limit = self.share.budget(|budget| budget.limit());
        self.inboxes.arrange(&wanted, limit, now.at);
    }

    /// Takes the answer about a queue in.
    pub(super) fn took_of_inbox(&mut self, name: &str, reply: Reply, now: &Now) {
        if self.inboxes.answered(name, reply, now.at) {
            let readers: BTreeSet<Changed> = self
                .served
                .iter()
                .filter(|(_, target)| target.inbox.as_deref() == Some(name))
                .map(|(key, _)| Changed::Leaderboard(key.clone()))
                .collect();
            self.changes.extend(readers);
        }
    }

    /// Messages to take in, each with the number that [`Queue::settle_message`] wants back.
    pub fn take_arrivals(&mut self) -> Vec<(u64, Arrival)> {
        std::mem::take(&mut self.inboxes.arrivals)
    }

    /// What becomes of a message.
    pub fn settle_message(&mut self, queue: &str, serial: u64, settled: Settled, now: Now) {
        self.inboxes.settle(queue, serial, settled, now.at);
    }

    /// Why the queue of a Leaderboard is not read; none while it is, or has failed for a short time only.
    pub fn inbox_trouble(&self, leaderboard: &Key, now: Now) -> Option<InboxTrouble> {
        let name = self.served.get(leaderboard)?.inbox.as_ref()?;
        let (since, trouble) = self.inboxes.by_name.get(name)?.trouble.as_ref()?;
        is_shown(*since, trouble, now.at).then(|| trouble.clone())
    }
}
