//! The controller's way to S3 and to the nodes' logs: one worker for each bucket, which does what reconciles ask for and wakes
//! the object with the answer. No reconcile waits for either.
//!
//! Three kinds of work: the report of a run, the fence against a lost Pod, the log of a failure. Each has
//! limits of its own, so that a bucket which hangs keeps nothing else waiting. What is due when is decided by `state`.

mod request;
mod run;
mod state;
mod work;

use std::sync::{Arc, Mutex};
use std::time::Duration;

use futures::stream::FuturesUnordered;
use futures::{FutureExt, StreamExt};
use jiff::Timestamp;
use kube::runtime::reflector::ObjectRef;
use kube::{Client, ResourceExt};
use tokio::sync::Notify;
use tokio::time::Instant;
use tracing::Instrument;

use super::failure_log::{LogDemand, Tail};
use super::view::{ObservedFence, ObservedLog, ReportDemand, ReportView};
use crate::controller::objects::{Wake, uid};
use crate::services::archive::Archive;
use crate::services::aws::Aws;
use leaderboard_api::{RunPlan, Storage, Submission, SubmissionStatus, effective};
use leaderboard_base::lock::lock;
use leaderboard_base::tasks::Tasks;
use request::{Done, Target, Uid, Work};
use state::State;

/// A worker whose bucket nobody uses ends after this long: the next submission of a quiet Leaderboard finds it ready.
const LINGERS: Duration = Duration::from_mins(1);

/// The workers of all buckets. Cheap to ask in each reconcile: nothing here waits.
pub struct ArchiveWorkers(Arc<Shared>);

struct Shared {
    aws: Aws,
    client: Client,
    wake: Wake<Submission>,
    tasks: Tasks,
    /// A worker ends under this lock, and is asked for more under it.
    buckets: Mutex<Vec<Arc<Bucket>>>,
}

/// What one worker shares with those that ask it.
struct Bucket {
    storage: Storage,
    state: Mutex<State>,
    notify: Notify,
}

impl Bucket {
    /// Two Leaderboards that keep their objects there differently have a worker each: what it stores for a run is kept as that run's
    /// Leaderboard says.
    fn is_of(&self, storage: &Storage) -> bool {
        let Storage {
            bucket,
            region,
            endpoint,
            kms_key_arn,
            storage_class,
            ..
        } = &self.storage;
        let place = (bucket, region, endpoint) == (&storage.bucket, &storage.region, &storage.endpoint);
        place && (kms_key_arn, storage_class) == (&storage.kms_key_arn, &storage.storage_class)
    }
}

/// What a run's worker remembers of it.
pub struct Observed {
    pub report: ReportView,
    pub fence: ObservedFence,
    pub log: ObservedLog,
}

impl ArchiveWorkers {
    /// `wake` gets each object that has something new to decide on.
    pub fn new(aws: Aws, client: Client, tasks: Tasks, wake: Wake<Submission>) -> Self {
        Self(Arc::new(Shared {
            aws,
            client,
            wake,
            tasks,
            buckets: Mutex::default(),
        }))
    }

    /// What is known of a run. Nothing, without a plan.
    pub fn observe(&self, submission: &Submission, pod: Option<&str>, is_over: bool) -> Observed {
        let now = Instant::now();
        let status = submission.status.as_ref();
        let job = status.map(SubmissionStatus::job_number).unwrap_or_default();
        let found = status.and_then(|status| self.known_bucket(status));
        let uid = uid(submission);
        let nothing = State::default();
        let guard = found.as_ref().map(|bucket| lock(&bucket.state));
        let state = guard.as_deref().unwrap_or(&nothing);
        Observed {
            report: state.report(uid, job, pod, now),
            fence: state.fence(uid, job, now),
            log: state.log(uid, job, is_over, now),
        }
    }

    /// Notes which report is needed of a run that `ended` then; None: none any more.
    pub fn demand(
        &self,
        submission: &Submission,
        status: &SubmissionStatus,
        ended: Option<Timestamp>,
        demand: Option<ReportDemand>,
    ) {
        if demand.is_some() || self.known_bucket(status).is_some() {
            self.ask(submission, status, ended, |state, uid, target, now| {
                state.demand(uid, target, demand, now);
            });
        }
    }

    /// Asks for our own mark in the place of a lost Pod's.
    pub fn want_fence(&self, submission: &Submission, status: &SubmissionStatus) {
        let since = status.times.stopping.as_ref().map_or(0, |t| t.0.as_second());
        let mark = format!("controller-{since}");
        self.ask(submission, status, None, |state, uid, target, now| {
            state.want_fence(uid, target, status.job_number(), mark, now);
        });
    }

    /// Asks for the log that explains a failure.
    pub fn want_log(&self, submission: &Submission, status: &SubmissionStatus, demand: LogDemand) {
        self.ask(submission, status, None, |state, uid, target, now| {
            state.want_log(uid, target, demand, now);
        });
    }

    /// The log of the failure that a status describes.
    pub fn tail(&self, submission: &Submission, status: &SubmissionStatus) -> Option<Tail> {
        let bucket = self.known_bucket(status)?;
        let state = lock(&bucket.state);
        state.tail(uid(submission), status.job_number())
    }

    /// Drops all that is known of an object.
    pub fn forget(&self, uid: &str) {
        for bucket in lock(&self.0.buckets).iter() {
            lock(&bucket.state).forget(uid);
            bucket.notify.notify_one();
        }
    }

    fn known_bucket(&self, status: &SubmissionStatus) -> Option<Arc<Bucket>> {
        let plan = status.plan.as_ref()?;
        let buckets = lock(&self.0.buckets);
        buckets.iter().find(|bucket| bucket.is_of(&plan.storage)).cloned()
    }

    /// Changes what the worker of a run's bucket has to do. Nothing, without a plan.
    fn ask(
        &self,
        submission: &Submission,
        status: &SubmissionStatus,
        ended: Option<Timestamp>,
        change: impl FnOnce(&mut State, &Uid, &Arc<Target>, Instant),
    ) {
        let Some(plan) = &status.plan else { return };
        let mut buckets = lock(&self.0.buckets);
        let known = buckets.iter().find(|bucket| bucket.is_of(&plan.storage)).cloned();
        let bucket = known.unwrap_or_else(|| {
            let bucket = ArchiveWorker::start(&self.0, &plan.storage);
            buckets.push(Arc::clone(&bucket));
            bucket
        });
        let now = Instant::now();
        let mut state = lock(&bucket.state);
        let is_same = |target: &Target| {
            target.attempt == submission.present_attempt() && target.ended.is_some() == ended.is_some()
        };
        let (uid, target) = state
            .known(uid(submission))
            .filter(|(_, target)| is_same(target))
            .unwrap_or_else(|| {
                let uid = Uid::from(uid(submission));
                let target = target(submission, &uid, plan, ended, now);
                (uid, Arc::new(target))
            });
        change(&mut state, &uid, &target, now);
        bucket.notify.notify_one();
    }
}

fn target(submission: &Submission, uid: &Uid, plan: &RunPlan, ended: Option<Timestamp>, now: Instant) -> Target {
    let age = ended.map(|at| Timestamp::now().duration_since(at));
    let age = age.map(|age| Duration::try_from(age).unwrap_or_default());
    Target {
        namespace: submission.namespace().unwrap_or_default().into(),
        name: submission.name_any().into(),
        leaderboard: submission.spec.leaderboard_name.as_str().into(),
        prefix: effective::key_prefix(&plan.storage, &plan.run_id).into(),
        submission_uid: match plan.submission_uid.as_deref() {
            Some(other) if *other != **uid => other.into(),
            _ => Arc::clone(uid),
        },
        attempt: submission.present_attempt(),
        ended: age.map(|age| now.checked_sub(age).unwrap_or(now)),
    }
}

/// Does the work of one bucket until the stop, or until nobody uses the bucket.
struct ArchiveWorker {
    shared: Arc<Shared>,
    bucket: Arc<Bucket>,
    archive: Archive,
}

impl ArchiveWorker {
    fn start(shared: &Arc<Shared>, storage: &Storage) -> Arc<Bucket> {
        let bucket = Arc::new(Bucket {
            storage: storage.clone(),
            state: Mutex::default(),
            notify: Notify::default(),
        });
        let worker = Self {
            archive: Archive::of_storage(&shared.aws, storage),
            shared: Arc::clone(shared),
            bucket: Arc::clone(&bucket),
        };
        let name = format!("archive {}", storage.bucket);
        shared.tasks.may_end(name, worker.run());
        bucket
    }

    async fn run(self) {
        let stop = self.shared.tasks.stop().clone();
        let mut under_way = FuturesUnordered::new();
        let mut idle_since = None;
        loop {
            while let Some(work) = lock(&self.bucket.state).next(Instant::now()) {
                under_way.push(self.done(work).boxed());
            }
            let is_idle = lock(&self.bucket.state).is_idle();
            idle_since = is_idle.then(|| idle_since.unwrap_or_else(Instant::now));
            let ends_at = idle_since.map(|since| since + LINGERS);
            if ends_at.is_some_and(|at| at <= Instant::now()) && self.leaves() {
                return;
            }
            let wake_at = lock(&self.bucket.state).wake_at().or(ends_at);
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
                    let is_new = lock(&self.bucket.state).done(&work, done, Instant::now());
                    if is_new {
                        (self.shared.wake)(ObjectRef::new(&work.target.name).within(&work.target.namespace));
                    }
                }
                () = due => {}
            }
        }
    }

    async fn done(&self, work: Work) -> (Work, Done) {
        let archive = self.archive.at_prefix(&*work.target.prefix);
        let done = work::carry_out(&self.shared.client, &archive, &work);
        let done = done.instrument(work.span()).await;
        (work, done)
    }

    /// Takes the bucket away, unless somebody has asked for something meanwhile.
    fn leaves(&self) -> bool {
        let mut buckets = lock(&self.shared.buckets);
        let is_idle = lock(&self.bucket.state).is_idle();
        if is_idle {
            buckets.retain(|bucket| !Arc::ptr_eq(bucket, &self.bucket));
        }
        is_idle
    }
}

#[cfg(test)]
#[path = "worker_tests.rs"]
mod tests;
