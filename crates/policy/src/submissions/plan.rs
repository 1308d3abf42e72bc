//! The steps of one reconcile of a submission: the result of `decide`, which `act` carries out.

use std::time::Duration;

use crate::questions::{Input, Row};
use crate::slots::turns::InLine;
use crate::view::{LogPlace, ReportDemand};
use leaderboard_api::{JobNumber, ReasonName, SubmissionStatus, names};
use leaderboard_contract::run::Stop;

/// The result of a reconcile: the status to show, the actions in order, and the events.
#[derive(Clone, Debug, PartialEq)]
pub struct Plan {
    pub status: SubmissionStatus,
    pub write: StatusWrite,
    pub actions: Vec<Action>,
    pub events: Vec<Event>,
    /// The report that the next decision needs; None: none.
    pub report: Option<ReportDemand>,
    /// When to look again without any other cause.
    pub requeue: Option<Duration>,
}

/// The use that a submission makes of its slot and of its place in line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SlotUse {
    /// The Job is about to be created, or exists.
    Holds,
    /// It stands in line for one, and for nothing else; or it has one, and its file is being copied.
    Waits,
    /// It waits for something else, or has come to its end: a later attempt stands in line like anyone.
    Leaves,
}

impl Plan {
    /// The use that the plan makes of the slot.
    pub fn slot(&self) -> SlotUse {
        if self.status.job_name.is_some() && !self.status.has_ended() {
            SlotUse::Holds
        } else if self.actions.iter().any(|action| matches!(action, Action::JoinLine(_))) {
            SlotUse::Waits
        } else {
            SlotUse::Leaves
        }
    }

    /// True if it creates a Job.
    pub fn creates_job(&self) -> bool {
        self.actions.iter().any(|action| matches!(action, Action::CreateJob(_)))
    }
}

/// When the status is written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StatusWrite {
    /// Nothing is new, or what is new may wait.
    NotNow,
    Now,
    /// In its turn among all whose place in line has moved.
    InTurn,
}

/// One thing to do. All are safe to repeat.
#[derive(Clone, Debug, PartialEq)]
pub enum Action {
    /// Put our finalizer on the object, which goes before the status, or take it off.
    SetFinalizer(bool),
    /// All but the slot is settled: wait for one at this place. Shows nothing new until it is known who is next.
    JoinLine(InLine),
    /// Ask this in the background.
    Ask(Question),
    /// Create this Job.
    CreateJob(JobNumber),
    /// Delete a Job and its Pods with this grace period.
    DeleteJob {
        name: String,
        uid: String,
        grace_seconds: i64,
    },
    /// Remove a Pod that does not end.
    DeletePod { name: String, uid: String },
    /// Write our own mark into `logcopy/owner`, so that a Pod that can no longer be reached stops itself.
    TakeOwnership,
    /// Ask the Pod to stop.
    StopPod { pod: String, stop: Stop },
    /// Keep the tail of the log that explains the failure, from the first of these places that has it.
    KeepLog { places: Vec<LogPlace> },
    /// Send an update to EvalAI.
    UpdateEvalai(EvalaiUpdate),
    /// Every system has the end: drop all that is remembered for it.
    Forget,
    /// Write the row.
    Record(TableUpdate),
    /// Delete the object, if it is still the one that was decided on.
    DeleteSubmission { uid: String, resource_version: String },
}

/// A question, whose answer wakes the submission.
#[derive(Clone, Debug, PartialEq)]
pub enum Question {
    /// Does another program's row of the table show a run?
    Row(Box<Row>),
    /// Is the submitted file of EvalAI's in the bucket?
    Input(Box<Input>),
    /// Does EvalAI want it to run?
    Evalai,
    /// Does it still, whatever was answered before?
    EvalaiAnew,
    /// Has it come to an end in EvalAI, from now on?
    EvalaisEnd,
}

/// An update of EvalAI.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum EvalaiUpdate {
    Queued,
    Running,
    /// A partial result; `is_shown`: with the metrics over what is done so far, else with the original's zeros.
    Partial {
        is_shown: bool,
    },
    Finished,
    Failed,
    Cancelled,
}

/// A write to the table.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TableUpdate {
    /// How a run stands, with the next write of its row.
    Progress,
    End,
}

/// An event of Kubernetes, published after the status was written.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Event {
    pub warning: bool,
    pub reason: ReasonName,
    pub message: String,
}

/// Name of the Job that the present attempt has or will have.
pub fn job_name(submission: &str, status: &SubmissionStatus) -> String {
    names::job(submission, status.job_number())
}
