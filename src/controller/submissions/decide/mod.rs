//! What is to be done for one submission: a pure function from a `View` to a `Plan`.
//!
//! Owns the state machine of docs/states.md. Called by the reconciler, once a reconcile. Knows no client, no clock but the
//! one in the view, and no `async`. One file a stage of life: `accept`, `line`, `live`, `start`, `stop`, `end`, `publish`; `interruption` is a
//! node that is taken away, `pulls` bounds a start, `blame` decides whose fault a crash was,
//! `crashes` counts them, `clock` how long a run has gone on, `pin` pins the plan, `reported` takes reports in, `provoked` bounds failures that an agent can cause, `leave` deletes what
//! has ended long ago, `write` decides when a changed status is worth a write, `failure` names the causes of an end and `next_steps` what to do about them, `cause` the causes of a wait,
//! `words` whose fault a start is by what Kubernetes writes of it, `disk` whose disk was full.

mod accept;
mod blame;
mod cause;
mod clock;
mod crashes;
mod disk;
mod end;
mod failure;
mod gates;
mod image;
mod interruption;
mod isolation;
mod leave;
mod line;
mod live;
mod log;
mod next_steps;
mod pin;
mod plan;
mod provoked;
mod publish;
mod pulls;
mod record;
mod reported;
mod run;
mod start;
mod status;
mod stop;
#[cfg(test)]
mod tests;
mod waits;
mod words;
mod write;

use std::time::Duration;

use super::view::View;
pub(super) use image::pinned;
pub use plan::{Action, EvalaiUpdate, Event, Plan, Question, SlotUse, StatusWrite, TableUpdate, job_name};
pub use publish::previous_controller;
pub use run::{awaits_publication, patience};
use status::PlanBuilder;

/// Decides one reconcile.
pub fn decide(view: &View) -> Plan {
    let mut draft = PlanBuilder::new(view);
    if draft.begin_attempt() {
        // What was observed is of another attempt.
        publish::leave_job(&mut draft);
        draft.requeue_in(Duration::ZERO);
    } else {
        decide_stage(&mut draft);
        if needs_finalizer(&draft) {
            draft.act_first(Action::SetFinalizer(true));
        }
    }
    let report = run::demand(&draft);
    draft.into_plan(report)
}

fn decide_stage(draft: &mut PlanBuilder<'_>) {
    if !draft.is_finished() {
        live::decide(draft);
    }
    if draft.is_finished() {
        publish::decide(draft);
    }
}

/// A deletion waits only for another system that has heard of the submission, or will, and not of its end.
fn needs_finalizer(draft: &PlanBuilder<'_>) -> bool {
    let is_owed = draft.spec().evalai.is_some() || record::has_row(draft);
    let has_begun = draft.status.has_run();
    let is_requested = draft.does(|action| matches!(action, Action::UpdateEvalai(_) | Action::Record(_)));
    let is_settled = draft.does(|action| *action == Action::Forget);
    is_owed && (has_begun || is_requested) && !is_settled && !draft.has_finalizer() && !draft.is_deleting()
}
