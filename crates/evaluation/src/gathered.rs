//! The state of a run's results after one round. Plain data, for every kind of evaluation.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

use bytes::Bytes;
use leaderboard_api::{Metric, WorkerState};
use leaderboard_contract::keys::EVALAI;
use leaderboard_contract::report::{Outcome, RefusedResults, ReportWorker, StoredFile};
use leaderboard_protocol::files::{Host, Pair, Progress};
use sha2::{Digest, Sha256};

use crate::judge::Ending;

/// Why a plan cannot be evaluated, and what to do.
#[derive(thiserror::Error, Clone, Debug, PartialEq, Eq)]
#[error("{problem}. {next_step}")]
pub struct Refused {
    pub problem: String,
    pub next_step: String,
}

/// One worker, as its status files show it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct WorkerSeen {
    /// From its agent's folder; `None` for a worker without one. An agent that runs before all evaluators is the first worker's.
    pub agent: Option<Progress>,
    /// From its host's folder.
    pub host: Progress,
    /// The side with the last word on the results is done.
    pub done: bool,
}

impl WorkerSeen {
    pub(crate) fn read(status: &Path, pair: Pair, kind: Host, has_agent: bool) -> Self {
        let agent = has_agent.then(|| Progress::read(status, pair.agent()));
        let host = Progress::read(status, pair.host(kind));
        let done = match kind {
            Host::Simulator => agent.is_some_and(|agent| agent.done),
            Host::Evaluator => host.done,
        };
        Self { agent, host, done }
    }

    /// True if one of its containers has begun, and may be running.
    pub fn has_started(&self) -> bool {
        self.host.started || self.agent.is_some_and(|agent| agent.started)
    }

    /// `Waiting`, `Running`, `Done` or `Crashed`; the last means between a crash and the next start.
    pub fn state(&self) -> WorkerState {
        // One that is done says nothing of an evaluator that starts after it.
        let agent = self.agent.filter(|agent| !agent.done).unwrap_or_default();
        match self {
            Self { done: true, .. } => WorkerState::Done,
            Self { host, .. } if agent.started || host.started => WorkerState::Running,
            Self { host, .. } if agent.crashes.max(host.crashes) > 0 => WorkerState::Crashed,
            _ => WorkerState::Waiting,
        }
    }

    /// Number of crashes of the side that had more, the agent's or the host's.
    pub fn crashes(&self) -> u32 {
        let of_agent = self.agent.map_or(0, |agent| agent.crashes);
        of_agent.max(self.host.crashes)
    }
}

/// A result that is stored from memory. Its content is shared, never copied.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Object {
    /// Its content.
    pub bytes: Bytes,
    /// Size and digest of it.
    pub digest: StoredFile,
}

impl Object {
    /// With its digest.
    pub fn new(bytes: impl Into<Bytes>) -> Self {
        let bytes = bytes.into();
        let digest = StoredFile {
            size: bytes.len() as u64,
            sha256: hex::encode(Sha256::digest(&bytes)),
        };
        Self { bytes, digest }
    }
}

/// Results by their keys below the run's prefix.
pub type Objects = BTreeMap<String, Object>;

/// The results so far in numbers.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Summary {
    /// Units of work done.
    pub done: u32,
    /// Over the units done so far; over all of them once `is_complete`.
    pub score: Option<Metric>,
    /// Further numbers, over the same units.
    pub metrics: Vec<Metric>,
    /// No unit of the plan is missing.
    pub is_complete: bool,
    /// Every evaluator has come to its regular end.
    pub has_ended: bool,
    /// The results count.
    pub eligible: bool,
    /// How the run ended.
    pub outcome: Outcome,
    /// Scores that do not follow from what was recorded, one sentence each.
    pub warnings: Vec<String>,
}

/// The texts that EvalAI gets as a result.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Texts {
    /// JSON of the metrics; zeros or an empty list until the results are complete.
    pub results: String,
    /// JSON of the metrics so far. `None` before the first unit, and once the results are complete.
    pub partial_results: Option<String>,
}

/// The findings of one round.
#[derive(Clone, Debug)]
pub struct Gathered {
    /// The last good merge; `None` before the first results.
    pub merged: Option<Arc<Summary>>,
    /// EvalAI's short texts, of the same merge.
    pub texts: Arc<Texts>,
    /// The last good results, the merged file and EvalAI's texts, as they are to be stored.
    pub objects: Objects,
    /// Each worker from its status files.
    pub seen: Vec<WorkerSeen>,
    /// Each worker for the report.
    pub workers: Vec<ReportWorker>,
    /// Why each worker's results are refused, if they are, as the end that follows from it.
    pub refused: Vec<Option<Ending>>,
    /// How the run ends if a worker has come to its end as it is now; `None` for one whose results are complete.
    pub if_ended: Vec<Option<Ending>>,
    /// True for a worker whose results this node can't read at present.
    pub unreadable: Vec<bool>,
    /// The end that follows if the workers' results together can't be merged.
    pub unmerged: Option<Ending>,
}

impl Gathered {
    /// The participant's first results that are refused; none once nothing is missing, since what came later changes nothing.
    pub fn first_refused(&self) -> Option<RefusedResults> {
        self.faults().find_map(|ending| match ending {
            Ending::Invalid(refused) => Some(refused.clone()),
            Ending::Unusable(_) | Ending::Complete | Ending::Stopped(_) => None,
        })
    }

    /// Results of the host's evaluators that can't be used.
    pub fn unusable(&self) -> impl Iterator<Item = &RefusedResults> {
        self.faults().filter_map(|ending| match ending {
            Ending::Unusable(refused) => Some(refused),
            Ending::Invalid(_) | Ending::Complete | Ending::Stopped(_) => None,
        })
    }

    fn faults(&self) -> impl Iterator<Item = &Ending> {
        let all = self.refused.iter().flatten().chain(&self.unmerged);
        all.filter(|_| !self.is_complete())
    }

    /// True if no unit of the plan is missing. The last good files decide, whatever the agents report.
    pub fn is_complete(&self) -> bool {
        self.unmerged.is_none() && self.merged.as_ref().is_some_and(|merged| merged.is_complete)
    }

    /// True if every evaluator has come to its regular end. An evaluator whose host crashed in its last unit has a record
    /// of every unit, but no end. It repeats that unit if it is restarted.
    pub fn has_ended(&self) -> bool {
        self.merged.as_ref().is_some_and(|merged| merged.has_ended)
    }

    /// Digests of EvalAI's texts, by key.
    pub fn digests(&self) -> BTreeMap<String, StoredFile> {
        let texts = self.objects.iter().filter(|(key, _)| key.starts_with(EVALAI));
        texts
            .map(|(key, object)| (key.clone(), object.digest.clone()))
            .collect()
    }
}
