//! Wires the controller: watches, lease, services, passes. Called by the command line; decides nothing.
//!
//! Standbys keep warm caches and are ready. A process that has led and no longer does ends with an error: the kubelet
//! starts it again with empty hands.

mod counts;
mod marks;
mod needs;
mod passes;

use std::collections::HashSet;
use std::sync::Arc;
use std::time::Duration;

use futures::future::FusedFuture;
use futures::{FutureExt, StreamExt};
use k8s_openapi::api::batch::v1::Job;
use k8s_openapi::api::core::v1::{Container, Pod, PodTemplateSpec};
use k8s_openapi::api::networking::v1::NetworkPolicy;
use kube::runtime::events::{Recorder as EventRecorder, Reporter};
use kube::runtime::reflector::{ObjectRef, Store};
use kube::runtime::watcher::Config;
use kube::{Api, Client, ResourceExt};
use tokio::sync::mpsc;
use tokio::time::Instant;

use super::context::{Context, Settings, Stores};
use super::leader::{self, Leader, Leadership};
use super::leaderboards::isolation;
use super::observe::board::Places;
use super::observe::children_selector;
use super::sync::Sync;
use super::watches::preflight::{await_kinds, watch_access};
use super::watches::{Touch, Touches, Watch, Watchable, guarded, spawn_watch};
use crate::api::{Leaderboard, Submission};
use crate::bridge::ingest::{self, Incoming, Source};
use crate::observability::Observability;
use crate::services::ObjectKey;
use crate::services::aws::Aws;
use crate::services::evalai::{Changed, Hub, Options, SweepRow, Timeouts, Timing};
use crate::services::table::Recorder;
use marks::{Fingerprints, standing};

/// Passes in hand may take this long to end after a stop.
const DRAIN: Duration = Duration::from_secs(20);

/// The cache of policies is waited for so long at the start: without a right to them nothing starts, but runs are watched.
const POLICIES_LIMIT: Duration = Duration::from_secs(5);

/// Why the controller ended.
#[derive(thiserror::Error, Debug)]
pub enum RunError {
    #[error("this process no longer leads: {0}")]
    LostLease(String),
    #[error("a part of the controller has ended by itself; the process starts anew")]
    PartEnded,
}

/// Something has changed for an object.
#[derive(Clone, Debug)]
pub(super) enum Touched {
    Submission(ObjectRef<Submission>),
    Leaderboard(ObjectRef<Leaderboard>),
    /// An object is gone for good.
    Gone(ObjectKey),
}

/// Runs until told to stop, or until it no longer leads.
pub async fn run(
    clients: Clients,
    lease: leader::Settings,
    settings: Settings,
    aws: Aws,
    seen: Observability,
) -> Result<(), RunError> {
    let client = &clients.api;
    if !await_kinds(client, &["leaderboards", "submissions"], &seen).await {
        return Ok(());
    }
    let access = client.clone();
    let (namespace, watcher) = (settings.namespace.clone(), seen.clone());
    tokio::spawn(watch_rights(access, namespace, lease.clone(), watcher));
    let watches = Watches::start(&clients.watch, settings.namespace.as_deref(), &seen);
    let leader = leader::start(clients.lease, lease, &seen);
    let parts = Parts {
        client: clients.api,
        settings,
        aws: aws.counted_by(counts::meter(&seen)),
        watches,
        seen,
    };
    let result = parts.lead(&leader).await;
    if result.is_ok()
        && let Err(error) = leader.release().await
    {
        tracing::warn!("{error}");
    }
    result
}

async fn watch_rights(client: Client, namespace: Option<String>, lease: leader::Settings, seen: Observability) {
    let needs = needs::needs(namespace.as_deref(), &lease);
    watch_access(client, &needs, &seen).await;
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
    fn start(client: &Client, namespace: Option<&str>, seen: &Observability) -> Self {
        let children = || Config::default().labels(&children_selector());
        Self {
            leaderboards: spawn_watch(guarded(client.clone(), namespace), Config::default(), |_| {}, seen),
            submissions: spawn_watch(guarded(client.clone(), namespace), Config::default(), |_| {}, seen),
            jobs: spawn_watch(guarded(client.clone(), namespace), children(), trim_job, seen),
            pods: spawn_watch(guarded(client.clone(), namespace), children(), trim_pod, seen),
            policies: spawn_watch(guarded(client.clone(), namespace), children(), |_| {}, seen),
        }
    }

    fn stores(&self) -> Stores {
        Stores {
            leaderboards: self.leaderboards.store.clone(),
            submissions: self.submissions.store.clone(),
            jobs: self.jobs.store.clone(),
            pods: self.pods.store.clone(),
            policies: self.policies.store.clone(),
        }
    }

    async fn synced(&self) {
        // An error means that the watch's task is gone; liveness sees that.
        let _ = self.leaderboards.store.wait_until_ready().await;
        let _ = self.submissions.store.wait_until_ready().await;
        let _ = self.jobs.store.wait_until_ready().await;
        let _ = self.pods.store.wait_until_ready().await;
        let _ = tokio::time::timeout(POLICIES_LIMIT, self.policies.store.wait_until_ready()).await;
    }

    /// Tells everything that is there now, then everything that is touched.
    fn feed(&self, touched: &mpsc::UnboundedSender<Touched>, context: &Arc<Context>) {
        let mut boards = Fingerprints::default();
        forward(
            self.leaderboards.subscribe(),
            touched,
            move |touch: Touch<Leaderboard>| {
                let object = touch.object.as_ref();
                if touch.is_gone {
                    return vec![Touched::Gone(boards.drop(object))];
                }
                let moved = boards.moved(object, "");
                moved
                    .by_others
                    .then(|| Touched::Leaderboard(ObjectRef::from_obj(object)))
                    .into_iter()
                    .collect()
            },
        );
        let (mut submissions, mut places) = (Fingerprints::default(), Places::default());
        let (policies_of, context) = (Arc::clone(context), Arc::clone(context));
        forward(
            self.submissions.subscribe(),
            touched,
            move |touch: Touch<Submission>| {
                let object = touch.object.as_ref();
                let namespace = object.namespace().unwrap_or_default();
                let board = ObjectRef::new(&object.spec.leaderboard).within(&namespace);
                // Before anybody is woken by it.
                if places.moved(object, touch.is_gone) {
                    context.board.moved(&namespace, &object.spec.leaderboard);
                }
                if touch.is_gone {
                    return vec![Touched::Gone(submissions.drop(object)), Touched::Leaderboard(board)];
                }
                let moved = submissions.moved(object, &standing(object));
                let own = moved
                    .by_others
                    .then(|| Touched::Submission(ObjectRef::from_obj(object)));
                own.into_iter()
                    .chain(moved.in_line.then_some(Touched::Leaderboard(board)))
                    .collect()
            },
        );
        forward(self.jobs.subscribe(), touched, |touch: Touch<Job>| {
            owner(touch.object.as_ref())
        });
        let mut measured = HashSet::new();
        forward(self.pods.subscribe(), touched, move |touch: Touch<Pod>| {
            let pod = touch.object.as_ref();
            let uid = pod.uid().unwrap_or_default();
            let mut concerned = owner(pod);
            if touch.is_gone {
                measured.remove(&uid);
            } else if isolation::finding(pod).is_some() && measured.insert(uid) {
                concerned.extend(board(pod));
            }
            concerned
        });
        tokio::spawn(isolation::restore(self.policies.subscribe(), policies_of));
        forward(self.policies.subscribe(), touched, |touch: Touch<NetworkPolicy>| {
            board(touch.object.as_ref()).into_iter().collect()
        });
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

fn owner(child: &impl ResourceExt) -> Vec<Touched> {
    Stores::owner_of(child).map(Touched::Submission).into_iter().collect()
}

fn board(child: &impl ResourceExt) -> Option<Touched> {
    Stores::leaderboard_of(child).map(Touched::Leaderboard)
}

fn key(object: &impl ResourceExt) -> ObjectKey {
    ObjectKey {
        namespace: object.namespace().unwrap_or_default(),
        name: object.name_any(),
        uid: object.uid().unwrap_or_default(),
    }
}

fn forward<K: Watchable>(
    mut touches: Touches<K>,
    touched: &mpsc::UnboundedSender<Touched>,
    mut map: impl FnMut(Touch<K>) -> Vec<Touched> + Send + 'static,
) {
    let touched = touched.clone();
    tokio::spawn(async move {
        while let Some(touch) = touches.next().await {
            for each in map(touch) {
                // Without a receiver the process is ending.
                let _ = touched.send(each);
            }
        }
    });
}

/// What one process is made of.
struct Parts {
    client: Client,
    settings: Settings,
    aws: Aws,
    watches: Watches,
    seen: Observability,
}

impl Parts {
    async fn lead(self, leader: &Leader) -> Result<(), RunError> {
        if !await_lead(leader, &self.seen).await? {
            return Ok(());
        }
        tokio::select! { () = self.watches.synced() => {}, () = self.seen.stop.wait() => return Ok(()) }
        let (touched, inbox) = mpsc::unbounded_channel();
        let fence = leader.fence();
        let hub = hub(
            &fence,
            &touched,
            &self.client,
            &self.watches.leaderboards.store,
            &self.seen,
        );
        let recorder = recorder(&fence, &touched, self.aws.clone(), &self.seen);
        let instance = std::env::var("POD_NAME").ok();
        let reporter = Reporter {
            controller: "leaderboard.carla.org/controller".into(),
            instance,
        };
        let events = EventRecorder::new(self.client.clone(), reporter);
        let sync = Sync::new(hub.clone(), recorder);
        tokio::spawn(counts::keep(
            hub.clone(),
            self.watches.submissions.store.clone(),
            self.seen.clone(),
        ));
        let stores = self.watches.stores();
        let context = Arc::new(Context::new(self.client, self.settings, stores, sync, self.aws, events));
        self.watches.feed(&touched, &context);
        let mut leadership = leader.leadership();
        let mut passes = std::pin::pin!(passes::run(context, inbox, self.seen.clone()).fuse());
        tokio::select! {
            () = self.seen.stop.wait() => {}
            why = lost(&mut leadership) => return Err(RunError::LostLease(why)),
            () = &mut passes => if !self.seen.stop.is_set() { return Err(RunError::PartEnded) },
        }
        finish(passes).await;
        if hub.drain().await {
            leader.drained();
        }
        Ok(())
    }
}

/// Passes end by the stop; what they have begun is finished. They may have ended already, in the very moment of the stop.
async fn finish(passes: impl FusedFuture<Output = ()>) {
    if !passes.is_terminated() {
        let _ = tokio::time::timeout(DRAIN, passes).await;
    }
}

fn recorder(
    fence: &leader::Fence,
    touched: &mpsc::UnboundedSender<Touched>,
    aws: Aws,
    seen: &Observability,
) -> Recorder {
    let (changed, mut rows) = mpsc::unbounded_channel::<ObjectKey>();
    let touched = touched.clone();
    tokio::spawn(async move {
        while let Some(key) = rows.recv().await {
            let _ = touched.send(Touched::Submission(ObjectRef::new(&key.name).within(&key.namespace)));
        }
    });
    let fence = fence.clone();
    Recorder::new(aws, move || fence.may_write(), changed, seen.stop.receiver())
}

/// Waits to become the leader. False if told to stop before.
async fn await_lead(leader: &Leader, seen: &Observability) -> Result<bool, RunError> {
    let mut leadership = leader.leadership();
    loop {
        match &*leadership.borrow_and_update() {
            Leadership::Leader { .. } => return Ok(true),
            Leadership::Lost { why } => return Err(RunError::LostLease(why.clone())),
            Leadership::Standby => {}
        }
        tokio::select! {
            () = seen.stop.wait() => return Ok(false),
            changed = leadership.changed() => if changed.is_err() { return Err(RunError::PartEnded) },
        }
    }
}

async fn lost(leadership: &mut tokio::sync::watch::Receiver<Leadership>) -> String {
    let ended = leadership.wait_for(|l| !matches!(l, Leadership::Leader { .. })).await;
    match ended.as_deref() {
        Ok(Leadership::Lost { why }) => why.clone(),
        _ => "the lease's task has ended".into(),
    }
}

fn hub(
    fence: &leader::Fence,
    touched: &mpsc::UnboundedSender<Touched>,
    client: &Client,
    leaderboards: &Store<Leaderboard>,
    seen: &Observability,
) -> Hub {
    let (changed, mut changes) = mpsc::unbounded_channel::<Changed>();
    let (sweep, rows) = mpsc::unbounded_channel::<SweepRow>();
    let forward = touched.clone();
    tokio::spawn(async move {
        while let Some(change) = changes.recv().await {
            let _ = forward.send(match change {
                Changed::Submission(key) => Touched::Submission(ObjectRef::new(&key.name).within(&key.namespace)),
                Changed::Leaderboard(key) => Touched::Leaderboard(ObjectRef::new(&key.name).within(&key.namespace)),
            });
        }
    });
    tokio::spawn(sweep_into_cluster(
        client.clone(),
        leaderboards.clone(),
        rows,
        seen.clone(),
    ));
    let not_before = fence.evalai_not_before().unwrap_or_else(Instant::now);
    let writes = fence.clone();
    Hub::new(Options {
        fence: Arc::new(move || writes.may_write()),
        not_before,
        changed,
        sweep,
        timing: Timing::default(),
        timeouts: Timeouts::default(),
        meter: counts::meter(seen),
    })
}

/// Submissions whose message was lost go the same way as those of messages.
async fn sweep_into_cluster(
    client: Client,
    leaderboards: Store<Leaderboard>,
    mut rows: mpsc::UnboundedReceiver<SweepRow>,
    seen: Observability,
) {
    loop {
        let row = tokio::select! {
            () = seen.stop.wait() => return,
            row = rows.recv() => match row { Some(row) => row, None => return },
        };
        let all = leaderboards.state();
        let Some(board) = serving(&all, &row) else { continue };
        let api: Api<Submission> = Api::namespaced(client.clone(), &board.namespace().unwrap_or_default());
        let incoming = Incoming {
            challenge: row.challenge,
            phase: row.phase,
            submission: row.submission,
            image: None,
            source: Source::Sweep,
            sent_ms: row.time.as_millisecond(),
        };
        match ingest::apply(&api, &board.name_any(), &incoming).await {
            Ok(outcome) => tracing::info!(
                submission = row.submission,
                ?outcome,
                "EvalAI waits for a submission whose message was lost"
            ),
            Err(error) => tracing::warn!(submission = row.submission, "{error}"),
        }
    }
}

/// The oldest Leaderboard that serves a row's phase.
fn serving<'a>(all: &'a [Arc<Leaderboard>], row: &SweepRow) -> Option<&'a Arc<Leaderboard>> {
    let serves = |l: &&Arc<Leaderboard>| {
        l.spec.evalai.as_ref().is_some_and(|e| e.challenge == row.challenge)
            && l.spec.tracks.iter().any(|t| t.phase == Some(row.phase))
            && l.metadata.deletion_timestamp.is_none()
    };
    all.iter()
        .filter(serves)
        .min_by_key(|l| (l.metadata.creation_timestamp.as_ref().map(|t| t.0), l.name_any()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test(start_paused = true)]
    async fn passes_that_ended_in_the_moment_of_the_stop_are_not_waited_for() {
        let began = Instant::now();
        let mut passes = std::pin::pin!(async {}.fuse());
        passes.as_mut().await;
        finish(passes).await;
        assert_eq!(began.elapsed(), Duration::ZERO);
        let mut passes = std::pin::pin!(tokio::time::sleep(Duration::from_secs(3)).fuse());
        finish(passes.as_mut()).await;
        assert_eq!(began.elapsed(), Duration::from_secs(3));
        finish(std::pin::pin!(std::future::pending::<()>().fuse())).await;
        assert_eq!(began.elapsed(), Duration::from_secs(3) + DRAIN);
    }
}
