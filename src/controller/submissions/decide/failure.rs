//! Failures: from what was observed of Jobs, Pods and results to a class, a reason and one sentence.
//!
//! Called by the stages of `decide`. The class shows whose failure it is; only a participant's is charged. Those of crashed
//! workers are in `crashes`.

use super::next_steps::{Steps, for_both, infrastructure_for_participants, of_infrastructure, of_participant};
use crate::controller::submissions::report_digest::{ReportDigest, clamp};
use crate::controller::submissions::view::ObservedNode;
use leaderboard_api::text::sentence;
use leaderboard_api::{Failure, FailureClass, WorkerStatus, reasons};
use leaderboard_contract::run::Stop;

/// A failure that is the participant's: `what` happened, in one sentence, and what each reader does about it.
pub(super) fn participant(reason: &str, what: &str, next: &Steps) -> Failure {
    let message = format!("{what} {}", next.hosts);
    let for_participants = format!("{what} {}", next.participant);
    Failure {
        class: FailureClass::Participant,
        reason: reason.into(),
        participant_message: Some(for_participants).filter(|text| *text != message),
        message,
        next_step: Some(next.hosts.clone()),
        worker: None,
    }
}

/// The same with the next step of the table of reasons, which both readers can take.
pub(super) fn charged(reason: &str, what: &str) -> Failure {
    participant(reason, what, &for_both(&of_participant(reason)))
}

/// A failure that is not: `what` happened, in one sentence for hosts. As long as another Job may follow there is no next step.
pub(super) fn infrastructure(reason: &str, what: &str) -> Failure {
    Failure {
        class: FailureClass::Infrastructure,
        reason: reason.into(),
        message: what.to_owned(),
        next_step: None,
        participant_message: Some(infrastructure_for_participants(reason)),
        worker: None,
    }
}

/// A failure that ends its submission: with what a host does about it.
pub(super) fn at_the_end(found: Failure) -> Failure {
    match found.class {
        FailureClass::Participant => found,
        FailureClass::Infrastructure => {
            let step = of_infrastructure(&found.reason);
            Failure {
                message: format!("{} {step}", found.message).trim_end().to_owned(),
                next_step: Some(step.to_owned()).filter(|step| !step.is_empty()),
                ..found
            }
        }
    }
}

/// What was submitted names no image that could ever be pulled.
pub(super) fn image_invalid(what: &str) -> Failure {
    charged(reasons::IMAGE_INVALID, what)
}

pub(super) fn job_deleted() -> Failure {
    infrastructure(reasons::JOB_DELETED, "The Job was deleted repeatedly by somebody else.")
}

pub(super) fn job_expired() -> Failure {
    infrastructure(
        reasons::JOB_EXPIRED,
        "The Job ended and was removed after its time to live, and nobody had read its end; what was stored is kept.",
    )
}

pub(super) fn node_lost(node: Option<&str>, node_state: ObservedNode) -> Failure {
    let node = node.map_or_else(|| "The node of the Pod".to_owned(), |node| format!("Node {node}"));
    let what = if node_state == ObservedNode::Reports {
        "did not end its Pod within its grace"
    } else {
        "was lost and its Pod with it"
    };
    infrastructure(reasons::NODE_LOST, &format!("{node} {what}; finished routes are kept."))
}

pub(super) fn time_limit(seconds: i64) -> Failure {
    let what = format!("The run took longer than {seconds} s and was stopped; finished routes are kept.");
    charged(reasons::TIME_LIMIT, &what)
}

pub(super) fn results_not_stored() -> Failure {
    infrastructure(
        reasons::RESULTS_NOT_STORED,
        "The Pod ended before its final results were stored; what was stored is kept.",
    )
}

pub(super) fn invalid_results(why: &str) -> Failure {
    let what = format!("The results cannot be used: {}", sentence(why));
    Failure {
        worker: pair_named(why),
        ..charged(reasons::INVALID_RESULTS, &what)
    }
}

/// The pair whose checkpoint logcopy speaks of: `pair 2: …` or `pair 2, record …`.
fn pair_named(why: &str) -> Option<i32> {
    let (number, _) = why.strip_prefix("pair ")?.split_once([':', ','])?;
    number.parse().ok()
}

/// Results that are complete but do not count.
pub(super) fn not_eligible(report: &ReportDigest, workers: &[WorkerStatus]) -> Failure {
    if report.entry_status == "Crashed" {
        return named_crash(report, workers);
    }
    let what = format!("The run ended as {}, so its results do not count.", report.entry_status);
    charged(reasons::NOT_ELIGIBLE, &what)
}

/// Results that name a crash of the simulation. The agent writes them, and knows its score by then, so a crash that no host's container had is
/// its own. Evaluators repeat the route of a crash; one that does not keeps its record over the Jobs of an attempt.
fn named_crash(report: &ReportDigest, workers: &[WorkerStatus]) -> Failure {
    let named = report.workers.iter().filter(|worker| worker.names_crash);
    let mut named = named.map(|worker| clamp(worker.id));
    let first = named.clone().next();
    let has_failed = |id: i32| {
        workers
            .iter()
            .any(|worker| worker.id == id && worker.environment_failed)
    };
    if let Some(id) = named.find(|id| !has_failed(*id)) {
        let what = format!("The results of pair {id} name a crash of the simulation that its simulator did not have.");
        return Failure {
            worker: Some(id),
            ..charged(reasons::INVALID_RESULTS, &what)
        };
    }
    // One of an older operator's Pod names no pair.
    Failure {
        worker: first,
        ..infrastructure(
            reasons::SIMULATION_CRASHED,
            "The simulation crashed during a route, so the results do not count.",
        )
    }
}

/// The stop that a failure calls for, or a higher attempt.
pub(super) fn stop_of(failure: Option<&Failure>) -> Stop {
    match failure.map(|failure| failure.reason.as_str()) {
        Some(reasons::TIME_LIMIT) => Stop::RunDeadline,
        // Without a failure it is stopped for a higher attempt.
        Some(reasons::NODE_INTERRUPTED) | None => Stop::Interruption,
        _ => Stop::Retries,
    }
}
