//! The objects of one kind as they were last observed, by name and by one index.
//!
//! Filled by the watch's task alone; readers get the objects themselves, shared.

use std::collections::HashMap;
use std::sync::{Arc, PoisonError, RwLock, RwLockReadGuard, RwLockWriteGuard};

use kube::runtime::reflector::{Lookup, ObjectRef};
use tokio::sync::watch;

use super::Watchable;

/// By what objects are looked up besides their names, if at all.
pub type Index<K> = fn(&K) -> Option<String>;

/// Reads a cache. Clones are the same one.
pub struct Store<K>(Arc<Shared<K>>);

struct Shared<K> {
    cache: RwLock<Cache<K>>,
    index: Index<K>,
    ready: watch::Receiver<bool>,
}

struct Cache<K> {
    by_key: HashMap<Box<str>, Arc<K>>,
    by_index: HashMap<Box<str>, Vec<Arc<K>>>,
}

/// The watch's task has ended, and with it the process will.
#[derive(thiserror::Error, Debug)]
#[error("the watch has ended before its first list")]
pub struct Ended;

/// Namespace and name in one.
pub(super) fn key_of(object: &impl Lookup) -> Box<str> {
    key(
        object.namespace().as_deref(),
        object.name().as_deref().unwrap_or_default(),
    )
}

pub(super) fn key(namespace: Option<&str>, name: &str) -> Box<str> {
    format!("{}/{name}", namespace.unwrap_or_default()).into()
}

impl<K> Clone for Store<K> {
    fn clone(&self) -> Self {
        Self(Arc::clone(&self.0))
    }
}

impl<K: Watchable> Store<K> {
    /// An empty cache, and what is sent `true` once everything was listed.
    pub(super) fn new(index: Index<K>) -> (Self, watch::Sender<bool>) {
        let (listed, ready) = watch::channel(false);
        let cache = Cache {
            by_key: HashMap::new(),
            by_index: HashMap::new(),
        };
        let shared = Shared {
            cache: RwLock::new(cache),
            index,
            ready,
        };
        (Self(Arc::new(shared)), listed)
    }

    /// The object of this name.
    pub fn get(&self, reference: &ObjectRef<K>) -> Option<Arc<K>> {
        self.by_key(&key(reference.namespace.as_deref(), &reference.name))
    }

    /// The objects of one value of the index.
    pub fn indexed(&self, value: &str) -> Vec<Arc<K>> {
        self.read().by_index.get(value).cloned().unwrap_or_default()
    }

    /// All of them.
    pub fn state(&self) -> Vec<Arc<K>> {
        self.read().by_key.values().cloned().collect()
    }

    pub fn len(&self) -> usize {
        self.read().by_key.len()
    }

    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Waits until everything was listed once.
    pub async fn wait_until_ready(&self) -> Result<(), Ended> {
        let mut ready = self.0.ready.clone();
        let is_ready = ready.wait_for(|is_ready| *is_ready).await;
        is_ready.map(|_| ()).map_err(|_| Ended)
    }

    pub(super) fn is_ready(&self) -> bool {
        *self.0.ready.borrow()
    }

    pub(super) fn by_key(&self, key: &str) -> Option<Arc<K>> {
        self.read().by_key.get(key).cloned()
    }

    fn read(&self) -> RwLockReadGuard<'_, Cache<K>> {
        self.0.cache.read().unwrap_or_else(PoisonError::into_inner)
    }

    fn write(&self) -> RwLockWriteGuard<'_, Cache<K>> {
        self.0.cache.write().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes an object in. Returns it, and what it replaces.
    pub(super) fn insert(&self, object: K) -> (Arc<K>, Option<Arc<K>>) {
        let (key, object) = (key_of(&object), Arc::new(object));
        let index = self.0.index;
        let mut cache = self.write();
        let before = cache.by_key.insert(key, Arc::clone(&object));
        if let Some(before) = &before {
            cache.leave(before, index);
        }
        if let Some(value) = index(&object) {
            let all = cache
                .by_index
                .entry(value.into())
                .or_insert_with(|| Vec::with_capacity(1));
            all.push(Arc::clone(&object));
        }
        drop(cache);
        (object, before)
    }

    /// Drops an object. Returns what it was.
    pub(super) fn evict(&self, key: &str) -> Option<Arc<K>> {
        let mut cache = self.write();
        let before = cache.by_key.remove(key)?;
        cache.leave(&before, self.0.index);
        drop(cache);
        Some(before)
    }

    /// The keys for which this does not hold.
    pub(super) fn keys_without(&self, holds: impl Fn(&str) -> bool) -> Vec<Box<str>> {
        let cache = self.read();
        cache.by_key.keys().filter(|key| !holds(key)).cloned().collect()
    }
}

impl<K> Cache<K> {
    fn leave(&mut self, object: &Arc<K>, index: Index<K>) {
        let Some(value) = index(object) else { return };
        if let Some(all) = self.by_index.get_mut(value.as_str()) {
            all.retain(|other| !Arc::ptr_eq(other, object));
            if all.is_empty() {
                self.by_index.remove(value.as_str());
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::objects::Pod;
    use super::*;

    /// Caches that tests fill.
    impl<K: Watchable> Store<K> {
        /// A cache that holds these.
        pub(crate) fn of(objects: impl IntoIterator<Item = K>, index: Index<K>) -> Self {
            let (store, listed) = Self::new(index);
            for object in objects {
                store.insert(object);
            }
            listed.send_replace(true);
            store
        }

        /// An empty cache, and what makes it complete.
        pub(crate) fn unlisted() -> (Self, watch::Sender<bool>) {
            Self::new(|_| None)
        }

        pub(crate) fn put(&self, object: K) {
            self.insert(object);
        }

        pub(crate) fn remove(&self, object: &K) {
            self.evict(&key_of(object));
        }
    }

    fn owner(pod: &Pod) -> Option<String> {
        pod.metadata.owner_references.first().map(|owner| owner.uid.to_string())
    }

    fn pod(name: &str, uid: &str, owner: &str) -> Pod {
        let owners = serde_json::json!([{"uid": owner}]);
        let metadata = serde_json::json!({"name": name, "namespace": "n", "uid": uid, "ownerReferences": owners});
        serde_json::from_value(serde_json::json!({"metadata": metadata})).unwrap()
    }

    #[test]
    fn the_index_follows_an_object_that_is_replaced_or_removed() {
        let (store, _) = Store::new(owner);
        let uids = |value: &str| {
            let mut uids: Vec<_> = store
                .indexed(value)
                .iter()
                .map(|p| p.metadata.uid.to_string())
                .collect();
            uids.sort();
            uids
        };
        store.insert(pod("a", "1", "job-1"));
        store.insert(pod("b", "2", "job-1"));
        assert_eq!(uids("job-1"), ["1", "2"]);
        let (_, before) = store.insert(pod("a", "3", "job-2"));
        assert_eq!(before.unwrap().metadata.uid.as_ref(), "1");
        assert_eq!(
            (uids("job-1"), uids("job-2")),
            (vec!["2".to_owned()], vec!["3".to_owned()])
        );
        store.insert(pod("a", "3", "job-2"));
        assert_eq!(uids("job-2"), ["3"], "once, however often it changes");
        store.evict("n/b");
        store.evict("n/a");
        assert!(store.evict("n/a").is_none() && store.is_empty());
        assert!(store.read().by_index.is_empty(), "nothing is left of what is gone");
    }
}
