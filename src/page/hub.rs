//! Hands the view to its viewers. All of them share one view. It is made a second after a change at the soonest, and not at all without
//! a viewer.
//!
//! A viewer that reads slowly holds one old view and gets the newest one next; none waits for another.

use std::sync::Arc;
use std::time::Duration;

use axum::body::Bytes;
use futures::stream::{self, BoxStream};
use futures::{FutureExt, Stream, StreamExt};
use tokio::sync::{Notify, OwnedSemaphorePermit, Semaphore, watch};
use tokio::time::{sleep, timeout};

use leaderboard_base::shutdown::Stop;

/// Most viewers at once. Each can hold one view that is no longer the newest.
pub(super) const VIEWERS: usize = 32;
/// Least time between two views.
const PACE: Duration = Duration::from_secs(1);
/// Time until a view is made again without a change: failures grow old, and this replica may have begun to lead.
const REFRESH: Duration = Duration::from_secs(15);
/// Time between two signs of life, which show viewers and programs in between that an idle connection is not a dead one.
const KEEP_ALIVE: Duration = Duration::from_secs(15);
const ALIVE: &[u8] = b":\n\n";

/// The data that a page shows.
pub(super) trait Source: Send + Sync + 'static {
    /// Yields whenever the view may have changed. The hub holds it only while there is a viewer.
    fn changes(&self) -> BoxStream<'static, ()>;
    /// The view as JSON in one line.
    fn view(&self) -> Vec<u8>;
    /// One submission as JSON; none if there is none of this name.
    fn detail(&self, namespace: &str, name: &str) -> Option<Vec<u8>>;
}

/// Clones are the same hub.
#[derive(Clone)]
pub(super) struct Hub(Arc<Shared>);

struct Shared {
    places: Arc<Semaphore>,
    /// Somebody has come.
    come: Notify,
    /// The newest view as an event; None without a viewer.
    latest: watch::Sender<Option<Bytes>>,
}

/// A place among the viewers.
pub(super) struct Viewer {
    views: watch::Receiver<Option<Bytes>>,
    _place: OwnedSemaphorePermit,
}

impl Hub {
    pub(super) fn new() -> Self {
        Self(Arc::new(Shared {
            places: Arc::new(Semaphore::new(VIEWERS)),
            come: Notify::new(),
            latest: watch::Sender::new(None),
        }))
    }

    /// A place for one more; none if all are taken.
    pub(super) fn join(&self) -> Option<Viewer> {
        let place = Arc::clone(&self.0.places).try_acquire_owned().ok()?;
        let mut views = self.0.latest.subscribe();
        // The present view is news to this viewer.
        views.mark_changed();
        self.0.come.notify_one();
        Some(Viewer { views, _place: place })
    }

    /// Makes views while somebody looks.
    pub(super) async fn run(self, source: Arc<dyn Source>) {
        loop {
            self.0.come.notified().await;
            self.show(source.as_ref()).await;
        }
    }

    /// Makes views until the last viewer has gone.
    async fn show(&self, source: &dyn Source) {
        let latest = &self.0.latest;
        let mut changes = source.changes();
        let mut shown = Vec::new();
        while latest.receiver_count() > 0 {
            // This view has the changes so far.
            while changes.next().now_or_never().flatten().is_some() {}
            let view = source.view();
            if view != shown {
                latest.send_replace(Some(event(&view)));
                shown = view;
            }
            tokio::select! {
                biased;
                () = latest.closed() => break,
                () = next(&mut changes) => {}
            }
        }
        latest.send_replace(None);
    }
}

/// Waits for a change, for the pace of views, and for the refresh at most.
async fn next(changes: &mut BoxStream<'static, ()>) {
    sleep(PACE).await;
    // The end of a watch ends the process; until then there is no change.
    if let Ok(None) = timeout(REFRESH, changes.next()).await {
        sleep(REFRESH).await;
    }
}

/// JSON has no raw line break, so that it is one line of an event.
fn event(view: &[u8]) -> Bytes {
    [b"data: ".as_slice(), view, b"\n\n"].concat().into()
}

impl Viewer {
    /// Each view that is new when it is read, and a sign of life between them; ends by the stop.
    pub(super) fn events(self, stop: Stop) -> impl Stream<Item = Bytes> + Send {
        let events = stream::unfold(self, |mut viewer| async move {
            let view = timeout(KEEP_ALIVE, viewer.next()).await;
            let event = view.unwrap_or(Some(Bytes::from_static(ALIVE)));
            event.map(|event| (event, viewer))
        });
        events.take_until(async move { stop.wait().await })
    }

    async fn next(&mut self) -> Option<Bytes> {
        loop {
            self.views.changed().await.ok()?;
            let view = self.views.borrow_and_update().clone();
            if view.is_some() {
                return view;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::atomic::{AtomicUsize, Ordering};
    use tokio::sync::mpsc;
    use tokio::time::{Instant, advance};

    /// A source that counts its views; the content is its number of changes.
    #[derive(Clone, Default)]
    struct Counter {
        views: Arc<AtomicUsize>,
        content: Arc<AtomicUsize>,
        wakes: Arc<std::sync::Mutex<Vec<mpsc::UnboundedSender<()>>>>,
    }

    impl Counter {
        fn change(&self) {
            self.content.fetch_add(1, Ordering::SeqCst);
            self.wakes.lock().unwrap().retain(|wake| wake.send(()).is_ok());
        }

        fn made(&self) -> usize {
            self.views.load(Ordering::SeqCst)
        }

        fn subscriptions(&self) -> usize {
            let mut wakes = self.wakes.lock().unwrap();
            wakes.retain(|wake| !wake.is_closed());
            wakes.len()
        }
    }

    impl Source for Counter {
        fn changes(&self) -> BoxStream<'static, ()> {
            let (wake, woken) = mpsc::unbounded_channel();
            self.wakes.lock().unwrap().push(wake);
            let next = |mut woken: mpsc::UnboundedReceiver<()>| async move { woken.recv().await.map(|()| ((), woken)) };
            stream::unfold(woken, next).boxed()
        }

        fn view(&self) -> Vec<u8> {
            self.views.fetch_add(1, Ordering::SeqCst);
            self.content.load(Ordering::SeqCst).to_string().into_bytes()
        }

        fn detail(&self, _: &str, _: &str) -> Option<Vec<u8>> {
            None
        }
    }

    fn hub() -> (Hub, Counter, watch::Sender<bool>, Stop) {
        let (hub, source) = (Hub::new(), Counter::default());
        let (sender, stop) = Stop::new();
        tokio::spawn(hub.clone().run(Arc::new(source.clone())));
        (hub, source, sender, stop)
    }

    #[tokio::test(start_paused = true)]
    async fn nothing_is_made_while_nobody_looks_and_one_view_serves_all() {
        let (hub, source, _sender, stop) = hub();
        source.change();
        advance(10 * REFRESH).await;
        assert_eq!((source.made(), source.subscriptions()), (0, 0), "nobody looks");
        let mut all: Vec<_> = (0..VIEWERS)
            .map(|_| Box::pin(hub.join().unwrap().events(stop.clone())))
            .collect();
        for viewer in &mut all {
            assert_eq!(viewer.next().await.unwrap(), "data: 1\n\n");
        }
        assert_eq!((source.made(), source.subscriptions()), (1, 1), "one for all viewers");
        drop(all);
        // It notices that the last viewer has gone, and drops the subscription, which would gather changes without a reader.
        sleep(Duration::from_millis(1)).await;
        assert!(hub.0.latest.borrow().is_none());
        source.change();
        advance(10 * REFRESH).await;
        assert_eq!((source.made(), source.subscriptions()), (1, 0));
        let mut again = Box::pin(hub.join().unwrap().events(stop));
        assert_eq!(again.next().await.unwrap(), "data: 2\n\n");
    }

    #[tokio::test(start_paused = true)]
    async fn a_thousand_changes_in_a_second_are_one_view_and_a_slow_reader_gets_the_newest() {
        let (hub, source, _sender, stop) = hub();
        let mut fast = Box::pin(hub.join().unwrap().events(stop.clone()));
        let mut slow = Box::pin(hub.join().unwrap().events(stop));
        assert_eq!(fast.next().await.unwrap(), "data: 0\n\n");
        let from = Instant::now();
        for round in 1..=3_usize {
            for _ in 0..1000 {
                source.change();
            }
            let event = fast.next().await.unwrap();
            assert_eq!(event, format!("data: {}\n\n", round * 1000));
        }
        assert!(from.elapsed() >= 3 * PACE, "{:?}", from.elapsed());
        assert_eq!(source.made(), 4);
        assert_eq!(slow.next().await.unwrap(), "data: 3000\n\n");
    }

    #[tokio::test(start_paused = true)]
    async fn the_same_view_is_sent_once_and_a_sign_of_life_comes_between() {
        let (hub, source, _sender, stop) = hub();
        let mut viewer = Box::pin(hub.join().unwrap().events(stop));
        assert_eq!(viewer.next().await.unwrap(), "data: 0\n\n");
        for _ in 0..3 {
            assert_eq!(viewer.next().await.unwrap(), ALIVE);
        }
        assert!(source.made() >= 3, "it was made again, and was the same");
    }

    #[tokio::test(start_paused = true)]
    async fn a_place_is_free_again_when_its_viewer_goes_and_all_end_by_the_stop() {
        let (hub, _source, sender, stop) = hub();
        let mut all: Vec<_> = (0..VIEWERS).map(|_| hub.join().unwrap()).collect();
        assert!(hub.join().is_none(), "the limit");
        all.pop();
        let mut last = Box::pin(hub.join().unwrap().events(stop));
        assert!(hub.join().is_none());
        assert!(last.next().await.is_some());
        sender.send(true).unwrap();
        assert!(last.next().await.is_none());
    }
}
