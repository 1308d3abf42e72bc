//! The caches of the API server, and what is looked up in them.

use std::sync::Arc;

use k8s_openapi::api::networking::v1::NetworkPolicy;
use kube::ResourceExt;
use kube::runtime::reflector::ObjectRef;

use super::objects::board_of;
use crate::kubernetes::objects::{Job, Meta, Node, Pod};
use crate::kubernetes::{Store, Synced, Watch};
use leaderboard_api::{Leaderboard, Submission, names};
use leaderboard_pod_spec::network_policy;

/// Caches of the API server, filled by one task each. Clones are the same.
#[derive(Clone)]
pub struct Stores {
    pub leaderboards: Store<Leaderboard>,
    pub submissions: Store<Submission>,
    pub jobs: Store<Job>,
    /// By the UID of their Job too.
    pub pods: Store<Pod>,
    pub policies: Store<NetworkPolicy>,
    /// True once `policies` can be relied on.
    pub policies_synced: Synced,
    /// None: an operator without rights of the whole cluster has none to nodes.
    pub nodes: Option<Watch<Node>>,
}

impl Stores {
    /// The Leaderboard that a Submission names.
    pub fn leaderboard_for(&self, submission: &Submission) -> Option<Arc<Leaderboard>> {
        self.leaderboards.get(&board_of(submission))
    }

    /// The youngest Pod of a Job.
    pub fn newest_pod(&self, job: &Job) -> Option<Arc<Pod>> {
        let created = |pod: &Arc<Pod>| pod.metadata.creation_timestamp.as_ref().map(|t| t.0);
        let age = |one: &Arc<Pod>, other: &Arc<Pod>| {
            let by_name = one.metadata.name.cmp(&other.metadata.name);
            created(one).cmp(&created(other)).then(by_name)
        };
        self.pods_of(job).into_iter().max_by(age)
    }

    /// All Pods of a Job.
    pub fn pods_of(&self, job: &Job) -> Vec<Arc<Pod>> {
        self.pods.indexed(&job.metadata.uid)
    }

    /// All Submissions of a Leaderboard.
    pub fn submissions_for(&self, board: &ObjectRef<Leaderboard>) -> Vec<Arc<Submission>> {
        let mut all = self.submissions.state();
        all.retain(|one| one.spec.leaderboard_name == board.name && one.metadata.namespace == board.namespace);
        all
    }

    /// True if the policy that a Leaderboard's present spec asks for is seen to be there.
    pub fn shows_policy(&self, leaderboard: &Leaderboard) -> bool {
        if !self.policies_synced.is_true() {
            return false;
        }
        let namespace = leaderboard.namespace().unwrap_or_default();
        let name = network_policy::name(leaderboard);
        let found = self.policies.get(&ObjectRef::new(&name).within(&namespace));
        found.is_some_and(|found| network_policy::is_in_place(&found, leaderboard))
    }

    /// The Submission that a Job or a Pod belongs to.
    pub fn owner_of(child: &Meta) -> Option<ObjectRef<Submission>> {
        Some(ObjectRef::new(child.labels.submission.as_deref()?).within(child.namespace.as_deref()?))
    }

    /// The Leaderboard that a Pod belongs to.
    pub fn leaderboard_of(child: &Meta) -> Option<ObjectRef<Leaderboard>> {
        Some(ObjectRef::new(child.labels.leaderboard.as_deref()?).within(child.namespace.as_deref()?))
    }

    /// The Leaderboard that a policy belongs to.
    pub fn leaderboard_of_policy(policy: &NetworkPolicy) -> Option<ObjectRef<Leaderboard>> {
        let name = policy.labels().get(names::LABEL_LEADERBOARD)?;
        Some(ObjectRef::new(name).within(policy.metadata.namespace.as_deref()?))
    }
}

/// The UID of what a Pod belongs to, by which it is found.
pub fn owner_uid(pod: &Pod) -> Option<String> {
    let owner = pod.metadata.owner_references.first()?;
    Some(owner.uid.to_string())
}
