//! Requests to the API server without types in between: what is measured must not be this program's own decoding.

use futures::future::ready;
use futures::{Stream, StreamExt};
use http::{Method, Request};
use kube::Client;
use kube::core::WatchEvent;
use serde::Deserialize;
use serde::de::DeserializeOwned;
use std::collections::BTreeMap;

use crate::bench::Outcome;

/// The namespace of everything.
pub const NAMESPACE: &str = "bench";
const METADATA_ONLY: &str = "application/json;as=PartialObjectMetadata;g=meta.k8s.io;v=v1,application/json";

pub const JSON: &str = "application/json";
pub const MERGE: &str = "application/merge-patch+json";
pub const APPLY: &str = "application/apply-patch+yaml";

/// The parts of an object that a measurement reads.
#[derive(Deserialize, Clone, Debug)]
pub struct Slim<S> {
    pub metadata: Meta,
    #[serde(default = "Option::default")]
    pub status: Option<S>,
}

#[derive(Deserialize, Clone, Debug, Default)]
#[serde(rename_all = "camelCase")]
pub struct Meta {
    #[serde(default)]
    pub name: String,
    #[serde(default)]
    pub uid: String,
    #[serde(default)]
    pub labels: BTreeMap<String, String>,
    #[serde(default)]
    pub owner_references: Vec<Owner>,
}

#[derive(Deserialize, Clone, Debug)]
pub struct Owner {
    pub uid: String,
}

/// A condition, as far as it matters here.
#[derive(Deserialize, Clone, Debug)]
pub struct Condition {
    #[serde(rename = "type")]
    pub kind: String,
    pub status: String,
}

/// Nothing of an object's status.
#[derive(Deserialize, Clone, Debug)]
pub struct Nothing {}

/// Path of a kind's objects in the namespace.
pub fn path(kind: &str) -> String {
    let group = match kind {
        "jobs" => "/apis/batch/v1",
        "submissions" | "leaderboards" => "/apis/leaderboard.carla.org/v1alpha1",
        _ => "/api/v1",
    };
    format!("{group}/namespaces/{NAMESPACE}/{kind}")
}

/// Sends a body; the answer is the object's metadata.
pub async fn send(client: &Client, method: Method, path: &str, kind: &str, body: Vec<u8>) -> Outcome<Meta> {
    let request = Request::builder().method(method).uri(path);
    let request = request
        .header("Accept", METADATA_ONLY)
        .header("Content-Type", kind)
        .body(body)?;
    let answer: Slim<Nothing> = client.request(request).await?;
    Ok(answer.metadata)
}

pub async fn create(client: &Client, path: &str, body: Vec<u8>) -> Outcome<Meta> {
    send(client, Method::POST, path, JSON, body).await
}

/// A merge patch of an object's status.
pub async fn set_status(client: &Client, kind: &str, name: &str, body: Vec<u8>) -> Outcome<Meta> {
    let path = format!("{}/{name}/status", self::path(kind));
    send(client, Method::PATCH, &path, MERGE, body).await
}

pub async fn text(client: &Client, path: &str) -> Outcome<String> {
    Ok(client.request_text(Request::get(path).body(Vec::new())?).await?)
}

pub async fn get<T: DeserializeOwned>(client: &Client, path: &str) -> Outcome<T> {
    Ok(client.request(Request::get(path).body(Vec::new())?).await?)
}

/// All objects of a kind as they appear and change. It ends when the server ends it.
pub async fn watch<S>(client: &Client, kind: &str) -> Outcome<impl Stream<Item = Slim<S>> + use<S>>
where
    S: Clone + DeserializeOwned + Send + 'static,
{
    let uri = format!("{}?watch=1&timeoutSeconds=7200", path(kind));
    let events = client
        .request_events::<Slim<S>>(Request::get(uri).body(Vec::new())?)
        .await?;
    // An error ends the watch sooner or later, and the next one begins with every object again.
    Ok(events.filter_map(|event: kube::Result<WatchEvent<Slim<S>>>| {
        ready(match event {
            Ok(WatchEvent::Added(object) | WatchEvent::Modified(object)) => Some(object),
            _ => None,
        })
    }))
}
