//! Lists of submissions and what a challenge's leaderboards are: from when on a list reaches, and what an answer changes.
//!
//! Owned by `queue`. Pure.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::Duration;

use jiff::{SignedDuration, Timestamp};

use super::sub::Sub;
use super::{Now, Queue};
use crate::answer::{About, Answer};
use crate::request::{Purpose, Reply, Request};
use crate::row::{Challenge, Row};
use crate::types::{Changed, Key, SweepRow, Swept};
use leaderboard_api::evalai_status::Status;
use leaderboard_api::names;

/// Time during which a find of the sweep is not handed out again.
const SWEPT_FOR: Duration = Duration::from_mins(10);
/// Before a failed check is retried.
const RETRY_CHECK: Duration = Duration::from_mins(1);

/// How far before its Leaderboard a re-run or resumed submission may first have been submitted: it keeps that time.
const SWEEP_REACH: SignedDuration = SignedDuration::from_hours(180 * 24);

/// Kind of run that a row asks for. EvalAI makes a re-run's row by copying the old one: it keeps the Jobs of the old one's id,
/// when that was submitted and when it ended.
fn kind_of(row: &Row, since: Timestamp) -> Swept {
    let own = format!("{}-", names::submission(row.id));
    let has_run = row.jobs.iter().any(|job| job.starts_with(&own));
    let is_ours = !has_run && row.submitted_at.is_some_and(|at| at >= since);
    let has_ended = row.completed_at.is_some();
    match (row.status, row.resumed_at) {
        (Status::Resuming, _) => Swept::Resuming,
        (_, None) if is_ours && !has_ended => Swept::New,
        (_, Some(_)) if is_ours && !(has_ended && row.jobs.is_empty()) => Swept::Rerun,
        _ => Swept::Edited,
    }
}

impl Queue {
    /// From when on a list reaches: never the whole table, which is costly for the server.
    pub(super) fn list_after(&self, id: i64, purpose: Purpose) -> Option<Timestamp> {
        match purpose {
            Purpose::Cancel => {
                let live = self
                    .subs
                    .values()
                    .filter(|sub| sub.target.challenge == id && sub.live.is_some());
                let first = live.filter_map(Sub::submitted_at).min()?;
                Some(back(first, SignedDuration::from_secs(1)))
            }
            Purpose::SweepSubmitted | Purpose::SweepResuming => {
                let (_, since) = self.challenges.get(&id)?.sweep?;
                Some(back(since, SWEEP_REACH))
            }
        }
    }

    pub(super) fn took_list(&mut self, list: (i64, Purpose), requested: Duration, answer: Answer<Vec<Row>>, now: &Now) {
        let (id, purpose) = list;
        let Some(challenge) = self.challenges.get_mut(&id) else {
            return;
        };
        let every = match purpose {
            Purpose::Cancel => challenge.period,
            Purpose::SweepSubmitted | Purpose::SweepResuming => {
                challenge.sweep.map_or(challenge.period, |(every, _)| every)
            }
        };
        let rows = match answer {
            Answer::Done(rows) => rows,
            // Throttling is the whole token's: the budget waits.
            Answer::Throttled(_) => {
                challenge.poll(purpose).busy = false;
                return;
            }
            other => {
                let is_news = challenge.poll(purpose).failures == 0;
                challenge.poll(purpose).failed(now.at, every);
                if is_news && matches!(other, Answer::Refused(refusal) if refusal.about == About::Challenge) {
                    challenge.check.hurry(now.at);
                }
                return;
            }
        };
        challenge.poll(purpose).done(requested, now.at, every);
        if purpose == Purpose::Cancel {
            self.note_cancelled(id, &rows, requested, now);
        }
        for row in rows {
            if matches!(purpose, Purpose::SweepSubmitted | Purpose::SweepResuming) {
                self.sweep_row(id, &row, now);
            }
            self.spread(&Arc::new(row), requested, now, |_| {});
        }
    }

    /// Wakes the submissions that have their end and were cancelled since the last list. A re-run that is live lets the list reach back to its
    /// original: EvalAI copies the time of the submission.
    fn note_cancelled(&mut self, id: i64, rows: &[Row], requested: Duration, now: &Now) {
        let namespace = self.served.keys().next().map(|board| board.namespace.clone());
        let (Some(namespace), Some(challenge)) = (namespace, self.challenges.get_mut(&id)) else {
            return;
        };
        let ended = rows
            .iter()
            .filter(|row| row.status == Status::Cancelled && !self.pks.contains_key(&row.id));
        let listed: BTreeSet<i64> = ended.map(|row| row.id).collect();
        // Nothing is known of them here but the name.
        let named = |id: &i64| Key {
            namespace: namespace.clone(),
            name: names::submission(*id),
            uid: String::new(),
        };
        let new = listed.difference(&challenge.cancelled.1).map(named);
        self.changes.extend(new.map(Changed::Submission));
        let took = SignedDuration::try_from(now.at.saturating_sub(requested)).unwrap_or_default();
        challenge.cancelled = (back(now.wall, took), listed);
    }

    /// When the list was asked for that shows an ended submission as cancelled; none if the last one does not.
    pub fn cancelled_as_of(&self, leaderboard: &Key, pk: i64) -> Option<Timestamp> {
        let (at, listed) = &self.challenge_of(leaderboard)?.cancelled;
        listed.contains(&pk).then_some(*at)
    }

    /// A row that asks to be run, long enough ago for its message to be lost, and that no object here is for.
    fn sweep_row(&mut self, id: i64, row: &Row, now: &Now) {
        let lost = SignedDuration::try_from(self.timing.lost).unwrap_or(SignedDuration::MAX);
        let (Some(time), Some(phase)) = (row.wanted_at(), row.phase) else {
            return;
        };
        // Another Leaderboard of the challenge may be far older: what came before that of the row's phase has another worker.
        let targets = self.served.values().filter(|target| target.challenge == id);
        let Some(target) = targets
            .filter(|target| target.phases.contains(&phase))
            .min_by_key(|target| target.since)
        else {
            return;
        };
        let Some(challenge) = self.challenges.get_mut(&id) else {
            return;
        };
        let settings = challenge.check.catalog.as_ref().map(|catalog| catalog.settings);
        if target.takes_files && settings.is_none() {
            // The settings may say that the row is of no file.
            return;
        }
        let (age, since) = (now.wall.duration_since(time), target.since);
        challenge.swept.retain(|_, (_, found)| *found + SWEPT_FOR > now.at);
        let is_known = challenge.swept.get(&row.id).is_some_and(|(at, _)| *at == time);
        if age < lost || time < since || is_known || self.pks.contains_key(&row.id) {
            return;
        }
        challenge.swept.insert(row.id, (time, now.at));
        self.sweep.push(SweepRow {
            server: target.api_server.clone(),
            challenge: id,
            phase,
            submission: row.id,
            kind: kind_of(row, since),
            is_static_code_upload: settings.is_some_and(Challenge::is_static_code_upload),
            time,
        });
    }

    /// Takes in what a challenge's leaderboards are.
    pub(super) fn took_of_check(&mut self, request: &Request, reply: Reply, now: &Now) {
        let (Request::Phases(id)
        | Request::Splits(id)
        | Request::DatasetSplit(id, _)
        | Request::PhaseSplit(id, _)
        | Request::Challenge(id)) = request
        else {
            return;
        };
        let every = self.timing.check;
        let Some(challenge) = self.challenges.get_mut(id) else {
            return;
        };
        let check = &mut challenge.check;
        let before = (check.catalog.clone(), check.error.clone());
        match check.take(request, reply) {
            Answer::Done(()) => {
                check.poll.done(now.at, now.at, Duration::ZERO);
                if check.request(*id).is_none() {
                    check.poll.done(now.at, now.at, every);
                    check.close(now.wall);
                }
            }
            Answer::Throttled(_) => check.poll.busy = false,
            other => {
                check.is_forbidden = matches!(&other, Answer::Refused(refusal) if refusal.about == About::Challenge);
                check.error = other.error();
                check.restart();
                check.poll.failed(now.at, RETRY_CHECK);
            }
        }
        if before != (check.catalog.clone(), check.error.clone()) {
            self.wake_leaderboards(|target| target.challenge == *id);
        }
    }
}

/// Earlier, or as it is at the beginning of time.
fn back(at: Timestamp, by: SignedDuration) -> Timestamp {
    at.checked_sub(by).unwrap_or(at)
}
