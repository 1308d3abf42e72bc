//! Watches: one task for each kind, a cache, and a feed of what has changed.
//!
//! Each kind has its task, because a shared backoff would let one broken watch hold up all others. A kind may be watched in several
//! namespaces: each has a list and a backoff of its own (`source`). The cache is complete once all of them are listed. This module logs,
//! counts and retries errors; readers only ever get objects.

use std::collections::{BTreeSet, HashSet};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};

use futures::StreamExt;
use kube::Api;
use kube::runtime::watcher::{Config, Error, Event};
use tokio::sync::watch::Sender;

use super::feed::{Feed, WatchEvents};
use super::item::{Item, Watchable};
use super::objects::Texts;
use super::source::{self, Source, is_refusal};
use super::store::{Index, Store, key_of};
use crate::metrics::WatchMetrics;
use crate::observability::Observability;
use crate::observability::readiness::Readiness;
use leaderboard_api::client_errors;
use leaderboard_base::lock::lock;
use leaderboard_base::shutdown::Stop;

/// Objects of one page of a list, each of up to 50 KB: a page is in memory as a whole while it is decoded.
pub(super) const PAGE: u32 = 100;

/// A running watch. Clones are the same one.
pub struct Watch<K: Watchable> {
    /// The objects as they were last observed.
    pub store: Store<K>,
    /// True while the store is in sync with the API server.
    pub synced: Synced,
    /// Objects that exist and are not in the store, or only as they were before, by namespace and name.
    unreadable: Arc<Mutex<BTreeSet<Box<str>>>>,
    feed: Feed<K>,
}

/// True once a watch has listed its kind and was not refused since: otherwise a store may show what is long gone. Clones are
/// the same one.
#[derive(Clone, Debug, Default)]
pub struct Synced(Arc<AtomicBool>);

impl Synced {
    /// It is in sync.
    pub fn is_true(&self) -> bool {
        self.0.load(Ordering::Acquire)
    }

    pub(crate) fn set(&self, is_synced: bool) {
        self.0.store(is_synced, Ordering::Release);
    }
}

impl<K: Watchable> Clone for Watch<K> {
    fn clone(&self) -> Self {
        Self {
            store: self.store.clone(),
            synced: self.synced.clone(),
            unreadable: self.unreadable.clone(),
            feed: self.feed.clone(),
        }
    }
}

impl<K: Watchable> Watch<K> {
    /// True if the store holds every object, each as it is.
    pub fn is_complete(&self) -> bool {
        self.synced.is_true() && lock(&self.unreadable).is_empty()
    }

    /// All objects that exist now, then each that is added, changed or deleted. The store is at least as new as each event.
    pub fn subscribe(&self) -> WatchEvents<K> {
        self.feed.subscribe(|| {
            // The objects of an unfinished first list come once it is complete.
            if self.store.is_ready() {
                self.store.state()
            } else {
                Vec::new()
            }
        })
    }
}

/// Starts to watch a kind until the process stops, through each of these APIs, of which no two may show the same object. Until their
/// first lists are complete, the process is not ready.
pub fn spawn_watch<K: Watchable>(
    apis: Vec<Api<Item<K>>>,
    config: Config,
    index: Index<K>,
    telemetry: &Observability,
) -> Watch<K> {
    let (store, listed) = Store::new(index);
    let watch = Watch {
        store,
        synced: Synced::default(),
        unreadable: Arc::default(),
        feed: Feed::new(),
    };
    let kind = K::kind(&()).into_owned();
    let has_one = apis.len() == 1;
    let source = |api: &Api<Item<K>>| {
        let namespace = api.namespace().filter(|_| !has_one);
        let name = namespace.map_or_else(|| kind.clone(), |namespace| format!("{kind} in {namespace}"));
        Source::new(namespace, telemetry.liveness.watch(&name))
    };
    let task = Task {
        check: format!("{} synced", K::plural(&())),
        sources: apis.iter().map(source).collect(),
        metrics: telemetry.metrics.watch(&kind, &telemetry.clock),
        readiness: telemetry.readiness.clone(),
        kind,
        texts: Texts::default(),
        listed,
        watch: watch.clone(),
        pending: HashSet::new(),
    };
    task.missing("the first list has not come yet");
    let name = format!("watch of {}", K::plural(&()));
    let config = config.page_size(PAGE);
    telemetry
        .tasks
        .stay(name, task.run(apis, config, telemetry.stop.clone()));
    watch
}

struct Task<K: Watchable> {
    kind: String,
    /// Name of the check of readiness.
    check: String,
    /// One for each API, in their order.
    sources: Vec<Source>,
    metrics: WatchMetrics,
    readiness: Readiness,
    texts: Texts,
    /// Makes the cache complete.
    listed: Sender<bool>,
    watch: Watch<K>,
    /// Keys that came before every source had listed once, or that a list after a refusal has shown: events once a list is complete.
    pending: HashSet<Box<str>>,
}

impl<K: Watchable> Task<K> {
    async fn run(mut self, apis: Vec<Api<Item<K>>>, config: Config, stop: Stop) {
        let mut events = source::all(apis, &config);
        loop {
            let event = tokio::select! {
                biased;
                () = stop.wait() => break,
                event = events.next() => event,
            };
            match event {
                Some((source, Ok(event))) => self.event(source, event),
                Some((source, Err(error))) => self.error(source, &error),
                // No API's events have an end; if one's end all the same, this task ends, and with it the process.
                None => break,
            }
        }
        self.watch.feed.close();
    }

    fn event(&mut self, source: usize, event: Event<Item<K>>) {
        let from = &mut self.sources[source];
        if matches!(event, Event::Init) {
            // The beginning of a list is a request, not an answer.
            from.probe.listing();
            return from.shown.clear();
        }
        self.metrics.event();
        match event {
            Event::Apply(item) => {
                from.probe.running();
                self.apply(source, item);
            }
            Event::Delete(item) => {
                from.probe.running();
                self.delete(source, item);
            }
            Event::InitApply(item) => {
                let key = self.apply(source, item);
                self.sources[source].shown.insert(key);
            }
            Event::Init | Event::InitDone => self.list_done(source),
        }
    }

    /// Takes an object in, and returns its key. One that can't be read stays as it was last read, because it has not been deleted.
    fn apply(&mut self, source: usize, item: Item<K>) -> Box<str> {
        let mut object = match item.object {
            Ok(object) => object,
            Err(malformed) => {
                malformed.log(&self.kind);
                let key = malformed.key();
                self.note_unreadable(|keys| _ = keys.insert(key.clone()));
                return key;
            }
        };
        let key = key_of(&object);
        self.note_unreadable(|keys| _ = keys.remove(&key));
        let is_as = |old: Arc<K>| old.uid() == object.uid() && old.resource_version() == object.resource_version();
        // A list shows again what is known.
        if self.watch.store.by_key(&key).is_some_and(is_as) {
            return key;
        }
        object.share(&mut self.texts);
        let (after, before) = self.watch.store.insert(object);
        match before {
            // The end of an object that was replaced by another one of its name between two reads.
            Some(before) if before.uid() != after.uid() => self.tell(source, &before, true),
            // No code here reads most fields of a Pod that its kubelet and the Job controller write.
            Some(before) if after.is_same(&before) => return key,
            _ => {}
        }
        self.tell(source, &after, false);
        key
    }

    fn delete(&mut self, source: usize, item: Item<K>) {
        let (key, last) = match item.object {
            Ok(object) => (key_of(&object), Some(Arc::new(object))),
            Err(malformed) => (malformed.key(), None),
        };
        self.note_unreadable(|keys| _ = keys.remove(&key));
        let known = self.watch.store.evict(&key);
        // No event was sent for an object that never could be read.
        if let Some(last) = last.or(known) {
            self.tell(source, &last, true);
        }
    }

    /// Sends an event once the cache is complete and its source is in sync: a reader that it wakes earlier would not trust the cache. Until
    /// then it keeps the name for the end of the list, unless the object is gone.
    fn tell(&mut self, source: usize, object: &Arc<K>, is_gone: bool) {
        let is_due = is_gone || self.sources[source].is_synced;
        if is_due && self.watch.store.is_ready() {
            self.watch.feed.push(object, is_gone);
        } else if !is_gone {
            self.pending.insert(key_of(object.as_ref()));
        }
    }

    fn list_done(&mut self, source: usize) {
        let from = &mut self.sources[source];
        let shown = std::mem::take(&mut from.shown);
        (from.is_synced, from.has_listed) = (true, true);
        from.probe.listed();
        let from = &self.sources[source];
        let is_there = |key: &str| !from.has(key) || shown.contains(key);
        self.note_unreadable(|keys| keys.retain(|key| is_there(key)));
        let store = &self.watch.store;
        let lost = store.keys_without(is_there);
        let gone: Vec<Arc<K>> = lost.iter().filter_map(|key| store.evict(key)).collect();
        if self.sources.iter().all(|source| source.has_listed) {
            self.complete(&gone);
        }
        tracing::info!(
            kind = self.kind,
            namespace = self.sources[source].namespace.as_deref(),
            objects = self.watch.store.len(),
            gone = gone.len(),
            "listed"
        );
    }

    /// The cache holds what every source has listed: what has come since is an event.
    fn complete(&mut self, gone: &[Arc<K>]) {
        // Before anyone is woken by what was listed.
        self.listed.send_replace(true);
        if !self.watch.synced.is_true() && self.sources.iter().all(|source| source.is_synced) {
            self.watch.synced.set(true);
            self.readiness.set(&self.check, Ok(()));
        }
        let Watch { store, feed, .. } = &self.watch;
        for gone in gone {
            feed.push(gone, true);
        }
        for object in self.pending.drain().filter_map(|key| store.by_key(&key)) {
            feed.push(&object, false);
        }
    }

    fn note_unreadable(&self, change: impl FnOnce(&mut BTreeSet<Box<str>>)) {
        let mut keys = lock(&self.watch.unreadable);
        change(&mut keys);
        self.metrics
            .unreadable
            .set(i64::try_from(keys.len()).unwrap_or(i64::MAX));
    }

    fn error(&mut self, source: usize, error: &Error) {
        self.metrics.errors.inc();
        let from = &mut self.sources[source];
        source::report(&from.probe, error);
        if is_refusal(error) {
            from.is_synced = false;
            self.watch.synced.set(false);
        }
        let cause = from.cause(client_errors::watch(error));
        if source::is_forgotten(error) {
            tracing::info!(kind = self.kind, error = cause, "listing again");
        } else {
            tracing::warn!(kind = self.kind, error = cause, "a watch has failed and is retried");
        }
        if !self.watch.synced.is_true() {
            self.missing(&cause);
        }
    }

    fn missing(&self, what: &str) {
        self.readiness.set(&self.check, Err(what.to_owned()));
    }
}
