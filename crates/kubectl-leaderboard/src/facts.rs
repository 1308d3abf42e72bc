//! Facts of one Submission in words: its state, since when, its team and track.
//!
//! Called by every module that shows or changes submissions. Pure: the time is handed in.

use std::sync::LazyLock;

use jiff::Timestamp;
use k8s_openapi::apimachinery::pkg::apis::meta::v1::Time;
use kube::ResourceExt;

use super::text::{Frame, join, size, span, when};
use leaderboard_api::standings::track_of;
use leaderboard_api::{
    Agents, Attempt, FailureClass, RunPlan, S3Bucket, State, Submission, SubmissionStatus, Waiting, conditions,
};

/// The status; an empty one before the operator has written one.
pub(super) fn status(submission: &Submission) -> &SubmissionStatus {
    static NOTHING: LazyLock<SubmissionStatus> = LazyLock::new(SubmissionStatus::default);
    submission.status.as_ref().unwrap_or(&NOTHING)
}

/// The state as people read it.
pub(super) fn shown(submission: &Submission) -> &'static str {
    status(submission).known_state().map_or("new", State::as_str)
}

/// The name with its state and the reason, such as `submission-42 is Failed (NodeLost)`.
pub(super) fn named(submission: &Submission) -> String {
    let reason = status(submission).reason.as_ref();
    let reason = reason.map(|reason| format!(" ({reason})")).unwrap_or_default();
    format!("{} is {}{reason}", submission.name_any(), shown(submission))
}

/// Since when a submission is in its state.
pub(super) fn since(submission: &Submission) -> Option<Timestamp> {
    let status = status(submission);
    let moved = |type_: &str, truth: &str| {
        let found = conditions::get(&status.conditions, type_).filter(|c| c.status == truth);
        found.map(|c| c.last_transition_time.0)
    };
    let time = |time: &Option<Time>| time.as_ref().map(|t| t.0);
    let times = &status.times;
    let found = match status.known_state()? {
        State::Finished | State::Failed | State::Cancelled => {
            time(&times.finished).or_else(|| moved(conditions::FINISHED, "True"))
        }
        State::Running | State::Resumed if times.stopping.is_some() => time(&times.stopping),
        State::Running | State::Resumed => moved(conditions::RUNNING, "True")
            .or_else(|| moved(conditions::RUNNING, "False"))
            .or_else(|| time(&times.started)),
        // The attempt begins with this condition.
        State::Pending => moved(conditions::FINISHED, "False").or_else(|| time(&times.accepted)),
    };
    found.or_else(|| submission.creation_timestamp().map(|t| t.0))
}

/// Running ones first, then what starts or is new, then waiting ones by their position, then ended ones, the latest first.
pub(super) fn ordered(submissions: &[Submission], now: Timestamp) -> Vec<&Submission> {
    let place = |one: &&Submission| {
        let status = status(one);
        let age = since(one).map_or(0, |at| now.duration_since(at).as_secs());
        let position = status.waiting.as_ref().map_or(0, |waiting| waiting.position.into());
        let place = match status.known_state() {
            Some(State::Running | State::Resumed) => (0, -age),
            None | Some(State::Pending) => (1, position),
            Some(State::Finished | State::Failed | State::Cancelled) => (2, age),
        };
        (place, one.namespace(), one.name_any())
    };
    let mut ordered: Vec<&Submission> = submissions.iter().collect();
    ordered.sort_by_cached_key(place);
    ordered
}

/// Why it is in its state: the status's reason with the message, or the message alone. Empty without a reason if there is progress, which
/// says what the message would; a cancelled one keeps its message.
pub(super) fn reason(status: &SubmissionStatus, message: &str) -> String {
    let is_cancelled = status.known_state() == Some(State::Cancelled);
    match &status.reason {
        Some(reason) => join(&[&format!("{reason}:"), message]).trim_end_matches(':').to_owned(),
        None if status.progress.is_some() && !is_cancelled => String::new(),
        None => message.to_owned(),
    }
}

/// How long the wait in line may take.
pub(super) fn eta(waiting: &Waiting) -> Option<String> {
    let eta = waiting.eta()?;
    let (least, most) = (span(eta.min_seconds), span(eta.max_seconds));
    Some(if least == most {
        least
    } else {
        format!("{least}-{most}")
    })
}

/// The state of a submission in a sentence.
pub(super) fn headline(submission: &Submission, now: Timestamp) -> String {
    let name = submission.name_any();
    let since = since(submission).map(|at| when(at, now));
    match (status(submission).known_state(), since) {
        (Some(state), Some(since)) => format!("{name} is {} since {since}.", state.as_str()),
        (Some(state), None) => format!("{name} is {}.", state.as_str()),
        (None, _) => {
            let made = submission.creation_timestamp().map(|made| when(made.0, now));
            let made = made.map(|made| format!(", created {made}")).unwrap_or_default();
            format!("{name} is new{made}: the operator has not processed it yet.")
        }
    }
}

/// The state of this attempt, or of a later one, with its reason. Then the lines for a person who waits for it, which have the message
/// too. None before the attempt has begun.
pub(super) fn transition(submission: &Submission, attempt: Attempt, frame: Frame) -> Option<(String, Vec<String>)> {
    let status = submission.status.as_ref().filter(|s| s.attempt >= Some(attempt))?;
    let state = named(submission);
    let text = format!("{state}: {}", status.message.as_deref().unwrap_or_default());
    let mut page = frame.page();
    page.row(
        &frame.now.strftime("%H:%M:%SZ").to_string(),
        text.trim_end_matches(": "),
    );
    Some((state, page.into_lines()))
}

/// Track, Leaderboard, team, the submitted file and the submission in EvalAI.
pub(super) fn track(submission: &Submission) -> String {
    let spec = &submission.spec;
    let mut text = match track_of(submission) {
        Some(track) => format!("{track} of Leaderboard {}", spec.leaderboard_name),
        None => format!("not known yet; Leaderboard {}", spec.leaderboard_name),
    };
    if let Some(team) = submission.team_name() {
        text = format!("{text}, by {team}");
    }
    if let Some(file) = file(submission) {
        text = format!("{text}; {file}");
    }
    if let Some(evalai) = spec.evalai {
        text = format!(
            "{text}; EvalAI submission {}, phase {}",
            evalai.submission, evalai.phase
        );
    }
    text
}

/// The submitted file as `file (12 KiB)`, if the submission is one.
fn file(submission: &Submission) -> Option<String> {
    let file = status(submission).input.as_ref().or(submission.spec.input.as_ref())?;
    let quantity = size(u64::try_from(file.size).unwrap_or_default());
    let number = quantity.trim_end_matches(|c: char| c.is_ascii_alphabetic());
    let unit = quantity.strip_prefix(number).unwrap_or_default();
    Some(format!("file ({number} {unit}B)"))
}

/// The plan of a run, if there is one yet.
pub(super) fn plan(submission: &Submission) -> Option<&RunPlan> {
    status(submission).plan.as_ref()
}

/// The bucket of a run's results, if its plan is known.
pub(super) fn storage(submission: &Submission) -> Option<&S3Bucket> {
    Some(&plan(submission)?.storage.s3)
}

/// True if an agent runs, as far as the plan is known.
pub(super) fn has_agent(plan: Option<&RunPlan>) -> bool {
    plan.is_none_or(|plan| plan.agents() != Agents::Absent)
}

/// True if the attempt has ended and no higher one is requested.
pub(super) fn has_ended(submission: &Submission) -> bool {
    status(submission).has_ended() && !is_attempt_requested(submission)
}

/// True if the submission has a Job and has not ended.
pub(super) fn is_run(submission: &Submission) -> bool {
    let status = status(submission);
    status.job_name.is_some() && !status.has_ended()
}

/// True if a higher attempt is requested than the operator has started.
pub(super) fn is_attempt_requested(submission: &Submission) -> bool {
    status(submission).is_followed_by(submission.spec.attempt)
}

/// A command of this plugin for a submission, to be copied.
pub(super) fn command(verb: &str, submission: &Submission) -> String {
    let namespace = submission.namespace().map(|n| format!(" -n {n}")).unwrap_or_default();
    format!("kubectl leaderboard {verb} {}{namespace}", submission.name_any())
}

/// The class of a failure.
pub(super) fn class(class: FailureClass) -> &'static str {
    match class {
        FailureClass::Participant => "participant failure",
        FailureClass::Infrastructure => "infrastructure failure",
    }
}
