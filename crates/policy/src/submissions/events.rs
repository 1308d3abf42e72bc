//! Events of a changed status. Each costs a write, so that a good run has two: `Started`, and the one of its end.
//!
//! Pure.

use super::plan::Event;
use super::workers::agents_of;
use leaderboard_api::conditions;
use leaderboard_api::{Agents, Reason, ReasonName, State, SubmissionStatus};

/// Reasons that Kubernetes' own events, the event `Started` and the status show anyway.
const WITHOUT_EVENT: [Reason; 5] = [
    Reason::Preparing,
    Reason::AskingEvalAI,
    Reason::FetchingInput,
    Reason::Running,
    Reason::Resumed,
];

/// Events of the step from a stored status to the next.
pub(super) fn of_change(old: Option<&SubmissionStatus>, new: &SubmissionStatus) -> impl Iterator<Item = Event> {
    [start(old, new), transition(old, new)].into_iter().flatten()
}

/// The start of the agents, of each Pod once; of the evaluators where there are none.
fn start(old: Option<&SubmissionStatus>, new: &SubmissionStatus) -> Option<Event> {
    let is_running = |status: &SubmissionStatus| status.is_true(conditions::RUNNING);
    if old.is_some_and(is_running) || !is_running(new) {
        return None;
    }
    let node = new.node_name.as_ref().map(|node| format!(" on node {node}"));
    let (attempt, node) = (new.attempt?, node.unwrap_or_default());
    let message = match agents_of(new) {
        Agents::Beside => format!("The agents of attempt {attempt} run{node}."),
        Agents::First => format!("The agent of attempt {attempt} runs{node}."),
        Agents::Absent => format!("The evaluators of attempt {attempt} run{node}."),
    };
    Some(event(false, Reason::Started, message))
}

/// A changed state or reason. The event of a good end is that of its publication, where there is one.
fn transition(old: Option<&SubmissionStatus>, new: &SubmissionStatus) -> Option<Event> {
    let shown = |status: &SubmissionStatus| {
        let state = status.state_of_conditions();
        let awaits = state == State::Finished && is_awaited(status);
        (state, status.present_reason(), awaits)
    };
    let (state, reason, awaits) = shown(new);
    if awaits || old.map(shown) == Some((state, reason.clone(), awaits)) {
        return None;
    }
    let reason = reason.filter(|reason| !reason.is_one_of(&WITHOUT_EVENT))?;
    let message = new.message.as_deref().unwrap_or(state.as_str());
    if state == State::Finished && new.is_true(conditions::PUBLISHED) {
        return Some(event(
            false,
            Reason::Published,
            format!("EvalAI has the result: {message}"),
        ));
    }
    Some(event(state == State::Failed, reason, message.to_owned()))
}

/// True while EvalAI is to have an end and has not answered it.
fn is_awaited(status: &SubmissionStatus) -> bool {
    status.condition(conditions::PUBLISHED).is_some() && !status.is_delivered(conditions::PUBLISHED)
}

fn event(warning: bool, reason: impl Into<ReasonName>, message: String) -> Event {
    let reason = reason.into();
    Event {
        warning,
        reason,
        message,
    }
}
