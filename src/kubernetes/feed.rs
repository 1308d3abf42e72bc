//! Hands the changed objects of a watch to all subscribers, the newest state only.
//!
//! Filled by a watch's task. It never blocks the watch and loses no object: unread changes are coalesced by UID, so it takes no more
//! memory than the objects do. A subscriber that comes late gets all objects that are there.

use std::collections::{HashMap, VecDeque};
use std::pin::Pin;
use std::sync::{Arc, Mutex, Weak};
use std::task::{Context, Poll, Waker};

use futures::Stream;
use kube::runtime::reflector::Lookup;

use super::store::key_of;

use leaderboard_base::lock::lock;

/// An object that was added, changed or deleted.
#[derive(Debug)]
pub struct WatchEvent<K> {
    /// As it is, or as it was last.
    pub object: Arc<K>,
    /// It no longer exists.
    pub is_gone: bool,
}

/// The watch's end. Clones are the same feed.
pub(super) struct Feed<K>(Arc<Mutex<Lanes<K>>>);

struct Lanes<K> {
    lanes: Vec<Weak<Mutex<Lane<K>>>>,
    is_closed: bool,
}

struct Lane<K> {
    order: VecDeque<Box<str>>,
    latest: HashMap<Box<str>, WatchEvent<K>>,
    waker: Option<Waker>,
    is_closed: bool,
}

/// A subscriber's end: a stream that ends with the watch. Dropping it unsubscribes.
#[must_use = "a subscription gathers what is not read"]
pub struct WatchEvents<K>(Arc<Mutex<Lane<K>>>);

impl<K> Clone for Feed<K> {
    fn clone(&self) -> Self {
        Self(self.0.clone())
    }
}

impl<K: Lookup> Feed<K> {
    pub(super) fn new() -> Self {
        Self(Arc::new(Mutex::new(Lanes {
            lanes: Vec::new(),
            is_closed: false,
        })))
    }

    /// `present` is asked under the feed's lock, so that nothing falls between what is there and what comes.
    pub(super) fn subscribe(&self, present: impl FnOnce() -> Vec<Arc<K>>) -> WatchEvents<K> {
        let mut feed = lock(&self.0);
        let is_closed = feed.is_closed;
        let mut lane = Lane {
            order: VecDeque::new(),
            latest: HashMap::new(),
            waker: None,
            is_closed,
        };
        for object in present() {
            lane.push(WatchEvent { object, is_gone: false });
        }
        let lane = Arc::new(Mutex::new(lane));
        feed.lanes.push(Arc::downgrade(&lane));
        WatchEvents(lane)
    }

    pub(super) fn push(&self, object: &Arc<K>, is_gone: bool) {
        self.for_each(|lane| {
            lane.push(WatchEvent {
                object: object.clone(),
                is_gone,
            });
        });
    }

    pub(super) fn close(&self) {
        lock(&self.0).is_closed = true;
        self.for_each(|lane| lane.is_closed = true);
    }

    fn for_each(&self, act: impl Fn(&mut Lane<K>)) {
        let mut feed = lock(&self.0);
        feed.lanes.retain(|lane| {
            let Some(lane) = lane.upgrade() else { return false };
            let mut lane = lock(&lane);
            act(&mut lane);
            if let Some(waker) = lane.waker.take() {
                waker.wake();
            }
            true
        });
    }
}

impl<K: Lookup> Lane<K> {
    fn push(&mut self, event: WatchEvent<K>) {
        let object = event.object.as_ref();
        let key = object.uid().map_or_else(|| key_of(object), Into::into);
        if self.latest.insert(key.clone(), event).is_none() {
            self.order.push_back(key);
        }
    }
}

impl<K> Stream for WatchEvents<K> {
    type Item = WatchEvent<K>;

    fn poll_next(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<WatchEvent<K>>> {
        let mut lane = lock(&self.0);
        let next = lane.order.pop_front();
        if let Some(event) = next.and_then(|key| lane.latest.remove(&key)) {
            return Poll::Ready(Some(event));
        }
        if lane.is_closed {
            return Poll::Ready(None);
        }
        lane.waker = Some(context.waker().clone());
        Poll::Pending
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use futures::{FutureExt, StreamExt};
    use k8s_openapi::api::core::v1::ConfigMap;
    use kube::ResourceExt;

    impl<K: Lookup> WatchEvents<K> {
        /// Events that a test makes.
        pub(crate) fn by_hand() -> (impl Fn(K, bool), Self) {
            let feed = Feed::new();
            let events = feed.subscribe(Vec::new);
            (move |object, is_gone| feed.push(&Arc::new(object), is_gone), events)
        }
    }

    fn object(name: &str, uid: &str, version: &str) -> Arc<ConfigMap> {
        let mut object = ConfigMap::default();
        object.metadata.name = Some(name.into());
        object.metadata.uid = Some(uid.into());
        object.metadata.resource_version = Some(version.into());
        Arc::new(object)
    }

    fn read(events: &mut WatchEvents<ConfigMap>) -> Vec<(String, String, bool)> {
        std::iter::from_fn(|| events.next().now_or_never().flatten())
            .map(|t| {
                (
                    t.object.name_any(),
                    t.object.metadata.resource_version.clone().unwrap(),
                    t.is_gone,
                )
            })
            .collect()
    }

    fn expected(all: &[(&str, &str, bool)]) -> Vec<(String, String, bool)> {
        all.iter()
            .map(|&(name, version, is_gone)| (name.to_owned(), version.to_owned(), is_gone))
            .collect()
    }

    #[test]
    fn what_is_not_read_yet_comes_once_in_its_newest_state() {
        let feed = Feed::new();
        let mut events = feed.subscribe(|| vec![object("a", "1", "1")]);
        feed.push(&object("b", "2", "2"), false);
        feed.push(&object("a", "1", "3"), false);
        feed.push(&object("b", "2", "4"), true);
        assert_eq!(read(&mut events), expected(&[("a", "3", false), ("b", "4", true)]));
        feed.push(&object("a", "1", "5"), false);
        assert_eq!(read(&mut events), expected(&[("a", "5", false)]));
    }

    #[test]
    fn the_end_of_an_object_is_not_covered_by_its_namesake() {
        let feed = Feed::new();
        let mut events = feed.subscribe(Vec::new);
        feed.push(&object("a", "old", "1"), true);
        feed.push(&object("a", "new", "2"), false);
        assert_eq!(read(&mut events), expected(&[("a", "1", true), ("a", "2", false)]));
    }

    #[tokio::test]
    async fn each_subscriber_gets_all_and_ends_with_the_watch() {
        let feed = Feed::<ConfigMap>::new();
        let (mut one, two) = (feed.subscribe(Vec::new), feed.subscribe(Vec::new));
        drop(two);
        let reader = tokio::spawn(async move { one.next().await.map(|t| t.object.name_any()) });
        tokio::task::yield_now().await;
        feed.push(&object("a", "1", "1"), false);
        assert_eq!(reader.await.unwrap().as_deref(), Some("a"));
        assert_eq!(
            lock(&feed.0)
                .lanes
                .iter()
                .filter(|lane| lane.strong_count() > 0)
                .count(),
            0
        );
        let mut three = feed.subscribe(Vec::new);
        feed.push(&object("b", "2", "2"), false);
        feed.close();
        assert_eq!(
            read(&mut three),
            expected(&[("b", "2", false)]),
            "what came before the end still comes"
        );
        assert!(three.next().await.is_none());
        assert!(
            feed.subscribe(Vec::new).next().await.is_none(),
            "a watch that has ended has no more events"
        );
    }
}
