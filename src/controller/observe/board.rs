//! The waiting line of each Leaderboard, worked out again only when something has changed.
//!
//! Holds the slots that were granted and whose Jobs the caches do not show yet, so that two passes at once never start
//! more than `running.total`.

use std::collections::HashSet;
use std::sync::{Mutex, MutexGuard, PoisonError};

use kube::ResourceExt;

use super::uid_of;
use crate::api::{Leaderboard, Submission, conditions};
use crate::controller::context::Context;
use crate::controller::turns::{InLine, Limits, turns};
use crate::controller::view::Turn;

/// Lines by namespace and name of their Leaderboard.
#[derive(Default)]
pub struct Board {
    granted: Mutex<HashSet<String>>,
}

impl Board {
    /// Whether a submission without a Job may start. `Go` takes the slot.
    pub fn turn(&self, context: &Context, submission: &Submission, leaderboard: Option<&Leaderboard>) -> Turn {
        let waits = submission.status.as_ref().is_none_or(|s| s.job.is_none());
        let Some(leaderboard) = leaderboard.filter(|_| waits && !is_over(submission)) else {
            return Turn::Go;
        };
        let spec = &leaderboard.spec;
        let limits = Limits {
            total: spec.running.total.and_then(|n| usize::try_from(n).ok()),
            per_team: spec.running.per_team.and_then(|n| usize::try_from(n).ok()),
            paused: spec.paused,
        };
        let uid = uid_of(submission);
        if limits == Limits::default() {
            return Turn::Go;
        }
        let mut granted = self.lock();
        if granted.contains(&uid) && !limits.paused {
            return Turn::Go;
        }
        let (line, occupied) = line_of(context, leaderboard, &granted);
        let turn = turns(line, &occupied, limits)
            .remove(&uid)
            .unwrap_or(Turn::Wait { position: 0, eta: None });
        if turn == Turn::Go {
            granted.insert(uid);
        }
        turn
    }

    /// Gives a slot back: its holder did not start, or has come to its end.
    pub fn release(&self, uid: &str) {
        self.lock().remove(uid);
    }

    fn lock(&self) -> MutexGuard<'_, HashSet<String>> {
        self.granted.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

fn line_of(context: &Context, leaderboard: &Leaderboard, granted: &HashSet<String>) -> (Vec<InLine>, Vec<String>) {
    let (name, namespace) = (leaderboard.name_any(), leaderboard.namespace());
    let mut line = Vec::new();
    let mut occupied = Vec::new();
    for other in context.stores.submissions.state() {
        if other.spec.leaderboard != name || other.namespace() != namespace || is_over(&other) {
            continue;
        }
        let uid = uid_of(other.as_ref());
        if granted.contains(&uid) || other.status.as_ref().is_some_and(|s| s.job.is_some()) {
            occupied.push(team(&other));
        } else if can_start(&other) {
            line.push(in_line(uid, &other));
        }
    }
    (line, occupied)
}

fn in_line(uid: String, submission: &Submission) -> InLine {
    let submitted = submission.status.as_ref().and_then(|s| s.times.submitted.as_ref());
    let created = submission.metadata.creation_timestamp.as_ref();
    let submitted = submitted.or(created).map(|t| t.0).unwrap_or_default();
    InLine {
        uid,
        team: team(submission),
        priority: submission.spec.priority,
        submitted,
    }
}

fn team(submission: &Submission) -> String {
    let known = submission
        .status
        .as_ref()
        .and_then(|s| s.team.as_ref())
        .or(submission.spec.team.as_ref());
    known
        .and_then(|t| t.id.clone().or_else(|| t.name.clone()))
        .unwrap_or_default()
}

fn is_over(submission: &Submission) -> bool {
    let status = submission.status.as_ref();
    let ended = status.is_some_and(|s| conditions::is_true(&s.conditions, conditions::FINISHED));
    ended
        && status
            .and_then(|s| s.attempt)
            .is_some_and(|attempt| submission.spec.attempt <= attempt)
}

fn can_start(submission: &Submission) -> bool {
    let refused = |s: &crate::api::SubmissionStatus| {
        conditions::get(&s.conditions, conditions::ACCEPTED).is_some_and(|c| c.status == "False")
    };
    !submission.spec.cancel
        && submission.metadata.deletion_timestamp.is_none()
        && !submission.status.as_ref().is_some_and(refused)
}
