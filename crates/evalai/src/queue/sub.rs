//! One submission in the queue: what is requested, what is known, and what follows from both.
//!
//! Owned by `queue`. Pure: the guard is asked here, nothing is sent.

use std::sync::Arc;
use std::time::Duration;

use jiff::Timestamp;

use super::Now;
use super::poll::pause;
use crate::guard::{self, Attempt, End, Interim, Start};
use crate::row::Row;
use crate::types::{Ended, ImageAnswer, Outline, Run, SubmissionState, Target};
use leaderboard_api::evalai_status::{Outcome, Progress, Status};

/// Wait before an unknown status of EvalAI is read again.
const UNCLEAR_PAUSE: Duration = Duration::from_mins(1);
/// Wait before an end is retried that was refused, or that EvalAI breaks down over repeatedly.
pub(super) const RETRY_END: Duration = Duration::from_mins(10);

/// An update that is requested, and since when.
#[derive(Debug, Clone)]
pub(super) struct Pending<T> {
    pub what: T,
    pub since: Duration,
}

/// Kind of write of a submission.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Write {
    Progress,
    Partial,
    End,
}

#[derive(Debug)]
pub(super) struct Sub {
    pub pk: i64,
    /// Its Leaderboard's way to EvalAI.
    pub target: Arc<Target>,
    pub run: Run,
    /// When it was submitted, while its run may be cancelled.
    pub live: Option<Timestamp>,
    /// Since when it is asked whether this attempt may run.
    pub asked: Option<Duration>,
    pub image: bool,
    pub progress: Option<Pending<Progress>>,
    pub partial: Option<Pending<Arc<Outline>>>,
    pub end: Option<Pending<(Outcome, Arc<Outline>)>>,
    /// Why the end's results are not sent, whatever EvalAI shows.
    pub misfit: Option<String>,
    /// Request of the last read of the row.
    pub read: Option<Duration>,
    /// The row is known to be outdated.
    pub outdated: bool,
    /// From when on EvalAI knows of this attempt.
    pub known_at: Option<Duration>,
    /// A read that showed it as live, since this attempt began: whatever ends it later, ends this attempt.
    pub live_at: Option<Duration>,
    /// Answer of the last write: reads requested before show what was before it.
    pub wrote_at: Duration,
    pub retry_at: Duration,
    /// Failed reads in a row.
    pub failures: u32,
    /// From when on the uploaded file may be fetched again, and how often it could not be.
    pub image_at: Duration,
    pub image_failures: u32,
    /// Failed writes in a row: a read that goes well between two of them repairs nothing.
    pub write_failures: u32,
    pub view: SubmissionState,
}

impl Sub {
    pub fn new(pk: i64, target: Arc<Target>, run: Run) -> Self {
        let view = SubmissionState {
            attempt: run.attempt,
            ..SubmissionState::default()
        };
        Self {
            pk,
            target,
            run,
            live: None,
            asked: None,
            image: false,
            progress: None,
            partial: None,
            end: None,
            misfit: None,
            read: None,
            outdated: false,
            known_at: None,
            live_at: None,
            wrote_at: Duration::ZERO,
            retry_at: Duration::ZERO,
            failures: 0,
            image_at: Duration::ZERO,
            image_failures: 0,
            write_failures: 0,
            view,
        }
    }

    /// Begins a later attempt: every update of the earlier one is void, what was read stays. An earlier one without an end is restarted, so
    /// whatever ends the row that was live ends the later one.
    pub fn begin(&mut self, run: Run) {
        let live_at = self.live_at.or(self.known_at).filter(|_| !self.has_end());
        let old = std::mem::take(&mut self.view);
        let fresh = Self::new(self.pk, self.target.clone(), run);
        *self = Self {
            read: self.read,
            outdated: self.outdated,
            wrote_at: self.wrote_at,
            live_at,
            view: SubmissionState {
                row: old.row,
                read_at: old.read_at,
                answered: old.answered,
                // A file that named no image is read once more for each attempt.
                image: old.image.filter(|image| matches!(image, ImageAnswer::Named(_))),
                ..fresh.view.clone()
            },
            ..fresh
        };
    }

    /// True if this attempt has come to its end, published or not.
    pub fn has_end(&self) -> bool {
        self.end.is_some() || self.view.end.is_some() || self.is_over()
    }

    /// When the end that waits came to be.
    pub fn end_since(&self) -> Option<Timestamp> {
        self.end.as_ref().and(self.run.ended)
    }

    /// True if an end waits that EvalAI has not refused.
    pub fn has_end_to_publish(&self) -> bool {
        self.end.is_some() && self.view.end.is_none()
    }

    /// True if this attempt needs no further update.
    pub fn is_over(&self) -> bool {
        self.view.ended.is_some()
            || self
                .view
                .end
                .as_ref()
                .is_some_and(|end| !matches!(end, Ended::Refused(_)))
    }

    /// Next write, and since when it is wanted.
    pub fn next_write(&self) -> Option<(Write, Duration)> {
        let end = self.end.as_ref().map(|want| (Write::End, want.since));
        let progress = self.progress.as_ref().map(|want| (Write::Progress, want.since));
        // Partial results of an attempt that EvalAI does not know yet wait for its `queued` or `running`.
        let may_follow = self.of_partial() != Some(Interim::Wait);
        let partial = self.partial.as_ref().filter(|_| may_follow);
        end.or(progress)
            .or_else(|| partial.map(|want| (Write::Partial, want.since)))
    }

    /// True if the row, as last read, allows it.
    pub fn may_write(&self, write: Write) -> bool {
        match write {
            Write::Progress => self.of_progress() == Some(Interim::Send),
            Write::Partial => self.of_partial() == Some(Interim::Send),
            Write::End => self.outcome().is_some(),
        }
    }

    /// The end to write: `cancelled` for a submission that was deleted before its end, whatever it was here.
    pub fn outcome(&self) -> Option<Outcome> {
        match self.of_end()? {
            End::Put if self.problem().is_none() => Some(self.end.as_ref()?.what.0),
            End::Cancel => Some(Outcome::Cancelled),
            _ => None,
        }
    }

    /// True while the uploaded file is to be read: until it was read, and for nothing that has come to its end.
    pub fn wants_image(&self) -> bool {
        let unread = matches!(self.view.image, None | Some(ImageAnswer::Unread(_)));
        let has_file = self.view.row.as_ref().is_some_and(|row| row.input_file.is_some());
        self.image && unread && has_file && !self.has_end()
    }

    /// When it was submitted, by EvalAI's own time if it is known.
    pub fn submitted_at(&self) -> Option<Timestamp> {
        self.view.row.as_ref().and_then(|row| row.submitted_at).or(self.live)
    }

    /// True if EvalAI had stored this attempt when a read was made.
    fn is_known(&self, row: &Row, requested: Duration) -> bool {
        row.names(&self.run.job) || self.known_at.is_some_and(|known| requested > known)
    }

    /// True if the end of an earlier attempt could no longer stand when a read was made.
    fn begun(&self, row: &Row, requested: Duration) -> bool {
        self.is_known(row, requested) || self.live_at.is_some_and(|live| requested > live)
    }

    /// This attempt, as far as it had come when a read was made.
    fn attempt(&self, row: &Row, requested: Duration) -> Attempt {
        let since = |at: Option<Duration>| at.is_some_and(|at| requested > at);
        Attempt {
            number: self.run.attempt,
            by_hand: self.run.by_hand,
            begun: self.begun(row, requested),
            under_way: self.run.has_job || since(self.known_at) || since(self.live_at),
        }
    }

    /// Takes a row in; `calm` if no write of ours can still change it. Returns whether anything changed that the object
    /// should know.
    pub fn take_row(&mut self, row: &Arc<Row>, requested: Duration, calm: bool, now: &Now) -> bool {
        let before = self.view.clone();
        let start = guard::start(row.status, self.attempt(row, requested));
        let outdated = requested < self.wrote_at || self.read.is_some_and(|read| requested < read);
        if outdated {
            // A cancel may since have been overwritten by one of our writes: it still was one.
            if let Start::Drop(status @ (Status::Cancelled | Status::Archived | Status::Ignored | Status::Deleted)) =
                start
            {
                self.stop(status, !calm || requested < self.wrote_at);
            }
            return self.view != before;
        }
        self.view.row = Some(row.clone());
        self.view.read_at = Some(now.wall);
        self.read = Some(requested);
        self.outdated = false;
        match start {
            Start::Unclear => {
                self.retry_at = now.at + UNCLEAR_PAUSE;
                self.view.last_error =
                    Some("EvalAI gives the submission a status that this version does not know".into());
            }
            Start::Run => {
                if calm && !matches!(row.status, Status::Failed | Status::Cancelled) {
                    self.live_at = self.live_at.or(Some(requested));
                }
                self.answer(requested);
            }
            Start::Drop(status) => {
                self.answer(requested);
                self.stop(status, !calm);
            }
        }
        self.settle(now);
        // That it was read again is no news.
        let before = SubmissionState {
            read_at: self.view.read_at,
            ..before
        };
        self.view != before
    }

    fn answer(&mut self, requested: Duration) {
        if self.asked.is_some_and(|since| requested >= since) {
            self.asked = None;
            self.view.answered = Some(self.run.attempt);
        }
    }

    fn stop(&mut self, status: Status, overtaken: bool) {
        if self.end.is_none() && !self.is_over() {
            self.view.ended = Some(status);
            self.view.overtaken = overtaken || status == Status::Deleted;
        }
        (self.live, self.progress, self.partial) = (None, None, None);
    }

    /// Drops the updates that EvalAI shows already.
    pub fn settle(&mut self, now: &Now) {
        if let Some((Interim::There, wanted)) = self.of_progress().zip(self.progress.clone()) {
            let known = self.read.unwrap_or(now.at);
            self.known_at = Some(self.known_at.unwrap_or(known));
            self.view.progress = self.view.progress.max(Some(wanted.what));
            self.progress = None;
        }
        match self.of_end() {
            Some(End::Done(status)) => self.close(Ended::Agreed { status, at: now.wall }),
            Some(End::Amend(status)) => self.close(Ended::Otherwise(status)),
            Some(End::Wait) => self.retry_at = now.at + UNCLEAR_PAUSE,
            // A list that brings the row meanwhile does not put the next try off.
            Some(End::Put) if self.retry_at <= now.at => {
                if let Some(why) = self.problem() {
                    self.refuse_end(why, now);
                }
            }
            Some(End::Put | End::Cancel) | None => {}
        }
    }

    /// The end is settled.
    pub fn close(&mut self, end: Ended) {
        self.view.end = Some(end);
        (self.view.last_error, self.view.unread) = (None, None);
        (self.end, self.live, self.progress, self.partial) = (None, None, None, None);
    }

    /// The end can't be written now. It is retried from time to time, after a read that finds a later cancel too: so no list
    /// of cancelled ones is asked for it.
    pub fn refuse_end(&mut self, why: String, now: &Now) {
        self.view.end = Some(Ended::Refused(why.clone()));
        self.live = None;
        self.write_failed(why, RETRY_END, now);
    }

    /// Its Leaderboard has changed. What that changes may be what its end was refused for, so that is tried at once.
    pub fn follow(&mut self, target: &Arc<Target>, now: Duration) {
        if self.target != *target {
            self.target = target.clone();
            self.misfit = None;
            self.retry_at = self.retry_at.min(now);
        }
    }

    /// The outline of what is written next; none of progress.
    pub fn outline(&self) -> Option<&Arc<Outline>> {
        match self.next_write()?.0 {
            Write::End => self.end.as_ref().map(|end| &end.what.1),
            Write::Partial => self.partial.as_ref().map(|partial| &partial.what),
            Write::Progress => None,
        }
    }

    /// Verdict on the update of progress; none without one, or without a row.
    fn of_progress(&self) -> Option<Interim> {
        let (row, read) = (self.view.row.as_ref()?, self.read?);
        let wanted = self.progress.as_ref()?.what;
        let (attempt, is_known) = (self.attempt(row, read), self.is_known(row, read));
        Some(guard::progress(row.status, attempt, is_known, wanted))
    }

    /// Verdict on partial results; none without some, or without a row.
    fn of_partial(&self) -> Option<Interim> {
        let (row, read) = (self.view.row.as_ref()?, self.read?);
        self.partial.as_ref()?;
        Some(guard::partial(row.status, self.attempt(row, read)))
    }

    /// Verdict on the update to an end; none without one, or without a read since.
    fn of_end(&self) -> Option<End> {
        let (row, read, want) = (self.view.row.as_ref()?, self.read?, self.end.as_ref()?);
        let since = !self.outdated && read >= want.since && read >= self.wrote_at;
        since.then(|| guard::end(row.status, self.attempt(row, read), want.what.0))
    }

    /// Why the end is not sent although EvalAI waits for it.
    fn problem(&self) -> Option<String> {
        let (outcome, outline) = &self.end.as_ref()?.what;
        let is_bare = *outcome == Outcome::Finished && outline.stored.is_none();
        let nothing = is_bare.then(|| "there are no stored results".to_owned());
        self.misfit.clone().or(nothing).or_else(|| self.foreign_phase())
    }

    /// EvalAI would put the results on another phase's leaderboard without an error.
    fn foreign_phase(&self) -> Option<String> {
        let (outcome, outline) = &self.end.as_ref()?.what;
        let phase = self.view.row.as_ref()?.phase?;
        (*outcome == Outcome::Finished && phase != outline.phase).then(|| {
            let (pk, ours) = (self.pk, outline.phase);
            format!(
                "EvalAI shows that submission {pk} belongs to phase {phase}, not to phase {ours}; set its phase back to {ours} in EvalAI"
            )
        })
    }

    /// EvalAI has taken a status of ours.
    pub fn wrote(&mut self, status: Status, now: &Now) {
        self.wrote_at = now.at;
        self.known_at = Some(self.known_at.unwrap_or(now.at));
        (self.failures, self.write_failures) = (0, 0);
        self.view.last_error = None;
        if let Some(row) = &self.view.row {
            let mut row = Row::clone(row);
            row.status = status;
            if !row.names(&self.run.job) {
                row.jobs.push(self.run.job.to_lowercase());
            }
            self.view.row = Some(Arc::new(row));
        }
    }

    /// A read failed: the next one is later each time.
    pub fn read_failed(&mut self, why: String, now: &Now) {
        self.retry_at = now.at + pause(self.failures);
        self.failures = self.failures.saturating_add(1);
        self.view.last_error = Some(why);
    }

    /// A read went well.
    pub fn read_done(&mut self) {
        self.failures = 0;
        if self.write_failures == 0 {
            self.view.last_error = match &self.view.image {
                Some(ImageAnswer::Unread(why)) if self.wants_image() => Some(why.clone()),
                _ => None,
            };
        }
    }

    /// The uploaded file could not be fetched: the next try is later each time, whatever is read of the row meanwhile.
    pub fn image_failed(&mut self, why: String, now: &Now) {
        self.image_at = now.at + pause(self.image_failures);
        self.image_failures = self.image_failures.saturating_add(1);
        self.view.last_error = Some(why);
    }

    /// Notes that the bucket's part of the end could not be read: the next try is later each time.
    pub fn payload_failed(&mut self, why: String, now: &Now) {
        self.retry_at = now.at + pause(self.write_failures);
        self.write_failures = self.write_failures.saturating_add(1);
        self.view.unread = Some(why);
    }

    /// A write failed: the next try is that much later.
    pub fn write_failed(&mut self, why: String, pause: Duration, now: &Now) {
        self.retry_at = now.at + pause;
        self.write_failures = self.write_failures.saturating_add(1);
        self.view.last_error = Some(why);
    }
}
