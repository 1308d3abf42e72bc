//! A Job reduced to what decisions depend on. Pure.

use crate::kubernetes::objects::{Job, JobCondition, Pod};
use leaderboard_api::SharedText;
use leaderboard_api::text::{LONGEST_MESSAGE, one_line};
use leaderboard_policy::view::{JobEnd, JobView, Suspension};

/// Reduces a Job. `pod` is its newest.
pub fn view(job: &Job, pod: Option<&Pod>) -> JobView {
    JobView {
        name: job.metadata.name.to_string(),
        uid: job.metadata.uid.to_string(),
        created: job.metadata.creation_timestamp.as_ref().map(|t| t.0),
        started: job.status.start_time.as_ref().map(|t| t.0),
        suspension: suspension(job),
        end: end(job).or_else(|| pod.and_then(completion)),
        deleting: job.metadata.deletion_timestamp.is_some(),
        failed_create: None,
    }
}

/// The label counts for a Job that the host's own webhook has given its queue, too.
fn suspension(job: &Job) -> Option<Box<Suspension>> {
    let is_done = |c: &&JobCondition| &*c.type_ == "Suspended" && &*c.status == "True";
    let done = job.status.conditions.iter().find(is_done);
    job.spec.suspend.then(|| {
        Box::new(Suspension {
            since: done.and_then(|c| c.last_transition_time.as_ref()).map(|time| time.0),
            queue: job.metadata.labels.queue.as_deref().map(SharedText::from),
        })
    })
}

/// A Pod that has succeeded completes its Job, which has one completion. The Job controller reports it some seconds later.
fn completion(pod: &Pod) -> Option<JobEnd> {
    let status = &pod.status;
    if status.phase.as_deref() != Some("Succeeded") {
        return None;
    }
    let ends = status
        .all_containers()
        .filter_map(|container| container.state.ended()?.finished_at.as_ref());
    Some(JobEnd::Complete {
        at: ends.map(|time| time.0).max(),
    })
}

fn end(job: &Job) -> Option<JobEnd> {
    let conditions = &job.status.conditions;
    let find = |type_: &str| conditions.iter().find(|c| &*c.type_ == type_ && &*c.status == "True");
    if let Some(condition) = find("Complete") {
        return Some(JobEnd::Complete {
            at: condition.last_transition_time.as_ref().map(|t| t.0),
        });
    }
    let condition = find("Failed")?;
    Some(JobEnd::Failed {
        at: condition.last_transition_time.as_ref().map(|t| t.0),
        reason: condition.reason.as_deref().unwrap_or_default().to_owned(),
        message: one_line(condition.message.as_deref().unwrap_or_default(), LONGEST_MESSAGE),
    })
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::*;

    #[test]
    fn a_job_is_complete_with_its_pod() {
        let job: Job = serde_json::from_value(json!({"metadata": {"name": "a-1"}})).unwrap();
        let ended = |at: &str| {
            json!({"name": "c", "image": "i", "imageID": "", "ready": false, "restartCount": 0,
            "state": {"terminated": {"exitCode": 0, "finishedAt": at}}})
        };
        let pod = |phase: &str| -> Pod {
            serde_json::from_value(json!({"metadata": {"name": "p"}, "status": {"phase": phase,
                "initContainerStatuses": [ended("2026-01-01T00:00:09Z")],
                "containerStatuses": [ended("2026-01-01T00:00:07Z")]}}))
            .unwrap()
        };
        for phase in ["Pending", "Running", "Failed"] {
            assert_eq!(view(&job, Some(&pod(phase))).end, None, "{phase}");
        }
        let end = view(&job, Some(&pod("Succeeded"))).end;
        let at = Some("2026-01-01T00:00:09Z".parse().unwrap());
        assert_eq!(end, Some(JobEnd::Complete { at }));
        assert_eq!(view(&job, None).end, None);
    }

    #[test]
    fn a_job_is_suspended_by_its_spec_since_its_condition() {
        let job = |suspend: bool, labels: Value| -> Job {
            serde_json::from_value(json!({
                "metadata": {"name": "a-1", "labels": labels}, "spec": {"suspend": suspend},
                "status": {"conditions": [{"type": "Suspended", "status": "True",
                                           "lastTransitionTime": "2026-01-01T00:00:09Z"}]},
            }))
            .unwrap()
        };
        let suspension = |job: &Job| view(job, None).suspension;
        assert_eq!(suspension(&job(false, json!({}))), None);
        let since = Some("2026-01-01T00:00:09Z".parse().unwrap());
        let expected = |queue: Option<&str>| {
            Some(Box::new(Suspension {
                since,
                queue: queue.map(Into::into),
            }))
        };
        assert_eq!(suspension(&job(true, json!({}))), expected(None));
        let labels = json!({"kueue.x-k8s.io/queue-name": "gpus"});
        assert_eq!(suspension(&job(true, labels)), expected(Some("gpus")));
    }
}
