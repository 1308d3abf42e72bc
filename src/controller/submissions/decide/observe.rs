//! The end of a run that is not published, next to the end that EvalAI shows of another program's run of the same submission.

use jiff::{SignedDuration, Timestamp};

use super::plan::Action;
use super::plan_builder::PlanBuilder;
use leaderboard_api::conditions::{self, Truth};
use leaderboard_api::{State, reasons};

/// EvalAI is read again when what is known of the other run is older than this.
const OLD: SignedDuration = SignedDuration::from_mins(5);

/// Compares, and returns whether the other run's end is still to come. What never ran here has nothing to compare.
pub(super) fn awaits_end(draft: &mut PlanBuilder<'_>) -> bool {
    let is_compared =
        conditions::get(&draft.status.conditions, conditions::COMPARED).is_some_and(|c| c.status != "Unknown");
    let has_run = draft.status.job_name.is_some();
    if !draft.observes() || draft.is_deleting() || draft.spec().evalai.is_none() || !has_run || is_compared {
        return false;
    }
    let evalai = draft.view.evalai.as_ref();
    let Some(info) = evalai.and_then(|evalai| evalai.info.as_ref()) else {
        draft.act(Action::AskEvalai);
        return waits(draft);
    };
    let Some(theirs) = end_of(&info.status) else {
        let read_at = evalai.and_then(|evalai| evalai.read_at);
        if is_old(read_at, draft.now()) {
            // What is known is forgotten, so that the next reconcile asks anew.
            draft.act(Action::ForgetEvalai);
        }
        return waits(draft);
    };
    show(draft, theirs);
    false
}

fn waits(draft: &mut PlanBuilder<'_>) -> bool {
    draft.condition(conditions::COMPARED, Truth::Unknown, reasons::AWAITING_OTHER_END, "");
    true
}

fn show(draft: &mut PlanBuilder<'_>, theirs: State) {
    let ours = draft.status.state_of_conditions();
    let is_same = ours == theirs;
    let reason = if is_same {
        reasons::SAME_END
    } else {
        reasons::DIFFERENT_END
    };
    let message = format!("This run is {}; EvalAI shows {}.", ours.as_str(), theirs.as_str());
    draft.condition(conditions::COMPARED, Truth::from(is_same), reason, &message);
    if !is_same {
        draft.event(true, reason, message);
    }
}

/// The end that a status of EvalAI's is; none while the other run goes on.
pub(super) fn end_of(status: &str) -> Option<State> {
    match status {
        "finished" => Some(State::Finished),
        "failed" => Some(State::Failed),
        "cancelled" | "archived" | "deleted" | "ignored" | "missing" => Some(State::Cancelled),
        _ => None,
    }
}

fn is_old(read_at: Option<Timestamp>, now: Timestamp) -> bool {
    read_at.is_none_or(|at| now < at || now.duration_since(at) >= OLD)
}
