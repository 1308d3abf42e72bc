//! The page: a read-only view of standings, runs, queue and failures, for people who look at it in a browser.
//!
//! Started by the controller's `runtime` with `--dashboard`. It reads the controller's caches and grants nothing: it sends no request to
//! the API server, knows no credential and writes nothing. `model` (pure) makes of the cached objects what is shown, `detail` what is
//! shown of one submission. `hub` hands it to the viewers, `routes` are the few files and the stream of events, `connections` bounds what one of them can hold.
//!
//! It listens on 127.0.0.1 of its Pod alone, where no other Pod can reach it. A person comes in by `kubectl leaderboard dashboard`, a
//! port-forward, which the API server authenticates and authorizes (`pods/portforward`).

mod connections;
mod detail;
mod hub;
mod links;
mod model;
mod phases;
mod routes;
mod rows;
mod standings;

#[cfg(test)]
mod samples_tests;

use std::net::{Ipv4Addr, SocketAddr};
use std::sync::Arc;

use futures::StreamExt;
use futures::stream::{self, BoxStream};
use kube::runtime::reflector::ObjectRef;
use tokio::net::TcpListener;

use crate::kubernetes::Watch;
use crate::observability::Observability;
use connections::Bounded;
use detail::Detail;
use hub::{Hub, Source};
use leaderboard_api::{Leaderboard, Submission};
use leaderboard_base::clock::Clock;
use model::{PageView, Replica};

/// Why there is no page.
#[derive(Debug, thiserror::Error)]
pub enum PageError {
    #[error("can't listen on {address} for the page: {source}; choose another port with --dashboard=PORT")]
    Bind {
        address: SocketAddr,
        source: std::io::Error,
    },
}

/// The page before anybody can look at it.
#[derive(Debug)]
pub struct Page {
    listener: TcpListener,
    address: SocketAddr,
    name: String,
    title: String,
}

/// The sources that the page reads.
pub struct Reads {
    pub leaderboards: Watch<Leaderboard>,
    pub submissions: Watch<Submission>,
    /// Returns true while this replica leads.
    pub leads: Box<dyn Fn() -> bool + Send + Sync>,
}

impl Page {
    /// Listens on loopback; port 0 takes a free one. `name` is the replica's.
    ///
    /// # Errors
    /// If the port is taken.
    pub async fn bind(port: u16, name: &str) -> Result<Self, PageError> {
        let address = SocketAddr::from((Ipv4Addr::LOCALHOST, port));
        let failed = |source| PageError::Bind { address, source };
        let listener = TcpListener::bind(address).await.map_err(failed)?;
        let address = listener.local_addr().map_err(failed)?;
        Ok(Self {
            listener,
            address,
            name: name.to_owned(),
            title: String::new(),
        })
    }

    /// Sets the page's title, such as the name of its cluster.
    #[must_use]
    pub fn titled(mut self, title: &str) -> Self {
        title.clone_into(&mut self.title);
        self
    }

    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Serves it until the stop.
    pub fn start(self, reads: Reads, telemetry: &Observability) {
        let (name, title) = (self.name, self.title);
        let source: Arc<dyn Source> = Arc::new(Caches {
            reads,
            name,
            title,
            clock: telemetry.clock.clone(),
        });
        let hub = Hub::new();
        let work = hub.clone().run(Arc::clone(&source));
        telemetry.tasks.until_stop("page's view", work);
        let router = routes::router(hub, source, telemetry.stop.clone());
        let stop = telemetry.stop.clone();
        let listener = Bounded::new(self.listener);
        telemetry.tasks.stay("page", async move {
            let served = axum::serve(listener, router).with_graceful_shutdown(async move { stop.wait().await });
            // It ends by the stop and by no error: one that can't accept a connection waits and continues.
            let _ = served.await;
        });
        tracing::info!(address = %self.address, "serving the page");
    }
}

/// The caches as the hub's source.
struct Caches {
    reads: Reads,
    name: String,
    title: String,
    clock: Clock,
}

impl Source for Caches {
    fn changes(&self) -> BoxStream<'static, ()> {
        let boards = self.reads.leaderboards.subscribe().map(|_| ());
        let submissions = self.reads.submissions.subscribe().map(|_| ());
        stream::select(boards, submissions).boxed()
    }

    fn view(&self) -> Vec<u8> {
        let (boards, submissions) = (&self.reads.leaderboards, &self.reads.submissions);
        let replica = Replica {
            name: &self.name,
            title: &self.title,
            leads: (self.reads.leads)(),
            is_complete: boards.is_complete() && submissions.is_complete(),
        };
        let (leaderboards, submissions) = (boards.store.state(), submissions.store.state());
        let view = PageView::of(replica, &leaderboards, &submissions, self.clock.now());
        // Names as keys and plain values: serde_json has no error for them.
        serde_json::to_vec(&view).unwrap_or_default()
    }

    fn detail(&self, namespace: &str, name: &str) -> Option<Vec<u8>> {
        let submission = self
            .reads
            .submissions
            .store
            .get(&ObjectRef::new(name).within(namespace))?;
        let board = ObjectRef::new(&submission.spec.leaderboard_name).within(namespace);
        let board = self.reads.leaderboards.store.get(&board);
        let evalai = board.as_ref().and_then(|board| board.spec.evalai.as_ref());
        serde_json::to_vec(&Detail::of(&submission, evalai)).ok()
    }
}
