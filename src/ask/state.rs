//! Which questions are due, and what came of them. Pure: no clock but the times given.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use tokio::time::Instant;

use super::question::{Answered, Ask, Failure, Lookup, Service};
use leaderboard_base::object_key::ObjectKey;
use leaderboard_base::spans::LogSpan;

/// How long a question is kept that nobody repeats.
pub(super) const KEPT: Duration = Duration::from_mins(10);

/// All objects of one kind of question.
pub(super) struct State<Q: Ask> {
    /// By UID.
    entries: HashMap<String, Entry<Q>>,
    /// Reads under way, also of objects that have been forgotten.
    under_way: HashMap<Service, usize>,
    reads: u64,
}

struct Entry<Q: Ask> {
    about: ObjectKey,
    question: Q,
    service: Service,
    log: LogSpan,
    /// Since when the present question has waited for its first answer; None: it has one.
    waits_since: Option<Instant>,
    /// When somebody last asked.
    wanted: Instant,
    /// When the question is to be sent; None: it is under way, or answered for good.
    due: Option<Instant>,
    /// The number of the read under way.
    read: Option<u64>,
    failures: u32,
    last: Option<Last<Q>>,
}

struct Last<Q: Ask> {
    question: Q,
    sent: Instant,
    result: Arc<Result<Q::Answer, Failure>>,
}

/// One read to be made.
pub(super) struct Work<Q: Ask> {
    pub about: ObjectKey,
    pub question: Q,
    pub service: Service,
    pub log: LogSpan,
    number: u64,
    sent: Instant,
}

impl<Q: Ask> Default for State<Q> {
    fn default() -> Self {
        Self {
            entries: HashMap::new(),
            under_way: HashMap::new(),
            reads: 0,
        }
    }
}

impl<Q: Ask> State<Q> {
    /// Notes a question. Returns whether something is due that was not.
    pub fn want(&mut self, about: &ObjectKey, question: Q, log: LogSpan, now: Instant) -> bool {
        let Some(entry) = self.entries.get_mut(&about.uid) else {
            let entry = Entry {
                about: about.clone(),
                service: question.service(),
                question,
                log,
                waits_since: Some(now),
                wanted: now,
                due: Some(now),
                read: None,
                failures: 0,
                last: None,
            };
            self.entries.insert(about.uid.clone(), entry);
            return true;
        };
        entry.wanted = now;
        if entry.question == question {
            return false;
        }
        entry.service = question.service();
        (entry.question, entry.log, entry.failures) = (question, log, 0);
        (entry.waits_since, entry.due) = (Some(now), Some(now));
        true
    }

    pub fn get(&self, uid: &str, now: Instant) -> Lookup<Q> {
        let Some(entry) = self.entries.get(uid) else {
            return Lookup::default();
        };
        Lookup {
            waited: entry.waits_since.map(|since| now.saturating_duration_since(since)),
            last: entry.last.as_ref().map(|last| Answered {
                question: last.question.clone(),
                sent_ago: now.saturating_duration_since(last.sent),
                result: Arc::clone(&last.result),
            }),
        }
    }

    pub fn forget(&mut self, uid: &str) {
        self.entries.remove(uid);
    }

    /// The read that has been due longest, of those whose service has room.
    pub fn next(&mut self, now: Instant) -> Option<Work<Q>> {
        self.entries
            .retain(|_, entry| entry.read.is_some() || now.saturating_duration_since(entry.wanted) < KEPT);
        if self.under_way.values().sum::<usize>() >= Q::AT_ONCE {
            return None;
        }
        let has_room = |entry: &Entry<Q>| {
            let reads = self.under_way.get(&entry.service);
            reads.is_none_or(|reads| *reads < Q::AT_ONCE_OF_A_SERVICE)
        };
        let due = self
            .entries
            .values_mut()
            .filter_map(|entry| Some((entry.due()?, entry)));
        let due = due.filter(|(at, entry)| *at <= now && has_room(entry));
        let (_, entry) = due.min_by_key(|(at, _)| *at)?;
        self.reads += 1;
        (entry.due, entry.read) = (None, Some(self.reads));
        *self.under_way.entry(entry.service.clone()).or_default() += 1;
        Some(Work {
            about: entry.about.clone(),
            question: entry.question.clone(),
            service: entry.service.clone(),
            log: entry.log.clone(),
            number: self.reads,
            sent: now,
        })
    }

    /// When a question becomes due. One that is due already waits for a place, which an answer frees.
    pub fn next_due(&self, now: Instant) -> Option<Instant> {
        let due = self.entries.values().filter_map(Entry::due);
        due.filter(|at| *at > now).min()
    }

    /// Takes an answer in. Returns whether its object is still there.
    pub fn done(&mut self, work: &Work<Q>, result: Result<Q::Answer, Failure>, now: Instant) -> bool {
        if let Some(reads) = self.under_way.get_mut(&work.service) {
            *reads -= 1;
            if *reads == 0 {
                self.under_way.remove(&work.service);
            }
        }
        let entry = self.entries.get_mut(&work.about.uid);
        let Some(entry) = entry.filter(|entry| entry.read == Some(work.number)) else {
            return false;
        };
        entry.read = None;
        // One that is due has come while this read was under way: this answer is none to it.
        if entry.due.is_none() {
            entry.failures = if result.is_ok() {
                0
            } else {
                entry.failures.saturating_add(1)
            };
            entry.due = entry.question.again(&result, entry.failures).map(|pause| now + pause);
            entry.waits_since = None;
        }
        entry.last = Some(Last {
            question: work.question.clone(),
            sent: work.sent,
            result: Arc::new(result),
        });
        true
    }
}

impl<Q: Ask> Entry<Q> {
    /// When it may be sent: never while a read is under way.
    fn due(&self) -> Option<Instant> {
        self.due.filter(|_| self.read.is_none())
    }
}
