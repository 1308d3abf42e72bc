//! A Job as it is cached: without its template.

use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;
use kube::core::NamespaceResourceScope;
use serde::Deserialize;

use super::meta::Meta;
use super::texts::{Text, Texts, cut};
use super::watchable;

/// Part of a Job that is read.
#[derive(Deserialize, Clone, Debug, Default, PartialEq)]
#[serde(default)]
pub struct Job {
    pub metadata: Meta,
    pub spec: JobSpec,
    pub status: JobStatus,
}

#[derive(Deserialize, Clone, Copy, Debug, Default, PartialEq)]
#[serde(default)]
pub struct JobSpec {
    pub suspend: bool,
}

#[derive(Deserialize, Clone, Debug, Default, PartialEq)]
#[serde(rename_all = "camelCase", default)]
pub struct JobStatus {
    /// A resume sets it anew.
    pub start_time: Option<Time>,
    pub conditions: Box<[JobCondition]>,
}

#[derive(Deserialize, Clone, Debug, Default, PartialEq)]
#[serde(rename_all = "camelCase", default)]
pub struct JobCondition {
    #[serde(rename = "type")]
    pub type_: Text,
    pub status: Text,
    pub last_transition_time: Option<Time>,
    pub reason: Option<Text>,
    #[serde(deserialize_with = "cut")]
    pub message: Option<Box<str>>,
}

impl Job {
    fn share_texts(&mut self, texts: &mut Texts) {
        self.metadata.share_texts(texts);
        for condition in &mut self.status.conditions {
            texts.share(&mut condition.type_);
            texts.share(&mut condition.status);
            condition.reason.iter_mut().for_each(|reason| texts.share(reason));
        }
    }
}

watchable!(Job, NamespaceResourceScope, "Job", "batch", "v1", "jobs");
