//! Another program may run a submission of EvalAI's too, as the old pipeline does. A row of its run, or results of something else below
//! the prefix, hold the submission back: nothing is written anywhere until that run has ended, or a person hands the submission over.

use super::clock;
use super::plan::{Action, Question};
use super::status::{PlanBuilder, Terms};
use super::stop;
use super::waits::Wait;
use crate::ask::question::{Answered, Failure};
use crate::controller::submissions::questions::{ForeignRun, Row};
use crate::controller::submissions::view::{ContainerView, JobView, PodView};
use leaderboard_api::conditions::{self, Truth};
use leaderboard_api::text::{LONGEST_NAME, one_line, sentence};
use leaderboard_api::{names, reasons};
use leaderboard_contract::verdict::WorkspaceReason;

/// Why an end of what was held back is written to no other system.
pub(super) const NOT_WRITTEN: &str = "Nothing is written of this end, because another program may run the submission. If none does, \
                                      cancel it in EvalAI.";

/// Whether the submission is held back, or that is not known yet.
pub(super) fn waits(draft: &mut PlanBuilder<'_>, terms: Terms<'_>) -> bool {
    if draft.is_adopted() {
        return false;
    }
    if is_held_by_prefix(draft) {
        return true;
    }
    let Some(question) = question(draft, terms) else {
        return false;
    };
    let view = draft.view;
    let answer = view.row.answer_to(&question);
    match answer.map(|answer| (answer, answer.result.as_ref())) {
        Some((answer, Ok(None))) => return awaits_evalai(draft, answer),
        Some((_, Ok(Some(run)))) => {
            draft.moves();
            hold(draft, &message_of(run));
        }
        Some((_, Err(failure))) => {
            let message = not_known(draft, failure);
            hold(draft, &message);
        }
        None => show_reading(draft),
    }
    draft.act(Action::Ask(Question::Row(Box::new(question))));
    true
}

/// Where another program's row would be. None: there is no table, no other program gets the submission, or a run of ours has begun.
fn question(draft: &PlanBuilder<'_>, terms: Terms<'_>) -> Option<Row> {
    let team = &terms.info?.team_id;
    let table = terms.leaderboard.table.as_ref()?;
    // One that observes runs what another program runs, on purpose, and writes nothing.
    let is_asked = draft.status.plan.is_none() && !draft.observes() && !team.is_empty();
    is_asked.then(|| Row {
        attempt: draft.status.attempt.unwrap_or_default(),
        table: table.clone(),
        team: team.clone(),
        run_id: draft.submission().run_id(),
    })
}

fn show_reading(draft: &mut PlanBuilder<'_>) {
    if draft.waits_quietly(Wait::ROW, draft.view.row.waited.unwrap_or_default()) {
        return;
    }
    let message = "The table is asked whether another program runs the submission, and has not answered yet.";
    draft.condition(conditions::ACCEPTED, Truth::Unknown, reasons::FOREIGN, message);
    draft.show(reasons::FOREIGN, message);
}

/// Another program ends its run in EvalAI first and in the row then: EvalAI decides by an answer that is newer than the row.
fn awaits_evalai(draft: &mut PlanBuilder<'_>, answer: &Answered<Row>) -> bool {
    let read_at = draft.view.evalai.as_ref().and_then(|evalai| evalai.read_at);
    let sent = draft.now().checked_sub(answer.sent_ago).unwrap_or(draft.now());
    if !is_held(draft) || read_at.is_some_and(|at| at >= sent) {
        return false;
    }
    draft.keeps_status();
    draft.act(Action::Ask(Question::EvalaiAnew));
    draft.look_again(Wait::ROW);
    true
}

fn hold(draft: &mut PlanBuilder<'_>, message: &str) {
    draft.condition(conditions::ACCEPTED, Truth::False, reasons::FOREIGN, message);
    draft.show(reasons::FOREIGN, message);
}

/// While that cannot be known nothing starts: a second run would write over the results of the first.
fn not_known(draft: &mut PlanBuilder<'_>, failure: &Failure) -> String {
    let why = sentence(&failure.why);
    let message = format!(
        "The table does not show whether another program runs the submission: {why} It is read again every 30 s. To start the \
         submission all the same, {}",
        adoption()
    );
    if failure.is_refused {
        return draft.stall(reasons::FOREIGN, &message);
    }
    draft.moves();
    message
}

fn message_of(run: &ForeignRun) -> String {
    let since = run.since.as_ref().map(|since| one_line(since, LONGEST_NAME));
    let since = since.map(|since| format!(" since {since}")).unwrap_or_default();
    format!(
        "The table's row shows {}{since} and has no column attempt: another program runs the submission. It goes on when the row's \
         submission_status is FINISHED, FAILED or CANCELLED. If nothing runs it any more, set that to FAILED, or {}",
        run.status,
        adoption()
    )
}

/// How a person hands a submission over.
fn adoption() -> String {
    format!(
        "annotate the Submission with {}=true: it then takes up what is stored.",
        names::ANNOTATION_ADOPT
    )
}

/// Whether the submission is held back, or was when it ended here: its row in EvalAI and in the table may be another program's.
pub(super) fn is_held(draft: &PlanBuilder<'_>) -> bool {
    let accepted = draft.status.condition(conditions::ACCEPTED);
    accepted.is_some_and(|c| c.status == "False" && c.reason == reasons::FOREIGN)
}

/// Whether a Pod of the submission has found results of something else below the prefix, and nobody has handed it over since.
fn is_held_by_prefix(draft: &PlanBuilder<'_>) -> bool {
    draft.status.plan.is_some() && is_held(draft)
}

/// The words of the Pod's `workspace`, if it has found results of something else below the prefix.
fn prefix_in_use(pod: &PodView) -> Option<&str> {
    let is_workspace = |c: &&ContainerView| c.name == names::CONTAINER_WORKSPACE && pod.agent_started.is_none();
    let end = pod.containers.iter().find(is_workspace)?.last.as_ref()?;
    let is_in_use = end.own_reason == Some(WorkspaceReason::PrefixInUse);
    is_in_use.then(|| {
        end.why
            .as_deref()
            .unwrap_or("The prefix of the run holds results of something else.")
    })
}

/// Holds back a submission whose Pod has found the prefix in use, without an end, a retry or a write to EvalAI or table: its Job is
/// deleted. Returns whether it did.
pub(super) fn holds(draft: &mut PlanBuilder<'_>, job: &JobView) -> bool {
    if draft.is_to_stop() {
        return false;
    }
    if !is_held_by_prefix(draft) {
        let Some(found) = draft.view.pod.as_ref().and_then(prefix_in_use) else {
            return false;
        };
        let message = format!(
            "{} Nothing is run and nothing is written to EvalAI, table and bucket. Delete this Submission, or {}",
            sentence(found),
            adoption()
        );
        clock::count_use(draft, draft.now());
        clock::restart(draft);
        draft.status.node_name = None;
        draft.condition(conditions::RUNNING, Truth::False, reasons::FOREIGN, "");
        draft.stall_with(reasons::FOREIGN, &message);
        hold(draft, &message);
    }
    // The next Job has the name of this one, so it waits until this one is gone.
    draft.status.job_name = None;
    if !job.deleting {
        draft.act(stop::delete(job, Wait::DELETION.longest));
    }
    draft.look_again(Wait::JOB);
    true
}
