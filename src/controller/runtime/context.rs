//! What every pass of the controller shares: clients, caches and memory.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};

use kube::Client;
use kube::runtime::events::Recorder;

use crate::controller::leaderboards::isolation::{Policies, Wake};
use crate::controller::leaderboards::state::LeaderboardState;
pub use crate::controller::settings::Settings;
use crate::controller::slots::SlotAllocator;
pub use crate::controller::stores::Stores;
use crate::controller::submissions::archive::{ArchiveWorkers, bucket_id};
use crate::controller::submissions::external::ExternalSystems;
use crate::controller::submissions::memory::Memory;
use crate::controller::submissions::observe::lookups::Lookups;
use crate::controller::submissions::reruns::Reruns;
use crate::services::archive::Archive;
use crate::services::aws::Aws;
use leaderboard_api::{Leaderboard, Storage};

pub use crate::kubernetes::CALL_TIMEOUT;

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
    pub leaderboards: LeaderboardState,
    pub external: ExternalSystems,
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
        (external, archive_workers, lookups): (ExternalSystems, ArchiveWorkers, Lookups),
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
            leaderboards: LeaderboardState::default(),
            external,
            aws,
            recorder,
            wake,
            archives: Mutex::default(),
        }
    }

    /// Whether Jobs may be made: the policy of the present spec is seen to be there, and the last apply did not fail.
    pub fn is_policy_in_place(&self, leaderboard: &Leaderboard) -> bool {
        self.policies().is_in_place(leaderboard)
    }

    /// The prefix of a run; clients are kept by region and endpoint.
    pub fn archive(&self, storage: &Storage, run_id: &str) -> Archive {
        let mut archives = self.archives.lock().unwrap_or_else(PoisonError::into_inner);
        let shared = archives
            .entry(bucket_id(storage))
            .or_insert_with(|| Archive::of_run(&self.aws, storage, run_id));
        shared.at_prefix(leaderboard_api::effective::key_prefix(storage, run_id))
    }

    /// What keeps the policies in place.
    pub fn policies(&self) -> Policies<'_> {
        Policies {
            client: &self.client,
            stores: &self.stores,
            state: &self.leaderboards,
            slots: &self.slots,
            wake: &self.wake,
        }
    }

    /// Drops everything that is remembered of a Submission that is gone.
    pub fn forget(&self, uid: &str) {
        self.memory.forget(uid);
        self.archive_workers.forget(uid);
    }
}
