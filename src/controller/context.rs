//! What every pass of the controller shares: clients, caches and memory.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use k8s_openapi::api::batch::v1::Job;
use k8s_openapi::api::core::v1::Pod;
use k8s_openapi::api::networking::v1::NetworkPolicy;
use kube::runtime::events::Recorder;
use kube::runtime::reflector::{ObjectRef, Store};
use kube::{Client, ResourceExt};

use super::archive::{ArchiveWorkers, bucket_id};
use super::leaderboards::Desk;
use super::memory::Memory;
use super::network_policy;
use super::observe::lookups::Lookups;
use super::observe::{is_pod_of, uid_of};
use super::reruns::Reruns;
use super::slots::SlotAllocator;
use super::sync::Sync;
use crate::kubernetes::Synced;
use crate::services::archive::Archive;
use crate::services::aws::Aws;
use leaderboard_api::{Leaderboard, Storage, Submission};

/// Time any one call to the API server may take.
pub const CALL_TIMEOUT: Duration = Duration::from_secs(20);

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
        let name = child.labels().get(leaderboard_api::names::LABEL_SUBMISSION)?;
        Some(ObjectRef::new(name).within(&child.namespace()?))
    }

    /// The Leaderboard that a Pod or a policy belongs to.
    pub fn leaderboard_of(child: &impl ResourceExt) -> Option<ObjectRef<Leaderboard>> {
        let name = child.labels().get(leaderboard_api::names::LABEL_LEADERBOARD)?;
        Some(ObjectRef::new(name).within(&child.namespace()?))
    }
}

/// Settings that come from the command line.
#[derive(Clone, Debug)]
pub struct Settings {
    /// The operator's own image, which Pods use for `workspace` and `logcopy`.
    pub image: String,
    /// Pull policy of that image.
    pub image_pull_policy: Option<String>,
    /// AWS region of the operator, handed on to Pods.
    pub region: Option<String>,
    /// Only this namespace, or all.
    pub namespace: Option<String>,
    /// Passes at once.
    pub concurrency: u16,
}

/// Wakes a Leaderboard.
pub type Wake = Box<dyn Fn(ObjectRef<Leaderboard>) + Send + std::marker::Sync>;

/// Shared by all passes.
pub struct Context {
    pub client: Client,
    pub settings: Settings,
    pub stores: Stores,
    pub memory: Memory,
    pub archive_workers: ArchiveWorkers,
    pub lookups: Lookups,
    pub reruns: Reruns,
    pub slots: Arc<SlotAllocator>,
    pub desk: Desk,
    pub sync: Sync,
    pub aws: Aws,
    pub recorder: Recorder,
    wake: Wake,
    archives: Mutex<HashMap<String, Archive>>,
}

impl Context {
    pub fn new(
        client: Client,
        settings: Settings,
        stores: Stores,
        (sync, archive_workers, lookups): (Sync, ArchiveWorkers, Lookups),
        aws: Aws,
        recorder: Recorder,
        wake: Wake,
    ) -> Self {
        Self {
            client,
            settings,
            stores,
            memory: Memory::default(),
            archive_workers,
            lookups,
            reruns: Reruns::default(),
            slots: Arc::default(),
            desk: Desk::default(),
            sync,
            aws,
            recorder,
            wake,
            archives: Mutex::default(),
        }
    }

    /// Whether Jobs may be made: the policy of the present spec is seen to be there, and the last apply did not fail.
    pub fn is_policy_in_place(&self, leaderboard: &Leaderboard) -> bool {
        self.stores.shows_policy(leaderboard) && !self.desk.policy_failed(&uid_of(leaderboard))
    }

    /// The prefix of a run; clients are kept by region and endpoint.
    pub fn archive(&self, storage: &Storage, run_id: &str) -> Archive {
        let mut archives = self.archives.lock().unwrap_or_else(PoisonError::into_inner);
        let shared = archives
            .entry(bucket_id(storage))
            .or_insert_with(|| Archive::of_run(&self.aws, storage, run_id));
        shared.at_prefix(leaderboard_api::effective::key_prefix(storage, run_id))
    }

    /// Reconciles a Leaderboard again, and those that wait for it.
    pub fn wake(&self, board: ObjectRef<Leaderboard>) {
        self.slots.wake_pending(&board);
        (self.wake)(board);
    }

    /// Drops everything that is remembered of a Submission that is gone.
    pub fn forget(&self, uid: &str) {
        self.memory.forget(uid);
        self.archive_workers.forget(uid);
    }
}
