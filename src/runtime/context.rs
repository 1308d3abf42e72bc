//! Clients, caches and memory that all reconciles share. Each stage gets the parts that it uses, and nothing else.

use std::sync::Arc;

use kube::Client;
use kube::runtime::events::Recorder;

use crate::kubernetes::Writer;
use crate::kubernetes::objects::Pod;
use crate::leaderboards;
use crate::leaderboards::isolation::{self, Policies};
use crate::leaderboards::probe::Asks;
use crate::leaderboards::state::LeaderboardState;
use crate::metrics::Metrics;
use crate::observability::traces::Traces;
use crate::runtime::objects::Wake;
use crate::runtime::settings::Settings;
use crate::runtime::stores::Stores;
use crate::slots::Slots;
use crate::submissions::external::ExternalSystems;
use crate::submissions::memory::Memory;
use crate::submissions::observe::causes::Causes;
use crate::submissions::observe::workers::Workers;
use crate::submissions::{act, observe};
use leaderboard_api::Leaderboard;
use leaderboard_base::clock::Clock;
use leaderboard_base::object_key::ObjectKey;

/// Shared by all reconciles.
pub struct Context {
    pub clock: Clock,
    pub client: Client,
    pub writer: Writer,
    pub settings: Settings,
    pub stores: Stores,
    pub memory: Memory,
    pub workers: Workers,
    pub causes: Causes,
    pub slots: Arc<Slots>,
    pub leaderboards: LeaderboardState,
    pub asks: Asks,
    pub external: ExternalSystems,
    pub recorder: Recorder,
    pub metrics: Arc<Metrics>,
    pub traces: Traces,
    pub wake: Wake<Leaderboard>,
}

impl Context {
    pub fn for_observe(&self) -> observe::Uses<'_> {
        observe::Uses {
            clock: &self.clock,
            stores: &self.stores,
            memory: &self.memory,
            workers: &self.workers,
            slots: &self.slots,
            causes: &self.causes,
            external: &self.external,
        }
    }

    pub fn for_act(&self) -> act::Uses<'_> {
        act::Uses {
            client: &self.client,
            writer: &self.writer,
            recorder: &self.recorder,
            settings: &self.settings,
            stores: &self.stores,
            memory: &self.memory,
            workers: &self.workers,
            slots: &self.slots,
            external: &self.external,
            metrics: &self.metrics,
            traces: &self.traces,
        }
    }

    pub fn for_leaderboards(&self) -> leaderboards::Uses<'_> {
        leaderboards::Uses {
            policies: self.policies(),
            writer: &self.writer,
            recorder: &self.recorder,
            settings: &self.settings,
            slots: &self.slots,
            external: &self.external,
            asks: &self.asks,
        }
    }

    /// Part that keeps the policies in place.
    pub fn policies(&self) -> Policies<'_> {
        Policies {
            clock: &self.clock,
            client: &self.client,
            stores: &self.stores,
            state: &self.leaderboards,
            slots: &self.slots,
            wake: &self.wake,
        }
    }

    /// A Pod may have measured its isolation. Returns whether it has.
    pub fn measured(&self, pod: &Pod) -> bool {
        let board = Stores::leaderboard_of(&pod.metadata).and_then(|board| self.stores.leaderboards.get(&board));
        board.is_some_and(|board| isolation::note_finding(&self.leaderboards, &board, pod))
    }

    /// Drops everything that is remembered of an object that is gone.
    pub fn forget(&self, key: &ObjectKey) {
        self.memory.forget(&key.uid);
        self.workers.forget(&key.uid);
        self.leaderboards.forget(&key.uid);
        self.asks.forget(&key.uid);
        self.external.gone(key);
    }
}
