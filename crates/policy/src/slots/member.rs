//! The part of a cached Submission that counts for the others of its Leaderboard. Pure.

use std::borrow::Cow;

use jiff::Timestamp;

use super::turns::{Past, RUNS};
use leaderboard_api::{Attempt, JobNumber, Submission, SubmissionStatus, names};

#[derive(Debug)]
pub struct Member<'a> {
    pub uid: &'a str,
    pub team: Cow<'a, str>,
    track: &'a str,
    /// The one that runs or is to run next.
    pub attempt: Attempt,
    pub has_slot: bool,
    /// It has come to its end, and no other attempt is requested.
    pub is_over: bool,
    /// It starts nothing any more.
    pub is_leaving: bool,
    /// When its present or last run began.
    began: Option<Timestamp>,
    /// When a run ended that has begun.
    ended: Option<Timestamp>,
}

impl<'a> Member<'a> {
    /// `has_job`: whether it owns a Job of this name. A Job has a slot although the status may not name it.
    pub fn of(submission: &'a Submission, has_job: impl FnOnce(&str) -> bool) -> Self {
        let (meta, spec) = (&submission.metadata, &submission.spec);
        let name = meta.name.as_deref().unwrap_or_default();
        let status = submission.status.as_ref();
        let is_over = is_over(submission);
        let number = match status.filter(|status| !status.has_ended()) {
            Some(status) => JobNumber {
                attempt: submission.present_attempt(),
                retry: status.retry,
            },
            None => JobNumber::first(spec.attempt),
        };
        let times = status.map(|status| &status.times).filter(|_| !spec.check);
        let began = times.and_then(|times| times.scheduled.as_ref().or(times.started.as_ref()));
        // A submission that never ran does not show how long a run takes.
        let ended = times.and_then(|times| times.started.as_ref().and(times.finished.as_ref()));
        Self {
            uid: meta.uid.as_deref().unwrap_or_default(),
            team: if spec.check {
                check_team(name).into()
            } else {
                submission.team().unwrap_or_default().into()
            },
            track: status
                .and_then(|status| status.track.as_deref())
                .or(spec.track.as_deref())
                .unwrap_or_default(),
            attempt: number.attempt,
            has_slot: status.is_some_and(SubmissionStatus::has_slot) || !is_over && has_job(&names::job(name, number)),
            is_over,
            is_leaving: is_over || spec.cancel || meta.deletion_timestamp.is_some(),
            began: began.map(|time| time.0),
            ended: ended.map(|time| time.0),
        }
    }

    /// Adds when its team was last served, and how long its run took if that has ended.
    pub(super) fn note(&self, past: &mut Past) {
        let Some(began) = self.began else { return };
        match past.served.get_mut(&*self.team) {
            Some(served) => *served = began.max(*served),
            None => _ = past.served.insert(self.team.to_string(), began),
        }
        if let Some(ended) = self.ended {
            let run = (ended, ended.duration_since(began).as_secs().max(0));
            let runs = past.runs.entry(self.track.to_owned()).or_default();
            runs.push(run);
            if runs.len() >= 4 * RUNS {
                runs.sort_by_key(|run| std::cmp::Reverse(*run));
                runs.truncate(RUNS);
            }
        }
    }
}

/// It has come to its end, and no other attempt is requested.
pub fn is_over(submission: &Submission) -> bool {
    let status = submission.status.as_ref();
    status.is_some_and(|status| status.has_ended() && !status.is_followed_by(submission.spec.attempt))
}

/// The team as which a check stands in line: its own, so that no limit of a team holds it up.
pub fn check_team(name: &str) -> String {
    format!("check/{name}")
}

/// The part of a Submission that counts for the others, as a text. An equal text means that no other submission has to look.
pub fn mark(submission: &Submission) -> String {
    format!("{:?}", Member::of(submission, |_| false))
}
