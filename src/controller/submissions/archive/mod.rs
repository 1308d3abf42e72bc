//! The controller's way to S3 and to the nodes' logs: one worker for each bucket, which does what reconciles ask for and wakes
//! the object with the answer. No reconcile waits for either.
//!
//! Four kinds of work: the report of a run, the texts of a result, the fence against a lost Pod, the log of a failure. Each has
//! limits of its own, so that a bucket which hangs keeps nothing else waiting. What is due when is `state`'s to say.

pub mod digest;
pub mod request;
mod run;
pub mod state;
mod work;

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use futures::stream::FuturesUnordered;
use futures::{FutureExt, StreamExt};
use kube::runtime::reflector::ObjectRef;
use kube::{Client, ResourceExt};
use tokio::sync::Notify;
use tokio::time::Instant;

use super::failure_log::{LogDemand, Tail};
use super::view::{ObservedFence, ObservedLog, ObservedTexts, ReportDemand};
use crate::controller::objects::{Wake, uid_of};
use crate::observability::tasks::Tasks;
use crate::services::archive::Archive;
use crate::services::aws::Aws;
use digest::ReportId;
use leaderboard_api::{Storage, Submission, SubmissionStatus, effective};
use request::{Target, Uid, Work};
use state::{SeenReport, State};

/// The workers of all buckets. Cheap to ask in each reconcile: nothing here waits.
pub struct ArchiveWorkers {
    shared: Arc<Shared>,
    buckets: Mutex<HashMap<String, Arc<Bucket>>>,
}

struct Shared {
    aws: Aws,
    client: Client,
    wake: Wake<Submission>,
    tasks: Tasks,
}

/// What one worker shares with those that ask it.
#[derive(Default)]
struct Bucket {
    state: Mutex<State>,
    notify: Notify,
}

impl Bucket {
    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// What tells a bucket from another one.
pub fn bucket_id(storage: &Storage) -> String {
    format!("{:?}/{:?}/{}", storage.region, storage.endpoint, storage.bucket)
}

/// What a run's worker knows of it.
pub struct Observed {
    pub report: SeenReport,
    pub texts: ObservedTexts,
    pub fence: ObservedFence,
    pub log: ObservedLog,
}

/// One run, as its worker is asked about it.
struct Run {
    bucket: Arc<Bucket>,
    uid: Uid,
    target: Arc<Target>,
}

impl ArchiveWorkers {
    /// `wake` gets each object that has something new to decide on.
    pub fn new(aws: Aws, client: Client, tasks: Tasks, wake: Wake<Submission>) -> Self {
        let shared = Shared {
            aws,
            client,
            wake,
            tasks,
        };
        Self {
            shared: Arc::new(shared),
            buckets: Mutex::default(),
        }
    }

    /// What is known of a run. Nothing, without a plan.
    pub fn observe(&self, submission: &Submission, pod: Option<&str>, is_over: bool) -> Observed {
        let now = Instant::now();
        let status = submission.status.as_ref();
        let (attempt, retry) = try_of(status);
        let found = status.and_then(|status| self.known_bucket(status));
        let uid = uid_of(submission);
        let nothing = State::default();
        let guard = found.as_ref().map(|bucket| bucket.state());
        let state = guard.as_deref().unwrap_or(&nothing);
        Observed {
            report: state.report(&uid, attempt, retry, pod, now),
            texts: state.texts(&uid),
            fence: state.fence(&uid, attempt, retry, now),
            log: state.log(&uid, attempt, retry, is_over, now),
        }
    }

    /// Notes which report is needed; None: none any more.
    pub fn demand(&self, submission: &Submission, status: &SubmissionStatus, demand: Option<ReportDemand>) {
        if demand.is_none() && self.known_bucket(status).is_none() {
            return;
        }
        let Some(run) = self.run(submission, status) else {
            return;
        };
        run.bucket.state().demand(&run.uid, &run.target, demand, Instant::now());
        run.bucket.notify.notify_one();
    }

    /// Asks for the texts of a report.
    pub fn want_texts(&self, submission: &Submission, status: &SubmissionStatus, of: ReportId) {
        let Some(run) = self.run(submission, status) else {
            return;
        };
        run.bucket.state().want_texts(&run.uid, &run.target, of, Instant::now());
        run.bucket.notify.notify_one();
    }

    /// Asks for our own mark in the place of a lost Pod's.
    pub fn want_fence(&self, submission: &Submission, status: &SubmissionStatus) {
        let Some(run) = self.run(submission, status) else {
            return;
        };
        let (attempt, retry) = try_of(Some(status));
        let since = status.times.stopping.as_ref().map_or(0, |t| t.0.as_second());
        let mark = format!("controller-{since}");
        let now = Instant::now();
        run.bucket
            .state()
            .want_fence(&run.uid, &run.target, (attempt, retry), mark, now);
        run.bucket.notify.notify_one();
    }

    /// Asks for the log that explains a failure.
    pub fn want_log(&self, submission: &Submission, status: &SubmissionStatus, demand: LogDemand) {
        let Some(run) = self.run(submission, status) else {
            return;
        };
        run.bucket
            .state()
            .want_log(&run.uid, &run.target, demand, Instant::now());
        run.bucket.notify.notify_one();
    }

    /// The log of the failure that a status describes.
    pub fn tail(&self, submission: &Submission, status: &SubmissionStatus) -> Option<Tail> {
        let (attempt, retry) = try_of(Some(status));
        let bucket = self.known_bucket(status)?;
        let state = bucket.state();
        state.tail(&uid_of(submission), attempt, retry)
    }

    /// Drops all that is known of an object.
    pub fn forget(&self, uid: &str) {
        for bucket in lock(&self.buckets).values() {
            bucket.state().forget(uid);
        }
    }

    fn known_bucket(&self, status: &SubmissionStatus) -> Option<Arc<Bucket>> {
        let plan = status.plan.as_ref()?;
        lock(&self.buckets).get(&bucket_id(&plan.storage)).cloned()
    }

    fn run(&self, submission: &Submission, status: &SubmissionStatus) -> Option<Run> {
        let plan = status.plan.as_ref()?;
        let target = Target {
            namespace: submission.namespace().unwrap_or_default(),
            name: submission.name_any(),
            storage: plan.storage.clone(),
            run_id: plan.run_id.clone(),
        };
        Some(Run {
            bucket: self.bucket(&plan.storage),
            uid: uid_of(submission).into(),
            target: Arc::new(target),
        })
    }

    fn bucket(&self, storage: &Storage) -> Arc<Bucket> {
        let mut buckets = lock(&self.buckets);
        let found = buckets.entry(bucket_id(storage)).or_insert_with(|| {
            let bucket = Arc::new(Bucket::default());
            let worker = ArchiveWorker {
                archive: Archive::of_run(&self.shared.aws, storage, ""),
                shared: Arc::clone(&self.shared),
                bucket: Arc::clone(&bucket),
            };
            let name = format!("archive {}", storage.bucket);
            self.shared.tasks.stay(name, worker.run());
            bucket
        });
        Arc::clone(found)
    }
}

fn try_of(status: Option<&SubmissionStatus>) -> (i64, i32) {
    status.map_or((1, 0), |status| (status.attempt.unwrap_or(1), status.retry))
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Does the work of one bucket until the stop.
struct ArchiveWorker {
    shared: Arc<Shared>,
    bucket: Arc<Bucket>,
    archive: Archive,
}

impl ArchiveWorker {
    async fn run(self) {
        let stop = self.shared.tasks.stop().clone();
        let mut under_way = FuturesUnordered::new();
        loop {
            while let Some(work) = self.next() {
                let target = Arc::clone(&work.target);
                let archive = self
                    .archive
                    .at_prefix(effective::key_prefix(&target.storage, &target.run_id));
                let client = &self.shared.client;
                let done = async move {
                    let done = work::carry_out(client, &archive, &work).await;
                    (work, done)
                };
                under_way.push(done.boxed());
            }
            let wake_at = self.bucket.state().wake_at();
            let due = async {
                match wake_at {
                    Some(at) => tokio::time::sleep_until(at).await,
                    None => std::future::pending().await,
                }
            };
            tokio::select! {
                () = stop.wait() => return,
                () = self.bucket.notify.notified() => {}
                Some((work, done)) = under_way.next() => {
                    let is_new = self.bucket.state().done(&work, done, Instant::now());
                    if is_new {
                        (self.shared.wake)(ObjectRef::new(&work.target.name).within(&work.target.namespace));
                    }
                }
                () = due => {}
            }
        }
    }

    fn next(&self) -> Option<Work> {
        self.bucket.state().next(Instant::now())
    }
}

#[cfg(test)]
#[path = "worker_tests.rs"]
mod tests;
