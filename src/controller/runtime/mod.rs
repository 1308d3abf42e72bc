//! Wires the controller: watches, lease, services, reconciles. Called by the command line; decides nothing.
//!
//! Standbys keep warm caches and are ready. A process that has led and no longer does ends with an error, and so does one
//! that has lost one of its tasks: the kubelet starts it again with empty hands.

pub mod backoff;
pub mod context;
mod counts;
mod events;
pub mod leader;
mod needs;
mod reconciles;
mod sweep;

use std::sync::Arc;
use std::time::Duration;

use k8s_openapi::api::batch::v1::Job;
use k8s_openapi::api::core::v1::{Container, Pod, PodTemplateSpec};
use k8s_openapi::api::networking::v1::NetworkPolicy;
use kube::runtime::events::{Recorder as EventRecorder, Reporter};
use kube::runtime::reflector::{ObjectRef, Store};
use kube::runtime::watcher::Config;
use kube::{Client, Resource};
use tokio::sync::mpsc;
use tokio::task::JoinHandle;
use tokio::time::Instant;

use super::leaderboards::isolation;
use super::leaderboards::state::LeaderboardState;
use super::objects::{Wake, children_selector};
use super::settings::Settings;
use super::stores::Stores;
use crate::controller::submissions::archive::ArchiveWorkers;
use crate::controller::submissions::external::ExternalSystems;
use crate::controller::submissions::memory::Memory;
use crate::controller::submissions::observe::lookups::Lookups;
use crate::controller::submissions::reruns::Reruns;
use crate::kubernetes::preflight::{self, await_kinds, watch_access};
use crate::kubernetes::{Watch, guarded, spawn_watch};
use crate::observability::Observability;
use crate::observability::tasks::TaskFailed;
use crate::services::ObjectKey;
use crate::services::aws::Aws;
use crate::services::evalai::{Changed, Hub, Options, SweepRow, Timeouts, Timing};
use crate::services::meter::Meter;
use crate::services::table::Recorder;
use backoff::BackoffMap;
use context::Context;
use leader::{Leader, Leadership};
use leaderboard_api::{Leaderboard, Submission};

/// Reconciles under way may take this long to end after a stop.
const DRAIN: Duration = Duration::from_secs(20);

/// The cache of policies is waited for so long at the start: without a right to them nothing starts, but runs are watched.
const POLICIES_LIMIT: Duration = Duration::from_secs(5);

/// Why the controller ended.
#[derive(thiserror::Error, Debug)]
pub enum RunError {
    #[error("this process no longer leads: {0}")]
    LostLease(String),
    #[error(transparent)]
    TaskFailed(#[from] TaskFailed),
}

/// What all reconciles share.
pub(super) struct Shared {
    context: Arc<Context>,
    backoff: BackoffMap,
    telemetry: Observability,
}

impl Shared {
    /// Drops everything that is remembered of an object that is gone.
    fn forget(&self, key: &ObjectKey) {
        self.context.forget(key);
        self.backoff.dropped(&key.uid);
    }
}

/// Runs until the stop, or until it no longer leads.
pub async fn run(
    clients: Clients,
    lease: leader::Settings,
    settings: Settings,
    aws: Aws,
    telemetry: Observability,
) -> Result<(), RunError> {
    preflight::register(&telemetry);
    let tasks = telemetry.tasks.clone();
    let work = Box::pin(work(clients, lease, settings, aws, telemetry));
    tokio::select! {
        biased;
        failed = tasks.failed() => Err(failed.into()),
        result = work => result,
    }
}

async fn work(
    clients: Clients,
    lease: leader::Settings,
    settings: Settings,
    aws: Aws,
    telemetry: Observability,
) -> Result<(), RunError> {
    let client = &clients.api;
    if !await_kinds(client, &["leaderboards", "submissions"], &telemetry).await {
        return Ok(());
    }
    let rights = watch_rights(
        client.clone(),
        settings.namespace.clone(),
        lease.clone(),
        telemetry.clone(),
    );
    telemetry.tasks.may_end("permissions", rights);
    let watches = Watches::start(&clients.watch, settings.namespace.as_deref(), &telemetry);
    telemetry.readiness.registered();
    let leader = leader::start(clients.lease, lease, &telemetry);
    let parts = Parts {
        client: clients.api,
        settings,
        aws: aws.counted_by(Meter::for_metrics(&telemetry.metrics)),
        watches,
        telemetry,
    };
    let result = parts.lead(&leader).await;
    if result.is_ok()
        && let Err(error) = leader.release().await
    {
        tracing::warn!("{error}");
    }
    result
}

async fn watch_rights(client: Client, namespace: Option<String>, lease: leader::Settings, telemetry: Observability) {
    let needs = needs::needs(namespace.as_deref(), &lease);
    watch_access(client, &needs, &telemetry).await;
}

/// One client for calls, one whose dead connections end for watches, one without retries for the lease.
pub struct Clients {
    pub api: Client,
    pub watch: Client,
    pub lease: Client,
}

struct Watches {
    leaderboards: Watch<Leaderboard>,
    submissions: Watch<Submission>,
    jobs: Watch<Job>,
    pods: Watch<Pod>,
    policies: Watch<NetworkPolicy>,
}

impl Watches {
    fn start(client: &Client, namespace: Option<&str>, telemetry: &Observability) -> Self {
        let children = || Config::default().labels(&children_selector());
        Self {
            leaderboards: spawn_watch(guarded(client.clone(), namespace), Config::default(), |_| {}, telemetry),
            submissions: spawn_watch(guarded(client.clone(), namespace), Config::default(), |_| {}, telemetry),
            jobs: spawn_watch(guarded(client.clone(), namespace), children(), trim_job, telemetry),
            pods: spawn_watch(guarded(client.clone(), namespace), children(), trim_pod, telemetry),
            policies: spawn_watch(guarded(client.clone(), namespace), children(), |_| {}, telemetry),
        }
    }

    fn stores(&self) -> Stores {
        Stores {
            leaderboards: self.leaderboards.store.clone(),
            submissions: self.submissions.store.clone(),
            jobs: self.jobs.store.clone(),
            pods: self.pods.store.clone(),
            policies: self.policies.store.clone(),
            policies_synced: self.policies.synced.clone(),
        }
    }

    async fn synced(&self) {
        // An error means that the watch's task is gone, which ends the process.
        let _ = self.leaderboards.store.wait_until_ready().await;
        let _ = self.submissions.store.wait_until_ready().await;
        let _ = self.jobs.store.wait_until_ready().await;
        let _ = self.pods.store.wait_until_ready().await;
        let _ = tokio::time::timeout(POLICIES_LIMIT, self.policies.store.wait_until_ready()).await;
    }
}

/// Of a Job, decisions read metadata and status.
fn trim_job(job: &mut Job) {
    if let Some(spec) = &mut job.spec {
        spec.template = PodTemplateSpec::default();
    }
}

/// Of a Pod, decisions read metadata, its node, the names of its containers and status.
pub(super) fn trim_pod(pod: &mut Pod) {
    if let Some(spec) = &mut pod.spec {
        for container in &mut spec.containers {
            *container = Container {
                name: std::mem::take(&mut container.name),
                ..Container::default()
            };
        }
        spec.init_containers = None;
        spec.volumes = None;
    }
}

/// What one process is made of.
struct Parts {
    client: Client,
    settings: Settings,
    aws: Aws,
    watches: Watches,
    telemetry: Observability,
}

impl Parts {
    async fn lead(self, leader: &Leader) -> Result<(), RunError> {
        if !await_lead(leader, &self.telemetry).await? {
            return Ok(());
        }
        tokio::select! { () = self.watches.synced() => {}, () = self.telemetry.stop.wait() => return Ok(()) }
        let (boards, woken_boards) = mpsc::unbounded_channel();
        let (rows, changed_rows) = mpsc::unbounded_channel();
        let (evalai, changed) = mpsc::unbounded_channel();
        let (answers, answered) = mpsc::unbounded_channel();
        let external = self.external(&leader.fence(), evalai, rows);
        let hub = external.hub.clone();
        let shared = Arc::new(Shared {
            context: Arc::new(self.context(external, &answers, &boards)),
            backoff: BackoffMap::default(),
            telemetry: self.telemetry.clone(),
        });
        self.keep_policies(&shared.context);
        let reports = events::Reports {
            rows: changed_rows,
            evalai: changed,
            answers: answered,
        };
        let of_submissions = events::of_submissions(&self.watches, reports, &boards, &shared);
        let of_leaderboards = events::of_leaderboards(&self.watches, woken_boards, &shared);
        let mut leadership = leader.leadership();
        let reconciles = reconciles::run(of_submissions, of_leaderboards, shared);
        let reconciles = self.telemetry.tasks.stay("reconciles", reconciles);
        tokio::select! {
            () = self.telemetry.stop.wait() => {}
            why = lost(&mut leadership) => {
                reconciles.abort();
                return Err(RunError::LostLease(why));
            }
        }
        finish(reconciles).await;
        if hub.drain().await {
            leader.drained();
        }
        Ok(())
    }

    /// The services, and what counts them.
    fn external(
        &self,
        fence: &leader::Fence,
        evalai: mpsc::UnboundedSender<Changed>,
        rows: mpsc::UnboundedSender<ObjectKey>,
    ) -> ExternalSystems {
        let (watches, telemetry) = (&self.watches, &self.telemetry);
        let hub = hub(fence, evalai, &self.client, &watches.leaderboards.store, telemetry);
        let fence = fence.clone();
        let recorder = Recorder::new(
            self.aws.clone(),
            move || fence.may_write(),
            rows,
            telemetry.tasks.clone(),
        );
        let gauges = counts::keep(hub.clone(), watches.submissions.store.clone(), telemetry.clone());
        telemetry.tasks.stay("gauges", gauges);
        ExternalSystems::new(hub, recorder)
    }

    /// What all reconciles share. `answers` and `boards` wake Submissions and Leaderboards.
    fn context(
        &self,
        external: ExternalSystems,
        answers: &mpsc::UnboundedSender<ObjectRef<Submission>>,
        boards: &mpsc::UnboundedSender<ObjectRef<Leaderboard>>,
    ) -> Context {
        let (aws, client, tasks) = (&self.aws, &self.client, &self.telemetry.tasks);
        let context = Context {
            client: client.clone(),
            settings: self.settings.clone(),
            stores: self.watches.stores(),
            memory: Memory::default(),
            archive: ArchiveWorkers::new(aws.clone(), client.clone(), tasks.clone(), waking(answers)),
            lookups: Lookups::start(client.clone(), tasks, waking(answers)),
            reruns: Reruns::default(),
            slots: Arc::default(),
            leaderboards: LeaderboardState::default(),
            external,
            aws: aws.clone(),
            recorder: events(client),
            wake: waking(boards),
        };
        context.stores.fill(&context.slots);
        context
    }

    /// Restores the policies next to the reconciles.
    fn keep_policies(&self, context: &Arc<Context>) {
        let context = Arc::clone(context);
        let keep = move |board| {
            let context = Arc::clone(&context);
            async move { isolation::keep_missing(context.policies(), &board).await }
        };
        let watches = &self.watches;
        let restored = isolation::restore(watches.policies.subscribe(), watches.leaderboards.subscribe(), keep);
        self.telemetry.tasks.stay("policies", restored);
    }
}

/// Puts an object into its queue.
fn waking<K: Resource<DynamicType = ()> + 'static>(queue: &mpsc::UnboundedSender<ObjectRef<K>>) -> Wake<K> {
    let queue = queue.clone();
    Box::new(move |object| {
        // Without a receiver the process is ending.
        let _ = queue.send(object);
    })
}

/// Reconciles end by the stop; what they have begun is finished, and given up when that takes too long.
async fn finish<T>(mut reconciles: JoinHandle<T>) {
    if tokio::time::timeout(DRAIN, &mut reconciles).await.is_err() {
        reconciles.abort();
    }
}

fn events(client: &Client) -> EventRecorder {
    let reporter = Reporter {
        controller: "leaderboard.carla.org/controller".into(),
        instance: std::env::var("POD_NAME").ok(),
    };
    EventRecorder::new(client.clone(), reporter)
}

/// Waits to become the leader. False if the stop comes before.
async fn await_lead(leader: &Leader, telemetry: &Observability) -> Result<bool, RunError> {
    let mut leadership = leader.leadership();
    loop {
        match &*leadership.borrow_and_update() {
            Leadership::Leader { .. } => return Ok(true),
            Leadership::Lost { why } => return Err(RunError::LostLease(why.clone())),
            Leadership::Standby => {}
        }
        tokio::select! {
            () = telemetry.stop.wait() => return Ok(false),
            // The task of the Lease has failed, which ends the process.
            changed = leadership.changed() => if changed.is_err() { telemetry.stop.wait().await },
        }
    }
}

async fn lost(leadership: &mut tokio::sync::watch::Receiver<Leadership>) -> String {
    let why = {
        let ended = leadership.wait_for(|l| !matches!(l, Leadership::Leader { .. })).await;
        ended.map(|leadership| match &*leadership {
            Leadership::Lost { why } => why.clone(),
            _ => "the Lease was released".into(),
        })
    };
    match why {
        Ok(why) => why,
        // The task of the Lease has failed, and ends the process by its name.
        Err(_) => std::future::pending().await,
    }
}

fn hub(
    fence: &leader::Fence,
    changed: mpsc::UnboundedSender<Changed>,
    client: &Client,
    leaderboards: &Store<Leaderboard>,
    telemetry: &Observability,
) -> Hub {
    let (sweep, rows) = mpsc::unbounded_channel::<SweepRow>();
    let sweeping = sweep::into_cluster(client.clone(), leaderboards.clone(), rows);
    let stop = telemetry.stop.clone();
    telemetry.tasks.stay("sweep", async move {
        tokio::select! { () = stop.wait() => {}, () = sweeping => {} }
    });
    let not_before = fence.evalai_not_before().unwrap_or_else(Instant::now);
    let writes = fence.clone();
    Hub::new(Options {
        write_guard: Arc::new(move || writes.may_write()),
        not_before,
        changed,
        sweep,
        timing: Timing::default(),
        timeouts: Timeouts::default(),
        meter: Meter::for_metrics(&telemetry.metrics),
        tasks: telemetry.tasks.clone(),
    })
}

#[cfg(test)]
mod tests;
