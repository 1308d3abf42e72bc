//! Which replica leads: a Lease of our own, and the fence that writes ask.
//!
//! `main` starts it once; every writer to EvalAI, DynamoDB or Kubernetes asks `Fence::may_write` right before. `decide` is pure,
//! `record` translates between Leases and what `decide` reads, `elector` does the calls. Knows no Submission.
//!
//! The promise: at any moment at most one process may write, also when processes are paused, answers are lost and
//! clocks disagree. A process that has led leads no second time: `Leadership::Lost` has to end it.

pub mod decide;
mod elector;
pub mod fence;
pub mod record;

#[cfg(test)]
pub(crate) mod tests;

use std::time::Duration;

use tokio::sync::{oneshot, watch};
use tokio::task::JoinHandle;
use tokio::time::Instant;

pub use fence::Fence;
pub use record::Identity;

use crate::observability::Observability;

/// Times of the election.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Timing {
    /// A Lease that has not changed for so long may be taken from its holder. Whole seconds.
    pub lease: Duration,
    /// A leader that has not renewed for so long is none. Well below `lease`.
    pub renew_deadline: Duration,
    /// Between renewals, and between a standby's looks.
    pub retry: Duration,
    /// Any one call.
    pub call: Duration,
    /// EvalAI may work for so long on what a leader before has sent.
    pub evalai_quiet: Duration,
}

impl Default for Timing {
    fn default() -> Self {
        Self {
            lease: Duration::from_secs(15),
            renew_deadline: Duration::from_secs(10),
            retry: Duration::from_secs(2),
            call: Duration::from_secs(5),
            evalai_quiet: Duration::from_secs(75),
        }
    }
}

/// Settings of an election.
#[derive(Clone, Debug)]
pub struct Settings {
    /// The operator's own namespace.
    pub namespace: String,
    /// Name of the Lease.
    pub name: String,
    pub identity: Identity,
    pub timing: Timing,
}

impl Settings {
    /// The usual times.
    pub fn new(namespace: &str, name: &str, identity: Identity) -> Self {
        Self {
            namespace: namespace.to_owned(),
            name: name.to_owned(),
            identity,
            timing: Timing::default(),
        }
    }

    /// Name of the installation that stands for leader: all its replicas share the Lease.
    pub fn installation(&self) -> String {
        format!("{}/{}", self.namespace, self.name)
    }
}

/// Where this process stands.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Leadership {
    /// Another process leads, or no leader is known.
    Standby,
    /// This process leads.
    Leader {
        /// Grows with every change of leaders.
        term: i32,
    },
    /// It led and does no more: stop starting work and exit with an error.
    Lost { why: String },
}

impl Leadership {
    /// The term, while it leads.
    pub fn term(&self) -> Option<i32> {
        match self {
            Self::Leader { term } => Some(*term),
            Self::Standby | Self::Lost { .. } => None,
        }
    }
}

/// The part of an election that other parts hold.
#[derive(Debug)]
pub struct Leader {
    leadership: watch::Receiver<Leadership>,
    fence: Fence,
    release: oneshot::Sender<()>,
    task: JoinHandle<Option<()>>,
}

/// A client for the Lease alone: no retries of its own, since the election decides what is tried again.
///
/// # Errors
/// If the configuration holds no usable TLS or credentials.
pub fn lease_client(mut config: kube::Config) -> Result<kube::Client, kube::Error> {
    config.default_retry = false;
    let limit = Timing::default().call;
    config.connect_timeout = Some(limit);
    config.read_timeout = Some(limit);
    config.write_timeout = Some(limit);
    kube::Client::try_from(config)
}

/// Starts to stand for leader. `client` is one from `lease_client`.
pub fn start(client: kube::Client, settings: Settings, telemetry: &Observability) -> Leader {
    let (publish, leadership) = watch::channel(Leadership::Standby);
    let (release, released) = oneshot::channel();
    let fence = Fence::new(telemetry.clock.clone(), settings.timing.renew_deadline);
    let elector = elector::Elector::new(client, settings, publish, fence.clone(), telemetry);
    // Its orderly end means that the Lease is lost or released.
    let task = telemetry.tasks.may_end("lease", elector.run(released));
    Leader {
        leadership,
        fence,
        release,
        task,
    }
}

impl Leader {
    /// Where this process stands, now and later. `Lost` is the last value.
    pub fn leadership(&self) -> watch::Receiver<Leadership> {
        self.leadership.clone()
    }

    /// Fence that writers ask.
    pub fn fence(&self) -> Fence {
        self.fence.clone()
    }

    /// Hands the Lease over: closes the fence and clears the holder, so that the successor writes at once. The last thing a stopping
    /// process does, and only if EvalAI has answered all its writes; bounded by a few calls. A standby, or a process that has lost the
    /// Lease, has nothing to release.
    pub async fn release(self) {
        self.fence.close();
        if self.fence.evalai_not_before().is_some_and(|at| Instant::now() < at) {
            // The leader before may have left a write under way, for which the next one waits only if the Lease expires.
            return;
        }
        // The election ends by itself only when the Lease is lost.
        let _ = self.release.send(());
        let _ = self.task.await;
    }
}
