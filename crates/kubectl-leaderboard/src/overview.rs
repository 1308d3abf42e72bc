//! All submissions of a namespace that wait, have failed or are stuck, one line each.
//!
//! Called by `main` for `why` without a name. Pure: the time is handed in.

use std::collections::BTreeMap;

use jiff::Timestamp;
use kube::ResourceExt;
use serde_json::Value;

use super::board::{self, Observed};
use super::facts;
use super::table::table;
use super::text::{Frame, age, join, wrap};
use super::why;
use leaderboard_api::conditions::{self, Condition};
use leaderboard_api::{Leaderboard, Reason, ReasonName, State, Submission, SubmissionStatus};

/// How long an end may wait for another system before that is a problem.
const PATIENCE_SECONDS: i64 = 300;

/// Where submissions were listed.
#[derive(Clone, Copy, Debug)]
pub struct Place<'a> {
    pub namespace: &'a str,
    /// All namespaces.
    pub is_all: bool,
}

impl Place<'_> {
    /// The name of an object, with its namespace where there are several.
    fn name_of(self, object: &impl ResourceExt) -> String {
        match object.namespace().filter(|_| self.is_all) {
            Some(namespace) => format!("{namespace}/{}", object.name_any()),
            None => object.name_any(),
        }
    }
}

/// Lines for an empty list. `words` are its limits; `elsewhere` are the namespaces that have submissions, with their number.
pub fn nothing(place: Place<'_>, words: Option<&str>, elsewhere: &[(String, usize)], frame: Frame) -> Vec<String> {
    let namespace = place.namespace;
    let others: Vec<String> = elsewhere
        .iter()
        .map(|(name, count)| format!("{name} ({count})"))
        .collect();
    let text = match words {
        Some(words) if place.is_all => format!("No submission of any namespace has {words}."),
        Some(words) => format!("No submission of namespace {namespace} has {words}."),
        None if place.is_all => {
            "No namespace has a submission. Check that the context is that of the right cluster.".to_owned()
        }
        None if others.is_empty() => format!(
            "Namespace {namespace} has no submissions. `kubectl get submissions -A` lists those of all namespaces."
        ),
        None => format!(
            "Namespace {namespace} has no submissions. There are some in {}: use -n NAMESPACE, or -A.",
            others.join(", ")
        ),
    };
    wrap(&text, frame.width)
}

/// The lines of a namespace, or of all. No Leaderboards: this person has no right to read them.
pub fn lines(
    place: Place<'_>,
    submissions: &[Submission],
    leaderboards: Option<&[Leaderboard]>,
    frame: Frame,
) -> Vec<String> {
    let now = frame.now;
    let mut page = frame.page();
    for text in of_leaderboards(place, submissions, leaderboards) {
        page.paragraph(&text);
    }
    page.gap();
    let mut rows = Vec::new();
    for one in facts::ordered(submissions, now) {
        let trouble = trouble(one, now);
        if !trouble.is_empty() {
            let state = facts::status(one).known_state().map_or("(new)", State::as_str);
            let since = facts::since(one).map(|at| age(at, now)).unwrap_or_default();
            rows.push(vec![place.name_of(one), state.to_owned(), since, trouble]);
        }
    }
    if rows.is_empty() {
        let here = if place.is_all {
            "The cluster".to_owned()
        } else {
            format!("Namespace {}", place.namespace)
        };
        page.paragraph(&match submissions.len() {
            1 => format!("{here} has 1 submission. It is not waiting, failed or stuck."),
            count => format!("{here} has {count} submissions. None is waiting, failed or stuck."),
        });
        return page.into_lines();
    }
    let mut lines = page.into_lines();
    lines.extend(table(&["NAME", "STATE", "SINCE", "WHY"], &rows, frame.width));
    lines.push(String::new());
    let namespace = if place.is_all { "NAMESPACE" } else { place.namespace };
    let hint = format!("`kubectl leaderboard why NAME -n {namespace}` has the details and the next step.");
    lines.extend(wrap(&hint, frame.width));
    lines
}

/// The submissions that have a line, as JSON; each as `why NAME -o json` has it.
pub fn value(submissions: &[Submission], leaderboards: Option<&[Leaderboard]>, now: Timestamp) -> Value {
    let board_of = |submission: &Submission| {
        let Some(all) = leaderboards else {
            return Observed::Forbidden;
        };
        let is_its = |board: &&Leaderboard| {
            board.namespace() == submission.namespace() && board.name_any() == submission.spec.leaderboard_name
        };
        all.iter().find(is_its).map_or(Observed::Missing, Observed::Found)
    };
    let shown = submissions.iter().filter(|one| !trouble(one, now).is_empty());
    Value::Array(shown.map(|one| why::value(one, board_of(one))).collect())
}

/// Lines about the problems of existing Leaderboards, and of those that submissions name.
fn of_leaderboards(place: Place<'_>, submissions: &[Submission], leaderboards: Option<&[Leaderboard]>) -> Vec<String> {
    let Some(leaderboards) = leaderboards else {
        return vec!["You have no right to read Leaderboards; one may be paused or not Ready.".to_owned()];
    };
    let mut observed: BTreeMap<String, Observed<'_>> = BTreeMap::new();
    let live = submissions.iter().filter(|s| !facts::has_ended(s));
    let board_of = |s: &Submission| match s.namespace().filter(|_| place.is_all) {
        Some(namespace) => format!("{namespace}/{}", s.spec.leaderboard_name),
        None => s.spec.leaderboard_name.clone(),
    };
    observed.extend(live.map(|s| (board_of(s), Observed::Missing)));
    observed.extend(leaderboards.iter().map(|l| (place.name_of(l), Observed::Found(l))));
    let problems = observed.iter().flat_map(|(name, board)| board::problems(name, *board));
    problems.map(|(text, _)| text).collect()
}

/// Faults of a submission; empty if there is none.
fn trouble(submission: &Submission, now: Timestamp) -> String {
    let status = facts::status(submission);
    let is_deleting = submission.metadata.deletion_timestamp.is_some();
    let deleting = if is_deleting { "Being deleted." } else { "" };
    let others = other_systems(status, now).unwrap_or_default();
    let doubt = is_false(status, conditions::PLAUSIBLE).map(|c| format!("{}.", c.reason));
    let own = own_reason(submission, status).unwrap_or_default();
    join(&[deleting, &others, &doubt.unwrap_or_default(), &own])
}

/// Why a submission is in its state; nothing if it is running, has finished, or was cancelled as requested.
fn own_reason(submission: &Submission, status: &SubmissionStatus) -> Option<String> {
    let reason = status.present_reason();
    let reason = reason.as_ref().map(ReasonName::as_str).unwrap_or_default();
    let message = status.message.as_deref().unwrap_or_default();
    if status.has_ended() && facts::is_attempt_requested(submission) {
        let wanted = submission.spec.attempt;
        return Some(format!(
            "Attempt {wanted} is requested; the operator has not processed it yet."
        ));
    }
    match status.known_state() {
        None => Some("The operator has not processed it yet.".to_owned()),
        Some(State::Pending) => Some(match &status.waiting {
            Some(waiting) => {
                let eta = facts::eta(waiting).map(|eta| format!(", starts in {eta}"));
                let eta = eta.unwrap_or_default();
                format!("{reason}: position {}{eta}", waiting.position)
            }
            None => format!("{reason}: {message}"),
        }),
        Some(State::Running | State::Resumed) => {
            let is_well = status.reason.is_none();
            let stalled = conditions::get(&status.conditions, conditions::STALLED).filter(|c| c.is_true());
            match stalled {
                Some(stalled) => Some(format!("{}: {}", stalled.reason, stalled.message)),
                None => (!is_well).then(|| format!("{reason}: {message}")),
            }
        }
        Some(State::Failed) => {
            let class = status.failure.as_ref().map(|f| format!(" ({})", facts::class(f.class)));
            Some(format!("{reason}{}: {message}", class.unwrap_or_default()))
        }
        Some(State::Finished | State::Cancelled) => None,
    }
}

/// The system that lacks the result for too long, with the reason. The first is enough: DynamoDB's row follows EvalAI.
fn other_systems(status: &SubmissionStatus, now: Timestamp) -> Option<String> {
    let late = |c: &&Condition| {
        let age = now.duration_since(c.last_transition_time.0).as_secs();
        match c.reason.known() {
            Some(Reason::NotRequired | Reason::Superseded | Reason::CancelledInEvalAI) => false,
            Some(Reason::WaitingForPreviousController) => age > PATIENCE_SECONDS,
            Some(Reason::Waiting) => !c.message.is_empty() || age > PATIENCE_SECONDS,
            _ => true,
        }
    };
    let [_, systems @ ..] = conditions::SYSTEMS;
    systems.iter().find_map(|(type_, system)| {
        let condition = is_false(status, type_).filter(late)?;
        Some(format!("{system}: {}.", condition.reason))
    })
}

fn is_false<'a>(status: &'a SubmissionStatus, type_: &str) -> Option<&'a Condition> {
    conditions::get(&status.conditions, type_).filter(|c| c.status == "False")
}
