//! Watches: one task for each kind, a cache, and a feed of what has changed.
//!
//! One task each, because a shared backoff would let one broken watch hold up all others. Errors are logged, counted and
//! retried here; readers only ever get objects.

use std::collections::{BTreeSet, HashMap};
use std::pin::Pin;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use futures::{Stream, StreamExt};
use kube::core::DeserializeGuard;
use kube::runtime::reflector::{ObjectRef, Store, store::Writer};
use kube::runtime::watcher::{Config, Error, Event};
use kube::runtime::{WatchStreamExt, watcher};
use kube::{Api, ResourceExt};

use super::Watchable;
use super::feed::{Feed, WatchEvents};
use crate::observability::Observability;
use crate::observability::liveness::WatchProbe;
use crate::observability::metrics::WatchMetrics;
use crate::observability::readiness::Readiness;
use crate::observability::shutdown::Stop;
use leaderboard_api::client_errors;

/// A watch that the API server has refused begins again with a list after this long.
const REFUSED_AGAIN: Duration = Duration::from_secs(10);

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
pub struct Unreadable(Arc<Mutex<BTreeSet<ObjectName>>>);

type ObjectName = (Option<String>, String);

impl Unreadable {
    /// There is none.
    pub fn is_empty(&self) -> bool {
        self.names().is_empty()
    }

    fn names(&self) -> MutexGuard<'_, BTreeSet<ObjectName>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

fn name_of(object: &impl ResourceExt) -> ObjectName {
    (object.namespace(), object.name_any())
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
        self.feed.subscribe(|| self.store.state())
    }
}

/// Starts to watch a kind until the process stops. `trim` drops what is never read, before it is cached; managed fields go
/// anyway. Until the first list is complete, the process is not ready.
pub fn spawn_watch<K: Watchable>(
    api: Api<DeserializeGuard<K>>,
    config: Config,
    trim: fn(&mut K),
    telemetry: &Observability,
) -> Watch<K> {
    let writer = Writer::<K>::new(());
    let watch = Watch {
        store: writer.as_reader(),
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
        store: watch.store.clone(),
        writer,
        feed: watch.feed.clone(),
        synced: watch.synced.clone(),
        unreadable: watch.unreadable.clone(),
        listing: BTreeSet::new(),
    };
    task.missing("the first list has not come yet");
    let name = format!("watch of {}", K::plural(&()));
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
    store: Store<K>,
    writer: Writer<K>,
    feed: Feed<K>,
    synced: Synced,
    unreadable: Unreadable,
    /// The unreadable objects of the list under way.
    listing: BTreeSet<ObjectName>,
}

type Events<K> = Pin<Box<dyn Stream<Item = Result<Event<DeserializeGuard<K>>, Error>> + Send>>;

/// A list, then what changes.
fn begin<K: Watchable>(api: &Api<DeserializeGuard<K>>, config: &Config) -> Events<K> {
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
    async fn run(mut self, api: Api<DeserializeGuard<K>>, config: Config, stop: Stop) {
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

    fn event(&mut self, event: Event<DeserializeGuard<K>>) {
        if matches!(event, Event::Init) {
            // The beginning of a list is a request, not an answer.
            self.probe.listing();
            self.listing.clear();
            return self.writer.apply_watcher_event(&Event::Init);
        }
        self.metrics.event();
        match event {
            Event::Apply(object) => self.apply(object),
            Event::Delete(object) => self.delete(object),
            Event::InitApply(object) => self.listed(object),
            Event::Init | Event::InitDone => self.list_done(),
        }
    }

    fn apply(&mut self, object: DeserializeGuard<K>) {
        self.probe.running();
        let name = name_of(&object);
        let Some(object) = self.read(object) else {
            self.unreadable.names().insert(name);
            return;
        };
        self.unreadable.names().remove(&name);
        let key = ObjectRef::from_obj(&object);
        let before = self.store.get(&key);
        self.writer.apply_watcher_event(&Event::Apply(object));
        let after = self.store.get(&key);
        // The end of an object that was replaced by another one of its name between two reads.
        if let Some(before) = before.filter(|b| after.as_ref().is_some_and(|a| a.uid() != b.uid())) {
            self.feed.push(&before, true);
        }
        if let Some(after) = after {
            self.feed.push(&after, false);
        }
    }

    fn delete(&mut self, object: DeserializeGuard<K>) {
        self.probe.running();
        self.unreadable.names().remove(&name_of(&object));
        let last = match object.0 {
            Ok(mut object) => {
                self.trim(&mut object);
                Arc::new(object)
            }
            Err(invalid) => {
                let mut key = ObjectRef::<K>::new(invalid.metadata.name.as_deref().unwrap_or_default());
                key.namespace = invalid.metadata.namespace;
                // No event was sent for an object that never could be read.
                let Some(known) = self.store.get(&key) else { return };
                known
            }
        };
        self.writer.apply_watcher_event(&Event::Delete((*last).clone()));
        self.feed.push(&last, true);
    }

    fn listed(&mut self, object: DeserializeGuard<K>) {
        let (namespace, name) = name_of(&object);
        let object = self.read(object).or_else(|| {
            self.listing.insert((namespace.clone(), name.clone()));
            // One that has become unreadable stays as it was last read: it has not been deleted.
            let mut key = ObjectRef::<K>::new(&name);
            key.namespace = namespace;
            self.store.get(&key).map(|known| (*known).clone())
        });
        if let Some(object) = object {
            self.writer.apply_watcher_event(&Event::InitApply(object));
        }
    }

    fn list_done(&mut self) {
        let mut before: HashMap<_, _> = self
            .store
            .state()
            .into_iter()
            .map(|object| (object.uid(), object))
            .collect();
        self.writer.apply_watcher_event(&Event::InitDone);
        *self.unreadable.names() = std::mem::take(&mut self.listing);
        self.probe.listed();
        // Before anyone is woken by what was listed.
        if !self.synced.is_true() {
            self.synced.set(true);
            self.readiness.set(&self.check, Ok(()));
        }
        let mut changed = 0_usize;
        for object in self.store.state() {
            let known = before.remove(&object.uid());
            if known.is_none_or(|known| known.resource_version() != object.resource_version()) {
                self.feed.push(&object, false);
                changed += 1;
            }
        }
        for gone in before.values() {
            self.feed.push(gone, true);
        }
        tracing::info!(
            kind = self.kind,
            objects = self.store.len(),
            changed,
            gone = before.len(),
            "listed"
        );
    }

    /// The object, trimmed; None if it can't be read, which is logged with its name.
    fn read(&self, object: DeserializeGuard<K>) -> Option<K> {
        match object.0 {
            Ok(mut object) => {
                self.trim(&mut object);
                Some(object)
            }
            Err(invalid) => {
                self.metrics.malformed();
                let (namespace, name) = (invalid.metadata.namespace.as_deref(), invalid.metadata.name.as_deref());
                tracing::error!(
                    kind = self.kind,
                    namespace,
                    name,
                    error = invalid.error,
                    "skipped an object that can't be read"
                );
                None
            }
        }
    }

    fn trim(&self, object: &mut K) {
        object.meta_mut().managed_fields = None;
        (self.trim)(object);
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
