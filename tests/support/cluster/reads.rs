//! Readers of objects, for the tests.

use k8s_openapi::api::core::v1::{ContainerStatus, Pod};
use kube::{Resource, ResourceExt};
use leaderboard_api::{Reason, State, Submission, SubmissionStatus, conditions};

/// The STATE column.
pub fn state(submission: &Submission) -> Option<State> {
    submission.status.as_ref().and_then(|status| status.state)
}

/// Why it is in its state.
pub fn reason(submission: &Submission) -> String {
    let present = submission.status.as_ref().and_then(SubmissionStatus::present_reason);
    present.map(|reason| reason.to_string()).unwrap_or_default()
}

/// Its driving score.
pub fn score(submission: &Submission) -> &str {
    submission
        .status
        .as_ref()
        .and_then(|status| status.score.as_ref())
        .map(|score| score.text.as_str())
        .unwrap_or_default()
}

/// Routes that are done.
pub fn done(submission: &Submission) -> i32 {
    let progress = submission.status.as_ref().and_then(|status| status.progress.as_ref());
    progress.map_or(0, |progress| progress.done)
}

/// True if a condition of a Submission is True.
pub fn is_true(submission: &Submission, condition: &str) -> bool {
    let status = submission.status.as_ref();
    status.is_some_and(|status| conditions::is_true(&status.conditions, condition))
}

/// The names of objects, for messages.
pub fn names<K: Resource>(objects: &[K]) -> Vec<String> {
    objects.iter().map(ResourceExt::name_any).collect()
}

/// The statuses of all of a Pod's containers, init containers and sidecar first.
pub fn containers(pod: &Pod) -> Vec<ContainerStatus> {
    let status = pod.status.clone().unwrap_or_default();
    let lists = [status.init_container_statuses, status.container_statuses];
    lists.into_iter().flatten().flatten().collect()
}

/// True if it has come to its end in Kubernetes, EvalAI and DynamoDB.
pub fn is_settled(submission: &Submission) -> bool {
    let Some(status) = &submission.status else { return false };
    let known = |type_: &str| {
        let condition = conditions::get(&status.conditions, type_);
        condition.is_some_and(|c| c.status == "True" || c.reason == Reason::NotRequired)
    };
    status.attempt == Some(submission.spec.attempt)
        && is_true(submission, conditions::FINISHED)
        && known(conditions::PUBLISHED)
        && known(conditions::RECORDED)
}
