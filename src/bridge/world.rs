//! The Leaderboards as the bridge knows them: one watch in a task of its own, with its own backoff.
//!
//! Writes the `World` that the supervisor and the pollers read. Knows no queue.

use std::collections::BTreeMap;
use std::error::Error;
use std::sync::Arc;

use futures::StreamExt;
use kube::api::ListParams;
use kube::core::{DeserializeGuard, ObjectMeta};
use kube::runtime::{WatchStreamExt, watcher};
use kube::{Api, Client};
use tokio::sync::watch;

use super::{Health, Observer};
use leaderboard_api::Leaderboard;

/// Namespace and name.
type Key = (String, String);
/// A Leaderboard, or why this program can't read it.
type Entry = Result<Arc<Leaderboard>, String>;

/// The Leaderboards as last seen.
#[derive(Clone, Debug, Default)]
pub struct World {
    entries: Arc<BTreeMap<Key, Entry>>,
    synced: bool,
}

impl World {
    /// Those that can be read.
    pub fn leaderboards(&self) -> Vec<Arc<Leaderboard>> {
        self.entries.values().filter_map(|entry| entry.clone().ok()).collect()
    }

    /// True if no Leaderboard can be missing. One that this program can't read might serve any phase.
    pub fn is_complete(&self) -> bool {
        self.synced && self.entries.values().all(Result::is_ok)
    }
}

/// All Leaderboards that the bridge serves: of one namespace, or of the cluster.
pub fn api(client: Client, namespace: Option<&str>) -> Api<DeserializeGuard<Leaderboard>> {
    match namespace {
        Some(namespace) => Api::namespaced(client, namespace),
        None => Api::all(client),
    }
}

/// Reads the Leaderboards without any cache.
pub async fn read(api: &Api<DeserializeGuard<Leaderboard>>) -> kube::Result<World> {
    let list = api.list(&ListParams::default()).await?;
    let entries = list.items.into_iter().map(entry).collect();
    Ok(World {
        entries: Arc::new(entries),
        synced: true,
    })
}

/// Follows the Leaderboards until it is dropped.
pub async fn follow(
    api: Api<DeserializeGuard<Leaderboard>>,
    world: watch::Sender<World>,
    health: Arc<Health>,
    observer: Arc<dyn Observer>,
) {
    let mut events = std::pin::pin!(watcher(api, watcher::Config::default()).default_backoff());
    let mut listing = BTreeMap::new();
    while let Some(event) = events.next().await {
        let event = match event {
            Ok(event) => event,
            Err(error) => {
                let text = chain(&error);
                tracing::warn!(error = text, "the watch of Leaderboards failed and is begun again");
                observer.watch_failed();
                health.watch(Some(text));
                continue;
            }
        };
        observer.watch_moved();
        health.watch(None);
        if let watcher::Event::InitDone = event {
            health.synced();
        }
        apply(event, &mut listing, &world);
    }
}

fn apply(
    event: watcher::Event<DeserializeGuard<Leaderboard>>,
    listing: &mut BTreeMap<Key, Entry>,
    world: &watch::Sender<World>,
) {
    match event {
        watcher::Event::Init => listing.clear(),
        watcher::Event::InitApply(object) => {
            listing.extend([entry(object)]);
        }
        watcher::Event::InitDone => world.send_modify(|world| {
            world.entries = Arc::new(std::mem::take(listing));
            world.synced = true;
        }),
        watcher::Event::Apply(object) => {
            world.send_if_modified(|world| {
                let (key, fresh) = entry(object);
                let is_new = world.entries.get(&key).is_none_or(|old| differs(old, &fresh));
                Arc::make_mut(&mut world.entries).insert(key, fresh);
                is_new
            });
        }
        watcher::Event::Delete(object) => world.send_modify(|world| {
            Arc::make_mut(&mut world.entries).remove(&entry(object).0);
        }),
    }
}

/// The status of a Leaderboard changes often and means nothing to the bridge.
fn differs(old: &Entry, fresh: &Entry) -> bool {
    match (old, fresh) {
        (Ok(old), Ok(fresh)) => {
            old.spec != fresh.spec || old.metadata.deletion_timestamp != fresh.metadata.deletion_timestamp
        }
        (old, fresh) => old.is_ok() || fresh.is_ok(),
    }
}

fn entry(object: DeserializeGuard<Leaderboard>) -> (Key, Entry) {
    match object.0 {
        Ok(mut leaderboard) => {
            leaderboard.metadata.managed_fields = None;
            leaderboard.status = None;
            (key(&leaderboard.metadata), Ok(Arc::new(leaderboard)))
        }
        Err(invalid) => {
            let key = key(&invalid.metadata);
            let (namespace, name) = &key;
            tracing::error!(
                leaderboard = %format_args!("{namespace}/{name}"),
                error = invalid.error,
                "this Leaderboard can't be read: install the definitions that belong to this version of the operator; \
                 until then no message of an unknown phase is given up"
            );
            (key, Err(invalid.error))
        }
    }
}

fn key(metadata: &ObjectMeta) -> Key {
    (
        metadata.namespace.clone().unwrap_or_default(),
        metadata.name.clone().unwrap_or_default(),
    )
}

/// An error of the cluster's in its own words, without dumps.
pub fn chain(error: &(dyn Error + 'static)) -> String {
    let mut parts: Vec<String> = Vec::new();
    let mut next = Some(error);
    while let Some(current) = next {
        if let Some(status) = current.downcast_ref::<kube::core::Status>() {
            return status.message.clone();
        }
        parts.push(current.to_string());
        next = current.source();
    }
    // The outer ones repeat the innermost.
    parts.pop().unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bridge::route::tests::{board, with_queue};
    use watcher::Event;

    fn good(name: &str) -> DeserializeGuard<Leaderboard> {
        DeserializeGuard(Ok((*with_queue(board(name, 1), "https://q/1")).clone()))
    }

    fn bad(name: &str) -> DeserializeGuard<Leaderboard> {
        let metadata = ObjectMeta {
            name: Some(name.into()),
            namespace: Some("ns".into()),
            ..ObjectMeta::default()
        };
        DeserializeGuard(Err(kube::core::error_boundary::InvalidObject {
            error: "missing field".into(),
            metadata,
        }))
    }

    fn names(world: &World) -> Vec<String> {
        world
            .leaderboards()
            .iter()
            .map(|lb| kube::ResourceExt::name_any(lb.as_ref()))
            .collect()
    }

    #[test]
    fn a_new_list_replaces_the_old_only_when_it_is_whole() {
        let (sender, receiver) = watch::channel(World::default());
        let mut listing = BTreeMap::new();
        let mut feed = |event| apply(event, &mut listing, &sender);
        feed(Event::Init);
        feed(Event::InitApply(good("a")));
        assert!(!receiver.borrow().synced);
        feed(Event::InitDone);
        assert!(receiver.borrow().is_complete());
        feed(Event::Init);
        feed(Event::InitApply(good("b")));
        assert_eq!(names(&receiver.borrow()), ["a"]);
        feed(Event::InitDone);
        assert_eq!(names(&receiver.borrow()), ["b"]);
        feed(Event::Apply(good("c")));
        feed(Event::Delete(good("b")));
        assert_eq!(names(&receiver.borrow()), ["c"]);
    }

    #[test]
    fn one_that_cannot_be_read_hides_no_other_but_leaves_the_world_incomplete() {
        let (sender, receiver) = watch::channel(World::default());
        let mut listing = BTreeMap::new();
        let mut feed = |event| apply(event, &mut listing, &sender);
        feed(Event::InitApply(good("a")));
        feed(Event::InitDone);
        feed(Event::Apply(bad("b")));
        assert_eq!(names(&receiver.borrow()), ["a"]);
        assert!(receiver.borrow().synced && !receiver.borrow().is_complete());
        feed(Event::Apply(good("b")));
        assert!(receiver.borrow().is_complete());
    }

    #[test]
    fn a_change_of_status_wakes_nobody() {
        let (sender, mut receiver) = watch::channel(World::default());
        let mut listing = BTreeMap::new();
        let mut feed = |event| apply(event, &mut listing, &sender);
        feed(Event::Apply(good("a")));
        receiver.mark_unchanged();
        feed(Event::Apply(good("a")));
        assert!(!receiver.has_changed().unwrap());
    }
}
