//! The smallest valid objects, and JSON merge patches on them: a test has only what it is about.

use kube::api::{Api, PostParams};
use kube::core::{ApiResource, DynamicObject};
use kube::{Client, Resource};
use leaderboard_api::{Leaderboard, Submission};
use serde_json::{Value, json};

/// A kind of ours.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    Leaderboard,
    Submission,
}

impl Kind {
    /// As its definition calls it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Leaderboard => "Leaderboard",
            Self::Submission => "Submission",
        }
    }

    fn resource(self) -> ApiResource {
        match self {
            Self::Leaderboard => ApiResource::erase::<Leaderboard>(&()),
            Self::Submission => ApiResource::erase::<Submission>(&()),
        }
    }

    /// Objects of this kind as they are, without our types in between.
    pub fn api(self, client: &Client, namespace: &str) -> Api<DynamicObject> {
        Api::namespaced_with(client.clone(), namespace, &self.resource())
    }

    /// The smallest object that is accepted, with `patches` laid over it in turn.
    pub fn object(self, name: &str, patches: &[&Value]) -> Value {
        let spec = match self {
            Self::Leaderboard => json!({
                "tracks": [{"name": "sensors"}],
                "evaluation": {"carla": {
                    "version": "V2", "contents": {"image": "contents:1"}, "simulator": {"image": "simulator:1"},
                }},
                "storage": {"s3": {"bucket": "results"}},
            }),
            Self::Submission => json!({"leaderboardName": "local", "track": "sensors", "image": "agent:1"}),
        };
        let resource = self.resource();
        let mut object = json!({
            "apiVersion": resource.api_version,
            "kind": resource.kind,
            "metadata": {"name": name},
            "spec": spec,
        });
        for patch in patches {
            merge(&mut object, patch);
        }
        object
    }
}

/// Creates an object, or only asks whether it would be accepted.
pub async fn create(api: &Api<DynamicObject>, object: Value, dry_run: bool) -> kube::Result<DynamicObject> {
    let object: DynamicObject = serde_json::from_value(object).unwrap();
    let params = PostParams {
        dry_run,
        ..PostParams::default()
    };
    api.create(&params, &object).await
}

/// Lays a JSON merge patch (RFC 7396) over a value.
pub fn merge(target: &mut Value, patch: &Value) {
    let Value::Object(patch) = patch else {
        *target = patch.clone();
        return;
    };
    if !target.is_object() {
        *target = json!({});
    }
    for (key, value) in patch {
        if value.is_null() {
            target.as_object_mut().unwrap().remove(key);
        } else {
            merge(&mut target[key], value);
        }
    }
}

/// Faults that the API server found, one text for each cause.
pub fn causes(error: &kube::Error) -> Vec<String> {
    let kube::Error::Api(status) = error else {
        panic!("not an answer of the API server: {error}");
    };
    let details = status.details.as_ref();
    let causes: Vec<String> = details
        .iter()
        .flat_map(|details| &details.causes)
        .map(|cause| format!("{}: {}", cause.field, cause.message))
        .collect();
    if causes.is_empty() {
        vec![status.message.clone()]
    } else {
        causes
    }
}

/// The plural in the address of a kind.
pub fn plural(kind: Kind) -> String {
    match kind {
        Kind::Leaderboard => Leaderboard::plural(&()).into_owned(),
        Kind::Submission => Submission::plural(&()).into_owned(),
    }
}
