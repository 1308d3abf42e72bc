//! Causes: from what was seen of containers, Jobs and results to a class, a reason and one sentence with the next step.
//!
//! Called by the stages of `decide`. The class says whose failure it is; only a participant's is charged.

use jiff::Timestamp;
use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;

use super::draft::Draft;
use super::next_steps::{Steps, for_both, in_the_log_of, infrastructure_for_participants, of_infrastructure, smaller};
use crate::controller::archive::digest::ReportDigest;
use crate::controller::view::{ContainerView, EndView, JobEnd, NodeSight, PodView};
use crate::pod::run::Stop;
use leaderboard_api::text::sentence;
use leaderboard_api::{Failure, FailureClass, LastEnd, PairStatus, SubmissionStatus, reasons};

/// A failure that is the participant's: `what` happened, in one sentence, and what each reader does about it.
pub(super) fn participant(reason: &str, what: &str, next: &Steps) -> Failure {
    let message = format!("{what} {}", next.hosts);
    let for_participants = format!("{what} {}", next.participant);
    Failure {
        class: FailureClass::Participant,
        reason: reason.into(),
        participant_message: Some(for_participants).filter(|text| *text != message),
        message,
        charged: true,
        pair: None,
    }
}

/// A failure that is not: `what` happened, in one sentence for hosts; the next step is the reason's.
pub(super) fn infrastructure(reason: &str, what: &str) -> Failure {
    Failure {
        class: FailureClass::Infrastructure,
        reason: reason.into(),
        message: format!("{what} {}", of_infrastructure(reason)).trim_end().to_owned(),
        participant_message: Some(infrastructure_for_participants(reason)),
        charged: false,
        pair: None,
    }
}

/// The message of a failure without the next step, for as long as a retry may fix it.
pub(super) fn what_happened(failure: &Failure) -> String {
    let message = failure.message.as_str();
    let next = of_infrastructure(&failure.reason);
    let what = message
        .strip_suffix(next)
        .filter(|_| failure.class == FailureClass::Infrastructure);
    what.unwrap_or(message).trim_end().to_owned()
}

/// What was submitted names no image that could ever be pulled.
pub(super) fn image_invalid(what: &str) -> Failure {
    let next = for_both("Submit again with an image as in registry.example/team/agent:1.");
    participant(reasons::IMAGE_INVALID, what, &next)
}

pub(super) fn job_deleted() -> Failure {
    infrastructure(reasons::JOB_DELETED, "The Job was deleted repeatedly by somebody else.")
}

pub(super) fn node_lost(node: Option<&str>, sight: NodeSight) -> Failure {
    let node = node.map_or_else(|| "Its node".to_owned(), |node| format!("Node {node}"));
    let what = if sight == NodeSight::Reports {
        "did not end its Pod within its grace"
    } else {
        "was lost and its Pod with it"
    };
    infrastructure(reasons::NODE_LOST, &format!("{node} {what}; finished routes are kept."))
}

pub(super) fn time_limit(seconds: i64) -> Failure {
    let what = format!("The run took longer than {seconds} s and was stopped; finished routes are kept.");
    participant(reasons::TIME_LIMIT, &what, &faster())
}

fn faster() -> Steps {
    for_both("Make the agent faster, or ask the host for more time.")
}

pub(super) fn results_not_stored() -> Failure {
    infrastructure(
        reasons::RESULTS_NOT_STORED,
        "The Pod ended before its final results were stored; what was stored is kept.",
    )
}

pub(super) fn invalid_results(why: &str) -> Failure {
    let what = format!("The results cannot be used: {}", sentence(why));
    let next = for_both("Check what the agent writes into its checkpoint, and submit again.");
    Failure {
        pair: pair_named(why),
        ..participant(reasons::INVALID_RESULTS, &what, &next)
    }
}

/// The pair whose checkpoint logcopy speaks of: `pair 2: …` or `pair 2, record …`.
fn pair_named(why: &str) -> Option<i32> {
    let (number, _) = why.strip_prefix("pair ")?.split_once([':', ','])?;
    number.parse().ok()
}

/// Whether what looked like crashes were runs to the end whose checkpoint is refused: an agent that ends by itself without
/// results that can be read is tried again as one that crashed.
pub(super) fn is_refusal(status: &SubmissionStatus, found: &Failure, report: &ReportDigest) -> bool {
    let by_itself = |pair: &PairStatus| matches!(last_word(pair), Some("exited" | "incomplete"));
    let is_of_results = [reasons::AGENT_CRASHED, reasons::INVALID_RESULTS].contains(&found.reason.as_str());
    is_of_results && status.pairs.iter().any(by_itself) && report.is_final && report.why.is_some()
}

/// Results that are complete but do not count.
pub(super) fn not_eligible(entry_status: &str) -> Failure {
    if entry_status == "Crashed" {
        return infrastructure(
            reasons::SIMULATION_CRASHED,
            "The simulation crashed during a route, so the results do not count.",
        );
    }
    let what = format!("The run ended as {entry_status}, so its results do not count.");
    let next = for_both("Compare the agent's sensors with those the track allows, and submit again.");
    participant(reasons::NOT_ELIGIBLE, &what, &next)
}

/// A Pod that was evicted because the agent's side filled its disk. Another Pod would run into it again.
pub(super) fn disk_full(pod: &PodView) -> Option<Failure> {
    let (reason, message) = pod.ended_by_node.as_ref()?;
    let is_agents = reason == "Evicted" && is_agents_disk(message);
    is_agents.then(|| {
        let what = format!("The Pod was evicted because it filled its disk: {}", sentence(message));
        let next = for_both("Write less to disk or to the log.");
        participant(reasons::DISK_FULL, &what, &next)
    })
}

/// A limit of the Pod, the logs or an agent; not the node's own shortage, nor a limit of the host's containers.
fn is_agents_disk(message: &str) -> bool {
    let signs = [
        "Pod ephemeral local storage usage exceeds",
        "EmptyDir volume \"logs\"",
        "Container agent-",
    ];
    !message.starts_with("The node was low on") && signs.iter().any(|sign| message.contains(sign))
}

/// The stop that a failure calls for.
pub(super) fn stop_of(failure: Option<&Failure>) -> Stop {
    if failure.is_some_and(|f| f.reason == reasons::TIME_LIMIT) {
        Stop::RunDeadline
    } else {
        Stop::Retries
    }
}

/// Remembers how the containers of each pair last ended: their Pod may be gone when the cause is looked for.
pub(super) fn note_ends(status: &mut SubmissionStatus, pod: &PodView) {
    for container in &pod.containers {
        let Some((_, id)) = pair_of(&container.name) else {
            continue;
        };
        let crashes = crashes(container);
        if crashes > 0 {
            let pair = pair_entry(status, id);
            pair.crashes = pair.crashes.max(crashes);
        }
    }
    for pair in &mut status.pairs {
        if let Some(last) = last_end(pod, pair.id) {
            pair.last = Some(last);
        }
    }
}

/// Ends of a container that were crashes. One that has ended counts at once, not only when it is started again.
fn crashes(container: &ContainerView) -> i32 {
    let end = container.last.as_ref().filter(|_| !container.running);
    let is_new = end.is_some_and(|end| end.exit_code != 0 && !is_obedient(end));
    container.restarts.saturating_add(i32::from(is_new))
}

/// It ended because it was told to.
fn is_obedient(end: &EndView) -> bool {
    matches!(end.what.as_deref(), Some("stopped" | "cancelled" | "finished"))
}

/// How a side of a pair last ended.
#[derive(Clone, Copy)]
struct Ended<'a> {
    end: &'a EndView,
    /// Which of its container's lives that was, from 1.
    life: i32,
}

/// How a pair last crashed. Both sides of a round end within moments: a simulator that crashed of itself takes its agent
/// along, whose own word says less then. One that only followed its agent says `peerCrashed`.
fn last_end(pod: &PodView, id: i32) -> Option<LastEnd> {
    let end_of = |wanted: Side| {
        let of_pair = |c: &&ContainerView| pair_of(&c.name).is_some_and(|(side, pair)| side == wanted && pair == id);
        let container = pod.containers.iter().find(of_pair)?;
        let end = container.last.as_ref()?;
        let life = container.restarts.saturating_add(i32::from(!container.running));
        (end.exit_code != 0 && !is_obedient(end)).then_some(Ended { end, life })
    };
    let agent = end_of(Side::Agent);
    let simulator = end_of(Side::Simulator);
    let (word, end) = match (agent, simulator) {
        (Some(agent), Some(simulator)) if blame_each_other(simulator, agent) => (FORGED, agent.end),
        (Some(agent), Some(simulator)) if is_followed(simulator.end, agent.end) => {
            (word(Side::Simulator, simulator.end), simulator.end)
        }
        // The simulator followed a later end of its agent, which is not seen yet.
        (Some(agent), Some(simulator)) if says_peer_crashed(simulator.end) && is_before(agent.end, simulator.end) => {
            (UNSEEN, simulator.end)
        }
        (Some(agent), _) => (word(Side::Agent, agent.end), agent.end),
        (None, simulator) => (word(Side::Simulator, simulator?.end), simulator?.end),
    };
    Some(LastEnd {
        reason: word.into(),
        exit_code: Some(end.exit_code),
        time: end.at.map(Time),
    })
}

/// Whether a simulator that crashed of itself is the last word: it took this agent along, or did so in a later round.
fn is_followed(simulator: &EndView, agent: &EndView) -> bool {
    const SAME_ROUND_SECONDS: i64 = 60;
    let is_long_before = match (simulator.at, agent.at) {
        (Some(simulator), Some(agent)) => agent.duration_since(simulator).as_secs() > SAME_ROUND_SECONDS,
        _ => false,
    };
    // One that was killed without a word is missed only when its container is started again.
    let is_of_agents_round = !is_long_before || says_peer_crashed(agent);
    !says_peer_crashed(simulator) && !is_before(simulator, agent) && is_of_agents_round
}

/// Either side writes down its own crash before the other can see it, so one of them has a cause of its own. Where neither has,
/// the agent has written a crash into its folder of the status files. A life of its own tells the end that is meant: an agent that
/// was killed without a word overlaps with the simulator of the round before, whose next end is still to come.
fn blame_each_other(simulator: Ended<'_>, agent: Ended<'_>) -> bool {
    let is_same_round = !is_before(simulator.end, agent.end) && !is_before(agent.end, simulator.end);
    let both_say_so = says_peer_crashed(simulator.end) && says_peer_crashed(agent.end);
    both_say_so && is_same_round && simulator.life == agent.life
}

fn says_peer_crashed(end: &EndView) -> bool {
    end.what.as_deref() == Some(FOLLOWED)
}

/// Whether a life was over before the other began, and so belongs to an earlier round: those of one round overlap.
fn is_before(end: &EndView, other: &EndView) -> bool {
    end.at.zip(other.began).is_some_and(|(at, began)| at < began)
}

/// Whether a pair has crashed as often as it may, or cannot start at all. A count whose cause is not seen yet waits for it: an
/// agent that followed its simulator is no cause, and the simulator's own end is seen moments later.
pub(super) fn retries_used_up(draft: &Draft<'_>) -> Option<Failure> {
    let limit = draft.retries().per_pair.max(1);
    let crashed = || draft.status.pairs.iter().filter(|p| p.crashes > 0);
    let hopeless = crashed().find(|p| last_word(p) == Some("cannotStart"));
    let worn = crashed().find(|p| p.crashes > limit || (p.crashes == limit && !waits_for_a_word(p, draft.now())));
    let pair = hopeless.or(worn)?;
    Some(of_pair(pair.id, pair.crashes, last_word(pair)?))
}

/// The word for an agent's crash that only its simulator has told of: the agent's own end is seen moments later.
const UNSEEN: &str = "unseen";
/// The word for an agent's end whose simulator's is not seen yet.
const FOLLOWED: &str = "peerCrashed";
/// The word for a crash that an agent has made up.
const FORGED: &str = "forged";
/// How long the other side's own word is waited for: more than a container has for its end. It may never come.
const WORD_SECONDS: i64 = 120;

fn waits_for_a_word(pair: &PairStatus, now: Timestamp) -> bool {
    let is_no_cause = last_word(pair).is_some_and(|word| [UNSEEN, FOLLOWED].contains(&word));
    let time = pair.last.as_ref().and_then(|last| last.time.as_ref());
    is_no_cause && time.is_some_and(|time| now.duration_since(time.0).as_secs().abs() < WORD_SECONDS)
}

fn last_word(pair: &PairStatus) -> Option<&str> {
    pair.last.as_ref().map(|last| last.reason.as_str())
}

/// The failure of a Job that ended without final results.
pub(super) fn of_job(status: &SubmissionStatus, end: &JobEnd, pod: Option<&PodView>) -> Failure {
    if let Some(failure) = pod.and_then(disk_full) {
        return failure;
    }
    match end {
        JobEnd::Complete { .. } => results_not_stored(),
        JobEnd::Failed { reason, .. } if reason == "DeadlineExceeded" => participant(
            reasons::TIME_LIMIT,
            "The Pod reached its time limit; finished routes are kept.",
            &faster(),
        ),
        JobEnd::Failed { reason, message, .. } => worst_pair(status).unwrap_or_else(|| {
            let what = format!("Its Job failed with {reason}: {}", sentence(message));
            infrastructure(reasons::JOB_FAILED, &what)
        }),
    }
}

fn worst_pair(status: &SubmissionStatus) -> Option<Failure> {
    let crashed = status.pairs.iter().filter(|p| p.crashes > 0 && p.last.is_some());
    let pair = crashed.max_by_key(|p| p.crashes)?;
    Some(of_pair(pair.id, pair.crashes, last_word(pair)?))
}

fn of_pair(id: i32, crashes: i32, word: &str) -> Failure {
    Failure {
        pair: Some(id),
        ..cause_of_pair(id, crashes, word)
    }
}

fn cause_of_pair(id: i32, crashes: i32, word: &str) -> Failure {
    let times = if crashes == 1 {
        "once".to_owned()
    } else {
        format!("{crashes} times")
    };
    let (reason, what, next) = match word {
        "OOMKilled" => (
            reasons::OUT_OF_MEMORY,
            format!("Agent {id} crashed {times}, the last time for lack of memory."),
            smaller(),
        ),
        "idle" => (
            reasons::IDLE,
            format!("Agent {id} ended too early {times}, the last time because it printed nothing for too long."),
            in_the_log_of(id),
        ),
        FORGED => (
            reasons::AGENT_CRASHED,
            format!("Agent {id} ended {times} by a status file that says it crashed, which it has not."),
            for_both("Leave the folder of the status files to the evaluator's runner, and submit again."),
        ),
        "incomplete" => (
            reasons::INVALID_RESULTS,
            format!(
                "Agent {id} ended by itself {times} without complete results: its checkpoint is missing, malformed or has \
                 no global record."
            ),
            in_the_log_of(id),
        ),
        "cannotStart" | "startError" => (
            reasons::CANNOT_START,
            format!("Agent {id} could not be started: its command is missing in the image or not for this machine."),
            for_both("Rebuild the image for linux/amd64."),
        ),
        "notReady" | FOLLOWED | "simulator" => {
            let what = if word == "notReady" {
                "was not ready in time"
            } else {
                "crashed"
            };
            let what = format!("The simulator of pair {id} failed {times}: it {what}.");
            return infrastructure(reasons::SIMULATION_CRASHED, &what);
        }
        _ => (
            reasons::AGENT_CRASHED,
            format!("Agent {id} crashed {times}."),
            in_the_log_of(id),
        ),
    };
    participant(reason, &what, &next)
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Side {
    Agent,
    Simulator,
}

fn pair_of(container: &str) -> Option<(Side, i32)> {
    let (side, id) = container.rsplit_once('-')?;
    let side = match side {
        "agent" => Side::Agent,
        "simulator" => Side::Simulator,
        _ => return None,
    };
    Some((side, id.parse().ok()?))
}

fn pair_entry(status: &mut SubmissionStatus, id: i32) -> &mut PairStatus {
    if let Some(at) = status.pairs.iter().position(|p| p.id == id) {
        return &mut status.pairs[at];
    }
    let fresh = PairStatus {
        id,
        done: 0,
        total: pair_total(status, id),
        crashes: 0,
        state: "Waiting".into(),
        last: None,
    };
    let at = status.pairs.partition_point(|p| p.id < id);
    status.pairs.insert(at, fresh);
    &mut status.pairs[at]
}

fn pair_total(status: &SubmissionStatus, id: i32) -> i32 {
    let slice = status.plan.as_ref().and_then(|plan| {
        let slice = plan.slices.get(usize::try_from(id).ok()?.checked_sub(1)?)?;
        let (first, last) = leaderboard_api::effective::slice_bounds(slice)?;
        i32::try_from(last - first + 1).ok()?.checked_mul(plan.repetitions)
    });
    slice.unwrap_or(0)
}

/// One word for an end: the runner's own, unless the kernel took the memory away while the command ran.
fn word(side: Side, end: &EndView) -> &str {
    let what = end.what.as_deref();
    if side == Side::Simulator {
        return match what {
            Some(FOLLOWED) => UNSEEN,
            Some("notReady") => "notReady",
            _ => "simulator",
        };
    }
    match what {
        Some(word @ (FOLLOWED | "notReady" | "idle" | "cannotStart")) => word,
        _ if end.reason == "OOMKilled" => "OOMKilled",
        Some(word) => word,
        None if matches!(end.reason.as_str(), "StartError" | "ContainerCannotRun") => "startError",
        None => "killed",
    }
}
