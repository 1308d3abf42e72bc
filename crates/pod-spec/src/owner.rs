//! The reference of an object that the operator makes to the object that it is made for.

use std::collections::BTreeMap;

use k8s_openapi::apimachinery::pkg::apis::meta::v1::{ObjectMeta, OwnerReference};
use kube::Resource;

use leaderboard_api::{Leaderboard, names};

/// The reference by which a child goes with its owner.
pub fn owner_reference<K: Resource<DynamicType = ()>>(owner: &K) -> OwnerReference {
    OwnerReference {
        api_version: K::api_version(&()).into_owned(),
        kind: K::kind(&()).into_owned(),
        name: owner.meta().name.clone().unwrap_or_default(),
        uid: owner.meta().uid.clone().unwrap_or_default(),
        controller: Some(true),
        block_owner_deletion: Some(true),
    }
}

/// The metadata of an object that the operator makes for a Leaderboard.
pub fn child_of(leaderboard: &Leaderboard, name: String) -> ObjectMeta {
    let of = leaderboard.metadata.name.clone().unwrap_or_default();
    ObjectMeta {
        name: Some(name),
        namespace: leaderboard.metadata.namespace.clone(),
        labels: Some(BTreeMap::from([
            (names::LABEL_MANAGED_BY.into(), names::OPERATOR.into()),
            (names::LABEL_LEADERBOARD.into(), of),
        ])),
        owner_references: Some(vec![owner_reference(leaderboard)]),
        ..ObjectMeta::default()
    }
}
