//! Watches: one task for each kind, a cache, and a feed of what has changed.
//!
//! Each kind has its task, because a shared backoff would let one broken watch hold up all others. A kind may be watched in several
//! namespaces: each has a list and a backoff of its own (`source`). The cache is complete once all of them are listed. This module logs,
//! counts and retries errors; readers only ever get objects.

use std::collections::{BTreeSet, HashSet};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard};

use futures::StreamExt;
use kube::Api;
use kube::runtime::watcher::{Config, Error, Event};

use super::feed::{Feed, WatchEvents};
use super::item::{Item, Watchable};
use super::objects::Texts;
use super::source::{self, Source, is_refusal};
use super::store::{Index, Store, Writer, key_of};
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
    /// Objects that exist and are not in the store, or only as they were before.
    pub unreadable: Unreadable,
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

/// The objects that this program can't read now, by namespace and name. Clones are the same.
#[derive(Clone, Debug, Default)]
pub struct Unreadable(Arc<Mutex<BTreeSet<Box<str>>>>);

impl Unreadable {
    /// There is none.
    pub fn is_empty(&self) -> bool {
        self.keys().is_empty()
    }

    fn keys(&self) -> MutexGuard<'_, BTreeSet<Box<str>>> {
        lock(&self.0)
    }
}

/// Shape in which a kind is kept, and how it is found.
pub struct Shape<K> {
    /// Drops what is never read, before an object is cached.
    pub trim: fn(&mut K),
    pub index: Index<K>,
}

impl<K> Default for Shape<K> {
    fn default() -> Self {
        Self {
            trim: |_| {},
            index: |_| None,
        }
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
        self.synced.is_true() && self.unreadable.is_empty()
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
    Shape { trim, index }: Shape<K>,
    telemetry: &Observability,
) -> Watch<K> {
    let writer = Writer::<K>::new(index);
    let watch = Watch {
        store: writer.store().clone(),
        synced: Synced::default(),
        unreadable: Unreadable::default(),
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
        trim,
        texts: Texts::default(),
        writer,
        feed: watch.feed.clone(),
        synced: watch.synced.clone(),
        unreadable: watch.unreadable.clone(),
        pending: HashSet::new(),
        is_complete: false,
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
    sources: Vec<Source<K>>,
    metrics: WatchMetrics,
    readiness: Readiness,
    trim: fn(&mut K),
    texts: Texts,
    writer: Writer<K>,
    feed: Feed<K>,
    synced: Synced,
    unreadable: Unreadable,
    /// Keys that have come before the cache was complete, and are events when it is.
    pending: HashSet<Box<str>>,
    /// Every source has listed once.
    is_complete: bool,
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
                Some((source, Some(Ok(event)))) => self.event(source, event),
                Some((source, Some(Err(error)))) => self.error(source, &error),
                // None of them has an end; if one ends all the same, this task ends, and with it the process.
                Some((_, None)) | None => break,
            }
        }
        self.feed.close();
    }

    fn event(&mut self, source: usize, event: Event<Item<K>>) {
        let from = &mut self.sources[source];
        if matches!(event, Event::Init) {
            // The beginning of a list is a request, not an answer.
            from.probe.listing();
            return from.list.begins();
        }
        self.metrics.event();
        match event {
            Event::Apply(item) => {
                from.probe.running();
                self.apply(item);
            }
            Event::Delete(item) => {
                from.probe.running();
                self.delete(item);
            }
            Event::InitApply(item) => self.listed(source, item),
            Event::Init | Event::InitDone => self.list_done(source),
        }
    }

    fn apply(&mut self, item: Item<K>) {
        let object = match self.read(item) {
            Ok(object) => object,
            Err(key) => return self.note_unreadable(|keys| keys.extend([key])),
        };
        let key = key_of(&object);
        self.note_unreadable(|keys| _ = keys.remove(&key));
        let (after, before) = self.writer.put(object);
        match before {
            // The end of an object that was replaced by another one of its name between two reads.
            Some(before) if before.uid() != after.uid() => self.tell(&before, true),
            // No code here reads most fields of a Pod that its kubelet and the Job controller write.
            Some(before) if after.is_same(&before) => return,
            _ => {}
        }
        self.tell(&after, false);
    }

    fn delete(&mut self, item: Item<K>) {
        let (key, last) = match item.object {
            Ok(object) => (key_of(&object), Some(self.trimmed(object))),
            Err(malformed) => (malformed.key(), None),
        };
        self.note_unreadable(|keys| _ = keys.remove(&key));
        let known = self.writer.remove(&key);
        // No event was sent for an object that never could be read.
        if let Some(last) = last.map(Arc::new).or(known) {
            self.tell(&last, true);
        }
    }

    /// Sends an event once the cache is complete. Before that it keeps the name for the end of the list, unless the object is gone.
    fn tell(&mut self, object: &Arc<K>, is_gone: bool) {
        if self.is_complete {
            self.feed.push(object, is_gone);
        } else if !is_gone {
            self.pending.insert(key_of(object.as_ref()));
        }
    }

    fn listed(&mut self, source: usize, item: Item<K>) {
        let object = match self.read(item) {
            Ok(object) => object,
            Err(key) => return self.sources[source].list.unreadable(key),
        };
        let key = key_of(&object);
        let known = self.writer.store().by_key(&key);
        let is_known = known
            .is_some_and(|known| known.uid() == object.uid() && known.resource_version() == object.resource_version());
        let list = &mut self.sources[source].list;
        list.shown.insert(key.clone());
        if is_known {
            return;
        }
        let (after, before) = self.writer.put(object);
        list.changed.insert(key);
        list.replaced
            .extend(before.filter(|before| before.uid() != after.uid()));
    }

    fn list_done(&mut self, source: usize) {
        let from = &mut self.sources[source];
        let list = std::mem::take(&mut from.list);
        from.is_synced = true;
        from.has_listed = true;
        let from = &self.sources[source];
        let mut gone = list.replaced;
        for key in self
            .writer
            .keys_without(|key| !from.has(key) || list.shown.contains(key))
        {
            gone.extend(self.writer.remove(&key));
        }
        self.note_unreadable(|keys| {
            keys.retain(|key| !from.has(key));
            keys.extend(list.unreadable);
        });
        from.probe.listed();
        let (changed, left) = (list.changed.len(), gone.len());
        self.pending.extend(list.changed);
        if self.sources.iter().all(|source| source.has_listed) {
            self.complete(&gone);
        }
        tracing::info!(
            kind = self.kind,
            namespace = self.sources[source].namespace(),
            objects = self.writer.store().len(),
            changed,
            gone = left,
            "listed"
        );
    }

    /// The cache holds what every source has listed: what has come since is an event.
    fn complete(&mut self, gone: &[Arc<K>]) {
        // Before anyone is woken by what was listed.
        self.writer.is_complete();
        self.is_complete = true;
        if !self.synced.is_true() && self.sources.iter().all(|source| source.is_synced) {
            self.synced.set(true);
            self.readiness.set(&self.check, Ok(()));
        }
        for gone in gone {
            self.feed.push(gone, true);
        }
        let store = self.writer.store();
        for object in self.pending.drain().filter_map(|key| store.by_key(&key)) {
            self.feed.push(&object, false);
        }
    }

    fn note_unreadable(&self, change: impl FnOnce(&mut BTreeSet<Box<str>>)) {
        let mut keys = self.unreadable.keys();
        change(&mut keys);
        self.metrics
            .unreadable
            .set(i64::try_from(keys.len()).unwrap_or(i64::MAX));
    }

    /// The object, trimmed; if it can't be read, its key, and its name is logged.
    fn read(&mut self, item: Item<K>) -> Result<K, Box<str>> {
        item.object.map(|object| self.trimmed(object)).map_err(|malformed| {
            tracing::error!(
                kind = self.kind,
                namespace = malformed.namespace,
                name = malformed.name,
                error = malformed.error,
                "skipped an object that can't be read"
            );
            malformed.key()
        })
    }

    fn trimmed(&mut self, mut object: K) -> K {
        (self.trim)(&mut object);
        object.share(&mut self.texts);
        object
    }

    fn error(&mut self, source: usize, error: &Error) {
        self.metrics.errors.inc();
        let from = &mut self.sources[source];
        source::report(&from.probe, error);
        if is_refusal(error) {
            from.is_synced = false;
            self.synced.set(false);
        }
        let cause = from.cause(client_errors::watch(error));
        if source::is_forgotten(error) {
            tracing::info!(kind = self.kind, error = cause, "listing again");
        } else {
            tracing::warn!(kind = self.kind, error = cause, "a watch has failed and is retried");
        }
        if !self.synced.is_true() {
            self.missing(&cause);
        }
    }

    fn missing(&self, what: &str) {
        self.readiness.set(&self.check, Err(what.to_owned()));
    }
}
