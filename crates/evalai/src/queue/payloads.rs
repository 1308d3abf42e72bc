//! The payload of a write that comes next: it is read before the row is, so that the write follows that read at once.
//!
//! Owned by `queue`. Pure. Agents decide how large texts are. So a queue holds [`PAYLOADS`] of them at most, each from before it is read
//! until its write is answered, and the hub bounds those of all queues.

use std::sync::Arc;
use std::time::Duration;

use tokio::sync::OwnedSemaphorePermit;

use super::sub::{Sub, Write};
use super::{Busy, Next, Now, Queue};
use crate::labels::{Catalog, Misfit, listed};
use crate::payload::{for_listed, for_split};
use crate::types::{Changed, Key, Metrics, Outline, Payload, PayloadProblem, Target};
use leaderboard_api::evalai_status::Outcome;

/// Payloads that are held at once: with a second one, a write that EvalAI does not answer holds no other up.
pub const PAYLOADS: usize = 2;
/// A list of results without one.
const NO_RESULTS: &str = "[]";
/// A payload whose write does not begin gives its place to others after so long.
const KEPT: Duration = Duration::from_secs(15);

/// The share of a payload in the memory for all of them; dropped, it is free again.
pub type Place = Option<OwnedSemaphorePermit>;

/// The payload of one write.
#[derive(Debug)]
pub(super) struct Held {
    of: Arc<Outline>,
    /// Its results are for the splits of this Leaderboard.
    target: Arc<Target>,
    /// None while it is being read.
    read: Option<Read>,
}

#[derive(Debug)]
struct Read {
    payload: Arc<Payload>,
    /// Until when it is kept for a write that does not begin.
    until: Duration,
    _place: Place,
}

impl Held {
    fn is_of(&self, sub: &Sub) -> bool {
        sub.outline() == Some(&self.of) && sub.target == self.target
    }
}

impl Queue {
    /// True if the next write of a submission lacks its payload.
    pub(super) fn lacks_payload(&self, key: &Key, sub: &Sub) -> bool {
        let is_stored = sub.outline().is_some_and(|outline| outline.stored.is_some());
        let held = self.held.get(key);
        is_stored && !held.is_some_and(|held| held.read.is_some() && held.is_of(sub))
    }

    /// When the payload of a submission that lacks it may be read; none if an answer tells.
    pub(super) fn payload_free_at(&self, key: &Key, now: &Now) -> Option<Duration> {
        if self.held.contains_key(key) {
            return None;
        }
        if self.held.len() < PAYLOADS {
            return Some(Duration::ZERO);
        }
        let kept = self.held.values().filter_map(|held| Some(held.read.as_ref()?.until));
        kept.filter(|until| *until > now.at).min()
    }

    /// Payload of a submission's next write; none if that is to be read.
    pub(super) fn payload(&self, key: &Key, outline: &Outline) -> Option<Arc<Payload>> {
        if outline.stored.is_none() {
            return Some(Arc::new(Payload::bare(outline)));
        }
        let read = self.held.get(key)?.read.as_ref()?;
        Some(read.payload.clone())
    }

    /// A write was answered: what it was sent with is dropped.
    pub(super) fn sent_payload(&mut self, key: &Key) -> Option<Arc<Outline>> {
        self.held.remove(key).map(|held| held.of)
    }

    /// Drops the payloads that nobody wants any more, and those that others have waited long enough for the place of.
    pub(super) fn tidy_payloads(&mut self, now: &Now) {
        let (subs, lanes, fresh) = (&self.subs, &self.lanes, self.timing.fresh);
        self.held.retain(|key, held| {
            let Some(read) = &held.read else { return true };
            let Some(sub) = subs.get(key) else { return false };
            let lane = lanes.get(&sub.pk);
            let busy = lane.and_then(|lane| lane.busy);
            let is_next = lane.is_some_and(|lane| lane.checked.is_some_and(|at| now.at <= at + fresh));
            let is_kept = now.at < read.until || busy.is_some() || is_next;
            busy == Some(Busy::Write) || (is_kept && held.is_of(sub))
        });
    }

    /// The read of a payload, noted as begun.
    pub(super) fn start_payload(&mut self, key: &Key) -> Option<Next> {
        let sub = self.subs.get(key)?;
        let (of, target) = (sub.outline()?.clone(), sub.target.clone());
        let held = Held {
            of: of.clone(),
            target,
            read: None,
        };
        self.held.insert(key.clone(), held);
        Some(Next::Read(key.clone(), of))
    }

    /// Takes a payload in that was read. What goes wrong with partial results leaves them out: newer ones come.
    pub fn took_payload(&mut self, key: &Key, answer: Result<(Payload, Place), PayloadProblem>, now: Now) {
        let held = self.held.remove(key).filter(|held| held.read.is_none());
        let sub = self.subs.get_mut(key);
        let Some((held, sub)) = held.zip(sub).filter(|(held, sub)| held.is_of(sub)) else {
            return;
        };
        let before = sub.view.clone();
        let is_partial = sub.next_write().is_some_and(|(write, _)| write == Write::Partial);
        let has_results = is_partial || sub.end.as_ref().is_some_and(|end| end.what.0 == Outcome::Finished);
        let challenge = self.challenges.get(&held.target.challenge);
        let catalog = challenge.and_then(|challenge| challenge.check.catalog.as_ref());
        let fit = |payload| {
            if has_results {
                fitted(payload, &held.target, held.of.phase, catalog, is_partial)
            } else {
                Some((payload, None))
            }
        };
        match answer.map(|(payload, place)| (fit(payload), place)) {
            Ok((None, _)) => sub.read_failed("EvalAI has not shown its leaderboards yet".to_owned(), &now),
            Ok((Some((_, misfit @ Some(_))), _)) if is_partial => {
                sub.view.unread = None;
                sub.view.partial_done = held.of.stored.as_ref().map(|stored| stored.done);
                (sub.partial, sub.view.last_error) = (None, misfit);
            }
            Ok((Some((payload, misfit)), place)) => {
                (sub.view.unread, sub.misfit) = (None, misfit);
                let read = Some(Read {
                    payload: Arc::new(payload),
                    until: now.at + KEPT,
                    _place: place,
                });
                self.held.insert(key.clone(), Held { read, ..held });
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

/// Results as their Leaderboard publishes them, and why they are not sent. None while it is not known what EvalAI lists.
pub(super) fn fitted(
    payload: Payload,
    target: &Target,
    phase: i64,
    catalog: Option<&Catalog>,
    is_partial: bool,
) -> Option<(Payload, Option<String>)> {
    let fitted = match &target.metrics {
        Metrics::Fixed(labels) => for_split(&payload.result, &target.split, labels),
        // Where a phase does not show results so far, EvalAI gets the texts alone.
        Metrics::Listed(_) if is_partial && payload.result == NO_RESULTS => return Some((payload, None)),
        Metrics::Listed(_) => {
            let listed = listed(target, catalog?, phase).ok_or_else(|| Misfit::Unnamed { phase }.to_string());
            listed.and_then(|listed| for_listed(&payload.result, &listed))
        }
    };
    Some(match fitted {
        Ok(result) => (Payload { result, ..payload }, None),
        Err(why) => (payload, Some(why)),
    })
}
