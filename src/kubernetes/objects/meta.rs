//! The metadata of a child.

use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;
use serde::Deserialize;

use super::texts::{Text, Texts};

/// Part of a child's metadata that is read.
#[derive(Deserialize, Clone, Debug, Default)]
#[serde(rename_all = "camelCase", default)]
pub struct Meta {
    pub name: Box<str>,
    pub namespace: Option<Text>,
    pub uid: Box<str>,
    pub resource_version: Box<str>,
    pub creation_timestamp: Option<Time>,
    pub deletion_timestamp: Option<Time>,
    pub deletion_grace_period_seconds: Option<i64>,
    pub owner_references: Box<[Owner]>,
    pub labels: Labels,
    pub annotations: Annotations,
}

/// Owner of an object.
#[derive(Deserialize, Clone, Debug, Default, PartialEq)]
#[serde(default)]
pub struct Owner {
    pub uid: Box<str>,
}

/// The labels that lead from a child to what it belongs to.
#[derive(Deserialize, Clone, Debug, Default, PartialEq)]
#[serde(default)]
pub struct Labels {
    #[serde(rename = "leaderboard.carla.org/submission")]
    pub submission: Option<Box<str>>,
    #[serde(rename = "leaderboard.carla.org/leaderboard")]
    pub leaderboard: Option<Text>,
    #[serde(rename = "kueue.x-k8s.io/queue-name")]
    pub queue: Option<Text>,
}

/// The annotations of a Pod that are read.
#[derive(Deserialize, Clone, Debug, Default, PartialEq)]
#[serde(default)]
pub struct Annotations {
    #[serde(rename = "leaderboard.carla.org/stop")]
    pub stop: Option<Box<str>>,
    #[serde(rename = "leaderboard.carla.org/leaderboard-generation")]
    pub leaderboard_generation: Option<Text>,
}

/// Two objects that differ in their version alone are the same.
impl PartialEq for Meta {
    fn eq(&self, other: &Self) -> bool {
        let Self {
            name,
            namespace,
            uid,
            resource_version: _,
            creation_timestamp,
            deletion_timestamp,
            deletion_grace_period_seconds,
            owner_references,
            labels,
            annotations,
        } = self;
        (name, namespace, uid) == (&other.name, &other.namespace, &other.uid)
            && (creation_timestamp, deletion_timestamp) == (&other.creation_timestamp, &other.deletion_timestamp)
            && *deletion_grace_period_seconds == other.deletion_grace_period_seconds
            && (owner_references, labels, annotations) == (&other.owner_references, &other.labels, &other.annotations)
    }
}

impl Meta {
    /// The namespace; empty for an object without one.
    pub fn namespace(&self) -> &str {
        self.namespace.as_deref().unwrap_or_default()
    }

    /// True if it belongs to the object with this UID.
    pub fn is_owned_by(&self, uid: &str) -> bool {
        self.owner_references.iter().any(|owner| *owner.uid == *uid)
    }

    pub(super) fn share_texts(&mut self, texts: &mut Texts) {
        let shared = [
            &mut self.namespace,
            &mut self.labels.leaderboard,
            &mut self.labels.queue,
            &mut self.annotations.leaderboard_generation,
        ];
        shared.into_iter().flatten().for_each(|text| texts.share(text));
    }
}

#[cfg(test)]
mod tests {
    use leaderboard_api::names;
    use serde_json::json;

    use super::*;

    #[test]
    fn labels_and_annotations_have_the_names_that_are_written() {
        let meta: Meta = serde_json::from_value(json!({
            "labels": {names::LABEL_SUBMISSION: "s", names::LABEL_LEADERBOARD: "l", names::LABEL_KUEUE_QUEUE: "q", "app": "x"},
            "annotations": {names::ANNOTATION_STOP: "cancel", names::ANNOTATION_GENERATION: "3", "other": "y"},
        }))
        .unwrap();
        assert_eq!(meta.labels.submission.as_deref(), Some("s"));
        assert_eq!(meta.labels.leaderboard.as_deref(), Some("l"));
        assert_eq!(meta.labels.queue.as_deref(), Some("q"));
        assert_eq!(meta.annotations.stop.as_deref(), Some("cancel"));
        assert_eq!(meta.annotations.leaderboard_generation.as_deref(), Some("3"));
    }
}
