//! The next steps of one submission: those of the table of reasons, and the command of this plugin that takes one.

use leaderboard_api::{Failure, FailureClass, Reason, Submission, conditions, reasons};

use crate::board::{self, Observed};
use crate::facts::{self, has_ended};

/// A text of the table of reasons about the worker that failed.
pub(super) fn of_worker(text: &str, worker: Option<i32>) -> String {
    let text = reasons::plain(text);
    worker.map_or(text.clone(), |worker| text.replace("<n>", &worker.to_string()))
}

/// The next steps; that of the present reason comes first.
pub(super) fn next_steps(submission: &Submission, leaderboard: Observed<'_>) -> Vec<String> {
    let status = facts::status(submission);
    let mut reasons: Vec<Reason> = status
        .present_reason()
        .and_then(|reason| reason.known())
        .into_iter()
        .collect();
    // While the run is being stopped, the reason is that of the stop.
    reasons.extend(status.failure.as_ref().and_then(|failure| failure.reason.known()));
    let doubt = conditions::get(&status.conditions, conditions::PLAUSIBLE).filter(|c| c.status == "False");
    reasons.extend(doubt.and_then(|c| c.reason.known()));
    let problems = if has_ended(submission) {
        Vec::new()
    } else {
        board::problems(&submission.spec.leaderboard_name, leaderboard)
    };
    reasons.extend(problems.iter().filter_map(|(_, reason)| *reason));
    let worker = status.failure.as_ref().and_then(|failure| failure.worker);
    let mut steps: Vec<String> = Vec::new();
    let next = |reason| next_step(status.failure.as_deref(), reason);
    let steps_of = |reason| match reason {
        // The command stands below it.
        Reason::Cancelled => "To continue it, resume it.".to_owned(),
        reason => of_worker(next(reason), worker),
    };
    for next in reasons.into_iter().map(steps_of) {
        if !steps.contains(&next) {
            steps.push(next);
        }
    }
    if status.attempt.is_none() && problems.is_empty() {
        steps.push("Nothing. If it lasts for a minute, check that the operator runs.".to_owned());
    }
    steps
}

/// The next step of a reason: of an infrastructure failure the one that hosts do after it.
fn next_step(failure: Option<&Failure>, reason: Reason) -> &'static str {
    let is_of_host = failure.is_some_and(|f| f.reason == reason && f.class == FailureClass::Infrastructure);
    if is_of_host {
        reason.after_failure()
    } else {
        reason.next_step()
    }
}

/// The command of this plugin for the next step.
pub(super) fn verb(submission: &Submission) -> Option<&'static str> {
    let status = facts::status(submission);
    // A check is run again, not resumed.
    if submission.metadata.deletion_timestamp.is_some() || submission.spec.check {
        return None;
    }
    if has_ended(submission) {
        let is_infrastructure = |f: &Failure| f.class == FailureClass::Infrastructure;
        let is_resumable = status.failure.as_deref().is_some_and(is_infrastructure);
        return (is_resumable || status.shows(Reason::Cancelled)).then_some("resume");
    }
    let of_people = [Reason::TrackNotFound, Reason::ImageMissing, Reason::PhaseDiffers];
    let reason = status.present_reason();
    reason
        .is_some_and(|reason| reason.is_one_of(&of_people))
        .then_some("cancel")
}
