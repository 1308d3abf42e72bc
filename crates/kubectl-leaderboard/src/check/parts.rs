//! What is known of each part of a Leaderboard, from its conditions and from the status of a check. Pure.
//!
//! A part works only if something proves it: nothing is concluded from the order of the parts.

use leaderboard_api::conditions;
use leaderboard_api::text::sentence;
use leaderboard_api::{Enforcement, Leaderboard, PolicySource, State, Submission, SubmissionStatus, reasons};

use super::collectors::Collectors;
use super::finding::{Finding, Mark, Part, finding_of};
use super::readers::Readers;
use crate::why;

/// Reasons of the runner about a node without what rendering needs.
const NO_GRAPHICS: [&str; 2] = ["NoGPU", "GraphicsDriverMissing"];
const NOT_REACHED: &str = "not reached";
/// Characters of a digest that tell one image from another: its algorithm, and as many digits as docker shows.
const DIGEST: usize = "sha256:".len() + 12;

/// What a check has seen.
#[derive(Clone, Copy, Debug)]
pub struct Seen<'a> {
    pub leaderboard: &'a Leaderboard,
    /// The check's Submission as it was last; none if it could not be created.
    pub submission: Option<&'a Submission>,
    /// Why it was given up, if it was.
    pub given_up: Option<&'a str>,
    pub readers: &'a Readers,
    pub collectors: &'a Collectors,
}

/// What broke: the part, what was found, and the next step.
struct Fault {
    part: Part,
    found: String,
    step: Option<String>,
}

/// What was found of every part that the Leaderboard has.
pub fn findings(seen: Seen<'_>) -> Vec<Finding> {
    let spec = &seen.leaderboard.spec;
    let nothing = SubmissionStatus::default();
    let status = seen.submission.and_then(|s| s.status.as_ref()).unwrap_or(&nothing);
    let faults: Vec<Fault> = [of_ready(seen.leaderboard), of_run(seen, status)]
        .into_iter()
        .flatten()
        .collect();
    let ready = faults.first().filter(|_| !is_ready(seen.leaderboard));
    let mut all = vec![leaderboard(seen.leaderboard, ready)];
    if spec.evalai.is_some() {
        all.push(of_probe(
            Part::Evalai,
            ready,
            "accepts the token; phases, split and labels fit",
        ));
    }
    if spec.queue.is_some() {
        all.push(of_probe(Part::Queue, ready, "answers"));
        all.push(seen.readers.finding());
    }
    all.push(registry(status));
    all.extend(of_start(status));
    all.push(isolation(seen.leaderboard, status));
    all.extend(of_end(status));
    if spec.table.is_some() {
        all.push(table(status));
    }
    all.extend(logs(seen.leaderboard, status));
    all.extend(seen.collectors.finding(seen.leaderboard));
    for fault in faults {
        if let Some(finding) = all.iter_mut().find(|finding| finding.part == fault.part) {
            *finding = Finding {
                step: fault.step,
                ..finding_of(fault.part, Mark::Broken, fault.found)
            };
        }
    }
    all
}

fn works_if(part: Part, is_proved: bool, found: impl Into<String>) -> Finding {
    if is_proved {
        finding_of(part, Mark::Works, found)
    } else {
        finding_of(part, Mark::Open, NOT_REACHED)
    }
}

fn is_ready(leaderboard: &Leaderboard) -> bool {
    let status = leaderboard.status.as_ref();
    status.is_some_and(|status| conditions::is_true(&status.conditions, conditions::READY))
}

/// For what the Leaderboard is not Ready.
fn of_ready(leaderboard: &Leaderboard) -> Option<Fault> {
    let status = leaderboard.status.as_ref();
    let Some(ready) = status.and_then(|status| conditions::get(&status.conditions, conditions::READY)) else {
        return Some(Fault {
            part: Part::Leaderboard,
            found: "The operator has not processed the Leaderboard yet.".to_owned(),
            step: Some("Check that the operator runs and serves this namespace.".to_owned()),
        });
    };
    (ready.status != "True").then(|| Fault {
        part: part_of_ready(&ready.reason),
        found: stated(&ready.reason, &ready.message),
        step: step_of(&ready.reason),
    })
}

fn part_of_ready(reason: &str) -> Part {
    match reason {
        reasons::TOKEN_MISSING
        | reasons::TOKEN_REFUSED
        | reasons::LABELS_DIFFER
        | reasons::INSECURE_SERVER
        | reasons::ASKING_EVALAI => Part::Evalai,
        reasons::BUCKET_UNREACHABLE => Part::Bucket,
        reasons::TABLE_UNREACHABLE => Part::Table,
        reasons::QUEUE_UNREACHABLE | reasons::DEAD_LETTER_QUEUE_UNREACHABLE | reasons::QUEUE_BLOCKED => Part::Queue,
        reasons::NOT_ISOLATED => Part::Network,
        reasons::INVALID_POD => Part::Node,
        _ => Part::Leaderboard,
    }
}

fn leaderboard(leaderboard: &Leaderboard, fault: Option<&Fault>) -> Finding {
    let status = leaderboard.status.as_ref();
    let ready = status.and_then(|status| conditions::get(&status.conditions, conditions::READY));
    match (fault, ready) {
        (Some(fault), _) => {
            let found = format!("not Ready: see {}", fault.part.title());
            finding_of(Part::Leaderboard, Mark::Open, found)
        }
        (None, Some(ready)) if !ready.message.is_empty() => {
            let found = format!("Ready. {}", sentence(&ready.message));
            finding_of(Part::Leaderboard, Mark::Note, found)
        }
        (None, _) => finding_of(Part::Leaderboard, Mark::Works, "Ready"),
    }
}

/// A part that the operator tries from time to time, as its condition Ready shows.
fn of_probe(part: Part, fault: Option<&Fault>, found: &str) -> Finding {
    match fault {
        None => finding_of(part, Mark::Works, found),
        Some(_) => finding_of(part, Mark::Open, "not known while the Leaderboard is not Ready"),
    }
}

fn registry(status: &SubmissionStatus) -> Finding {
    let accepted = conditions::get(&status.conditions, conditions::ACCEPTED).filter(|c| c.status == "True");
    match (accepted, &status.image) {
        (None, _) => finding_of(Part::Registry, Mark::Open, NOT_REACHED),
        (Some(_), Some(image)) => {
            let short: String = image.digest.chars().take(DIGEST).collect();
            finding_of(Part::Registry, Mark::Works, format!("has the image, {short}…"))
        }
        (Some(accepted), None) if accepted.reason == reasons::IMAGE_NOT_PINNED => Finding {
            step: step_of(reasons::IMAGE_NOT_PINNED),
            ..finding_of(Part::Registry, Mark::Note, sentence(&accepted.message))
        },
        (Some(_), None) => finding_of(Part::Registry, Mark::Open, "not asked: agent.images allows any image"),
    }
}

/// The way to the agent's start.
fn of_start(status: &SubmissionStatus) -> [Finding; 4] {
    let times = &status.times;
    let seconds = |from: &Option<k8s_openapi::apimachinery::pkg::apis::meta::v1::Time>,
                   to: &Option<k8s_openapi::apimachinery::pkg::apis::meta::v1::Time>| {
        let (from, to) = (from.as_ref()?.0, to.as_ref()?.0);
        Some(to.duration_since(from).as_secs().max(0))
    };
    let has_started = times.started.is_some();
    // It starts behind the contents.
    let is_copied = has_started || message(status).to_ascii_lowercase().starts_with("logcopy ");
    let node = match (&status.node_name, seconds(&times.accepted, &times.scheduled)) {
        (Some(node), Some(seconds)) => format!("{node}, after {seconds} s"),
        (Some(node), None) => node.clone(),
        (None, _) => "found".to_owned(),
    };
    let pulled = seconds(&times.scheduled, &times.started);
    let pulled = pulled.map_or_else(String::new, |seconds| {
        format!(", {seconds} s from the node to the agent")
    });
    [
        works_if(Part::Slot, status.job_name.is_some(), "granted"),
        works_if(Part::Node, times.scheduled.is_some(), node),
        works_if(Part::Images, has_started, format!("pulled{pulled}")),
        works_if(Part::Contents, is_copied, "copied"),
    ]
}

fn isolation(leaderboard: &Leaderboard, status: &SubmissionStatus) -> Finding {
    let network = &leaderboard.spec.network;
    let found = leaderboard.status.as_ref();
    let found = found.and_then(|status| conditions::get(&status.conditions, conditions::ISOLATED));
    let part = Part::Network;
    if network.policy == PolicySource::External {
        return finding_of(
            part,
            Mark::Note,
            "not measured: network.policy is External, so the cluster's own policies count",
        );
    }
    let Some(found) = found else {
        return finding_of(part, Mark::Open, NOT_REACHED);
    };
    let text = stated(&found.reason, &found.message);
    let step = step_of(&found.reason);
    let mark = match (found.status.as_str(), found.reason.as_str()) {
        ("True", _) => return finding_of(part, Mark::Works, text),
        (_, reasons::NOT_MEASURED) if network.enforcement == Enforcement::Off => {
            return finding_of(part, Mark::Note, "not measured: network.enforcement is Off");
        }
        (_, reasons::NOT_MEASURED) if status.times.started.is_none() => {
            return finding_of(part, Mark::Open, NOT_REACHED);
        }
        (_, reasons::FORBIDDEN | reasons::NOT_APPLIED) => Mark::Broken,
        // The host lets such Pods run.
        _ => Mark::Note,
    };
    Finding {
        step,
        ..finding_of(part, mark, text)
    }
}

/// What a run proves once its agent has started.
fn of_end(status: &SubmissionStatus) -> [Finding; 4] {
    let done = status.progress.as_ref().map_or(0, |progress| progress.done);
    let is_finished = status.state_of_conditions() == State::Finished;
    let is_agents = status
        .failure
        .as_ref()
        .is_some_and(|failure| part_of(&failure.reason, &failure.message) == Part::Agent);
    let is_stored = conditions::is_true(&status.conditions, conditions::ARCHIVED);
    let results = status.results_url.as_deref().unwrap_or_default();
    let progress = status
        .progress
        .as_ref()
        .map(|progress| progress.text.as_str())
        .unwrap_or_default();
    let score = status
        .score
        .as_ref()
        .map(|score| format!(", driving score {}", score.text))
        .unwrap_or_default();
    [
        works_if(
            Part::Simulator,
            is_finished || done > 0 || is_agents,
            "started, and the agent drove in it",
        ),
        works_if(Part::Agent, is_finished || done > 0, "ran"),
        works_if(Part::Bucket, is_stored, format!("has the results, {results}")),
        works_if(Part::Route, is_finished, format!("{progress} done{score}")),
    ]
    .map(|finding| match (finding.part, is_agents) {
        (Part::Simulator, true) => finding_of(Part::Simulator, Mark::Works, "started"),
        _ => finding,
    })
}

fn table(status: &SubmissionStatus) -> Finding {
    let recorded = conditions::get(&status.conditions, conditions::RECORDED);
    match recorded.map(|c| (c.status.as_str(), c.reason.as_str())) {
        Some(("True", _)) => finding_of(Part::Table, Mark::Works, "would take a row; a check writes none"),
        _ => finding_of(Part::Table, Mark::Open, NOT_REACHED),
    }
}

/// The Pod sends its lines by itself, and reports whether CloudWatch takes them.
fn logs(leaderboard: &Leaderboard, status: &SubmissionStatus) -> Option<Finding> {
    let group = leaderboard.spec.log_group.as_ref()?;
    let run = status.plan.as_ref().filter(|_| status.times.started.is_some());
    let Some(run) = run else {
        return Some(finding_of(Part::Logs, Mark::Open, NOT_REACHED));
    };
    let logged = conditions::get(&status.conditions, conditions::LOGGED);
    match logged.map(|logged| logged.status.as_str()) {
        Some("True") => {
            let found = format!("takes the lines, {}: {}/…", group.name, run.run_id);
            return Some(finding_of(Part::Logs, Mark::Works, found));
        }
        Some(_) => {
            let found = logged.map_or_else(String::new, |logged| sentence(&logged.message));
            return Some(Finding {
                step: step_of(reasons::LOGS_REFUSED),
                ..finding_of(Part::Logs, Mark::Broken, found)
            });
        }
        None => {}
    }
    let flag = |name: &str, value: Option<&String>| value.map(|v| format!(" {name} {v}")).unwrap_or_default();
    let command = format!(
        "aws logs describe-log-streams --log-group-name {} --log-stream-name-prefix {}/{}{}",
        group.name,
        run.run_id,
        flag("--region", group.region.as_ref()),
        flag("--endpoint-url", group.endpoint.as_ref())
    );
    Some(Finding {
        step: Some("See whether the streams are there:".to_owned()),
        commands: vec![command],
        ..finding_of(
            Part::Logs,
            Mark::Open,
            "not known: the Pod has not told whether CloudWatch takes its lines",
        )
    })
}

/// What ended the run, or held it up until it was given up.
fn of_run(seen: Seen<'_>, status: &SubmissionStatus) -> Option<Fault> {
    if let Some(failure) = &status.failure {
        let part = part_of(&failure.reason, &failure.message);
        let found = match &failure.next_step {
            Some(step) => failure.message.strip_suffix(step.as_str()).unwrap_or(&failure.message),
            None => &failure.message,
        };
        return Some(Fault {
            part,
            found: stated(&failure.reason, found.trim_end()),
            step: if part == Part::Agent {
                Some("Correct the image of the check, or name another one with --image.".to_owned())
            } else {
                step_of(&failure.reason)
            },
        });
    }
    let recorded = conditions::get(&status.conditions, conditions::RECORDED);
    if let Some(refused) = recorded.filter(|c| c.reason == reasons::REFUSED) {
        return Some(Fault {
            part: Part::Table,
            found: sentence(&refused.message),
            step: step_of(reasons::TABLE_UNREACHABLE),
        });
    }
    let why = seen.given_up?;
    let reason = status.reason.as_deref().unwrap_or_default();
    let part = if status.attempt.is_none() {
        Part::Leaderboard
    } else {
        part_of(reason, message(status))
    };
    let found = if reason.is_empty() {
        sentence(why)
    } else {
        format!("{} {}", sentence(why), stated(reason, message(status)))
    };
    Some(Fault {
        part,
        found,
        step: step_of(reason),
    })
}

fn message(status: &SubmissionStatus) -> &str {
    let failure = status.failure.as_ref().map(|failure| failure.message.as_str());
    failure.or(status.message.as_deref()).unwrap_or_default()
}

/// Whether a text is about the containers that work with the bucket before the agent starts.
fn is_of_sidecars(text: &str) -> bool {
    text.starts_with("workspace ")
        || text.starts_with("Workspace ")
        || text.starts_with("logcopy ")
        || text.starts_with("Logcopy ")
}

/// The part that a reason is about; `text` names which container it is.
fn part_of(reason: &str, text: &str) -> Part {
    match reason {
        reason if NO_GRAPHICS.contains(&reason) => Part::Simulator,
        reasons::CHECKING_IMAGE
        | reasons::IMAGE_MISSING
        | reasons::IMAGE_INVALID
        | reasons::IMAGE_NOT_ALLOWED
        | reasons::IMAGE_NOT_FOUND
        | reasons::IMAGE_TOO_LARGE
        | reasons::IMAGE_PLATFORM
        | reasons::IMAGE_VOLUMES
        | reasons::IMAGE_DENIED => Part::Registry,
        reasons::WAITING_FOR_SLOT | reasons::PAUSED => Part::Slot,
        reasons::UNSCHEDULABLE
        | reasons::QUOTA_EXCEEDED
        | reasons::POD_REFUSED
        | reasons::SCHEDULE_DEADLINE
        | reasons::NODE_LOST
        | reasons::NODE_CANNOT_START
        | reasons::JOB_DELETED
        | reasons::JOB_EXPIRED
        | reasons::JOB_FAILED => Part::Node,
        reasons::PREPARING | reasons::START_DEADLINE if is_of_sidecars(text) => Part::Bucket,
        reasons::PREPARING | reasons::START_DEADLINE if text.to_ascii_lowercase().starts_with("contents ") => {
            Part::Contents
        }
        reasons::IMAGE_PULL | reasons::CONTAINER_CONFIG | reasons::PREPARING | reasons::START_DEADLINE => Part::Images,
        reasons::CANNOT_START if text.contains("imulator-") => Part::Simulator,
        reasons::CANNOT_START if text.contains("ontents") => Part::Contents,
        reasons::NOT_ISOLATED => Part::Network,
        reasons::SIMULATION_CRASHED | reasons::REPEATED_FAILURES => Part::Simulator,
        reasons::CANNOT_START
        | reasons::AGENT_CRASHED
        | reasons::OUT_OF_MEMORY
        | reasons::IDLE
        | reasons::TIME_LIMIT
        | reasons::DISK_FULL => Part::Agent,
        reasons::RESULTS_NOT_STORED | reasons::FOREIGN | reasons::NOT_STORED => Part::Bucket,
        reasons::LEADERBOARD_NOT_FOUND
        | reasons::LEADERBOARD_NOT_READY
        | reasons::TRACK_NOT_FOUND
        | reasons::JOB_NAME_TAKEN => Part::Leaderboard,
        _ => Part::Route,
    }
}

fn stated(reason: &str, message: &str) -> String {
    if message.is_empty() {
        why::meaning(reason)
    } else {
        format!("{reason}: {}", sentence(message))
    }
}

/// The next step of a reason, for a host who runs a check.
fn step_of(reason: &str) -> Option<String> {
    let step = reasons::plain(reasons::after_failure(reason)?);
    let step = step
        .replace(", then resume the submission", "")
        .replace("the submission then continues", "run the check again");
    match step.as_str() {
        "Nothing." => None,
        "Fix this." => Some("Fix what this names, then run the check again.".to_owned()),
        _ => Some(step),
    }
}
