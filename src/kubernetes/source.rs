//! One API of a watch: its events, its list under way, and how it stands. Used by `watch` alone.

use std::collections::HashSet;
use std::pin::Pin;
use std::time::Duration;

use futures::future::ready;
use futures::{Stream, StreamExt, stream};
use kube::Api;
use kube::runtime::watcher::{Config, Error, Event};
use kube::runtime::{WatchStreamExt, watcher};

use super::item::{Item, Watchable};
use super::store::key;
use crate::observability::liveness::WatchProbe;

/// A watch that the API server has refused begins again with a list after this long.
const REFUSED_AGAIN: Duration = Duration::from_secs(10);

/// How one API of a watch stands.
pub(super) struct Source {
    /// Its namespace, where it is one of several.
    pub namespace: Option<Box<str>>,
    pub probe: WatchProbe,
    /// Keys that the list under way has shown. Its objects are cached at once, so that no second cache is needed.
    pub shown: HashSet<Box<str>>,
    /// It has listed and was not refused since.
    pub is_synced: bool,
    pub has_listed: bool,
}

impl Source {
    pub(super) fn new(namespace: Option<&str>, probe: WatchProbe) -> Self {
        Self {
            namespace: namespace.map(Into::into),
            probe,
            shown: HashSet::new(),
            is_synced: false,
            has_listed: false,
        }
    }

    /// True if an object of this key is one that it shows.
    pub(super) fn has(&self, object: &str) -> bool {
        self.namespace
            .as_deref()
            .is_none_or(|namespace| object.starts_with(&*key(Some(namespace), "")))
    }

    /// A cause of failure, with the namespace where there are several.
    pub(super) fn cause(&self, cause: String) -> String {
        match &self.namespace {
            Some(namespace) => format!("{cause} (namespace {namespace})"),
            None => cause,
        }
    }
}

/// An event of one API, or an error.
type News<K> = Result<Event<Item<K>>, Error>;
type Events<K> = Pin<Box<dyn Stream<Item = News<K>> + Send>>;

/// Events of all APIs, each with its number, until those of one end.
pub(super) fn all<K: Watchable>(
    apis: Vec<Api<Item<K>>>,
    config: &Config,
) -> impl Stream<Item = (usize, News<K>)> + Send + Unpin + use<K> {
    numbered(apis.into_iter().map(|api| lasting(api, config.clone())).collect())
}

/// Items of all streams, each with its stream's number. The end of one is the end of all.
fn numbered<S: Stream + Unpin>(streams: Vec<S>) -> impl Stream<Item = (usize, S::Item)> + Unpin {
    let with_end = |(number, one): (usize, S)| {
        let items = one.map(move |item| Some((number, item)));
        items.chain(stream::once(ready(None)))
    };
    stream::select_all(streams.into_iter().enumerate().map(with_end)).scan((), |(), item| ready(item))
}

/// A list, then what changes; a list again after a refusal, because a watch without news does not show that the right is back.
fn lasting<K: Watchable>(api: Api<Item<K>>, config: Config) -> Events<K> {
    let begun = begin(&api, &config);
    Box::pin(stream::unfold((begun, false), move |(mut events, was_refused)| {
        let (api, config) = (api.clone(), config.clone());
        async move {
            if was_refused {
                tokio::time::sleep(REFUSED_AGAIN).await;
                events = begin(&api, &config);
            }
            let event = events.next().await?;
            let is_refused = matches!(&event, Err(error @ Error::WatchStartFailed(_)) if is_refusal(error));
            Some((event, (events, is_refused)))
        }
    }))
}

fn begin<K: Watchable>(api: &Api<Item<K>>, config: &Config) -> Events<K> {
    Box::pin(watcher(api.clone(), config.clone()).default_backoff())
}

/// Shows what an error of a watch means in its probe.
pub(super) fn report(probe: &WatchProbe, error: &Error) {
    match error {
        // Both come from a watch that had been let in.
        Error::WatchError(_) | Error::WatchFailed(_) => probe.running(),
        _ if is_refusal(error) => probe.refused(),
        _ => probe.failed(),
    }
}

/// The server has forgotten where the watch was: usual after an outage.
pub(super) fn is_forgotten(error: &Error) -> bool {
    matches!(error, Error::WatchError(status) if status.code == 410)
}

/// The right to list or to watch is missing.
pub(super) fn is_refusal(error: &Error) -> bool {
    match error {
        Error::InitialListFailed(kube::Error::Api(status)) | Error::WatchStartFailed(kube::Error::Api(status)) => {
            status.code == 403
        }
        _ => false,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn the_end_of_one_stream_is_the_end_of_all() {
        let streams = vec![stream::pending().boxed(), stream::iter(["last"]).boxed()];
        let all = tokio::time::timeout(Duration::from_mins(1), numbered(streams).collect::<Vec<_>>());
        assert_eq!(all.await.expect("an end"), [(1, "last")]);
    }
}
