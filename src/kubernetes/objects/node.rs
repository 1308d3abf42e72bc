//! A node as it is cached: its name, its taints, and whether its kubelet reports.

use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;
use kube::core::ClusterResourceScope;
use serde::Deserialize;

use super::meta::Meta;
use super::texts::{Text, Texts};
use super::watchable;

/// Part of a node that is read.
#[derive(Deserialize, Clone, Debug, Default, PartialEq)]
#[serde(default)]
pub struct Node {
    pub metadata: Meta,
    pub spec: NodeSpec,
    pub status: NodeStatus,
}

#[derive(Deserialize, Clone, Debug, Default, PartialEq)]
#[serde(default)]
pub struct NodeSpec {
    pub taints: Box<[Taint]>,
}

#[derive(Deserialize, Clone, Debug, Default, PartialEq)]
#[serde(default)]
pub struct Taint {
    pub key: Text,
    pub effect: Text,
}

#[derive(Deserialize, Clone, Debug, Default, PartialEq)]
#[serde(default)]
pub struct NodeStatus {
    /// The condition `Ready`.
    #[serde(rename = "conditions", deserialize_with = "ready")]
    pub ready: Option<NodeCondition>,
}

#[derive(Deserialize, Clone, Debug, Default, PartialEq)]
#[serde(rename_all = "camelCase", default)]
pub struct NodeCondition {
    #[serde(rename = "type")]
    type_: Text,
    pub status: Text,
    pub last_transition_time: Option<Time>,
}

fn ready<'de, D: serde::Deserializer<'de>>(deserializer: D) -> Result<Option<NodeCondition>, D::Error> {
    let all = Option::<Vec<NodeCondition>>::deserialize(deserializer)?;
    Ok(all.into_iter().flatten().find(|condition| &*condition.type_ == "Ready"))
}

impl Node {
    fn share_texts(&mut self, texts: &mut Texts) {
        for taint in &mut self.spec.taints {
            texts.share(&mut taint.key);
            texts.share(&mut taint.effect);
        }
        if let Some(ready) = &mut self.status.ready {
            texts.share(&mut ready.type_);
            texts.share(&mut ready.status);
        }
    }
}

watchable!(Node, ClusterResourceScope, "Node", "", "v1", "nodes");
