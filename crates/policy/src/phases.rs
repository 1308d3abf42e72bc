//! The phases of a submission's life that a status ends: each with its beginning and its end, for metrics and traces.
//!
//! Called by `act` with each status that was stored. Pure: all times are those of the status, of its object, Job and Pod, so that a
//! controller that was restarted in the middle of a phase finds its beginning. Kubernetes keeps most of them in whole seconds.

use jiff::Timestamp;

use super::view::View;
use leaderboard_api::conditions::{ARCHIVED, FINISHED, PUBLISHED, RECORDED, RUNNING};
use leaderboard_api::{Attempt, Ingested, Reason, Submission, SubmissionStatus};

/// A stage of a submission's life.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Phase {
    /// From EvalAI's message to the object. Without a message it has no length.
    Intake,
    /// From the object, or the resume, to the plan: Leaderboard, image, EvalAI's word.
    Accept,
    /// Until its Job is made: for a place in line, or the pause before another Job.
    Wait,
    /// From the Job to a node.
    Schedule,
    /// From the node to running agents: pulls, contents, what an earlier attempt stored.
    Start,
    /// Until the run of the Job is over.
    Run,
    /// One attempt, with all of the above.
    Attempt,
    /// From the end of the run until its results in S3 are read.
    Archive,
    /// From the end of the run until the table has it.
    Record,
    /// From the end of the run until EvalAI has it.
    Publish,
}

impl Phase {
    pub const ALL: [Self; 10] = [
        Self::Intake,
        Self::Accept,
        Self::Wait,
        Self::Schedule,
        Self::Start,
        Self::Run,
        Self::Attempt,
        Self::Archive,
        Self::Record,
        Self::Publish,
    ];

    /// As metrics and traces name it.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Intake => "intake",
            Self::Accept => "accept",
            Self::Wait => "wait",
            Self::Schedule => "schedule",
            Self::Start => "start",
            Self::Run => "run",
            Self::Attempt => "attempt",
            Self::Archive => "archive",
            Self::Record => "record",
            Self::Publish => "publish",
        }
    }
}

/// A phase that is over.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Ended {
    pub phase: Phase,
    pub start: Timestamp,
    /// Never before `start`, whatever the clocks of other machines say.
    pub end: Timestamp,
}

/// The phases that end with `new`, which is stored in place of what `view` shows.
pub fn ended(view: &View, new: &SubmissionStatus) -> Vec<Ended> {
    let Some(attempt) = new.attempt else { return Vec::new() };
    let before = view.submission.status.as_ref();
    let is_same = |before: &&SubmissionStatus| before.attempt == Some(attempt);
    let mut step = Step {
        view,
        old: restarted(&view.submission, new).or(before.filter(is_same)),
        new,
        ended: Vec::new(),
    };
    if before.is_none_or(|before| before.attempt.is_none()) {
        let created = created(view);
        step.add(Phase::Intake, Some(sent(view).unwrap_or(created)), created);
    }
    step.reach_job();
    step.of_job();
    step.reach_end();
    step.ended
}

/// The status of the attempt that a restart ends with `new`: all that ends then is of that attempt.
pub fn restarted<'a>(submission: &'a Submission, new: &SubmissionStatus) -> Option<&'a SubmissionStatus> {
    let old = submission.status.as_ref().filter(|old| !old.has_ended())?;
    (old.has_run() && new.is_restart() && old.attempt < new.attempt).then_some(old)
}

/// From one status of an attempt to the next.
struct Step<'a> {
    view: &'a View,
    /// None: the attempt is new.
    old: Option<&'a SubmissionStatus>,
    new: &'a SubmissionStatus,
    ended: Vec<Ended>,
}

impl Step<'_> {
    /// Adds nothing if the start is unknown.
    fn add(&mut self, phase: Phase, start: Option<Timestamp>, end: Timestamp) {
        let ended = start.map(|start| Ended {
            phase,
            start: start.min(end),
            end,
        });
        self.ended.extend(ended);
    }

    fn reach_job(&mut self) {
        let (old, new) = (self.old, self.new);
        let accepted = new.times.accepted.as_ref().map(|time| time.0);
        if let Some(accepted) = accepted
            && old.is_none_or(|old| old.times.accepted.is_none())
        {
            self.add(Phase::Accept, self.begun(), accepted);
        }
        if new.job_name.is_some() && old.and_then(|old| old.job_name.as_ref()) != new.job_name.as_ref() {
            let pause = old.and_then(|old| old.next_retry_time.as_ref());
            let start = if new.retry > 0 {
                pause.map(|time| time.0)
            } else {
                accepted
            };
            self.add(Phase::Wait, start, self.view.now);
        }
    }

    fn of_job(&mut self) {
        let Some(started) = self.started() else { return };
        let had_run = self.old.is_some_and(has_run);
        let is_over = self.is_job_over();
        if !had_run && (has_run(self.new) || is_over) {
            let scheduled = self.view.pod.as_ref().and_then(|pod| pod.scheduled);
            let created = self.view.job.ours().and_then(|job| job.created);
            if let Some(scheduled) = scheduled {
                self.add(Phase::Schedule, created, scheduled);
            }
            self.add(Phase::Start, scheduled, started);
        }
        if is_over {
            let end = self.new.times.finished.as_ref().filter(|_| self.new.has_ended());
            let end = end.map(|time| time.0).or(self.view.ended_at());
            self.add(Phase::Run, Some(started), end.unwrap_or(self.view.now));
        }
    }

    fn reach_end(&mut self) {
        let finished = self.new.end();
        if let Some(end) = finished.filter(|_| !self.old.is_some_and(SubmissionStatus::has_ended)) {
            self.add(Phase::Attempt, self.begun(), end.last_transition_time.0);
        } else if restarted(&self.view.submission, self.new).is_some() {
            self.add(Phase::Attempt, self.begun(), self.view.now);
        }
        let over = self.new.times.finished.as_ref().map(|time| time.0);
        for (type_, phase) in [
            (ARCHIVED, Phase::Archive),
            (RECORDED, Phase::Record),
            (PUBLISHED, Phase::Publish),
        ] {
            let was = self.old.is_some_and(|old| old.is_true(type_));
            let is = self
                .new
                .condition(type_)
                .filter(|found| found.is_true() && !was && finished.is_some());
            let Some(is) = is else { continue };
            let published = self.new.times.published.as_ref().filter(|_| phase == Phase::Publish);
            let end = published.unwrap_or(&is.last_transition_time).0;
            self.add(phase, over, end);
        }
    }

    /// When the attempt began: the first one with the object, any other with its status.
    fn begun(&self) -> Option<Timestamp> {
        if self.old.unwrap_or(self.new).attempt == Some(Attempt::FIRST) {
            return Some(created(self.view));
        }
        let mut known = self.old.into_iter().chain([self.new]);
        let shown = known.find_map(|status| status.condition(FINISHED).filter(|end| !end.is_true()));
        shown.map(|end| end.last_transition_time.0)
    }

    /// When the agents of the present Job have started: by its Pod, by the status if that speaks of this Job, or when it was seen.
    fn started(&self) -> Option<Timestamp> {
        let of_pod = self.view.pod.as_ref().and_then(|pod| pod.agent_started);
        let known = self.old.unwrap_or(self.new);
        let of_status = known.times.started.as_ref().map(|time| time.0);
        let scheduled = known.times.scheduled.as_ref().map(|time| time.0);
        let of_status = of_status.filter(|started| scheduled.is_some_and(|scheduled| *started >= scheduled));
        let seen = || {
            let running = known.condition(RUNNING).filter(|running| running.is_true());
            running.map(|running| running.last_transition_time.0)
        };
        of_pod.or(of_status).or_else(seen)
    }

    /// True if no further run of the present Job comes.
    fn is_job_over(&self) -> bool {
        let Some(old) = self.old else {
            return self.new.has_ended();
        };
        let is_replaced =
            self.new.attempt > old.attempt || self.new.retry > old.retry || self.new.recreated > old.recreated;
        is_replaced || (self.new.has_ended() && !old.has_ended())
    }
}

/// True if agents of the present Job run, or have run and may come back.
fn has_run(status: &SubmissionStatus) -> bool {
    status
        .condition(RUNNING)
        .is_some_and(|running| running.is_true() || running.reason == Reason::Replacing)
}

fn created(view: &View) -> Timestamp {
    let created = view.submission.metadata.creation_timestamp.as_ref();
    created.map_or(view.now, |time| time.0)
}

/// When the message was sent that made the object.
fn sent(view: &View) -> Option<Timestamp> {
    Timestamp::from_millisecond(Ingested::of(&view.submission)?.sent).ok()
}
