//! The end of a run that is not published, next to the end that EvalAI shows of another program's run of the same submission, and the
//! number of their routes.

use jiff::{SignedDuration, Timestamp};

use super::plan::Action;
use super::plan_builder::PlanBuilder;
use crate::controller::submissions::other_results::{Answer, Question, Routes};
use crate::controller::submissions::view::ObservedRoutes;
use leaderboard_api::conditions::{self, Truth};
use leaderboard_api::text::sentence;
use leaderboard_api::{State, SubmissionStatus, reasons};

/// EvalAI is read again when what is known of the other run is older than this.
const OLD: SignedDuration = SignedDuration::from_mins(5);

/// Compares, and returns whether the other run's end is still to come. What never ran here has nothing to compare.
pub(super) fn awaits_end(draft: &mut PlanBuilder<'_>) -> bool {
    let is_compared = draft
        .status
        .condition(conditions::COMPARED)
        .is_some_and(|c| c.status != "Unknown");
    let has_run = draft.status.job_name.is_some();
    if !draft.observes() || draft.is_deleting() || draft.spec().evalai.is_none() || !has_run || is_compared {
        return false;
    }
    let evalai = draft.view.evalai.as_ref();
    let Some(info) = draft.evalai_info() else {
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
    let Some(routes) = routes_of_other(draft) else {
        return waits(draft);
    };
    show(draft, theirs, &routes);
    false
}

/// How many routes the other run has; none while that is read.
fn routes_of_other(draft: &mut PlanBuilder<'_>) -> Option<Answer> {
    let attempt = draft.status.attempt.unwrap_or_default();
    let Some(plan) = &draft.status.plan else {
        return Some(Err("this run has no plan".to_owned()));
    };
    let question = Question::of(plan, attempt);
    if let ObservedRoutes::Answered(answer) = &draft.view.other_routes {
        return Some(answer.as_ref().clone());
    }
    draft.act(Action::ReadOtherResults(Box::new(question)));
    None
}

fn waits(draft: &mut PlanBuilder<'_>) -> bool {
    draft.condition(conditions::COMPARED, Truth::Unknown, reasons::AWAITING_OTHER_END, "");
    true
}

fn show(draft: &mut PlanBuilder<'_>, theirs: State, routes: &Answer) {
    let ours = draft.status.state_of_conditions();
    let own = own_routes(&draft.status);
    let has_same_routes = routes.as_ref().is_ok_and(|other| !differs(ours, own, *other));
    let reason = match routes {
        _ if ours != theirs => reasons::DIFFERENT_END,
        Ok(_) if !has_same_routes => reasons::DIFFERENT_ROUTES,
        _ => reasons::SAME_END,
    };
    let of_routes = match routes {
        Ok(other) => format!(
            "This run has {} of {} routes, and the other program's results have {} of {}.",
            own.done, own.total, other.done, other.total
        ),
        Err(why) => format!("The numbers of routes were not compared: {}", sentence(why)),
    };
    let (ends, is_same) = ((ours.as_str(), theirs.as_str()), reason == reasons::SAME_END);
    let message = format!("This run is {}; EvalAI shows {}. {of_routes}", ends.0, ends.1);
    draft.condition(conditions::COMPARED, Truth::from(is_same), reason, &message);
    if !is_same {
        draft.event(true, reason, message);
    }
}

/// A run that ends early may have reported no progress; how many routes it has is in its plan.
fn own_routes(status: &SubmissionStatus) -> Routes {
    let total = status
        .plan
        .as_ref()
        .map(|plan| plan.routes.saturating_mul(plan.repetitions));
    Routes {
        done: status.progress.as_ref().map_or(0, |progress| progress.done),
        total: total.unwrap_or_default(),
    }
}

/// How far a run comes that does not finish is no matter of the program that drives it.
fn differs(end: State, own: Routes, other: Routes) -> bool {
    own.total != other.total || (end == State::Finished && own.done != other.done)
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
