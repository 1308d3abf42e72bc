//! When this program has observed what, by name of the Submission. Both sides of a comparison are observed in the same way.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use futures::StreamExt;
use jiff::Timestamp;
use kube::Client;
use leaderboard_api::names;
use serde::Deserialize;
use tokio::sync::Notify;
use tokio::task::JoinHandle;
use tokio::time::timeout_at;

use crate::api::{self, Condition, Slim};

#[derive(Deserialize, Clone, Debug)]
#[serde(rename_all = "camelCase")]
pub struct JobStatus {
    #[serde(default)]
    conditions: Vec<Condition>,
}

#[derive(Deserialize, Clone, Debug)]
#[serde(rename_all = "camelCase")]
pub struct SubmissionStatus {
    reason: Option<String>,
    message: Option<String>,
    #[serde(default)]
    conditions: Vec<Condition>,
}

/// The moments.
#[derive(Default)]
pub struct Moments {
    /// UIDs of the Submissions.
    pub uids: HashMap<String, String>,
    pub created: HashMap<String, Instant>,
    pub jobs: HashMap<String, Instant>,
    pub complete: HashMap<String, Instant>,
    pub running: HashMap<String, Instant>,
    /// The last container's end is stored.
    pub ended: HashMap<String, (Instant, Timestamp)>,
    pub finished: HashMap<String, Instant>,
    /// Ends that are none of a good run, with their reason.
    pub failed: HashMap<String, String>,
    pub reasons: HashMap<String, (String, Instant)>,
}

/// The moments, shared by those who observe and who wait.
#[derive(Clone, Default)]
pub struct Observed {
    moments: Arc<Mutex<Moments>>,
    news: Arc<Notify>,
}

impl Observed {
    pub fn get(&self) -> MutexGuard<'_, Moments> {
        self.moments.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub fn note<T>(&self, change: impl FnOnce(&mut Moments) -> T) -> T {
        let done = change(&mut self.get());
        self.news.notify_waiters();
        done
    }

    /// Waits until something holds; false if it does not within the limit.
    pub async fn until(&self, limit: Duration, holds: impl Fn(&Moments) -> bool) -> bool {
        let end = tokio::time::Instant::now() + limit;
        loop {
            let news = self.news.notified();
            tokio::pin!(news);
            // Registered before the question, so that no news is missed.
            news.as_mut().enable();
            if holds(&self.get()) {
                return true;
            }
            if timeout_at(end, news).await.is_err() {
                return holds(&self.get());
            }
        }
    }

    /// Observes Jobs and Submissions.
    pub fn follow(&self, client: &Client) -> Vec<JoinHandle<()>> {
        let (jobs, submissions) = (self.clone(), self.clone());
        let (of_jobs, of_submissions) = (client.clone(), client.clone());
        vec![
            tokio::spawn(async move {
                endless(&of_jobs, "jobs", |job: Slim<JobStatus>| jobs.job(job)).await;
            }),
            tokio::spawn(async move {
                endless(&of_submissions, "submissions", |one: Slim<SubmissionStatus>| {
                    submissions.submission(one);
                })
                .await;
            }),
        ]
    }

    fn job(&self, job: Slim<JobStatus>) {
        let Some(name) = job.metadata.labels.get(names::LABEL_SUBMISSION).cloned() else {
            return;
        };
        let owner = job.metadata.owner_references.into_iter().next();
        let conditions = job.status.map(|status| status.conditions).unwrap_or_default();
        let is_complete = is_true(&conditions, "Complete");
        self.note(|moments| {
            let now = Instant::now();
            moments.jobs.entry(name.clone()).or_insert(now);
            if let Some(owner) = owner {
                moments.uids.entry(name.clone()).or_insert(owner.uid);
            }
            if is_complete {
                moments.complete.entry(name).or_insert(now);
            }
        });
    }

    fn submission(&self, submission: Slim<SubmissionStatus>) {
        let name = submission.metadata.name;
        let status = submission.status;
        self.note(|moments| {
            let now = Instant::now();
            moments.uids.entry(name.clone()).or_insert(submission.metadata.uid);
            let Some(status) = status else { return };
            let reason = status.reason.unwrap_or_default();
            if is_true(&status.conditions, "Running") {
                moments.running.entry(name.clone()).or_insert(now);
            }
            let known = moments.reasons.get(&name).is_some_and(|(known, _)| *known == reason);
            if !known && !reason.is_empty() {
                moments.reasons.insert(name.clone(), (reason.clone(), now));
            }
            if is_true(&status.conditions, "Finished") {
                if !reason.is_empty() {
                    let why = format!("{reason}: {}", status.message.unwrap_or_default());
                    moments.failed.insert(name.clone(), why);
                }
                moments.finished.entry(name).or_insert(now);
            }
        });
    }
}

fn is_true(conditions: &[Condition], kind: &str) -> bool {
    conditions
        .iter()
        .any(|condition| condition.kind == kind && condition.status == "True")
}

/// Hands every change of a kind on, and begins again whenever the watch ends.
pub async fn endless<S>(client: &Client, kind: &str, mut take: impl FnMut(Slim<S>))
where
    S: Clone + serde::de::DeserializeOwned + Send + 'static,
{
    loop {
        if let Ok(changes) = api::watch::<S>(client, kind).await {
            let mut changes = std::pin::pin!(changes);
            while let Some(object) = changes.next().await {
                take(object);
            }
        }
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
}
