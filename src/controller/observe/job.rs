//! A Job reduced to what decisions depend on. Pure.

use k8s_openapi::api::batch::v1::{Job, JobCondition};
use kube::ResourceExt;

use crate::controller::view::{JobEnd, JobView};

/// Reduces a Job.
pub fn view(job: &Job) -> JobView {
    JobView {
        name: job.name_any(),
        uid: job.uid().unwrap_or_default(),
        created: job.metadata.creation_timestamp.as_ref().map(|t| t.0),
        end: end(job),
        deleting: job.metadata.deletion_timestamp.is_some(),
        has_ttl: job
            .spec
            .as_ref()
            .is_some_and(|s| s.ttl_seconds_after_finished.is_some()),
        failed_create: None,
    }
}

fn end(job: &Job) -> Option<JobEnd> {
    let conditions = job.status.as_ref()?.conditions.as_deref()?;
    let find = |type_: &str| {
        conditions
            .iter()
            .find(|c: &&JobCondition| c.type_ == type_ && c.status == "True")
    };
    if let Some(condition) = find("Complete") {
        return Some(JobEnd::Complete {
            at: condition.last_transition_time.as_ref().map(|t| t.0),
        });
    }
    let condition = find("Failed")?;
    Some(JobEnd::Failed {
        at: condition.last_transition_time.as_ref().map(|t| t.0),
        reason: condition.reason.clone().unwrap_or_default(),
        message: condition.message.clone().unwrap_or_default(),
    })
}
