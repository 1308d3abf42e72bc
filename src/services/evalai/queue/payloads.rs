//! The payload of the write that comes next: it is read before the row is, so that the write follows that read at once.
//!
//! Owned by `queue`. Pure. Agents decide how large texts are. So a queue holds one payload at a time, from before it is read until its
//! write is answered, and the hub bounds those of all queues.

use std::sync::Arc;
use std::time::Duration;

use tokio::sync::OwnedSemaphorePermit;

use super::choose::{Offer, What};
use super::poll::pause;
use super::sub::{Sub, Write};
use super::{Busy, Now, Queue};
use crate::services::evalai::payload::{check, for_split};
use crate::services::evalai::status::Outcome;
use crate::services::evalai::types::{Changed, Key, Outline, Payload, PayloadProblem, Target};

/// The share of a payload in the memory for all of them; dropped, it is free again.
pub type Place = Option<OwnedSemaphorePermit>;

/// The payload of one write.
#[derive(Debug)]
pub(super) struct Held {
    key: Key,
    of: Arc<Outline>,
    /// Its results name the split of this Leaderboard.
    target: Arc<Target>,
    /// None while it is being read.
    read: Option<(Arc<Payload>, Place)>,
}

impl Held {
    fn is_of(&self, key: &Key, sub: &Sub) -> bool {
        self.key == *key && sub.outline() == Some(&self.of) && sub.target == self.target
    }
}

impl Queue {
    /// Whether the next write of a submission lacks its payload.
    pub(super) fn lacks_payload(&self, key: &Key, sub: &Sub) -> bool {
        let is_stored = sub.outline().is_some_and(|outline| outline.stored.is_some());
        is_stored && !(self.held.as_ref()).is_some_and(|held| held.read.is_some() && held.is_of(key, sub))
    }

    /// What the next write of a submission is sent with; none if that is to be read.
    pub(super) fn payload(&self, key: &Key, outline: &Outline) -> Option<Arc<Payload>> {
        if outline.stored.is_none() {
            return Some(Arc::new(Payload::bare(outline)));
        }
        let held = self.held.as_ref().filter(|held| held.key == *key)?;
        held.read.as_ref().map(|(payload, _)| payload.clone())
    }

    /// A write was answered: what it was sent with is dropped.
    pub(super) fn sent_payload(&mut self, key: &Key) -> Option<Arc<Outline>> {
        let sent = self.held.take_if(|held| held.key == *key && held.read.is_some());
        sent.map(|held| held.of)
    }

    /// Drops a payload that nobody wants any more.
    pub(super) fn tidy_payload(&mut self) {
        let (subs, lanes) = (&self.subs, &self.lanes);
        self.held.take_if(|held| {
            let sub = subs.get(&held.key);
            let is_sent = |sub: &Sub| lanes.get(&sub.pk).is_some_and(|lane| lane.busy == Some(Busy::Write));
            held.read.is_some() && !sub.is_some_and(|sub| is_sent(sub) || held.is_of(&held.key, sub))
        });
    }

    /// The first of the payloads that are missing, if it may be read now: also in place of one whose write comes later.
    pub(super) fn payload_to_read(&self, missing: &[Offer<'_>], due: &[Offer<'_>]) -> Option<(Key, Arc<Outline>)> {
        let first = missing.iter().min_by_key(|offer| offer.rank)?;
        let What::Payload(key) = first.what else { return None };
        if let Some(held) = &self.held {
            let sub = self.subs.get(&held.key);
            let is_busy = sub.is_some_and(|sub| self.lanes.get(&sub.pk).is_some_and(|lane| lane.busy.is_some()));
            let own = due
                .iter()
                .find(|offer| matches!(offer.what, What::Sub(key, _) if *key == held.key));
            if held.read.is_none() || is_busy || own.is_some_and(|own| own.rank < first.rank) {
                return None;
            }
        }
        Some((key.clone(), self.subs.get(key)?.outline()?.clone()))
    }

    /// Notes that a payload is being read.
    pub(super) fn start_payload(&mut self, key: &Key, of: &Arc<Outline>) {
        let target = self.subs.get(key).map(|sub| sub.target.clone());
        self.held = target.map(|target| Held {
            key: key.clone(),
            of: of.clone(),
            target,
            read: None,
        });
    }

    /// Takes a payload in that was read. What goes wrong with partial results leaves them out: newer ones come.
    pub fn took_payload(&mut self, key: &Key, answer: Result<(Payload, Place), PayloadProblem>, now: Now) {
        let Some(mut held) = self.held.take_if(|held| held.key == *key && held.read.is_none()) else {
            return;
        };
        let Some(sub) = self.subs.get_mut(key).filter(|sub| held.is_of(key, sub)) else {
            return;
        };
        let before = sub.view.clone();
        let is_partial = sub.next_write().is_some_and(|(write, _)| write == Write::Partial);
        let has_results = is_partial || sub.end.as_ref().is_some_and(|end| end.what.0 == Outcome::Finished);
        match answer {
            Ok((payload, place)) => {
                let target = &held.target;
                let payload = for_split(payload, &target.split);
                let misfit = check(&payload, &target.split, &target.labels)
                    .err()
                    .filter(|_| has_results);
                sub.view.unread = None;
                if is_partial && misfit.is_some() {
                    sub.view.partial_done = held.of.stored.as_ref().map(|stored| stored.done);
                    (sub.partial, sub.view.last_error) = (None, misfit);
                } else {
                    sub.misfit = misfit;
                    held.read = Some((Arc::new(payload), place));
                    self.held = Some(held);
                }
            }
            Err(_) if is_partial => sub.partial = None,
            Err(PayloadProblem::Unfit(why)) => sub.payload_failed(why, &now),
            Err(PayloadProblem::Unread(why)) => {
                sub.payload_failed(why, &now);
                let (again, failures) = (sub.retry_at, sub.write_failures);
                self.leave_bucket(&held.of, again, failures);
            }
        }
        if self.subs.get(key).is_some_and(|sub| sub.view != before) {
            self.changes.insert(Changed::Submission(key.clone()));
        }
    }

    /// A bucket that hangs for one end hangs for all that it has: none of them is to keep those of another bucket waiting.
    fn leave_bucket(&mut self, of: &Outline, again: Duration, failures: u32) {
        let bucket = |outline: &Outline| outline.stored.as_ref().map(|stored| stored.storage.clone());
        let bucket_of = bucket(of);
        let ends = self.subs.values_mut().filter(|sub| sub.end.is_some());
        for sub in ends.filter(|sub| sub.outline().is_some_and(|outline| bucket(outline) == bucket_of)) {
            sub.retry_at = sub.retry_at.max(again);
            sub.write_failures = sub.write_failures.max(failures);
        }
    }
}
