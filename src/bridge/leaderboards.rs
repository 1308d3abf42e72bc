//! The Leaderboards as the bridge needs them: from the watch's cache, or read anew.

use std::sync::Arc;

use kube::Client;
use kube::api::ListParams;

use crate::kubernetes::{Watch, guarded};
use leaderboard_api::Leaderboard;

/// The Leaderboards at one moment.
#[derive(Clone, Debug)]
pub struct Leaderboards {
    /// Those that can be read.
    pub all: Vec<Arc<Leaderboard>>,
    /// True if none can be missing. One that this program can't read might serve any phase.
    pub is_complete: bool,
}

impl Leaderboards {
    /// As the watch last observed them.
    pub fn cached(watch: &Watch<Leaderboard>) -> Self {
        // Asked first: what is complete now has all that is read below.
        let is_complete = watch.is_complete();
        Self {
            all: watch.store.state(),
            is_complete,
        }
    }

    /// Lists them without any cache.
    pub async fn read(client: Client, namespace: Option<&str>) -> kube::Result<Self> {
        let list = guarded::<Leaderboard>(client, namespace)
            .list(&ListParams::default())
            .await?;
        let count = list.items.len();
        let readable = list.items.into_iter().filter_map(|item| item.object.ok());
        let all: Vec<_> = readable.map(Arc::new).collect();
        Ok(Self {
            is_complete: all.len() == count,
            all,
        })
    }
}
