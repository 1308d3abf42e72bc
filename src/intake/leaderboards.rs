//! The Leaderboards as the readers of queues need them: from the watch's cache, or read anew.

use std::sync::Arc;

use kube::Client;
use kube::api::ListParams;

use crate::kubernetes::{Namespaces, Watch};
use leaderboard_api::Leaderboard;
use leaderboard_policy::allowed::Allowed;

/// The Leaderboards that are served, and the queues that they may name.
#[derive(Clone, Debug)]
pub struct Scope {
    pub namespaces: Namespaces,
    pub allowed: Allowed,
}

/// The Leaderboards at one moment.
#[derive(Clone, Debug)]
pub struct Leaderboards {
    /// The Leaderboards that can be read.
    pub all: Vec<Arc<Leaderboard>>,
    /// True if none can be missing. One that this program can't read might serve any phase.
    pub is_complete: bool,
}

impl Leaderboards {
    /// As the watch last observed them.
    pub fn cached(watch: &Watch<Leaderboard>, allowed: &Allowed) -> Self {
        // Asked first: what is complete now has all that is read below.
        let is_complete = watch.is_complete();
        Self {
            all: served(watch.store.state(), allowed),
            is_complete,
        }
    }

    /// Lists them without any cache.
    pub async fn read(client: &Client, scope: &Scope) -> kube::Result<Self> {
        let (mut count, mut all) = (0, Vec::new());
        for api in scope.namespaces.apis::<Leaderboard>(client) {
            let list = api.list(&ListParams::default()).await?;
            count += list.items.len();
            let readable = list.items.into_iter().filter_map(|item| item.object.ok());
            all.extend(readable.map(Arc::new));
        }
        Ok(Self {
            is_complete: all.len() == count,
            all: served(all, &scope.allowed),
        })
    }
}

/// Drops each Leaderboard that names a place it may not: it has no queue, and no say in the end of another's messages.
fn served(all: Vec<Arc<Leaderboard>>, allowed: &Allowed) -> Vec<Arc<Leaderboard>> {
    let is_allowed = |leaderboard: &Arc<Leaderboard>| allowed.refusal(leaderboard).is_none();
    all.into_iter().filter(is_allowed).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use leaderboard_policy::intake::fixtures::{board, with_queue};

    #[test]
    fn a_queue_that_a_leaderboard_may_not_name_is_not_read() {
        let all = || {
            vec![
                with_queue(board("a", 1), "https://q/ours"),
                with_queue(board("b", 2), "https://q/theirs"),
            ]
        };
        let urls = |allowed: &str| -> Vec<String> {
            let served = served(all(), &allowed.parse().unwrap());
            let queues = served.iter().filter_map(|leaderboard| leaderboard.spec.sqs());
            queues.map(|queue| queue.url.clone()).collect()
        };
        assert_eq!(urls(""), ["https://q/ours", "https://q/theirs"]);
        let ours = r#"{"*": {"queues": ["ours"], "buckets": ["*"]}}"#;
        assert_eq!(urls(ours), ["https://q/ours"]);
        assert_eq!(urls("{}"), Vec::<String>::new());
    }
}
