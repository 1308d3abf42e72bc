//! Facts of any object: its key, its owner, and its mark as ours. Pure.

use kube::runtime::reflector::ObjectRef;
use kube::{Resource, ResourceExt};
use tracing::Span;

use leaderboard_api::{Leaderboard, Submission, names};
use leaderboard_base::object_key::ObjectKey;
use leaderboard_base::spans::LogSpan;

/// Puts an object into its work queue.
pub type Wake<K> = Box<dyn Fn(ObjectRef<K>) + Send + Sync>;

/// Wakes an object by its key.
pub fn by_key<K: Resource<DynamicType = ()> + 'static>(wake: Wake<K>) -> crate::ask::Wake {
    Box::new(move |key| wake(ObjectRef::new(&key.name).within(&key.namespace)))
}

/// The key of an object in every map of the controller: its UID, which a name does not replace.
pub fn uid(object: &impl Resource) -> &str {
    object.meta().uid.as_deref().unwrap_or_default()
}

/// UID, to be kept.
pub fn uid_of(object: &impl Resource) -> String {
    uid(object).to_owned()
}

/// The resource version of an object: those of one kind grow, and the API promises that they can be compared as numbers.
pub fn version(object: &impl Resource) -> u64 {
    object.meta().resource_version.as_deref().map_or(0, version_number)
}

/// Number of a version that a write has made.
pub fn version_number(version: &str) -> u64 {
    version.parse().unwrap_or(0)
}

/// The key of an object towards the services.
pub fn key_of(object: &impl ResourceExt) -> ObjectKey {
    ObjectKey {
        namespace: object.namespace().unwrap_or_default(),
        name: object.name_any(),
        uid: object.uid().unwrap_or_default(),
    }
}

/// Span of all log lines about a submission.
pub fn span_of(submission: &Submission) -> Span {
    log_span_of(submission).span()
}

/// Span for a task that works for a submission later.
pub fn log_span_of(submission: &Submission) -> LogSpan {
    let meta = &submission.metadata;
    let (namespace, name) = (meta.namespace.as_deref(), meta.name.as_deref());
    LogSpan::of(
        format_args!("{}/{}", namespace.unwrap_or_default(), name.unwrap_or_default()),
        &submission.spec.leaderboard_name,
        submission.present_attempt().0,
        uid(submission),
    )
}

/// The Leaderboard that a Submission names.
pub fn board_of(submission: &Submission) -> ObjectRef<Leaderboard> {
    ObjectRef::new(&submission.spec.leaderboard_name).within(&submission.namespace().unwrap_or_default())
}

/// The label selector of everything the operator makes for submissions.
pub fn children_selector() -> String {
    format!("{}={}", names::LABEL_MANAGED_BY, names::OPERATOR)
}
