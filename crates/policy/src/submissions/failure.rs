//! Failures: a class, a reason, one sentence and the next step for hosts and for participants.
//!
//! No text for a participant names a file, an object or a machine of the hosts.

use super::workers::{agents_beside, cause_of, pair_with};
use crate::report_digest::{ReportDigest, clamp};
use crate::view::ObservedNode;
use leaderboard_api::text::sentence;
use leaderboard_api::{Agents, EndReason, Failure, FailureClass, Reason, SubmissionStatus, WorkerStatus, reasons};
use leaderboard_contract::keys::{REFUSED, result_path};
use leaderboard_contract::report::{Outcome, RefusedResults};
use leaderboard_evaluation::{Words, words};

/// A failure that is the participant's: `what` happened, in one sentence, and what both readers can do about it.
pub(super) fn participant(reason: Reason, what: &str, step: &str) -> Failure {
    Failure {
        class: FailureClass::Participant,
        reason: reason.into(),
        message: format!("{what} {step}"),
        next_step: Some(step.to_owned()),
        participant_message: None,
        worker: None,
    }
}

/// A participant's failure about which participants do something else than hosts.
fn apart(reason: Reason, what: &str, of_hosts: &str, of_participants: &str) -> Failure {
    Failure {
        participant_message: Some(format!("{what} {of_participants}")),
        ..participant(reason, what, of_hosts)
    }
}

/// A participant's failure with the next step of the table of reasons, which both readers can take.
pub(super) fn charged(reason: Reason, what: &str) -> Failure {
    participant(reason, what, &of_participant(reason))
}

/// A failure that is not: `what` happened, in one sentence for hosts. As long as another Job may follow there is no next step.
pub(super) fn infrastructure(reason: Reason, what: &str) -> Failure {
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
            let step = of_infrastructure(&found);
            Failure {
                message: format!("{} {step}", found.message).trim_end().to_owned(),
                next_step: Some(step.clone()).filter(|step| !step.is_empty()),
                ..found
            }
        }
    }
}

/// The files that an agent has left cannot be taken. `what` says what the participant does, too.
pub(super) fn input_refused(what: &str) -> Failure {
    let of_hosts = "Look at agent/agent1/leaderboard.log of the results.";
    let of_participants = "The challenge's hosts have the agent's log.";
    apart(Reason::InputInvalid, what, of_hosts, of_participants)
}

pub(super) fn job_deleted() -> Failure {
    infrastructure(Reason::JobDeleted, "The Job was deleted repeatedly by somebody else.")
}

pub(super) fn job_expired() -> Failure {
    infrastructure(
        Reason::JobExpired,
        "The Job ended and was removed after its time to live, and nobody had read its end; what was stored is kept.",
    )
}

pub(super) fn node_lost(node: Option<&str>, node_state: ObservedNode, words: &Words) -> Failure {
    let node = node.map_or_else(|| "The node of the Pod".to_owned(), |node| format!("Node {node}"));
    let what = if node_state == ObservedNode::Reports {
        "did not end its Pod within its grace"
    } else {
        "was lost and its Pod with it"
    };
    let what = format!("{node} {what}; finished {} are kept.", words.units);
    infrastructure(Reason::NodeLost, &what)
}

pub(super) fn time_limit(seconds: i64, words: &Words) -> Failure {
    let what = format!(
        "The run took longer than {seconds} s and was stopped; finished {} are kept.",
        words.units
    );
    charged(Reason::TimeLimit, &what)
}

/// The evaluators are the hosts' own, and so is the time that they take.
pub(super) fn evaluators_late(seconds: i64, words: &Words) -> Failure {
    let what = format!(
        "The evaluators had not finished after the {seconds} s of deadlines.runSeconds; finished {} are kept.",
        words.units
    );
    infrastructure(Reason::EvaluatorFailed, &what)
}

pub(super) fn results_not_stored() -> Failure {
    infrastructure(
        Reason::ResultsNotStored,
        "The Pod ended before its final results were stored; what was stored is kept.",
    )
}

pub(super) fn invalid_results(refused: &RefusedResults, words: &Words) -> Failure {
    let what = format!("The results cannot be used: {}", sentence(&refused.why));
    Failure {
        worker: refused.worker.map(clamp),
        ..participant(Reason::InvalidResults, &what, words.after_refused)
    }
}

/// Results that the host's own evaluator has spoiled.
pub(super) fn unusable_results(found: &RefusedResults) -> Failure {
    let worker = found.worker.map(clamp);
    let kept = worker.and_then(pair_with).map(|pair| {
        let path = result_path(pair);
        format!(" A file that cannot be used is kept at {REFUSED}{path}.")
    });
    let what = sentence(&capitalized(&found.why)) + &kept.unwrap_or_default();
    Failure {
        worker,
        ..infrastructure(Reason::EvaluatorFailed, &what)
    }
}

/// Results that are complete but do not count.
pub(super) fn not_eligible(report: &ReportDigest, status: &SubmissionStatus) -> Failure {
    if report.outcome == Outcome::Crashed {
        return named_crash(report, status);
    }
    let what = format!("The run ended as {}, so its results do not count.", report.outcome);
    let step = words(status.plan.as_ref()).after_rejected;
    participant(Reason::NotEligible, &what, step)
}

/// Results that name a crash of the simulation. The agent writes them, and knows its score by then, so a crash that no host's container had is
/// its own. Evaluators repeat the route of a crash; one that does not keeps its record over the Jobs of an attempt.
fn named_crash(report: &ReportDigest, status: &SubmissionStatus) -> Failure {
    let words = words(status.plan.as_ref());
    let named = report.workers.iter().filter(|worker| worker.names_crash);
    let mut named = named.map(|worker| clamp(worker.id));
    let first = named.clone().next();
    let has_failed = |id: i32| {
        let mut workers = status.workers.iter();
        workers.any(|worker| worker.id == id && worker.environment_failed)
    };
    if let Some(id) = named.find(|id| !has_failed(*id)) {
        let what = format!(
            "The results of pair {id} name a crash of the simulation that its {} did not have.",
            words.host
        );
        return Failure {
            worker: Some(id),
            ..participant(Reason::InvalidResults, &what, words.after_refused)
        };
    }
    // One of an older operator's Pod names no pair.
    Failure {
        worker: first,
        ..infrastructure(
            Reason::SimulationCrashed,
            &format!(
                "The simulation crashed during a {}, so the results do not count.",
                words.unit
            ),
        )
    }
}

/// The failure of the pair that has crashed most.
pub(super) fn worst(status: &SubmissionStatus) -> Option<Failure> {
    let crashed = status.workers.iter().filter(|p| p.crashes > 0 && p.last.is_some());
    let worker = crashed.max_by_key(|p| p.crashes)?;
    Some(of_worker(worker, cause_of(worker)?, status))
}

/// True if what looked like crashes were runs to the end whose checkpoint is refused: an agent that ends by itself without
/// results that can be read is tried again as one that crashed.
pub(super) fn is_refusal(status: &SubmissionStatus, found: &Failure, report: &ReportDigest) -> bool {
    let by_itself = |worker: &WorkerStatus| matches!(cause_of(worker), Some(EndReason::Exited | EndReason::Incomplete));
    let is_of_results = found.reason.is_one_of(&[Reason::AgentCrashed, Reason::InvalidResults]);
    is_of_results && status.workers.iter().any(by_itself) && report.is_verdict() && report.refused.is_some()
}

pub(super) fn of_worker(worker: &WorkerStatus, cause: EndReason, status: &SubmissionStatus) -> Failure {
    let (id, node, words) = (worker.id, status.node_name.as_deref(), words(status.plan.as_ref()));
    let agents = agents_beside(status, id);
    let times = match worker.crashes {
        1 => "once".to_owned(),
        crashes => format!("{crashes} times"),
    };
    let failure = if let Some((reason, what)) = of_node(id, &times, (cause, node), (agents, words)) {
        infrastructure(reason, &what)
    } else if let Some((reason, what)) = of_host(cause, agents) {
        let what = format!("The {} of {} {id} failed {times}: {what}.", words.host, words.worker);
        infrastructure(reason, &what)
    } else {
        of_agent(id, &times, cause, words)
    };
    Failure {
        worker: Some(id),
        ..failure
    }
}

/// The node's fault: it cannot draw, or start an agent.
fn of_node(
    id: i32,
    times: &str,
    (cause, node): (EndReason, Option<&str>),
    (agents, words): (Agents, &Words),
) -> Option<(Reason, String)> {
    let Words { host, worker, .. } = words;
    let node = node.map_or_else(|| "the node".to_owned(), |node| format!("node {node}"));
    match cause {
        EndReason::NoGPU => Some((
            Reason::NoGPU,
            format!(
                "{} {id} lacks a GPU on {node}, although the Leaderboard gives it one: {}",
                capitalized(worker),
                match agents {
                    Agents::Beside => format!("its {host} or its agent saw none. The {host}'s log says which."),
                    Agents::First => format!("its agent or its {host} saw none."),
                    Agents::Absent => format!("its {host} saw none."),
                }
            ),
        )),
        EndReason::GraphicsDriverMissing => Some((
            Reason::GraphicsDriverMissing,
            format!(
                "The {host} of {worker} {id} had a GPU and could not draw: the NVIDIA driver of {node} has no Vulkan/OpenGL part \
                 (nvidia_icd.json)."
            ),
        )),
        EndReason::NodeCannotStart => Some((
            Reason::NodeCannotStart,
            format!(
                "The container of agent {id} could not be started {times} on {node}; nothing of its image is the cause."
            ),
        )),
        EndReason::EndedFromOutside => Some((
            Reason::JobFailed,
            format!("The containers of {worker} {id} were ended from outside the Pod on {node}."),
        )),
        _ => None,
    }
}

/// The end of the host's container, if that was the cause.
pub(super) fn of_host(cause: EndReason, agents: Agents) -> Option<(Reason, &'static str)> {
    let (reason, what) = match cause {
        EndReason::SimulatorCrashed => (Reason::SimulationCrashed, "it crashed"),
        EndReason::SimulatorNotReady => (Reason::SimulationCrashed, "it was not ready in time"),
        EndReason::SimulatorSilent => (Reason::SimulationCrashed, "its server did not answer any more"),
        EndReason::SimulatorNotStarted => (Reason::SimulationCrashed, NOT_STARTED),
        EndReason::EvaluatorCrashed => (Reason::EvaluatorFailed, "it ended without a final result"),
        EndReason::EvaluatorNotReady if agents == Agents::Beside => (
            Reason::EvaluatorFailed,
            "it did not listen on its port in time, or had no final result in time",
        ),
        EndReason::EvaluatorNotReady => (Reason::EvaluatorFailed, "it had no final result in time"),
        EndReason::EvaluatorNotStarted => (Reason::EvaluatorFailed, NOT_STARTED),
        _ => return None,
    };
    Some((reason, what))
}

const NOT_STARTED: &str = "its container could not be started";

fn of_agent(id: i32, times: &str, cause: EndReason, words: &Words) -> Failure {
    let host = words.host;
    match cause {
        EndReason::OutOfMemory => apart(
            Reason::OutOfMemory,
            &format!("Agent {id} crashed {times}, the last time for lack of memory."),
            &of_participant(Reason::OutOfMemory),
            "Reduce the memory it uses and submit again; ask the challenge's hosts for the limit.",
        ),
        EndReason::Idle => {
            let what =
                format!("Agent {id} ended too early {times}, the last time because it printed nothing for too long.");
            in_the_log_of(id, Reason::Idle, &what, words)
        }
        EndReason::Incomplete => {
            let what = format!(
                "Agent {id} ended by itself {times} without complete results: its checkpoint is missing, malformed or has \
                 no global record."
            );
            in_the_log_of(id, Reason::InvalidResults, &what, words)
        }
        EndReason::CannotStart | EndReason::StartError => charged(
            Reason::CannotStart,
            &format!("Agent {id} could not be started: its command is missing in the image or not for this machine."),
        ),
        EndReason::NoProcess => participant(
            Reason::AgentCrashed,
            &format!(
                "{} {id} failed {times}: the agents left the Pod no process to start it again.",
                capitalized(words.worker)
            ),
            "Let the agents start fewer processes and threads, and submit again.",
        ),
        EndReason::BlamesHost => participant(
            Reason::AgentCrashed,
            &format!("Agent {id} ended {times} and blamed its {host}, which had not failed."),
            "Leave the files of the evaluator's runner alone, and submit again.",
        ),
        EndReason::PortTaken => participant(
            Reason::AgentCrashed,
            &format!("Another container of the Pod listened on the port of {host} {id}, which failed {times}."),
            &format!(
                "Let the agents listen on no port of {} {host}, and submit again.",
                article(host)
            ),
        ),
        _ => in_the_log_of(id, Reason::AgentCrashed, &format!("Agent {id} crashed {times}."), words),
    }
}

/// The log of an agent explains what happened. Only hosts can read it.
fn in_the_log_of(agent: i32, reason: Reason, what: &str, words: &Words) -> Failure {
    let of_hosts = of_participant(Reason::AgentCrashed).replace("<n>", &agent.to_string());
    let of_participants = format!(
        "Reproduce it on {} of your own, fix the agent and submit again; the challenge's hosts have its log.",
        words.practice
    );
    apart(reason, what, &of_hosts, &of_participants)
}

/// The next step of the table of reasons.
fn of_participant(reason: Reason) -> String {
    reasons::plain(reason.next_step())
}

/// The host's next step after a failure of the infrastructure that no retry has ended.
fn of_infrastructure(found: &Failure) -> String {
    let step = match found.reason.known() {
        // The text of `workspace` has the step before this one.
        Some(Reason::NotIsolated) => "Then resume the submission.",
        Some(reason) => reason.after_failure(),
        None => "Fix this, then resume the submission.",
    };
    let step = reasons::plain(step);
    match found.worker {
        Some(worker) => step.replace("<n>", &worker.to_string()),
        None => step,
    }
}

/// All that a participant reads of a failure of the infrastructure.
fn infrastructure_for_participants(reason: Reason) -> String {
    let what = match reason {
        Reason::ImagePull => "An image could not be pulled.",
        Reason::NodeLost => "The machine that ran the submission was lost.",
        Reason::NodeInterrupted => "The machine that ran the submission was taken away.",
        Reason::ResultsNotStored => "The results could not be stored.",
        Reason::SimulationCrashed => "The simulation crashed.",
        Reason::EvaluatorFailed => "The challenge's evaluator failed.",
        Reason::NoGPU => "The machine that ran the submission had no GPU for it.",
        Reason::NodeCannotStart => "The machine that was to run the submission could not start it.",
        Reason::DiskFull => "The run's disk was full.",
        Reason::GraphicsDriverMissing => "The machine that ran the submission had no driver for its simulation.",
        Reason::StartDeadline => "The run could not be started in time.",
        Reason::ScheduleDeadline => "No machine was free for the submission in time.",
        Reason::JobDeleted | Reason::JobExpired | Reason::JobFailed => "The cluster ended the run.",
        Reason::PhaseDiffers => "The submission's phase in EvalAI is not the one it was submitted to.",
        Reason::NotIsolated => "The run could not be isolated from the network.",
        Reason::InputMissing => "The submitted file could not be read.",
        _ => "The run could not be set up.",
    };
    format!(
        "{what} Your submission is not the cause. Ask the challenge's hosts to resume the submission, or submit again."
    )
}

/// Words at the beginning of a sentence.
fn capitalized(words: &str) -> String {
    let mut letters = words.chars();
    let first = letters.next().map(|first| first.to_ascii_uppercase());
    first.into_iter().chain(letters).collect()
}

/// The article before a word of a kind of evaluation.
fn article(word: &str) -> &'static str {
    if word.starts_with(['a', 'e', 'i', 'o', 'u']) {
        "an"
    } else {
        "a"
    }
}
