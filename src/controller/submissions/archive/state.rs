//! What is to be read from and written to one bucket, and what came of it. Pure: no client, and no clock but the times given.
//!
//! A demand stands until it is answered. Answers carry what was known when they were asked for: a demand that comes while a read
//! is under way is answered by a second read.

use std::collections::{BTreeSet, HashMap};
use std::sync::Arc;
use std::time::Duration;

use tokio::time::Instant;

use super::request::{Done, KINDS, Kind, LIMITS, Target, Uid, What, Work};
use super::run::{FenceRun, LogRun, ReportRun, Run, answers};
use crate::controller::submissions::failure_log::{LogAnswer, LogDemand, Tail};
use crate::controller::submissions::view::{ObservedFence, ObservedLog, ReportDemand, ReportView, Stage};
use leaderboard_api::JobNumber;

/// Time between two reads of reports in one bucket: at most 100 a second.
const SPACING: Duration = Duration::from_millis(10);
/// Reads of live reports that one bucket is asked for in a second, at most: the period of all stretches with their number.
const LIVE_A_SECOND: f64 = 100.0;
/// When a read that failed is made again while a decision waits for it.
const READ_AGAIN: Duration = Duration::from_secs(10);
/// The same of the fence and of a log.
const TRY_AGAIN: Duration = Duration::from_secs(3);
/// How long the fence is tried. After that `decide` goes on without it, and a late mark would stop the next Pod.
pub(super) const FENCE_TRIES: Duration = Duration::from_mins(1);
/// How often one log is looked for.
const LOG_TRIES: u32 = 3;

/// All runs of one bucket.
#[derive(Default)]
pub(super) struct State {
    runs: HashMap<Uid, Box<Run>>,
    due: [BTreeSet<(Instant, Uid)>; KINDS.len()],
    under_way: [usize; KINDS.len()],
    next_read: Option<Instant>,
    memories: u64,
}

impl State {
    /// Notes which report is needed; None: none any more.
    pub fn demand(&mut self, uid: &Uid, target: &Arc<Target>, demand: Option<ReportDemand>, now: Instant) {
        let Some(demand) = demand else {
            if let Some(run) = self.runs.get_mut(uid) {
                run.report = None;
                self.plan(uid, Kind::Live, None);
                self.plan(uid, Kind::Ended, None);
                self.tidy(uid);
            }
            return;
        };
        self.memories += 1;
        let memory = self.memories;
        let run = self.run(uid, target);
        let known = run.report.get_or_insert_with(|| ReportRun {
            memory,
            wanted: demand.clone(),
            since: now,
            is_under_way: false,
            of: None,
            error: None,
            etag: None,
            content: None,
        });
        if !answers(&known.wanted, &demand) || !answers(&demand, &known.wanted) {
            known.since = now;
        }
        // A run that goes on again has another end.
        if known.of.as_ref().is_some_and(|of| of.stage > demand.stage) {
            known.of = None;
        }
        if known.wanted != demand {
            known.wanted = demand;
        }
        if !known.is_under_way {
            self.plan_read(uid, now);
        }
    }

    /// What a run was last asked for with.
    pub fn known(&self, uid: &str) -> Option<(Uid, Arc<Target>)> {
        let (uid, run) = self.runs.get_key_value(uid)?;
        Some((Arc::clone(uid), Arc::clone(&run.target)))
    }

    /// What is known of a report, seen from a run that is at this Job with this Pod.
    pub fn report(&self, uid: &str, job: JobNumber, pod: Option<&str>, now: Instant) -> ReportView {
        let run = self.runs.get(uid);
        let Some((run, known)) = run.and_then(|run| Some((run, run.report.as_ref()?))) else {
            return ReportView::default();
        };
        let is_of = |sent: &&ReportDemand| {
            let is_of_pod = sent.pod.as_deref() == pod || sent.stage == Stage::JobEnded;
            sent.job == job && is_of_pod
        };
        ReportView {
            stored: known.shown(job.attempt, *run.target.submission_uid != *uid),
            stage: known.of.as_ref().filter(is_of).map(|sent| sent.stage),
            waited: now.saturating_duration_since(known.since),
        }
    }

    /// Asks for our own mark in the place of a lost Pod's.
    pub fn want_fence(&mut self, uid: &Uid, target: &Arc<Target>, job: JobNumber, mark: String, now: Instant) {
        let run = self.run(uid, target);
        if run.fence.as_ref().is_some_and(|fence| fence.job == job) {
            return;
        }
        run.fence = Some(Box::new(FenceRun {
            job,
            mark,
            since: now,
            is_held: false,
            has_failed: false,
        }));
        self.plan(uid, Kind::Fence, Some(now));
    }

    pub fn fence(&self, uid: &str, job: JobNumber, now: Instant) -> ObservedFence {
        let fence = self.runs.get(uid).and_then(|run| run.fence.as_ref());
        match fence.filter(|fence| fence.job == job) {
            None => ObservedFence::NotRequested,
            Some(fence) if fence.is_held => ObservedFence::Held,
            Some(fence) if fence.has_failed => ObservedFence::Failed(now.saturating_duration_since(fence.since)),
            Some(fence) => ObservedFence::Pending(now.saturating_duration_since(fence.since)),
        }
    }

    /// Asks for a log. One that was found stays; the end of the submission stores it.
    pub fn want_log(&mut self, uid: &Uid, target: &Arc<Target>, demand: LogDemand, now: Instant) {
        let run = self.run(uid, target);
        let known = run.log.take();
        let is_under_way = known.as_ref().is_some_and(|log| log.is_under_way);
        let fresh = |demand, tail| {
            Box::new(LogRun {
                demand,
                since: now,
                tries: 0,
                is_under_way,
                tail,
                end: None,
            })
        };
        let known = known.filter(|log| log.demand.job == demand.job);
        run.log = Some(match known {
            Some(log) if log.demand == demand || (log.demand.is_over && !demand.is_over) => log,
            // Found already, and nothing more is to be done with it.
            Some(log) if log.demand.is_over == demand.is_over && log.tail.is_some() => log,
            Some(log) if log.demand.is_over == demand.is_over => {
                let mut again = fresh(demand, None);
                again.since = log.since;
                again
            }
            Some(log) => fresh(demand, log.tail),
            None => fresh(demand, None),
        });
        let is_open = run
            .log
            .as_ref()
            .is_some_and(|log| log.end.is_none() && log.tries == 0 && !log.is_under_way);
        if is_open {
            self.plan(uid, Kind::Log, Some(now));
        }
    }

    pub fn log(&self, uid: &str, job: JobNumber, is_over: bool, now: Instant) -> ObservedLog {
        let log = self.log_of(uid, job).filter(|log| log.demand.is_over == is_over);
        log.map_or(ObservedLog::NotRequested, |log| {
            log.end
                .unwrap_or_else(|| ObservedLog::Pending(now.saturating_duration_since(log.since)))
        })
    }

    /// The log that was kept.
    pub fn tail(&self, uid: &str, job: JobNumber) -> Option<Tail> {
        self.log_of(uid, job)?.tail.clone()
    }

    fn log_of(&self, uid: &str, job: JobNumber) -> Option<&LogRun> {
        let log = self.runs.get(uid)?.log.as_deref()?;
        (log.demand.job == job).then_some(log)
    }

    /// Drops all that is known of an object.
    pub fn forget(&mut self, uid: &str) {
        if let Some((uid, run)) = self.runs.remove_entry(uid) {
            for (at, due) in run.due.into_iter().zip(&mut self.due) {
                if let Some(at) = at {
                    due.remove(&(at, uid.clone()));
                }
            }
        }
    }

    /// The next work; None if nothing is due or as much is under way as there may be.
    pub fn next(&mut self, now: Instant) -> Option<Work> {
        for kind in KINDS {
            let index = kind as usize;
            if self.under_way[index] >= LIMITS[index] || self.waits_for_pace(kind, now) {
                continue;
            }
            let first = self.due[index].first().filter(|(at, _)| *at <= now);
            let Some((_, uid)) = first.cloned() else { continue };
            self.plan(&uid, kind, None);
            let Some(work) = self.begin(kind, &uid, now) else {
                continue;
            };
            if matches!(kind, Kind::Ended | Kind::Live) {
                self.next_read = Some(self.next_read.unwrap_or(now).max(now) + SPACING);
            }
            self.under_way[index] += 1;
            return Some(work);
        }
        None
    }

    /// When `next` may have something.
    pub fn wake_at(&self) -> Option<Instant> {
        let of = |kind: Kind| {
            let index = kind as usize;
            let (at, _) = self.due[index]
                .first()
                .filter(|_| self.under_way[index] < LIMITS[index])?;
            let pace = self.next_read.filter(|_| matches!(kind, Kind::Ended | Kind::Live));
            Some(pace.map_or(*at, |pace| pace.max(*at)))
        };
        KINDS.into_iter().filter_map(of).min()
    }

    /// Nobody needs anything, and nothing is under way.
    pub fn is_idle(&self) -> bool {
        self.runs.is_empty() && self.under_way.iter().all(|count| *count == 0)
    }

    /// Takes in what came of work. Returns whether its object has something new to decide on.
    pub fn done(&mut self, work: &Work, done: Done, now: Instant) -> bool {
        self.under_way[work.kind as usize] -= 1;
        match (&work.what, done) {
            (What::Report { sent, .. }, Done::Report(answer)) => {
                let known = self.runs.get_mut(&work.uid).and_then(|run| run.report.as_mut());
                let Some(known) = known.filter(|known| known.memory == sent.memory) else {
                    return false;
                };
                known.is_under_way = false;
                let is_new = known.take(&sent.demand, answer);
                self.plan_read(&work.uid, now);
                is_new
            }
            (What::Fence { job, .. }, Done::Fence(result)) => self.fence_done(&work.uid, *job, &result, now),
            (What::Log { demand, .. }, Done::Log(answer)) => self.log_done(&work.uid, demand, answer, now),
            _ => false,
        }
    }

    fn fence_done(&mut self, uid: &Uid, of: JobNumber, result: &Result<(), String>, now: Instant) -> bool {
        let fence = self.runs.get_mut(uid).and_then(|run| run.fence.as_mut());
        let Some(fence) = fence.filter(|fence| fence.job == of) else {
            return false;
        };
        let had_failed = fence.has_failed;
        fence.is_held = result.is_ok();
        fence.has_failed = result.is_err();
        let again = now + TRY_AGAIN;
        if !fence.is_held && again < fence.since + FENCE_TRIES {
            self.plan(uid, Kind::Fence, Some(again));
        }
        result.is_ok() || !had_failed
    }

    fn log_done(&mut self, uid: &Uid, of: &LogDemand, answer: LogAnswer, now: Instant) -> bool {
        let Some(log) = self.runs.get_mut(uid).and_then(|run| run.log.as_mut()) else {
            return false;
        };
        log.is_under_way = false;
        if log.demand.job != of.job {
            self.plan(uid, Kind::Log, Some(now));
            return false;
        }
        log.tail = answer.tail.or(log.tail.take());
        if log.demand != *of {
            self.plan(uid, Kind::Log, Some(now));
            return false;
        }
        log.tries += 1;
        if answer.is_unclear && log.tries < LOG_TRIES {
            self.plan(uid, Kind::Log, Some(now + TRY_AGAIN));
            return false;
        }
        log.end = Some(match (&log.tail, answer.is_unclear) {
            (_, true) => ObservedLog::GivenUp,
            (Some(_), false) => ObservedLog::Kept,
            (None, false) => ObservedLog::None,
        });
        true
    }

    fn begin(&mut self, kind: Kind, uid: &Uid, now: Instant) -> Option<Work> {
        let run = self.runs.get_mut(uid)?;
        let what = match kind {
            Kind::Ended | Kind::Live => {
                let report = run.report.as_mut()?;
                report.is_under_way = true;
                What::Report {
                    sent: report.sent(),
                    etag: report.etag.clone(),
                }
            }
            Kind::Fence => {
                let fence = run.fence.as_ref()?;
                What::Fence {
                    job: fence.job,
                    mark: fence.mark.clone(),
                    left: (fence.since + FENCE_TRIES).saturating_duration_since(now),
                }
            }
            Kind::Log => {
                let log = run.log.as_mut()?;
                log.is_under_way = true;
                What::Log {
                    demand: log.demand.clone(),
                    tail: log.tail.clone(),
                }
            }
        };
        Some(Work {
            kind,
            uid: uid.clone(),
            target: Arc::clone(&run.target),
            what,
        })
    }

    fn waits_for_pace(&self, kind: Kind, now: Instant) -> bool {
        matches!(kind, Kind::Ended | Kind::Live) && self.next_read.is_some_and(|at| at > now)
    }

    /// Decides when the report is read next: at once for a demand without an answer, after the period while the run goes on.
    fn plan_read(&mut self, uid: &Uid, now: Instant) {
        let live = self.due[Kind::Live as usize].len() + self.under_way[Kind::Live as usize];
        let Some(run) = self.runs.get(uid) else { return };
        let Some(report) = &run.report else { return };
        let is_live = report.wanted.stage == Stage::Live;
        let kind = if is_live { Kind::Live } else { Kind::Ended };
        let is_answered = report.of.as_ref().is_some_and(|of| answers(of, &report.wanted));
        let known = run.due[kind as usize];
        let at = match (is_answered, &report.error) {
            (false, _) => Some(run.target.due(now)),
            // Already planned.
            (true, _) if known.is_some() => known,
            (true, _) if is_live => {
                #[expect(clippy::cast_precision_loss, reason = "a number of runs")]
                let stretched = Duration::from_secs_f64(live as f64 / LIVE_A_SECOND);
                Some(now + report.wanted.period.max(stretched))
            }
            (true, Some(_)) => Some(now + READ_AGAIN),
            (true, None) => None,
        };
        let other = if is_live { Kind::Ended } else { Kind::Live };
        self.plan(uid, other, None);
        self.plan(uid, kind, at);
    }

    fn plan(&mut self, uid: &Uid, kind: Kind, at: Option<Instant>) {
        let Some(run) = self.runs.get_mut(uid) else { return };
        let due = &mut self.due[kind as usize];
        if let Some(old) = std::mem::replace(&mut run.due[kind as usize], at) {
            due.remove(&(old, uid.clone()));
        }
        if let Some(at) = at {
            due.insert((at, uid.clone()));
        }
    }

    fn run(&mut self, uid: &Uid, target: &Arc<Target>) -> &mut Run {
        let run = self.runs.entry(uid.clone()).or_insert_with(|| {
            Box::new(Run {
                target: Arc::clone(target),
                due: [None; KINDS.len()],
                report: None,
                fence: None,
                log: None,
            })
        });
        // The log names the attempt that asked last.
        run.target = Arc::clone(target);
        run
    }

    /// Drops a run of which nothing is wanted.
    fn tidy(&mut self, uid: &Uid) {
        let is_idle = |run: &Run| run.fence.is_none() && run.log.is_none();
        if self
            .runs
            .get(uid)
            .is_some_and(|run| run.report.is_none() && is_idle(run))
        {
            self.forget(uid);
        }
    }
}

#[cfg(test)]
#[path = "state_tests.rs"]
mod tests;

#[cfg(test)]
#[path = "order_tests.rs"]
mod order_tests;
