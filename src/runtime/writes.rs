//! The writes that Submissions and Leaderboards share: the finalizer and the status. Both are safe to repeat.

use std::borrow::Cow;

use kube::api::{Patch, PatchParams};
use kube::{Resource, ResourceExt};
use serde::Serialize;
use serde_json::json;

use super::objects::uid;
use crate::kubernetes::{CallError, Watchable, Writer, Writes, call};
use leaderboard_api::names;

/// Parameters of a patch that is no apply.
pub fn patch_by(manager: &str) -> PatchParams {
    PatchParams {
        field_manager: Some(manager.into()),
        ..PatchParams::default()
    }
}

/// Puts our finalizer on an object, or takes it off. Returns the version of the object then, if it is still there.
pub async fn set_finalizer<K>(
    writer: &Writer,
    object: &K,
    finalizer: &str,
    wanted: bool,
) -> Result<Option<String>, CallError>
where
    K: Watchable + Resource<DynamicType = ()>,
{
    let mut finalizers = object.finalizers().to_vec();
    finalizers.retain(|known| known != finalizer);
    finalizers.extend(wanted.then(|| finalizer.to_owned()));
    // The resource version keeps other controllers' finalizers safe: a concurrent change makes this write fail.
    let version = &object.meta().resource_version;
    let patch = Patch::Merge(json!({ "metadata": { "resourceVersion": version, "finalizers": finalizers } }));
    let params = patch_by(names::MANAGER_FINALIZER);
    let (api, name) = (api(writer, object), object.name_any());
    match call("the finalizer", &described(object), api.patch(&name, &params, &patch)).await {
        Err(error) if !wanted && error.is_gone() => Ok(None),
        other => other.map(|written| Some(written.metadata.resource_version.into())),
    }
}

/// A status as it is applied. Written as text at once: a tree of values would be most of what a write allocates.
#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
struct Applied<'a, S> {
    api_version: Cow<'a, str>,
    kind: Cow<'a, str>,
    metadata: Identity<'a>,
    status: &'a S,
}

#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
struct Identity<'a> {
    name: &'a str,
    uid: &'a str,
    resource_version: Option<&'a str>,
}

/// Applies a status that was decided on this version of the object; another one is a conflict. Returns the version that has it.
pub async fn apply_status<K>(
    writer: &Writer,
    object: &K,
    version: Option<&str>,
    status: &impl Serialize,
) -> Result<Box<str>, CallError>
where
    K: Watchable + Resource<DynamicType = ()>,
{
    let (api, name) = (api(writer, object), object.name_any());
    let patch = Patch::Apply(Applied {
        api_version: <K as Resource>::api_version(&()),
        kind: <K as Resource>::kind(&()),
        metadata: Identity {
            name: &name,
            uid: uid(object),
            resource_version: version,
        },
        status,
    });
    let params = PatchParams::apply(names::MANAGER_STATUS).force();
    let applied = api.patch_status(&name, &params, &patch);
    let written = call("the status", &described(object), applied).await?;
    Ok(written.metadata.resource_version)
}

fn described<K: Resource<DynamicType = ()>>(object: &K) -> String {
    format!("{} {}", K::kind(&()), object.name_any())
}

fn api<K>(writer: &Writer, object: &K) -> Writes<K>
where
    K: Watchable + Resource<DynamicType = ()>,
{
    Writes::new(writer, &ResourceExt::namespace(object).unwrap_or_default())
}
