//! Parts of the API server's client that controller and bridge share: watches with their caches, and the checks before the start.
//!
//! Imports the API types and `observability`; knows no policy, and no module that uses it.

mod call;
mod feed;
mod item;
mod namespaces;
pub mod objects;
pub mod preflight;
mod recorder;
mod source;
mod store;
mod uncached;
mod watch;
mod write;

#[cfg(test)]
mod tests;

use std::time::Duration;

use kube::core::NamespaceResourceScope;
use kube::{Api, Client};

pub use call::{CallError, call, call_within};
pub use feed::{WatchEvent, WatchEvents};
pub use item::{Item, Malformed, Watchable};
pub use namespaces::Namespaces;
pub use recorder::recorder;
pub use store::{Index, Store};
pub use uncached::spawn_uncached;
pub use watch::{Synced, Watch, spawn_watch};
pub use write::{Writer, Writes, Written};

/// Longer than a watch may be silent: the server ends each after 290 s.
const READ_TIMEOUT: Duration = Duration::from_mins(5);

/// One client for calls, one whose dead connections end for watches.
#[derive(Clone)]
pub struct Clients {
    pub api: Client,
    pub watch: Client,
}

impl Clients {
    /// Both for one API server.
    ///
    /// # Errors
    /// If the configuration holds no usable TLS or credentials.
    pub fn new(config: kube::Config) -> Result<Self, kube::Error> {
        Ok(Self {
            api: Client::try_from(config.clone())?,
            watch: watch_client(config)?,
        })
    }
}

/// A client for watches: a list or a watch on a dead connection ends within minutes.
///
/// # Errors
/// If the configuration holds no usable TLS or credentials.
pub fn watch_client(config: kube::Config) -> Result<Client, kube::Error> {
    client_with(config, READ_TIMEOUT)
}

fn client_with(mut config: kube::Config, read_timeout: Duration) -> Result<Client, kube::Error> {
    config.read_timeout = Some(read_timeout);
    Client::try_from(config)
}

/// The API of a kind, in one namespace or in all. A malformed object is an item of its own kind, and fails no list.
pub fn guarded<K>(client: Client, namespace: Option<&str>) -> Api<Item<K>>
where
    K: Watchable<Scope = NamespaceResourceScope>,
{
    match namespace {
        Some(namespace) => Api::namespaced(client, namespace),
        None => Api::all(client),
    }
}
