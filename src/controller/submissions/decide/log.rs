//! Which log explains a failure: the places where its tail may be had, the best first. Pure.
//!
//! Called by `stop`, while the Pod is still there, and by `publish`. An agent's log is in S3, where logcopy stores it; the
//! others are on the node alone, and only as long as their Pod lives.

use std::time::Duration;

use super::cause;
use super::plan::Action;
use super::status::PlanBuilder;
use super::waits::Wait;
use crate::controller::submissions::view::{LogAt, LogPlace, ObservedLog, PodView};
use leaderboard_api::{FailureClass, SubmissionStatus, conditions, names, reasons};
use leaderboard_contract::keys::agent_log;
use leaderboard_contract::run::console;
use leaderboard_protocol::files::Pair;

/// Requests the log of a run that is being stopped for a failure, as far as the end of its Pod would take it away. Returns how
/// long that end waits for it.
pub(super) fn keep_while_there(draft: &mut PlanBuilder<'_>) -> Option<Duration> {
    if draft.is_cancelled() {
        return None;
    }
    let mut places = places(&draft.status, draft.view.pod.as_ref());
    // What is in S3 is complete only when the Pod has ended; it is read then, and the best place first.
    if !places.first().is_some_and(is_on_node) {
        return None;
    }
    places.retain(is_on_node);
    draft.act(Action::KeepLog { places });
    left(draft.view.log, Wait::LOG.left(Duration::ZERO))
}

/// How long a log is still waited for; `at_first`: while nobody has been asked for it.
fn left(log: ObservedLog, at_first: Option<Duration>) -> Option<Duration> {
    match log {
        ObservedLog::NotRequested => at_first,
        ObservedLog::Pending(waited) => Wait::LOG.left(waited),
        ObservedLog::Kept | ObservedLog::None | ObservedLog::GivenUp => None,
    }
}

/// Requests the log of a run that has failed, until EvalAI's answer to the end is known: its hosts read it there. Returns how
/// long EvalAI waits for it.
pub(super) fn keep_at_end(draft: &mut PlanBuilder<'_>) -> Option<Duration> {
    let before = draft.view.submission.status.as_ref();
    let has_just_ended = !before.is_some_and(SubmissionStatus::has_ended);
    let is_published = before.is_some_and(|s| s.is_delivered(conditions::PUBLISHED));
    let is_answered = draft.view.evalai.as_ref().is_some_and(|e| e.end.is_some());
    let is_awaited = draft.spec().evalai.is_some() && !is_published && !is_answered;
    if is_awaited || (has_just_ended && !is_answered) {
        let places = places(&draft.status, draft.view.pod.as_ref());
        if !places.is_empty() {
            draft.act(Action::KeepLog { places });
            // What is known is of the time before the end.
            let log = if has_just_ended {
                ObservedLog::NotRequested
            } else {
                draft.view.log
            };
            return left(log, Wait::LOG.left(Duration::ZERO));
        }
    }
    left(draft.view.log, None).filter(|_| !has_just_ended)
}

fn is_on_node(place: &LogPlace) -> bool {
    matches!(place.at, LogAt::Node { .. })
}

/// The places of the log that explains the failure of a status.
fn places(status: &SubmissionStatus, pod: Option<&PodView>) -> Vec<LogPlace> {
    let Some(failure) = &status.failure else {
        return Vec::new();
    };
    let id = failure.worker.unwrap_or_else(|| unfinished(status));
    let Some(pair) = u16::try_from(id).ok().and_then(Pair::new) else {
        return Vec::new();
    };
    let (agent, host) = (pair.agent().to_string(), pair.host().to_string());
    let on_node = |container: &str| pod.and_then(|pod| on_node(pod, container));
    let found = match failure.reason.as_str() {
        reasons::SIMULATION_CRASHED => vec![on_node(&host), Some(stored(&host, console(pair)))],
        reasons::START_DEADLINE => vec![pod.and_then(cause::failing_before_agents).and_then(on_node)],
        reasons::RESULTS_NOT_STORED | reasons::JOB_FAILED => vec![
            on_node(names::CONTAINER_LOGCOPY),
            Some(stored(
                names::CONTAINER_LOGCOPY,
                leaderboard_contract::keys::OWN_LOG.into(),
            )),
        ],
        // It never ran.
        reasons::IMAGE_INVALID
        | reasons::IMAGE_NOT_FOUND
        | reasons::IMAGE_PLATFORM
        | reasons::IMAGE_PULL
        | reasons::IMAGE_CHANGED
        | reasons::CONTAINER_CONFIG => Vec::new(),
        reasons::DISK_FULL => vec![Some(stored(&agent, agent_log(pair))), on_node(&agent)],
        _ if failure.class == FailureClass::Participant => vec![Some(stored(&agent, agent_log(pair))), on_node(&agent)],
        _ => Vec::new(),
    };
    found.into_iter().flatten().collect()
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
    let found = pod.containers.iter().find(|c| c.name == container)?;
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
