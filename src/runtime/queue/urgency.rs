//! How urgent an event is: by what the object, its Job or its Pod shows. Pure.

use super::Class;
use crate::kubernetes::objects::{ContainerStatus, Job, Pod};
use leaderboard_api::{Submission, SubmissionStatus};
use leaderboard_policy::submissions::Plan;
use leaderboard_policy::view::Stage;

/// Conditions of a Job that has ended, or is about to.
const JOB_ENDS: [&str; 4] = ["Complete", "Failed", "SuccessCriteriaMet", "FailureTarget"];

/// A change of the Submission itself.
pub fn of_submission(submission: &Submission) -> Class {
    of(submission, submission.status.as_ref())
}

/// An answer of S3, of the table or of the API server.
pub fn of_answer(submission: &Submission) -> Class {
    if submission.status.as_ref().is_some_and(SubmissionStatus::has_ended) {
        return Class::Urgent;
    }
    of_submission(submission)
}

/// News of EvalAI. For a submission that has a Job it is a cancel, or what became of a write.
pub fn of_evalai(submission: &Submission) -> Class {
    match of_submission(submission) {
        Class::Refresh => Class::Urgent,
        other => other,
    }
}

/// A change of its Job.
pub fn of_job(job: &Job, is_gone: bool) -> Class {
    let conditions = job.status.conditions.iter();
    let mut ends = conditions.filter(|c| &*c.status == "True" && JOB_ENDS.contains(&&*c.type_));
    let has_ended = is_gone || job.metadata.deletion_timestamp.is_some() || ends.next().is_some();
    urgent_or(has_ended, Class::Refresh)
}

/// A change of its Pod. Containers that run next to the agents, such as logcopy, may end later.
pub fn of_pod(pod: &Pod, is_gone: bool) -> Class {
    let phase = pod.status.phase.as_deref();
    let is_over = phase.is_some_and(|phase| ["Succeeded", "Failed"].contains(&phase));
    let containers = &pod.status.container_statuses;
    let has_ended = |c: &ContainerStatus| c.state.ended().is_some();
    let all_ended = !containers.is_empty() && containers.iter().all(has_ended);
    let is_deleting = pod.metadata.deletion_timestamp.is_some();
    urgent_or(is_gone || is_over || all_ended || is_deleting, Class::Refresh)
}

/// Urgency that a reconcile has decided, for all that follows it.
pub fn after(submission: &Submission, plan: &Plan) -> Class {
    let awaits_report_of_end = plan.report.as_ref().is_some_and(|demand| demand.stage > Stage::Live);
    if awaits_report_of_end && !plan.status.has_ended() {
        return Class::Urgent;
    }
    of(submission, Some(&plan.status))
}

fn of(submission: &Submission, status: Option<&SubmissionStatus>) -> Class {
    let is_deleting = submission.metadata.deletion_timestamp.is_some();
    let Some(status) = status else {
        return urgent_or(is_deleting || submission.spec.cancel, Class::New);
    };
    let is_behind = status.is_followed_by(submission.spec.attempt);
    if status.has_ended() {
        return urgent_or(is_deleting, if is_behind { Class::New } else { Class::Refresh });
    }
    let stops = is_behind || submission.spec.cancel || status.failure.is_some() || status.times.stopping.is_some();
    let has_job = status.job_name.is_some();
    urgent_or(is_deleting || stops, if has_job { Class::Refresh } else { Class::New })
}

fn urgent_or(is_urgent: bool, other: Class) -> Class {
    if is_urgent { Class::Urgent } else { other }
}

#[cfg(test)]
mod tests;
