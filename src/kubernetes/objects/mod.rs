//! The kinds that the API server types, reduced to what is read of them.
//!
//! A cache holds thousands, so each takes as little memory as it can. Decoding skips the fields that no code reads, and `Texts` stores
//! each shared text once. Every field is optional and every enum a text, so that the answer of a newer API server can be read.

mod event;
mod job;
mod meta;
mod node;
mod pod;
mod texts;

pub use event::{Event, Involved};
pub use job::{Job, JobCondition, JobSpec, JobStatus};
pub use meta::{Annotations, Labels, Meta, Owner};
pub use node::{Node, NodeCondition, NodeSpec, NodeStatus, Taint};
pub use pod::{
    Condition, Conditions, ContainerName, ContainerState, ContainerStatus, Ended, Pod, PodSpec, PodStatus, Running,
    Waiting,
};
pub use texts::{Text, Texts};

/// Makes a kind known to caches, feeds and watches.
macro_rules! watchable {
    ($type:ty, $scope:ty, $kind:literal, $group:literal, $version:literal, $plural:literal) => {
        impl kube::runtime::reflector::Lookup for $type {
            type DynamicType = ();

            fn kind((): &()) -> std::borrow::Cow<'_, str> {
                $kind.into()
            }

            fn group((): &()) -> std::borrow::Cow<'_, str> {
                $group.into()
            }

            fn version((): &()) -> std::borrow::Cow<'_, str> {
                $version.into()
            }

            fn plural((): &()) -> std::borrow::Cow<'_, str> {
                $plural.into()
            }

            fn name(&self) -> Option<std::borrow::Cow<'_, str>> {
                Some(self.metadata.name.as_ref().into())
            }

            fn namespace(&self) -> Option<std::borrow::Cow<'_, str>> {
                self.metadata.namespace.as_deref().map(Into::into)
            }

            fn resource_version(&self) -> Option<std::borrow::Cow<'_, str>> {
                Some(self.metadata.resource_version.as_ref().into())
            }

            fn uid(&self) -> Option<std::borrow::Cow<'_, str>> {
                Some(self.metadata.uid.as_ref().into())
            }
        }

        impl $crate::kubernetes::Watchable for $type {
            type Scope = $scope;

            fn read<'de, D: serde::Deserializer<'de>>(
                deserializer: D,
            ) -> Result<Result<Self, $crate::kubernetes::Malformed>, D::Error> {
                serde::Deserialize::deserialize(deserializer).map(Ok)
            }

            fn share(&mut self, texts: &mut $crate::kubernetes::objects::Texts) {
                self.share_texts(texts);
            }

            fn is_same(&self, other: &Self) -> bool {
                self == other
            }
        }
    };
}
use watchable;
