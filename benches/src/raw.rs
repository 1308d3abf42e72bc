//! A client that only writes: the limit that the operator is compared with. It sends the operator's own bodies, as the API server's audit
//! log has them, with other names in them.

use http::Method;
use kube::Client;
use serde_json::{Value, json};

use crate::api::{self, APPLY, JSON, MERGE, Meta};
use crate::audit;
use crate::bench::Outcome;
use crate::names::{LEADERBOARD, SAMPLE};

/// The writes for one submission until its Job exists.
pub struct Bodies {
    uid: String,
    status: Body,
    job: Body,
}

struct Body {
    method: Method,
    uri: String,
    kind: &'static str,
    text: String,
}

/// Name of the submission with this number; all names have the same length.
pub fn name(number: usize) -> String {
    format!("run-{number:05}")
}

/// A submission as a person applies it.
pub fn submission(name: &str) -> Vec<u8> {
    let object = json!({
        "apiVersion": "leaderboard.carla.org/v1alpha1",
        "kind": "Submission",
        "metadata": {"name": name},
        "spec": {
            "leaderboardName": LEADERBOARD,
            "track": "sensors",
            "image": "registry.example/teams/agent:1",
            "team": {"id": name.trim_start_matches("run-"), "name": format!("Team of {name}")},
        },
    });
    object.to_string().into_bytes()
}

pub async fn create_submission(client: &Client, name: &str) -> Outcome<Meta> {
    api::create(client, &api::path("submissions"), submission(name)).await
}

impl Bodies {
    /// The bodies of [`SAMPLE`], which has this UID, among the entries of an audit log; None until both are there.
    pub fn of_sample(entries: &[audit::Entry], uid: &str) -> Option<Self> {
        let found = |resource: &str, holds: &dyn Fn(&Value) -> bool| {
            let mut all = entries
                .iter()
                .filter(|entry| entry.is_write() && entry.resource() == resource && !entry.is_trial());
            all.find(|entry| entry.body.as_ref().is_some_and(holds))
                .and_then(Body::of)
        };
        Some(Self {
            uid: uid.to_owned(),
            status: found("submissions/status", &|body| body["status"]["jobName"].is_string())?,
            job: found("jobs", &|body| body["spec"]["template"].is_object())?,
        })
    }

    /// The three writes of one submission.
    pub async fn submit(&self, client: &Client, name: &str) -> Outcome<()> {
        let uid = create_submission(client, name).await?.uid;
        self.accept(client, name, &uid).await
    }

    /// Status and Job of a submission that exists.
    pub async fn accept(&self, client: &Client, name: &str, uid: &str) -> Outcome<()> {
        self.send(client, &self.status, name, uid).await?;
        self.send(client, &self.job, name, uid).await
    }

    /// The Job of a submission that exists.
    pub async fn job_of(&self, client: &Client, name: &str, uid: &str) -> Outcome<()> {
        self.send(client, &self.job, name, uid).await
    }

    /// A Job alone.
    pub async fn job(&self, client: &Client, name: &str) -> Outcome<()> {
        self.send(client, &self.job, name, &self.uid).await
    }

    /// Bytes of the Job.
    pub fn job_bytes(&self) -> usize {
        self.job.text.len()
    }

    async fn send(&self, client: &Client, body: &Body, name: &str, uid: &str) -> Outcome<()> {
        let text = body.text.replace(SAMPLE, name).replace(&self.uid, uid);
        let uri = body.uri.replace(SAMPLE, name);
        api::send(client, body.method.clone(), &uri, body.kind, text.into_bytes()).await?;
        Ok(())
    }
}

impl Body {
    fn of(entry: &audit::Entry) -> Option<Self> {
        let mut body = entry.body.clone()?;
        // The version is the sample's own.
        if let Some(metadata) = body.get_mut("metadata").and_then(Value::as_object_mut) {
            metadata.remove("resourceVersion");
        }
        let (method, kind) = match entry.verb.as_str() {
            "create" => (Method::POST, JSON),
            "update" => (Method::PUT, JSON),
            _ if entry.uri.contains("force=true") => (Method::PATCH, APPLY),
            _ => (Method::PATCH, MERGE),
        };
        Some(Self {
            method,
            uri: entry.uri.clone(),
            kind,
            text: body.to_string(),
        })
    }
}
