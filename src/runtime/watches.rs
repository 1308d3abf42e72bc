//! The watches of a controller: what each kind's cache holds, and what is summed up as it changes.

use std::time::Duration;

use k8s_openapi::api::networking::v1::NetworkPolicy;
use kube::core::NamespaceResourceScope;
use kube::runtime::watcher::Config;
use kube::{Api, Client};

use super::leader::Leader;
use crate::kubernetes::objects::{Job, Node, Pod};
use crate::kubernetes::{Index, Namespaces, Watch, Watchable, spawn_watch};
use crate::observability::Observability;
use crate::page::Reads;
use crate::runtime::objects::children_selector;
use crate::runtime::settings::Settings;
use crate::runtime::stores::{Stores, owner_uid};
use leaderboard_api::{Leaderboard, Submission};

/// Wait for the cache of policies at the start. It may never come: without a right to policies no Job starts, but runs are watched.
const POLICIES_LIMIT: Duration = Duration::from_secs(5);

/// Watches a kind in all namespaces that are served.
fn all<K: Watchable<Scope = NamespaceResourceScope>>(
    namespaces: &Namespaces,
    client: &Client,
    config: Config,
    index: Index<K>,
    telemetry: &Observability,
) -> Watch<K> {
    spawn_watch(namespaces.apis(client), config, index, telemetry)
}

/// The caches, and what they are filled from.
pub(super) struct Watches {
    pub(super) leaderboards: Watch<Leaderboard>,
    pub(super) submissions: Watch<Submission>,
    pub(super) jobs: Watch<Job>,
    pub(super) pods: Watch<Pod>,
    pub(super) policies: Watch<NetworkPolicy>,
    /// None: an operator without rights of the whole cluster has none to them.
    pub(super) nodes: Option<Watch<Node>>,
}

impl Watches {
    pub(super) fn start(client: &Client, settings: &Settings, telemetry: &Observability) -> Self {
        let namespaces = &settings.namespaces;
        let children = || Config::default().labels(&children_selector());
        Self {
            leaderboards: all(namespaces, client, Config::default(), |_| None, telemetry),
            submissions: all(namespaces, client, Config::default(), |_| None, telemetry),
            jobs: all(namespaces, client, children(), |_| None, telemetry),
            pods: all(namespaces, client, children(), owner_uid, telemetry),
            policies: all(namespaces, client, children(), |_| None, telemetry),
            nodes: settings.has_cluster_rights.then(|| {
                let nodes = vec![Api::all(client.clone())];
                spawn_watch(nodes, Config::default(), |_| None, telemetry)
            }),
        }
    }

    pub(super) fn stores(&self) -> Stores {
        Stores {
            leaderboards: self.leaderboards.store.clone(),
            submissions: self.submissions.store.clone(),
            jobs: self.jobs.store.clone(),
            pods: self.pods.store.clone(),
            policies: self.policies.store.clone(),
            policies_synced: self.policies.synced.clone(),
            nodes: self.nodes.clone(),
        }
    }

    /// Stores that the page reads, on a standby too.
    pub(super) fn for_page(&self, leader: &Leader) -> Reads {
        let leadership = leader.leadership();
        Reads {
            leaderboards: self.leaderboards.clone(),
            submissions: self.submissions.clone(),
            leads: Box::new(move || leadership.borrow().term().is_some()),
        }
    }

    pub(super) async fn synced(&self) {
        // An error means that the watch's task is gone, which ends the process.
        let _ = self.leaderboards.store.wait_until_ready().await;
        let _ = self.submissions.store.wait_until_ready().await;
        let _ = self.jobs.store.wait_until_ready().await;
        let _ = self.pods.store.wait_until_ready().await;
        let _ = tokio::time::timeout(POLICIES_LIMIT, self.policies.store.wait_until_ready()).await;
    }
}
