//! Watches: one task for each kind, a cache, and a feed of what has changed.
//!
//! One task each, because a shared backoff would let one broken watch hold up all others. Errors are logged, counted and
//! retried here; readers only ever get objects.

use std::collections::{BTreeSet, HashSet};
use std::pin::Pin;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use futures::{Stream, StreamExt};
use kube::Api;
use kube::runtime::watcher::{Config, Error, Event};
use kube::runtime::{WatchStreamExt, watcher};

use super::feed::{Feed, WatchEvents};
use super::item::{Item, Watchable};
use super::objects::Texts;
use super::store::{Index, Store, Writer, key_of};
use crate::observability::Observability;
use crate::observability::liveness::WatchProbe;
use crate::observability::metrics::WatchMetrics;
use crate::observability::readiness::Readiness;
use crate::observability::shutdown::Stop;
use leaderboard_api::client_errors;

/// A watch that the API server has refused begins again with a list after this long.
const REFUSED_AGAIN: Duration = Duration::from_secs(10);
/// Objects of one page of a list, each of up to 50 KB: a page is in memory as a whole while it is decoded.
const PAGE: u32 = 100;

/// A running watch. Clones are the same one.
pub struct Watch<K: Watchable> {
    /// The objects as they were last observed.
    pub store: Store<K>,
    /// Whether the store is in sync with the API server.
    pub synced: Synced,
    /// What exists and is not in the store, or only as it was before.
    pub unreadable: Unreadable,
    feed: Feed<K>,
}

/// Whether a watch has listed its kind and was not refused since: otherwise a store may show what is long gone. Clones are
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
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// What is kept of a kind, and how it is found.
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
    /// Whether the store holds every object, each as it is.
    pub fn is_complete(&self) -> bool {
        self.synced.is_true() && self.unreadable.is_empty()
    }

    /// All objects that exist now, then each that is added, changed or deleted. The store is at least as new as each event.
    pub fn subscribe(&self) -> WatchEvents<K> {
        self.feed.subscribe(|| {
            // What a first list has brought so far comes once it is complete.
            if self.store.is_ready() {
                self.store.state()
            } else {
                Vec::new()
            }
        })
    }
}

/// Starts to watch a kind until the process stops. Until the first list is complete, the process is not ready.
pub fn spawn_watch<K: Watchable>(
    api: Api<Item<K>>,
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
    let task = Task {
        check: format!("{} synced", K::plural(&())),
        probe: telemetry.liveness.watch(&kind),
        metrics: telemetry.metrics.watch(&kind),
        readiness: telemetry.readiness.clone(),
        kind,
        trim,
        texts: Texts::default(),
        writer,
        feed: watch.feed.clone(),
        synced: watch.synced.clone(),
        unreadable: watch.unreadable.clone(),
        list: Listing::default(),
    };
    task.missing("the first list has not come yet");
    let name = format!("watch of {}", K::plural(&()));
    let config = config.page_size(PAGE);
    telemetry
        .tasks
        .stay(name, task.run(api, config, telemetry.stop.clone()));
    watch
}

struct Task<K: Watchable> {
    kind: String,
    /// Name of the check of readiness.
    check: String,
    probe: WatchProbe,
    metrics: WatchMetrics,
    readiness: Readiness,
    trim: fn(&mut K),
    texts: Texts,
    writer: Writer<K>,
    feed: Feed<K>,
    synced: Synced,
    unreadable: Unreadable,
    list: Listing<K>,
}

/// A list under way. What it brings is cached at once, so that no second cache is needed, and is an event once the list is
/// complete.
struct Listing<K> {
    /// What this list has shown.
    shown: HashSet<Box<str>>,
    /// What it has shown and cannot be read.
    unreadable: BTreeSet<Box<str>>,
    /// What has changed since the last list that was complete.
    changed: HashSet<Box<str>>,
    /// What was replaced by another object of its name meanwhile.
    replaced: Vec<Arc<K>>,
}

impl<K> Default for Listing<K> {
    fn default() -> Self {
        Self {
            shown: HashSet::new(),
            unreadable: BTreeSet::new(),
            changed: HashSet::new(),
            replaced: Vec::new(),
        }
    }
}

type Events<K> = Pin<Box<dyn Stream<Item = Result<Event<Item<K>>, Error>> + Send>>;

/// A list, then what changes.
fn begin<K: Watchable>(api: &Api<Item<K>>, config: &Config) -> Events<K> {
    Box::pin(watcher(api.clone(), config.clone()).default_backoff())
}

/// The right to list or to watch is missing.
fn is_refusal(error: &Error) -> bool {
    match error {
        Error::InitialListFailed(kube::Error::Api(status)) | Error::WatchStartFailed(kube::Error::Api(status)) => {
            status.code == 403
        }
        _ => false,
    }
}

impl<K: Watchable> Task<K> {
    async fn run(mut self, api: Api<Item<K>>, config: Config, stop: Stop) {
        let mut events = begin(&api, &config);
        loop {
            let event = tokio::select! {
                () = stop.wait() => break,
                event = events.next() => event,
            };
            match event {
                Some(Ok(event)) => self.event(event),
                Some(Err(error)) => {
                    self.error(&error);
                    // A list, because a watch without news does not show that the right is back.
                    if matches!(error, Error::WatchStartFailed(_)) && is_refusal(&error) {
                        tokio::select! { () = stop.wait() => break, () = tokio::time::sleep(REFUSED_AGAIN) => {} }
                        events = begin(&api, &config);
                    }
                }
                // The stream has no end; if it ends all the same, this task ends, and with it the process.
                None => break,
            }
        }
        self.feed.close();
    }

    fn event(&mut self, event: Event<Item<K>>) {
        if matches!(event, Event::Init) {
            // The beginning of a list is a request, not an answer.
            self.probe.listing();
            self.list.shown.clear();
            return self.list.unreadable.clear();
        }
        self.metrics.event();
        match event {
            Event::Apply(item) => self.apply(item),
            Event::Delete(item) => self.delete(item),
            Event::InitApply(item) => self.listed(item),
            Event::Init | Event::InitDone => self.list_done(),
        }
    }

    fn apply(&mut self, item: Item<K>) {
        self.probe.running();
        let object = match self.read(item) {
            Ok(object) => object,
            Err(key) => {
                self.unreadable.keys().insert(key);
                return;
            }
        };
        self.unreadable.keys().remove(&key_of(&object));
        let (after, before) = self.writer.put(object);
        // The end of an object that was replaced by another one of its name between two reads.
        if let Some(before) = before.filter(|before| before.uid() != after.uid()) {
            self.feed.push(&before, true);
        }
        self.feed.push(&after, false);
    }

    fn delete(&mut self, item: Item<K>) {
        self.probe.running();
        let (key, last) = match item.object {
            Ok(object) => (key_of(&object), Some(self.trimmed(object))),
            Err(malformed) => (malformed.key(), None),
        };
        self.unreadable.keys().remove(&key);
        let known = self.writer.remove(&key);
        // No event was sent for an object that never could be read.
        if let Some(last) = last.map(Arc::new).or(known) {
            self.feed.push(&last, true);
        }
    }

    fn listed(&mut self, item: Item<K>) {
        let object = match self.read(item) {
            Ok(object) => object,
            Err(key) => {
                // One that has become unreadable stays as it was last read: it has not been deleted.
                self.list.shown.insert(key.clone());
                self.list.unreadable.insert(key);
                return;
            }
        };
        let key = key_of(&object);
        self.list.shown.insert(key.clone());
        let known = self.writer.store().by_key(&key);
        let is_known = known
            .is_some_and(|known| known.uid() == object.uid() && known.resource_version() == object.resource_version());
        if is_known {
            return;
        }
        let (after, before) = self.writer.put(object);
        self.list.changed.insert(key);
        self.list
            .replaced
            .extend(before.filter(|before| before.uid() != after.uid()));
    }

    fn list_done(&mut self) {
        let list = std::mem::take(&mut self.list);
        let mut gone = list.replaced;
        for key in self.writer.keys_without(|key| list.shown.contains(key)) {
            gone.extend(self.writer.remove(&key));
        }
        *self.unreadable.keys() = list.unreadable;
        self.probe.listed();
        // Before anyone is woken by what was listed.
        self.writer.is_complete();
        if !self.synced.is_true() {
            self.synced.set(true);
            self.readiness.set(&self.check, Ok(()));
        }
        for gone in &gone {
            self.feed.push(gone, true);
        }
        let store = self.writer.store();
        for object in list.changed.iter().filter_map(|key| store.by_key(key)) {
            self.feed.push(&object, false);
        }
        tracing::info!(
            kind = self.kind,
            objects = store.len(),
            changed = list.changed.len(),
            gone = gone.len(),
            "listed"
        );
    }

    /// The object, trimmed; if it can't be read, its key, and its name is logged.
    fn read(&mut self, item: Item<K>) -> Result<K, Box<str>> {
        item.object.map(|object| self.trimmed(object)).map_err(|malformed| {
            self.metrics.malformed();
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

    fn error(&self, error: &Error) {
        self.metrics.failed();
        match error {
            // Both come from a watch that had been let in.
            Error::WatchError(_) | Error::WatchFailed(_) => self.probe.running(),
            _ if is_refusal(error) => {
                self.probe.refused();
                self.synced.set(false);
            }
            _ => self.probe.failed(),
        }
        let cause = client_errors::watch(error);
        if let Error::WatchError(status) = error
            && status.code == 410
        {
            // The server has forgotten where the watch was: usual after an outage.
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
