//! Which log explains a failure, and where it may be. Pure.

use super::workers::{agents_of, host_of, pair_with};
use crate::view::{ContainerView, LogAt, LogPlace, PodView};
use leaderboard_api::{Agents, FailureClass, Reason, SubmissionStatus, names};
use leaderboard_contract::keys::{OWN_LOG, agent_log, host_log};
use leaderboard_protocol::files::{Host, Pair};

pub(super) fn is_on_node(place: &LogPlace) -> bool {
    matches!(place.at, LogAt::Node { .. })
}

/// The places of the log that explains the failure of a status.
pub(super) fn log_places(status: &SubmissionStatus, pod: Option<&PodView>) -> Vec<LogPlace> {
    let Some(failure) = &status.failure else {
        return Vec::new();
    };
    let id = failure.worker.unwrap_or_else(|| unfinished(status));
    let Some(pair) = pair_with(id) else {
        return Vec::new();
    };
    let kind = host_of(status);
    let host = pair.host(kind).to_string();
    let (own, own_log) = participants_log(status, kind, pair);
    let on_node = |container: &str| pod.and_then(|pod| on_node(pod, container));
    let found = match failure.reason.known() {
        Some(Reason::SimulationCrashed | Reason::EvaluatorFailed) => {
            vec![on_node(&host), Some(stored(&host, host_log(kind, pair)))]
        }
        Some(Reason::StartDeadline) => vec![pod.and_then(failing_preparation).and_then(on_node)],
        Some(Reason::ResultsNotStored | Reason::JobFailed) => vec![
            on_node(names::CONTAINER_LOGCOPY),
            Some(stored(names::CONTAINER_LOGCOPY, OWN_LOG.into())),
        ],
        // It never ran.
        Some(
            Reason::ImageInvalid
            | Reason::ImageNotFound
            | Reason::ImagePlatform
            | Reason::ImagePull
            | Reason::ImageChanged
            | Reason::ContainerConfig,
        ) => Vec::new(),
        Some(Reason::InputInvalid) if !status.has_run() => Vec::new(),
        Some(Reason::DiskFull) => vec![Some(stored(&own, own_log)), on_node(&own)],
        _ if failure.class == FailureClass::Participant => vec![Some(stored(&own, own_log)), on_node(&own)],
        _ => Vec::new(),
    };
    found.into_iter().flatten().collect()
}

/// The container whose log explains a failure of the participant's, and the key of that log: the evaluator's, where no program of theirs runs.
fn participants_log(status: &SubmissionStatus, kind: Host, pair: Pair) -> (String, String) {
    if agents_of(status) == Agents::Absent {
        return (pair.host(kind).to_string(), host_log(kind, pair));
    }
    let plan = status.plan.as_ref();
    let has_agent = plan.is_none_or(|plan| plan.has_agent(pair.get().into()));
    // One agent runs for all evaluators, and none for a command that merges.
    let pair = if has_agent { pair } else { Pair::new(1).unwrap_or(pair) };
    (pair.agent().to_string(), agent_log(pair))
}

/// The container of the operator's or the hosts' that fails, for which those after it wait.
fn failing_preparation(pod: &PodView) -> Option<&str> {
    let is_failing = |c: &&ContainerView| c.prepares() && c.last.as_ref().is_some_and(|l| l.exit_code != 0);
    pod.containers.iter().find(is_failing).map(|c| c.name.as_str())
}

/// The first worker that has not done all its work: a failure of the whole run is most likely explained by its log.
fn unfinished(status: &SubmissionStatus) -> i32 {
    let mut workers = status.workers.iter();
    workers
        .find(|worker| worker.done < worker.total)
        .map_or(1, |worker| worker.id)
}

fn stored(container: &str, key: String) -> LogPlace {
    LogPlace {
        container: container.into(),
        at: LogAt::Bucket { key },
    }
}

/// None for a container that never ran: it has no log.
fn on_node(pod: &PodView, container: &str) -> Option<LogPlace> {
    let found = pod.container(container)?;
    if !found.running && found.last.is_none() {
        return None;
    }
    let at = LogAt::Node {
        pod: pod.name.clone(),
        previous: found.running && found.last.is_some(),
    };
    Some(LogPlace {
        container: container.into(),
        at,
    })
}
