//! Wires the controller: watches, lease, services, reconciles. Called by the command line; decides nothing.
//!
//! Standbys keep warm caches and are ready. A process that loses the lead, or one of its tasks, ends with an error: the kubelet starts it
//! again with empty hands.

pub mod backoff;
pub mod context;
mod events;
mod gauges;
pub mod leader;
pub mod objects;
mod queue;
mod reconciles;
pub mod settings;
pub mod stores;
mod watches;
pub mod writes;

use crate::intake::inbox;
use crate::intake::sweep;
use std::sync::Arc;
use std::time::Duration;

use kube::Client;
use kube::runtime::reflector::ObjectRef;
use kube::runtime::watcher::Config;
use tokio::sync::{mpsc, watch};
use tokio::task::JoinHandle;
use tokio::time::Instant;

use super::leaderboards::probe::Asks;
use super::leaderboards::state::LeaderboardState;
use super::leaderboards::{isolation, operator};
use super::slots::Slots;
use crate::intake::leaderboards::Scope;
use crate::intake::shared;
use crate::kubernetes::objects::Event;
use crate::kubernetes::preflight::{self, await_kinds};
use crate::kubernetes::{Writer, recorder, spawn_uncached};
use crate::observability::Observability;
use crate::observability::readiness::Readiness;
use crate::page::Page;
use crate::runtime::objects::{Wake, by_key};
use crate::runtime::settings::Settings;
use crate::submissions::act::CONTROLLER;
use crate::submissions::external::ExternalSystems;
use crate::submissions::memory::Memory;
use crate::submissions::observe::causes::{Causes, OF_JOBS, OF_PODS, Objects};
use crate::submissions::observe::node;
use crate::submissions::observe::workers::Workers;
use crate::submissions::payloads;
use crate::submissions::records;
use backoff::BackoffMap;
use context::Context;
use leader::{Leader, Leadership};
use leaderboard_api::{Leaderboard, Submission};
use leaderboard_aws::clients::Aws;
use leaderboard_aws::table::Tables;
use leaderboard_base::object_key::ObjectKey;
use leaderboard_base::tasks::TaskFailed;
use leaderboard_evalai::{Changed, Hub, Network, Options, SweepRow, Timeouts, Timing};
use leaderboard_policy::phases::Phase;
use queue::{Class, urgency};
use reconciles::Queues;
use watches::Watches;

/// Reconciles under way may take this long to end after a stop.
const DRAIN: Duration = Duration::from_secs(20);

/// Plurals of the kinds that it works on.
pub const KINDS: [&str; 2] = ["leaderboards", "submissions"];

/// Why the controller ended.
#[derive(thiserror::Error, Debug)]
pub enum RunError {
    #[error("this process no longer leads: {0}")]
    LostLease(String),
    #[error(transparent)]
    TaskFailed(#[from] TaskFailed),
}

/// Parts that all reconciles share.
pub(super) struct Shared {
    context: Arc<Context>,
    queues: Queues,
    backoff: BackoffMap,
    telemetry: Observability,
}

impl Shared {
    /// Drops everything that is remembered of an object that is gone.
    fn forget(&self, key: &ObjectKey) {
        self.context.forget(key);
        self.backoff.forget(&key.uid);
    }
}

/// Runs until the stop, or until it no longer leads.
pub async fn run(
    clients: Clients,
    lease: leader::Settings,
    settings: Settings,
    aws: Aws,
    page: Option<Page>,
    telemetry: Observability,
) -> Result<(), RunError> {
    preflight::register(&telemetry);
    let tasks = telemetry.tasks.clone();
    let work = Box::pin(async move {
        if !await_kinds(&clients.api, &KINDS, &telemetry).await {
            return Ok(());
        }
        let watches = Watches::start(&clients.watch, &settings, &telemetry);
        telemetry.readiness.registered();
        let leader = leader::start(clients.lease, lease, &telemetry);
        if let Some(page) = page {
            page.start(watches.for_page(&leader), &telemetry);
        }
        let is_answered = if await_lead(&leader, &watches, &telemetry).await? {
            let parts = Parts {
                client: clients.api,
                watch_client: clients.watch,
                queues: Queues::new(settings.concurrency, &telemetry.metrics),
                settings,
                aws: aws.counted_by(telemetry.metrics.meter()),
                watches,
                fence: leader.fence(),
                telemetry,
            };
            parts.lead(&leader).await?
        } else {
            true
        };
        if is_answered {
            leader.release().await;
        } else {
            tracing::warn!(
                "EvalAI has not answered all requests: the Lease is left to expire, and the next leader waits for that"
            );
        }
        Ok(())
    });
    tokio::select! {
        biased;
        failed = tasks.failed() => Err(failed.into()),
        result = work => result,
    }
}

/// One client for calls, one whose dead connections end for watches, one without retries for the lease.
pub struct Clients {
    pub api: Client,
    pub watch: Client,
    pub lease: Client,
}

/// Parts of a process that leads.
struct Parts {
    client: Client,
    watch_client: Client,
    settings: Settings,
    aws: Aws,
    watches: Watches,
    fence: leader::Fence,
    queues: Queues,
    telemetry: Observability,
}

impl Parts {
    /// Until the stop. Returns whether EvalAI has answered all that was written to it.
    async fn lead(self, leader: &Leader) -> Result<bool, RunError> {
        // Prometheus sees no increase in a sample that begins with 1.
        for phase in Phase::ALL {
            self.telemetry.metrics.submissions.phases.of([phase.as_str()]);
        }
        let (evalai, changed) = mpsc::unbounded_channel();
        let tables = Arc::new(Tables::new(self.aws.clone()));
        let external = self.external(Arc::clone(&tables), evalai);
        let hub = external.hub.clone();
        let shared = Arc::new(Shared {
            context: Arc::new(self.context(tables, external)),
            queues: self.queues.clone(),
            backoff: BackoffMap::default(),
            telemetry: self.telemetry.clone(),
        });
        self.keep_policies(&shared.context);
        let walked = Arc::clone(&shared);
        let walk = move || gauges::walk(&walked, walked.telemetry.clock.now());
        let gauges = gauges::keep(gauges::EVERY, walk, self.telemetry.clone());
        self.telemetry.tasks.stay("gauges", gauges);
        let of_submissions = events::of_submissions(&self.watches, changed, &shared);
        let of_leaderboards = events::of_leaderboards(&self.watches, &shared);
        let reconciles = reconciles::run(of_submissions, of_leaderboards, shared);
        let reconciles = self.telemetry.tasks.stay("reconciles", reconciles);
        let (stop, lost) = (self.telemetry.stop.wait(), lost(leader.leadership()));
        end(reconciles, stop, hub.drain(), lost).await
    }

    /// The services.
    fn external(&self, tables: Arc<Tables>, changed: mpsc::UnboundedSender<Changed>) -> ExternalSystems {
        let (hub, fence, tasks) = (self.hub(changed), self.fence.clone(), &self.telemetry.tasks);
        let inbox = inbox::read(self.inbox(), hub.clone(), self.settings.operator.clone());
        tasks.stay("inbox", inbox);
        let records = records::start(tables, move || fence.may_write(), tasks, by_key(self.answered()));
        ExternalSystems::new(hub, records, self.settings.allowed.clone())
    }

    fn hub(&self, changed: mpsc::UnboundedSender<Changed>) -> Hub {
        let (fence, telemetry) = (self.fence.clone(), &self.telemetry);
        Hub::new(Options {
            connect: Arc::new(Network::connect),
            clock: telemetry.clock.clone(),
            not_before: fence.evalai_not_before().unwrap_or_else(Instant::now),
            write_guard: Arc::new(move || fence.may_write()),
            payloads: payloads::reader(self.aws.clone(), telemetry.clock.clone()),
            changed,
            sweep: self.sweep(),
            timing: Timing::default(),
            timeouts: Timeouts::default(),
            meter: telemetry.metrics.meter(),
            tasks: telemetry.tasks.clone(),
        })
    }

    /// Wakes a Submission that has an answer.
    fn answered(&self) -> Wake<Submission> {
        events::waking(&self.queues.submissions, &self.watches.submissions.store)
    }

    /// Where the sweep's finds go.
    fn sweep(&self) -> mpsc::UnboundedSender<SweepRow> {
        let (sweep, rows) = mpsc::unbounded_channel();
        let leaderboards = self.watches.leaderboards.store.clone();
        let swept = sweep::into_cluster(self.client.clone(), leaderboards, rows);
        self.telemetry.tasks.until_stop("sweep", swept);
        sweep
    }

    /// Parts that take messages of EvalAI's queues in. A queue that cannot be read shows in its Leaderboards' `Ready`.
    fn inbox(&self) -> Arc<shared::Shared> {
        Arc::new(shared::Shared {
            client: self.client.clone(),
            scope: Scope {
                namespaces: self.settings.namespaces.clone(),
                allowed: self.settings.allowed.clone(),
            },
            leaderboards: self.watches.leaderboards.clone(),
            recorder: recorder(&self.client, CONTROLLER),
            telemetry: self.telemetry.clone(),
            problems: shared::Problems::new(Readiness::default()),
        })
    }

    /// Parts that all reconciles share.
    fn context(&self, tables: Arc<Tables>, external: ExternalSystems) -> Context {
        let (aws, client, tasks) = (&self.aws, &self.client, &self.telemetry.tasks);
        let (fence, queues, submissions) = (self.fence.clone(), &self.queues, &self.watches.submissions.store);
        let turned = events::waking_as(urgency::of_submission, &queues.submissions, submissions);
        let board = || -> Wake<Leaderboard> {
            let boards = Arc::clone(&queues.leaderboards);
            Box::new(move |board: ObjectRef<Leaderboard>| boards.add(&board, Class::Refresh))
        };
        let context = Context {
            clock: self.telemetry.clock.clone(),
            client: client.clone(),
            writer: Writer::new(client.clone(), move || fence.may_write()),
            settings: self.settings.clone(),
            stores: self.watches.stores(),
            memory: Memory::default(),
            workers: Workers::start(aws, tables, &external.hub, client, tasks, || self.answered()),
            causes: self.causes(),
            slots: Arc::new(Slots::new(self.watches.stores(), turned)),
            leaderboards: LeaderboardState::default(),
            asks: Asks::start(client, aws, &self.settings, tasks, || by_key(board())),
            external,
            recorder: recorder(client, CONTROLLER),
            metrics: Arc::clone(&self.telemetry.metrics),
            traces: self.telemetry.traces.clone(),
            wake: board(),
        };
        let slots = Arc::clone(&context.slots);
        tasks.stay("slots", async move { slots.keep().await });
        for pod in context.stores.pods.state() {
            context.measured(&pod);
        }
        if let Some(nodes) = &self.watches.nodes {
            let woken = node::wake(nodes.subscribe(), context.stores.pods.clone(), self.answered());
            tasks.stay("nodes", woken);
        }
        context
    }

    /// Why Jobs have no Pod and Pods no node, as events show. Without the right to them no reason is shown, and the log names it.
    fn causes(&self) -> Causes {
        let causes = Causes::default();
        let objects = Objects {
            jobs: self.watches.jobs.store.clone(),
            pods: self.watches.pods.store.clone(),
        };
        for (name, selector) in [("events of Jobs", OF_JOBS), ("events of Pods", OF_PODS)] {
            let take = causes.taking(objects.clone(), self.answered());
            let apis = self.settings.namespaces.apis::<Event>(&self.watch_client);
            spawn_uncached(name, apis, Config::default().fields(selector), &self.telemetry, take);
        }
        causes
    }

    /// Restores the policies next to the reconciles.
    fn keep_policies(&self, context: &Arc<Context>) {
        let context = Arc::clone(context);
        let keep = move |board| {
            let context = Arc::clone(&context);
            async move {
                let known = context.stores.leaderboards.get(&board);
                if known.is_some_and(|known| operator::is_ours(&known, &context.settings.operator)) {
                    isolation::keep_missing(context.policies(), &board).await;
                }
            }
        };
        let watches = &self.watches;
        let restored = isolation::restore(watches.policies.subscribe(), watches.leaderboards.subscribe(), keep);
        self.telemetry.tasks.stay("policies", restored);
    }
}

/// After the stop, what reconciles have begun is finished, and given up when that takes too long; then `drain` is waited for and
/// answered. A leader that has lost its Lease drops all of it, at any moment.
async fn end<T>(
    mut reconciles: JoinHandle<T>,
    stop: impl Future<Output = ()>,
    drain: impl Future<Output = bool>,
    lost: impl Future<Output = String>,
) -> Result<bool, RunError> {
    let finished = async {
        stop.await;
        let _ = tokio::time::timeout(DRAIN, &mut reconciles).await;
        drain.await
    };
    let result = tokio::select! {
        biased;
        why = lost => Err(RunError::LostLease(why)),
        is_answered = finished => Ok(is_answered),
    };
    reconciles.abort();
    result
}

/// Waits to become the leader, with caches that are complete. False if the stop comes before.
async fn await_lead(leader: &Leader, watches: &Watches, telemetry: &Observability) -> Result<bool, RunError> {
    let leads = async {
        if let Leadership::Lost { why } = after(leader.leadership(), |now| *now == Leadership::Standby).await {
            return Err(RunError::LostLease(why));
        }
        watches.synced().await;
        Ok(true)
    };
    tokio::select! {
        biased;
        () = telemetry.stop.wait() => Ok(false),
        leads = leads => leads,
    }
}

async fn lost(leadership: watch::Receiver<Leadership>) -> String {
    match after(leadership, |now| now.term().is_some()).await {
        Leadership::Lost { why } => why,
        _ => "the Lease was released".into(),
    }
}

/// Where this process stands once this does not hold. Never, if the task of the Lease has failed, which ends the process by its name.
async fn after(mut leadership: watch::Receiver<Leadership>, holds: fn(&Leadership) -> bool) -> Leadership {
    let next = leadership.wait_for(|now| !holds(now)).await.map(|now| now.clone());
    match next {
        Ok(next) => next,
        Err(_) => std::future::pending().await,
    }
}

#[cfg(test)]
mod tests;
