//! The calls of an election: looks at the Lease, asks `decide`, writes with the resourceVersion that was read.
//!
//! One task a process, started by `leader::start`. Each call is bounded; what a call did when no answer came is found out
//! by looking again, never assumed.

use std::time::Duration;

use k8s_openapi::api::coordination::v1::Lease;
use kube::api::PostParams;
use kube::{Api, Client};
use tokio::sync::{oneshot, watch};
use tokio::time::{Instant, sleep};

use super::decide::{Decision, Leading, Loss, ObservedLease, decide, is_overdue};
use super::record::{Record, held, released};
use super::{Fence, Leadership, Settings};
use crate::kubernetes::{CallError, call_within};
use crate::observability::Observability;
use leaderboard_base::backoff::jittered;

/// Looks at a Lease that changes while it is being released.
const RELEASE_TRIES: u32 = 3;

pub(super) struct Elector {
    api: Api<Lease>,
    settings: Settings,
    publish: watch::Sender<Leadership>,
    fence: Fence,
    telemetry: Observability,
    seen: ObservedLease,
    /// The Lease as the server last answered it. None: there is none, if `is_fresh`.
    lease: Option<Lease>,
    /// The last look or write was answered, and nothing has been sent since.
    is_fresh: bool,
    leading: Option<Leading>,
}

/// How the election goes on.
enum Next {
    After(Duration),
    End(Loss),
}

impl Elector {
    pub(super) fn new(
        client: Client,
        settings: Settings,
        publish: watch::Sender<Leadership>,
        fence: Fence,
        telemetry: &Observability,
    ) -> Self {
        Self {
            api: Api::namespaced(client, &settings.namespace),
            settings,
            publish,
            fence,
            telemetry: telemetry.clone(),
            seen: ObservedLease::default(),
            lease: None,
            is_fresh: false,
            leading: None,
        }
    }

    /// Until the Lease is lost or handed over.
    pub(super) async fn run(mut self, mut release: oneshot::Receiver<()>) {
        loop {
            let pause = match self.round().await {
                Next::After(pause) => pause,
                Next::End(loss) => return self.lose(&loss.to_string()),
            };
            tokio::select! {
                biased;
                asked = &mut release => return match asked {
                    Ok(()) => self.hand_over().await,
                    Err(_) => self.lose("the election was abandoned by its process"),
                },
                () = sleep(pause) => {}
            }
        }
    }

    async fn round(&mut self) -> Next {
        let now = self.telemetry.clock.since_boot();
        if let Some(loss) = self
            .leading
            .and_then(|leading| is_overdue(&leading, &self.settings.timing, now))
        {
            return Next::End(loss);
        }
        // A leader writes with what its last write was answered; only a doubt costs it a look.
        if (self.leading.is_none() || !self.is_fresh)
            && let Err(error) = self.look().await
        {
            return self.failed(&error);
        }
        let now = self.telemetry.clock.since_boot();
        match decide(
            &self.seen,
            &self.settings.identity,
            self.leading.as_ref(),
            &self.settings.timing,
            now,
        ) {
            Decision::Acquire { term } | Decision::Renew { term } => self.write(term).await,
            Decision::Wait { until } => Next::After(self.retry().min(until.saturating_sub(now))),
            Decision::Lost(loss) => Next::End(loss),
        }
    }

    async fn look(&mut self) -> Result<(), CallError> {
        let name = self.settings.name.clone();
        let api = self.api.clone();
        let lease = self.call("the read", async move { api.get_opt(&name).await }).await?;
        self.note(lease);
        Ok(())
    }

    async fn write(&mut self, term: i32) -> Next {
        let sent = self.telemetry.clock.since_boot();
        let lease = held(self.lease.as_ref(), &self.settings, term, self.telemetry.clock.now());
        self.is_fresh = false;
        match self.send(&lease).await {
            Ok(written) => {
                self.note(Some(written));
                self.lead(term, sent);
                Next::After(self.retry())
            }
            Err(error) => self.failed(&error),
        }
    }

    async fn send(&self, lease: &Lease) -> Result<Lease, CallError> {
        let (api, params) = (self.api.clone(), PostParams::default());
        match lease.metadata.resource_version {
            Some(_) => {
                let replaced = async move { api.replace(&self.settings.name, &params, lease).await };
                self.call("the renewal", replaced).await
            }
            None => {
                self.call("the creation", async move { api.create(&params, lease).await })
                    .await
            }
        }
    }

    /// Bounds a call, also by the moment at which a leader has to know that it has lost.
    async fn call<T>(
        &self,
        what: &'static str,
        call: impl Future<Output = Result<T, kube::Error>>,
    ) -> Result<T, CallError> {
        let limit = self.settings.timing.call.min(self.time_left());
        let object = format!("Lease {}", self.settings.name);
        let answer = call_within(limit, what, &object, call).await;
        if answer.as_ref().err().is_none_or(is_stale) {
            self.telemetry.liveness.answered();
        }
        answer
    }

    fn note(&mut self, lease: Option<Lease>) {
        self.seen
            .note(lease.as_ref().map(Record::read), self.telemetry.clock.since_boot());
        self.lease = lease;
        self.is_fresh = true;
    }

    /// A write that shows us as the leader, sent at `sent`, has succeeded.
    fn lead(&mut self, term: i32, sent: Duration) {
        self.fence.renewed(sent);
        if self.leading.replace(Leading { term, renewed_at: sent }).is_none() {
            let quiet = if self.seen.is_quiet_before(term) {
                Duration::ZERO
            } else {
                self.settings.timing.evalai_quiet
            };
            self.fence.begin(Instant::now() + quiet);
            self.telemetry.metrics.set_leading(Some(term));
            tracing::info!(term, quiet = quiet.as_secs(), lease = self.settings.name, "leading");
            self.publish.send_replace(Leadership::Leader { term });
        }
    }

    fn lose(&mut self, why: &str) {
        self.fence.close();
        self.telemetry.metrics.set_leading(None);
        tracing::error!(lease = self.settings.name, why, "leading no more");
        self.publish.send_replace(Leadership::Lost { why: why.to_owned() });
    }

    fn failed(&self, error: &CallError) -> Next {
        let retry = self.settings.timing.retry;
        let pause = if is_stale(error) {
            // Two candidates that met once are kept from meeting again.
            jittered(retry / 8, 0.1)
        } else {
            self.telemetry.metrics.work.lease_errors.of([error.reason()]).inc();
            tracing::warn!("{error}");
            jittered(retry / 2, 0.1)
        };
        Next::After(pause.min(self.time_left()))
    }

    /// Until a leader is overdue; a standby has all the time.
    fn time_left(&self) -> Duration {
        let Some(leading) = self.leading else {
            return Duration::MAX;
        };
        let deadline = leading.renewed_at + self.settings.timing.renew_deadline;
        deadline.saturating_sub(self.telemetry.clock.since_boot())
    }

    fn retry(&self) -> Duration {
        jittered(self.settings.timing.retry, 0.1)
    }

    async fn hand_over(&mut self) {
        if let Some(leading) = self.leading {
            self.release(leading.term).await;
        }
        self.telemetry.metrics.set_leading(None);
        self.publish.send_replace(Leadership::Standby);
    }

    async fn release(&mut self, term: i32) {
        for _ in 0..RELEASE_TRIES {
            match self.try_release(term).await {
                Ok(()) => return tracing::info!(term, lease = self.settings.name, "released the Lease"),
                Err(error) => {
                    tracing::warn!("{error}; until a try succeeds, the next leader waits for the Lease to expire");
                }
            }
        }
    }

    async fn try_release(&mut self, term: i32) -> Result<(), CallError> {
        // The renewal deadline no longer bounds a call: the fence is closed.
        self.leading = None;
        self.look().await?;
        let me = self.settings.identity.as_str();
        let is_ours = self
            .seen
            .record
            .as_ref()
            .is_some_and(|r| r.holder.as_deref() == Some(me) && r.term == term);
        let Some(lease) = self.lease.take().filter(|_| is_ours) else {
            return Ok(());
        };
        self.send(&released(lease, self.telemetry.clock.now()))
            .await
            .map(|_| ())
    }
}

/// Somebody else was quicker, or the Lease is gone: look again.
fn is_stale(error: &CallError) -> bool {
    error.is_conflict() || error.is_gone()
}
