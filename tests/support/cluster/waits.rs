//! How a scene waits for what happens in it: it watches, and reports at a limit what it saw last.

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::pin::pin;
use std::time::Duration;

use futures::TryStreamExt as _;
use k8s_openapi::NamespaceResourceScope;
use k8s_openapi::api::core::v1::Pod;
use kube::runtime::WatchStreamExt as _;
use kube::runtime::wait::await_condition;
use kube::runtime::watcher::{self, Event, watcher};
use kube::{Resource, ResourceExt};
use leaderboard_api::{Leaderboard, State, Submission, conditions};
use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::json;
use tokio::time::{sleep, timeout};

use super::{Scene, is_settled, state};

/// Between a watch that failed and the next: the API server may be away, and needs the processor to come back.
const ANEW: Duration = Duration::from_millis(200);
/// How long a Pod may take to be made or replaced.
const POD: Duration = Duration::from_mins(5);
/// Characters of an object that a failed wait shows.
const SHOWN: usize = 800;

impl Scene {
    /// Waits until a Leaderboard is ready: EvalAI has been asked for phases and labels.
    pub async fn ready(&self, name: &str) {
        let ready = |found: Option<&Leaderboard>| {
            let status = found.and_then(|board| board.status.as_ref());
            status.is_some_and(|status| conditions::is_true(&status.conditions, conditions::READY))
        };
        self.wait(name, "it is ready", Duration::from_mins(3), ready).await;
    }

    /// Waits until `condition` holds for an object; it is handed back unless it is gone.
    pub async fn wait<K>(
        &self,
        name: &str,
        what: &str,
        limit: Duration,
        condition: impl Fn(Option<&K>) -> bool,
    ) -> Option<K>
    where
        K: Resource<Scope = NamespaceResourceScope>
            + Clone
            + std::fmt::Debug
            + Serialize
            + DeserializeOwned
            + Send
            + 'static,
        K::DynamicType: Default,
    {
        let last = RefCell::new(None);
        let holds = |found: Option<&K>| {
            *last.borrow_mut() = found.cloned();
            condition(found)
        };
        let reached = async {
            loop {
                match await_condition(self.api::<K>(), name, &holds).await {
                    Ok(found) => return found,
                    // A watch may expire, and begins anew.
                    Err(error) => println!("{name}: {what}: {error}"),
                }
                sleep(ANEW).await;
            }
        };
        let reached = timeout(limit, Box::pin(reached)).await;
        reached.unwrap_or_else(|_| {
            let last = last.borrow().as_ref().map_or_else(|| "nothing".to_owned(), brief);
            panic!(
                "{name}: not after {} s: {what}; last seen: {last}{}",
                limit.as_secs(),
                self.ended_programs()
            )
        })
    }

    /// Waits until `condition` holds for a Submission.
    pub async fn submission(
        &self,
        name: &str,
        what: &str,
        limit: Duration,
        condition: impl Fn(&Submission) -> bool + 'static,
    ) -> Submission {
        let holds = move |found: Option<&Submission>| found.is_some_and(&condition);
        self.wait(name, what, limit, holds).await.unwrap()
    }

    /// Waits until a Submission's agents run.
    pub async fn running(&self, name: &str, limit: Duration) -> Submission {
        let runs = |s: &Submission| matches!(state(s), Some(State::Running | State::Resumed));
        self.submission(name, "its agents run", limit, runs).await
    }

    /// Waits until a Submission has come to its end, in Kubernetes, EvalAI and DynamoDB.
    pub async fn settled(&self, name: &str, limit: Duration) -> Submission {
        self.submission(name, "it has ended and every system knows", limit, is_settled)
            .await
    }

    /// The only Pod of a Submission that is not ending. Between the end of one and the next there is none for a moment.
    pub async fn pod(&self, submission: &str) -> Pod {
        self.only_pod(&format!("leaderboard.carla.org/submission={submission}"), POD)
            .await
    }

    /// The only Pod of a Submission's first Job that is not ending.
    pub async fn first_pod(&self, submission: &str, limit: Duration) -> Pod {
        self.only_pod(&format!("batch.kubernetes.io/job-name={submission}-1"), limit)
            .await
    }

    async fn only_pod(&self, selector: &str, limit: Duration) -> Pod {
        let mut pods = BTreeMap::new();
        let found = async {
            let config = watcher::Config::default().labels(selector);
            let mut events = pin!(watcher(self.api::<Pod>(), config).default_backoff());
            let mut is_whole = false;
            loop {
                match events.try_next().await {
                    Ok(Some(Event::Init)) => {
                        pods.clear();
                        is_whole = false;
                    }
                    Ok(Some(Event::InitApply(pod) | Event::Apply(pod))) => _ = pods.insert(pod.name_any(), pod),
                    Ok(Some(Event::Delete(pod))) => _ = pods.remove(&pod.name_any()),
                    Ok(Some(Event::InitDone) | None) => is_whole = true,
                    Err(error) => println!("{selector}: {error}"),
                }
                let live: Vec<&Pod> = pods.values().filter(|pod| !is_ending(pod)).collect();
                if let ([pod], true) = (live.as_slice(), is_whole) {
                    return (*pod).clone();
                }
            }
        };
        let found = timeout(limit, Box::pin(found)).await;
        found.unwrap_or_else(|_| {
            let pods: Vec<_> = pods.values().map(brief).collect();
            panic!(
                "{selector}: not after {} s: there is one Pod that is not ending; last seen: {pods:?}{}",
                limit.as_secs(),
                self.ended_programs()
            )
        })
    }
}

fn is_ending(pod: &Pod) -> bool {
    pod.metadata.deletion_timestamp.is_some()
}

/// An object in brief, for a person who asks why it is not as expected.
fn brief(object: &impl Serialize) -> String {
    let object = json!(object);
    let status = &object["status"];
    let text = |field: &str| status[field].as_str().unwrap_or_default();
    let brief = if status["state"].is_string() {
        format!("{} {}: {}", text("state"), text("reason"), text("message"))
    } else {
        format!("{} {status}", object["metadata"]["name"])
    };
    brief.chars().take(SHOWN).collect()
}
