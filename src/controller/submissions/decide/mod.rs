//! What is to be done for one submission: a pure function from a `View` to a `Plan`.
//!
//! Owns the state machine of docs/states.md. Called by the reconciler, once a pass. Knows no client, no clock but the
//! one in the view, and no `async`. One file a stage of life: `accept`, `line`, `live`, `start`, `stop`, `end`, `after`; `blame`
//! decides whose fault a crash was, `crashes` counts them, `allowance` bounds those of a team's simulators, `retention` deletes what has ended long ago, `failure` names the
//! causes of an end and `next_steps` what to do about them, `trouble` the causes of a wait.

mod accept;
mod after;
mod allowance;
mod blame;
mod crashes;
mod draft;
mod end;
mod failure;
mod isolation;
mod line;
mod live;
mod log;
mod next_steps;
mod reading;
mod retention;
mod start;
mod stop;
#[cfg(test)]
mod tests;
mod trouble;

use std::time::Duration;

use super::archive::digest::ReportId;
use super::view::{ReportDemand, View};
use crate::controller::slots::turns::InLine;
use crate::pod::run::Stop;
pub use after::previous_controller;
use draft::Draft;
use leaderboard_api::{SubmissionStatus, names};
pub use log::{LogAt, LogPlace};

/// What a pass wants: the status to show, then the actions in order, then the events.
#[derive(Clone, Debug, PartialEq)]
pub struct Plan {
    pub status: SubmissionStatus,
    pub actions: Vec<Action>,
    pub events: Vec<Event>,
    /// The report that the next decision needs; None: none.
    pub report: Option<ReportDemand>,
    /// When to look again without any other cause.
    pub requeue: Option<Duration>,
}

/// One thing to do. All are safe to repeat.
#[derive(Clone, Debug, PartialEq)]
pub enum Action {
    /// Put our finalizer on the object; goes before the status.
    AddFinalizer,
    /// Take our finalizer off the object.
    ReleaseFinalizer,
    /// All but the slot is settled: wait for one at this place. Shows nothing new until it is known who is next.
    JoinLine(InLine),
    /// Create the Job of this attempt and retry.
    CreateJob { attempt: i64, retry: i32 },
    /// Delete a Job and its Pods with this grace period.
    DeleteJob {
        name: String,
        uid: String,
        grace_seconds: i64,
    },
    /// Remove a Pod that does not end.
    ForceDeletePod { name: String, uid: String },
    /// Write our own mark into `logcopy/owner`, so that a Pod we lost sight of stops itself.
    TakeOwnership,
    /// EvalaiUpdate the Pod to stop.
    AnnotateStop { pod: String, stop: Stop },
    /// Let Kubernetes remove the finished Job after its time.
    SetJobTtl { name: String, seconds: i32 },
    /// Keep the tail of the log that explains the failure, from the first of these places that has it.
    KeepLog { places: Vec<LogPlace> },
    /// Read the texts of this report, so that they can be published.
    ReadTexts { of: ReportId },
    /// Ask EvalAI for the submission.
    AskEvalai,
    /// Look for its end in EvalAI from now on, although nothing was sent to EvalAI yet.
    FollowEvalai,
    /// EvalaiUpdate EvalAI.
    UpdateEvalai(EvalaiUpdate),
    /// Forget what EvalAI last said, so that it is asked anew.
    ForgetEvalai,
    /// Every system has the end: drop all that is remembered for it.
    Forget,
    /// Write the row.
    Record { end: bool },
    /// Delete the object, if it is still the one that was decided on.
    DeleteSubmission { uid: String, resource_version: String },
}

/// What is sent to EvalAI.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum EvalaiUpdate {
    Queued,
    Running,
    Partial,
    Finished,
    Failed,
    Cancelled,
}

/// An event of Kubernetes, published after the status was written.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Event {
    pub warning: bool,
    pub reason: String,
    pub message: String,
}

/// Decides one pass.
pub fn decide(view: &View) -> Plan {
    let mut draft = Draft::new(view);
    if !draft.has_finalizer() && !draft.is_deleting() {
        draft.act(Action::AddFinalizer);
    }
    if draft.begin_attempt() {
        after::leave_job(&mut draft);
        draft.requeue_in(Duration::ZERO);
        return draft.into_plan();
    }
    if !draft.is_finished() {
        live::decide(&mut draft);
    }
    if draft.is_finished() {
        after::decide(&mut draft);
    }
    draft.into_plan()
}

/// Name of the Job that the present attempt has or will have.
pub fn job_name(submission: &str, status: &SubmissionStatus) -> String {
    names::job(submission, status.attempt.unwrap_or(1), status.retry)
}
