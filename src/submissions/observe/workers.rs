//! The questions to other systems in the background: a reconcile asks, and a later one finds the answer in memory.

use std::sync::Arc;

use jiff::Timestamp;
use kube::Client;

use crate::ask::Asker;
use crate::runtime::objects::{Wake, by_key, key_of, log_span_of, uid};
use crate::submissions::failure_log::{self, FailureLog, Tail};
use crate::submissions::fences::{self, Fence};
use crate::submissions::inputs;
use crate::submissions::reports::{self, Report, RunFiles};
use crate::submissions::rows;
use leaderboard_api::{Submission, SubmissionStatus};
use leaderboard_aws::clients::Aws;
use leaderboard_aws::table::Tables;
use leaderboard_base::tasks::Tasks;
use leaderboard_evalai::Hub;
use leaderboard_policy::questions::{Input, Row};
use leaderboard_policy::view::{LogPlace, ReportDemand};

/// Asks them, and has what was answered.
pub struct Workers {
    pub reports: Asker<Report>,
    pub fences: Asker<Fence>,
    pub logs: Asker<FailureLog>,
    pub rows: Asker<Row>,
    pub inputs: Asker<Input>,
}

impl Workers {
    /// Starts them. Each calls its own result of `wake` with each submission that has its answer.
    pub fn start(
        aws: &Aws,
        tables: Arc<Tables>,
        hub: &Hub,
        client: &Client,
        tasks: &Tasks,
        wake: impl Fn() -> Wake<Submission>,
    ) -> Self {
        let wake = || by_key(wake());
        let (logs, files) = ((client.clone(), aws.clone()), (aws.clone(), hub.clone()));
        Self {
            reports: Asker::start("reports", tasks, wake(), aws.clone(), reports::read),
            fences: Asker::start("fences", tasks, wake(), aws.clone(), fences::write),
            logs: Asker::start("failure logs", tasks, wake(), logs, failure_log::keep),
            rows: Asker::start("rows", tasks, wake(), tables, rows::read),
            inputs: Asker::start("inputs", tasks, wake(), files, inputs::copy),
        }
    }

    /// Notes which report is needed of a run that `ended` then, if it has; None: none any more.
    pub fn demand_report(
        &self,
        submission: &Submission,
        status: &SubmissionStatus,
        ended: Timestamp,
        demand: Option<ReportDemand>,
    ) {
        let Some((demand, files)) = demand.zip(files(submission, status)) else {
            self.reports.forget(uid(submission));
            return;
        };
        let report = Report { demand, ended, files };
        self.reports.want(&key_of(submission), report, log_span_of(submission));
    }

    /// Writes our own mark in the place of a lost Pod's.
    pub fn want_fence(&self, submission: &Submission, status: &SubmissionStatus) {
        let Some(files) = files(submission, status) else { return };
        let since = status.times.stopping.as_ref().map_or(0, |t| t.0.as_second());
        let fence = Fence {
            job: status.job_number(),
            mark: format!("controller-{since}"),
            files,
        };
        self.fences.want(&key_of(submission), fence, log_span_of(submission));
    }

    /// Keeps the log that explains a failure.
    pub fn keep_log(&self, submission: &Submission, status: &SubmissionStatus, places: Vec<LogPlace>) {
        let Some(files) = files(submission, status) else { return };
        let log = FailureLog {
            job: status.job_number(),
            places,
            is_over: status.times.finished.is_some(),
            files,
        };
        self.logs.want(&key_of(submission), log, log_span_of(submission));
    }

    /// The log of the failure that a status describes.
    pub fn tail(&self, submission: &Submission, status: &SubmissionStatus) -> Option<Tail> {
        failure_log::kept(&self.logs.get(uid(submission)), status.job_number())
    }

    /// Drops what is known for an object that is gone, or that needs nothing more.
    pub fn forget(&self, uid: &str) {
        self.reports.forget(uid);
        self.fences.forget(uid);
        self.logs.forget(uid);
        self.rows.forget(uid);
        self.inputs.forget(uid);
    }
}

/// The files of a run. Without a plan their place is not known.
fn files(submission: &Submission, status: &SubmissionStatus) -> Option<Arc<RunFiles>> {
    let plan = status.plan.as_ref()?;
    Some(RunFiles::of(plan, uid(submission)))
}
