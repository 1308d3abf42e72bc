//! What is read off any object: its key, its owner, and what marks it as ours. Pure.

use k8s_openapi::api::networking::v1::NetworkPolicy;
use k8s_openapi::apimachinery::pkg::apis::meta::v1::OwnerReference;
use kube::runtime::reflector::ObjectRef;
use kube::{Resource, ResourceExt};
use tracing::Span;

use crate::kubernetes::objects::{Job, Pod};
use crate::observability::about;
use crate::services::ObjectKey;
use leaderboard_api::{Submission, names};

/// Puts an object into its work queue.
pub type Wake<K> = Box<dyn Fn(ObjectRef<K>) + Send + Sync>;

/// The key of an object in every map of the controller: its UID, which a name does not replace.
pub fn uid_of(object: &impl Resource) -> String {
    object.meta().uid.clone().unwrap_or_default()
}

/// The key of an object towards the services.
pub fn key_of(object: &impl ResourceExt) -> ObjectKey {
    ObjectKey {
        namespace: object.namespace().unwrap_or_default(),
        name: object.name_any(),
        uid: object.uid().unwrap_or_default(),
    }
}

/// What all log lines about a submission are written in.
pub fn span_of(submission: &Submission) -> Span {
    let meta = &submission.metadata;
    let (namespace, name) = (meta.namespace.as_deref(), meta.name.as_deref());
    about::submission(
        format_args!("{}/{}", namespace.unwrap_or_default(), name.unwrap_or_default()),
        &submission.spec.leaderboard_name,
        submission.spec.attempt,
        meta.uid.as_deref().unwrap_or_default(),
    )
}

/// An object that the operator makes for Submissions.
pub trait Child {
    fn namespace(&self) -> Option<&str>;
    /// The name of its Submission, if it has one.
    fn submission(&self) -> Option<&str>;
    /// The name of its Leaderboard.
    fn leaderboard(&self) -> Option<&str>;
}

macro_rules! child {
    ($kind:ty) => {
        impl Child for $kind {
            fn namespace(&self) -> Option<&str> {
                self.metadata.namespace.as_deref()
            }

            fn submission(&self) -> Option<&str> {
                self.metadata.labels.submission.as_deref()
            }

            fn leaderboard(&self) -> Option<&str> {
                self.metadata.labels.leaderboard.as_deref()
            }
        }
    };
}
child!(Job);
child!(Pod);

impl Child for NetworkPolicy {
    fn namespace(&self) -> Option<&str> {
        self.metadata.namespace.as_deref()
    }

    fn submission(&self) -> Option<&str> {
        None
    }

    fn leaderboard(&self) -> Option<&str> {
        self.labels().get(names::LABEL_LEADERBOARD).map(String::as_str)
    }
}

/// The reference by which a child goes with its owner.
pub fn owner_reference<K: Resource<DynamicType = ()>>(owner: &K) -> OwnerReference {
    OwnerReference {
        api_version: K::api_version(&()).into_owned(),
        kind: K::kind(&()).into_owned(),
        name: owner.meta().name.clone().unwrap_or_default(),
        uid: uid_of(owner),
        controller: Some(true),
        block_owner_deletion: Some(true),
    }
}

/// The label selector of everything the operator makes for submissions.
pub fn children_selector() -> String {
    format!("{}={}", names::LABEL_MANAGED_BY, names::OPERATOR)
}
