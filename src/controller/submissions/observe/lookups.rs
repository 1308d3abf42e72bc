//! How a node is, where nodes are not watched: asked of the API server now and then, by a task of its own, once for all who want to
//! know; an answer that differs wakes them. No reconcile waits for it.

use std::collections::HashMap;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use futures::stream::FuturesUnordered;
use futures::{FutureExt, StreamExt};
use kube::Client;
use kube::runtime::reflector::ObjectRef;
use tokio::sync::Notify;
use tokio::time::Instant;

use super::node;
use crate::controller::objects::Wake;
use crate::controller::submissions::view::NodeView;
use leaderboard_api::Submission;
use leaderboard_base::lock::lock;
use leaderboard_base::tasks::Tasks;

/// How many questions are under way at once.
const AT_ONCE: usize = 4;
/// Who has not asked again for so long does not want to know any more: a live run is reconciled more often.
const FORGOTTEN: Duration = Duration::from_mins(6);
/// How long an answer is passed on.
const FRESH: Duration = Duration::from_mins(1);
/// How often it is checked which questions are due.
const TICK: Duration = Duration::from_secs(1);

#[derive(Default)]
struct Entry {
    answer: Option<NodeView>,
    asked: Option<Instant>,
    is_under_way: bool,
    /// Who wants to know, and when they asked last.
    wanted_by: HashMap<ObjectRef<Submission>, Instant>,
}

#[derive(Default)]
struct Shared {
    /// By the name of the node.
    entries: Mutex<HashMap<String, Entry>>,
    notify: Notify,
}

/// What was asked, and what came of it.
#[derive(Clone)]
pub struct Lookups(Arc<Shared>);

impl Lookups {
    /// Starts the task that asks.
    pub fn start(client: Client, tasks: &Tasks, wake: Wake<Submission>) -> Self {
        let shared = Arc::new(Shared::default());
        tasks.until_stop("lookups", ask(client, Arc::clone(&shared), wake));
        Self(shared)
    }

    /// Asks for a node, and goes on asking for as long as this is called again.
    pub fn want(&self, submission: &Submission, node: &str) {
        self.0.want(node, ObjectRef::from_obj(submission));
    }

    /// How a node is, as far as it was read.
    pub fn node(&self, name: &str) -> NodeView {
        self.0.answer(name).unwrap_or_default()
    }
}

impl Shared {
    fn answer(&self, node: &str) -> Option<NodeView> {
        lock(&self.entries).get(node)?.answer.clone()
    }

    fn want(&self, node: &str, by: ObjectRef<Submission>) {
        let mut entries = lock(&self.entries);
        let entry = entries.entry(node.to_owned()).or_default();
        entry.wanted_by.insert(by, Instant::now());
        if entry.asked.is_none() {
            self.notify.notify_one();
        }
    }

    /// The next node that is due.
    fn next(&self, now: Instant) -> Option<String> {
        let mut entries = lock(&self.entries);
        entries.retain(|_, entry| {
            entry
                .wanted_by
                .retain(|_, at| now.saturating_duration_since(*at) < FORGOTTEN);
            entry.is_under_way || !entry.wanted_by.is_empty()
        });
        let is_due = |entry: &Entry| {
            let is_fresh = entry.asked.is_some_and(|at| now.saturating_duration_since(at) < FRESH);
            !entry.is_under_way && !is_fresh
        };
        let (node, entry) = entries.iter_mut().find(|(_, entry)| is_due(entry))?;
        entry.is_under_way = true;
        entry.asked = Some(now);
        Some(node.clone())
    }

    /// Takes an answer in. Returns whom it is new to.
    fn done(&self, node: &str, answer: NodeView) -> Vec<ObjectRef<Submission>> {
        let mut entries = lock(&self.entries);
        let Some(entry) = entries.get_mut(node) else {
            return Vec::new();
        };
        entry.is_under_way = false;
        let is_nothing = answer == NodeView::default() || answer == node::healthy();
        let is_new = match &entry.answer {
            Some(known) => *known != answer,
            None => !is_nothing,
        };
        entry.answer = Some(answer);
        if is_new {
            entry.wanted_by.keys().cloned().collect()
        } else {
            Vec::new()
        }
    }
}

async fn ask(client: Client, shared: Arc<Shared>, wake: Wake<Submission>) {
    let mut under_way = FuturesUnordered::new();
    let mut tick = tokio::time::interval(TICK);
    loop {
        while under_way.len() < AT_ONCE
            && let Some(name) = shared.next(Instant::now())
        {
            let client = client.clone();
            let asking = async move {
                let answer = node::read(&client, &name).await;
                (name, answer)
            };
            under_way.push(asking.boxed());
        }
        tokio::select! {
            Some((name, answer)) = under_way.next() => shared.done(&name, answer).into_iter().for_each(&wake),
            _ = tick.tick() => {}
            () = shared.notify.notified() => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::controller::submissions::view::ObservedNode;

    fn by(name: &str) -> ObjectRef<Submission> {
        ObjectRef::new(name).within("one")
    }

    fn gone() -> NodeView {
        NodeView {
            state: ObservedNode::Gone,
            ..NodeView::default()
        }
    }

    #[tokio::test(start_paused = true)]
    async fn a_node_is_asked_for_once_for_all_and_again_when_its_answer_is_old() {
        let shared = Shared::default();
        shared.want("a", by("1"));
        shared.want("a", by("2"));
        assert_eq!(shared.answer("a"), None);
        assert_eq!(shared.next(Instant::now()).as_deref(), Some("a"));
        assert_eq!(shared.next(Instant::now()), None, "it is under way");
        assert!(shared.done("a", node::healthy()).is_empty(), "nothing to decide on");
        tokio::time::advance(Duration::from_secs(59)).await;
        assert_eq!(shared.next(Instant::now()), None);
        tokio::time::advance(Duration::from_secs(1)).await;
        assert_eq!(shared.next(Instant::now()).as_deref(), Some("a"));
        let mut woken = shared.done("a", gone());
        woken.sort_by(|one, other| one.name.cmp(&other.name));
        assert_eq!(woken, [by("1"), by("2")]);
        assert_eq!(shared.answer("a"), Some(gone()));
    }

    #[tokio::test(start_paused = true)]
    async fn who_does_not_ask_again_is_forgotten_with_the_answer() {
        let shared = Shared::default();
        shared.want("a", by("1"));
        shared.next(Instant::now());
        assert_eq!(shared.done("a", gone()), [by("1")]);
        tokio::time::advance(FORGOTTEN).await;
        assert_eq!(shared.next(Instant::now()), None);
        assert!(lock(&shared.entries).is_empty());
    }
}
