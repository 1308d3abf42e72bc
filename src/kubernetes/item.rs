//! Decodes one object of a list or of a watch: straight from the bytes of the answer, without a generic value in between.
//!
//! One object that cannot be read is an item of its own kind, and fails no list.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::fmt;

use k8s_openapi::api::networking::v1::NetworkPolicy;
use k8s_openapi::apimachinery::pkg::apis::meta::v1::{OwnerReference, Time};
use kube::Resource;
use kube::api::ObjectMeta;
use kube::core::NamespaceResourceScope;
use kube::runtime::reflector::Lookup;
use leaderboard_api::{Leaderboard, Submission, SubmissionStatus};
use serde::de::{DeserializeOwned, IgnoredAny};
use serde::{Deserialize, Deserializer};
use serde_json::value::RawValue;

use super::objects::Texts;
use super::store;

/// Annotation that `kubectl apply` leaves for itself: a second copy of the object.
const LAST_APPLIED: &str = "kubectl.kubernetes.io/last-applied-configuration";

/// Kinds that can be watched.
pub trait Watchable: Lookup<DynamicType = ()> + Clone + fmt::Debug + Send + Sync + 'static {
    /// Scope: in a namespace or not.
    type Scope;

    /// Reads one object. Where people write what a kind holds, one that cannot be read is an answer too.
    fn read<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Result<Self, Malformed>, D::Error>;

    /// Stores texts once that many objects have.
    fn share(&mut self, _texts: &mut Texts) {}

    /// True if nothing has changed since `before` that anybody reads.
    fn is_same(&self, _before: &Self) -> bool {
        false
    }
}

/// An object that this program can't read.
#[derive(Clone, Debug)]
pub struct Malformed {
    pub namespace: Option<String>,
    pub name: String,
    pub error: String,
    resource_version: Option<String>,
}

impl Malformed {
    pub(super) fn key(&self) -> Box<str> {
        store::key(self.namespace.as_deref(), &self.name)
    }

    /// Logs that it is left out of a watch of this kind.
    pub(super) fn log(&self, kind: &str) {
        let Self {
            namespace, name, error, ..
        } = self;
        tracing::error!(kind, namespace, name, error, "skipped an object that can't be read");
    }
}

/// An object as a list or a watch has it.
#[derive(Clone, Debug)]
pub struct Item<K> {
    pub object: Result<K, Malformed>,
    /// Has the resource version, by which a watch goes on.
    metadata: ObjectMeta,
}

impl<'de, K: Watchable> Deserialize<'de> for Item<K> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let object = K::read(deserializer)?;
        let version = match &object {
            Ok(object) => object.resource_version().map(Cow::into_owned),
            Err(malformed) => malformed.resource_version.clone(),
        };
        let metadata = ObjectMeta {
            resource_version: version,
            ..ObjectMeta::default()
        };
        Ok(Self { object, metadata })
    }
}

impl<K: Watchable> Resource for Item<K> {
    type DynamicType = ();
    type Scope = K::Scope;

    fn kind((): &()) -> Cow<'_, str> {
        K::kind(&())
    }

    fn group((): &()) -> Cow<'_, str> {
        K::group(&())
    }

    fn version((): &()) -> Cow<'_, str> {
        K::version(&())
    }

    fn plural((): &()) -> Cow<'_, str> {
        K::plural(&())
    }

    fn meta(&self) -> &ObjectMeta {
        &self.metadata
    }

    fn meta_mut(&mut self) -> &mut ObjectMeta {
        &mut self.metadata
    }
}

impl Watchable for Submission {
    type Scope = NamespaceResourceScope;

    fn read<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Result<Self, Malformed>, D::Error> {
        in_parts(deserializer, |metadata, spec, mut status: Option<SubmissionStatus>| {
            if let Some(status) = &mut status {
                // A list that was read has room for twice as many.
                status.conditions.shrink_to_fit();
                status.workers.shrink_to_fit();
                if let Some(plan) = &mut status.plan {
                    plan.shrink_to_fit();
                }
            }
            Self { metadata, spec, status }
        })
    }

    fn share(&mut self, texts: &mut Texts) {
        let status = self.status.iter_mut();
        status
            .flat_map(SubmissionStatus::shared_texts)
            .for_each(|text| texts.share(text));
    }
}

impl Watchable for Leaderboard {
    type Scope = NamespaceResourceScope;

    fn read<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Result<Self, Malformed>, D::Error> {
        in_parts(deserializer, |metadata, spec, status| Self { metadata, spec, status })
    }
}

impl Watchable for NetworkPolicy {
    type Scope = NamespaceResourceScope;

    fn read<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Result<Self, Malformed>, D::Error> {
        in_parts(deserializer, |metadata, spec, _: IgnoredAny| Self { metadata, spec })
    }
}

/// An object whose spec and status are still text.
#[derive(Deserialize)]
struct Unparsed<'a> {
    #[serde(default)]
    metadata: Metadata,
    #[serde(borrow, default)]
    spec: Option<&'a RawValue>,
    #[serde(borrow, default)]
    status: Option<&'a RawValue>,
}

/// Reads an object that may be stored by another version of this program, or by a person.
fn in_parts<'de, D: Deserializer<'de>, K, S: DeserializeOwned, T: DeserializeOwned>(
    deserializer: D,
    join: impl FnOnce(ObjectMeta, S, T) -> K,
) -> Result<Result<K, Malformed>, D::Error> {
    let Unparsed { metadata, spec, status } = Unparsed::deserialize(deserializer)?;
    let parsed = (|| Ok((parse(spec)?, parse(status)?)))();
    Ok(match parsed {
        Ok((spec, status)) => Ok(join(metadata.into(), spec, status)),
        Err(error) => Err(metadata.malformed(&error)),
    })
}

fn parse<T: DeserializeOwned>(part: Option<&RawValue>) -> Result<T, serde_json::Error> {
    serde_json::from_str(part.map_or("null", RawValue::get))
}

/// Metadata without managed fields and what only a client reads.
#[derive(Deserialize, Default)]
#[serde(rename_all = "camelCase", default)]
struct Metadata {
    name: Option<String>,
    namespace: Option<String>,
    uid: Option<String>,
    resource_version: Option<String>,
    generation: Option<i64>,
    creation_timestamp: Option<Time>,
    deletion_timestamp: Option<Time>,
    finalizers: Option<Vec<String>>,
    owner_references: Option<Vec<OwnerReference>>,
    labels: Option<BTreeMap<String, String>>,
    annotations: Option<BTreeMap<String, String>>,
}

impl Metadata {
    fn malformed(self, error: &serde_json::Error) -> Malformed {
        Malformed {
            namespace: self.namespace,
            name: self.name.unwrap_or_default(),
            resource_version: self.resource_version,
            error: error.to_string(),
        }
    }
}

impl From<Metadata> for ObjectMeta {
    fn from(read: Metadata) -> Self {
        let mut annotations = read.annotations;
        if let Some(annotations) = &mut annotations {
            annotations.remove(LAST_APPLIED);
        }
        Self {
            name: read.name,
            namespace: read.namespace,
            uid: read.uid,
            resource_version: read.resource_version,
            generation: read.generation,
            creation_timestamp: read.creation_timestamp,
            deletion_timestamp: read.deletion_timestamp,
            finalizers: read.finalizers,
            owner_references: read.owner_references,
            labels: read.labels,
            annotations: annotations.filter(|annotations| !annotations.is_empty()),
            ..Self::default()
        }
    }
}
