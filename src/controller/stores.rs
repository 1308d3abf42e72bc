//! The caches of the API server, and what is looked up in them.

use std::sync::Arc;

use k8s_openapi::api::batch::v1::Job;
use k8s_openapi::api::core::v1::Pod;
use k8s_openapi::api::networking::v1::NetworkPolicy;
use kube::ResourceExt;
use kube::runtime::reflector::{ObjectRef, Store};

use super::network_policy;
use super::objects::is_pod_of;
use super::slots::SlotAllocator;
use crate::kubernetes::Synced;
use leaderboard_api::{Leaderboard, Submission, names};

/// Caches of the API server, filled by one task each.
pub struct Stores {
    pub leaderboards: Store<Leaderboard>,
    pub submissions: Store<Submission>,
    pub jobs: Store<Job>,
    pub pods: Store<Pod>,
    pub policies: Store<NetworkPolicy>,
    /// Whether what `policies` shows can be relied on.
    pub policies_synced: Synced,
}

impl Stores {
    /// The youngest Pod of a Job.
    pub fn newest_pod(&self, job: &Job) -> Option<Arc<Pod>> {
        let pods = self.pods.state().into_iter().filter(|pod| is_pod_of(pod, job));
        pods.max_by_key(|pod| (pod.metadata.creation_timestamp.clone().map(|t| t.0), pod.name_any()))
    }

    /// Takes all that is there into the lines for slots.
    pub fn fill(&self, slots: &SlotAllocator) {
        slots.start(
            &self.leaderboards.state(),
            &self.jobs.state(),
            &self.submissions.state(),
        );
    }

    /// Whether the policy that a Leaderboard's present spec asks for is seen to be there.
    pub fn shows_policy(&self, leaderboard: &Leaderboard) -> bool {
        if !self.policies_synced.is_true() {
            return false;
        }
        let namespace = leaderboard.namespace().unwrap_or_default();
        let name = network_policy::name(leaderboard);
        let found = self.policies.get(&ObjectRef::new(&name).within(&namespace));
        found.is_some_and(|found| network_policy::is_in_place(&found, leaderboard))
    }

    /// The Submission that a child belongs to.
    pub fn owner_of(child: &impl ResourceExt) -> Option<ObjectRef<Submission>> {
        let name = child.labels().get(names::LABEL_SUBMISSION)?;
        Some(ObjectRef::new(name).within(&child.namespace()?))
    }

    /// The Leaderboard that a Pod or a policy belongs to.
    pub fn leaderboard_of(child: &impl ResourceExt) -> Option<ObjectRef<Leaderboard>> {
        let name = child.labels().get(names::LABEL_LEADERBOARD)?;
        Some(ObjectRef::new(name).within(&child.namespace()?))
    }
}
