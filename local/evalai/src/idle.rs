//! How long a connection has been without a request: a real front closes it after a while. Used by `server`, one for
//! each connection.

use std::time::Duration;

use tokio::sync::watch;
use tokio::time::{Instant, sleep_until};

/// The times of one connection.
pub(crate) struct Idle {
    /// Since when there is no request; none while one is worked on.
    since: watch::Sender<Option<Instant>>,
    used: std::sync::atomic::AtomicBool,
}

impl Idle {
    /// A connection that has just been made.
    pub(crate) fn new() -> Self {
        Self {
            since: watch::Sender::new(Some(Instant::now())),
            used: false.into(),
        }
    }

    /// A request has come in. How long the connection was idle before; none for its first request.
    pub(crate) fn begin(&self) -> Option<Duration> {
        let since = self.since.send_replace(None);
        let used = self.used.swap(true, std::sync::atomic::Ordering::SeqCst);
        since.filter(|_| used).map(|since| since.elapsed())
    }

    /// The request is answered.
    pub(crate) fn end(&self) {
        self.since.send_replace(Some(Instant::now()));
    }

    /// Waits until the connection has been idle for as long as `limit` returns; it is asked again at each of `changes`.
    pub(crate) async fn over(&self, limit: impl Fn() -> Duration, mut changes: watch::Receiver<u64>) {
        let mut since = self.since.subscribe();
        loop {
            changes.mark_unchanged();
            let end = since.borrow_and_update().map(|since| since + limit());
            let timer = async {
                match end {
                    Some(end) => sleep_until(end).await,
                    None => std::future::pending().await,
                }
            };
            tokio::select! {
                () = timer => return,
                _ = since.changed() => {}
                _ = changes.changed() => {}
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test(start_paused = true)]
    async fn only_the_time_without_a_request_counts() {
        let (idle, changes) = (Idle::new(), watch::Sender::new(0));
        let second = Duration::from_secs(1);
        let over = async |limit: Duration| {
            let over = idle.over(|| limit, changes.subscribe());
            tokio::time::timeout(Duration::ZERO, over).await.is_ok()
        };
        tokio::time::advance(second).await;
        assert!(over(second).await && !over(second * 2).await);
        assert_eq!(idle.begin(), None, "the first request reuses nothing");
        tokio::time::advance(second * 10).await;
        assert!(!over(second).await, "a request is worked on");
        idle.end();
        assert!(!over(second).await);
        tokio::time::advance(second * 3).await;
        assert!(over(second * 3).await);
        assert_eq!(idle.begin(), Some(second * 3));
    }
}
