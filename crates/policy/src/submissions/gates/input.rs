//! The last gate before a Job: the file that EvalAI has of a submission is in the bucket of its run.

use super::super::end;
use super::super::failure::{infrastructure, participant};
use super::super::plan::{Action, Question};
use super::super::run;
use super::super::status::PlanBuilder;
use super::super::waits::Wait;
use super::slot::join;
use crate::questions::{Fetched, INPUT_TRIES, Input};
use leaderboard_api::text::sentence;
use leaderboard_api::{Agents, Evalai, Failure, Reason};

/// True if the copy has failed. The next try needs no slot, and a failure that is final waits for none.
pub(in super::super) fn has_failed(draft: &mut PlanBuilder<'_>) -> bool {
    let is_answered = question(draft).is_some_and(|question| draft.view.input.answer_to(&question).is_some());
    is_answered && waits(draft)
}

/// True if the file is not in the bucket yet. The submission keeps its slot for the first try alone: what is not served now may not be for
/// long.
pub(in super::super) fn waits(draft: &mut PlanBuilder<'_>) -> bool {
    let Some(question) = question(draft) else {
        return false;
    };
    let view = draft.view;
    let answer = view.input.answer_to(&question);
    match answer.map(|answer| answer.result.as_ref()) {
        None => show_first_try(draft),
        Some(Ok(Fetched::Stored(file))) => {
            draft.status.input = Some(file.clone());
            return false;
        }
        Some(Ok(Fetched::TooLarge)) => {
            end::failed(draft, too_large(question.limit));
            return true;
        }
        Some(Ok(Fetched::Missing { why, times })) if *times >= INPUT_TRIES => {
            let what = format!("The submitted file was asked for {times} times in a row: {why}.");
            end::failed(draft, infrastructure(Reason::InputMissing, &what));
            return true;
        }
        Some(Ok(Fetched::Missing { why, .. })) => show_failed_try(draft, &why.to_string(), false),
        Some(Err(failure)) => show_failed_try(draft, &failure.why, failure.is_refused),
    }
    draft.act(Action::Ask(Question::Input(Box::new(question))));
    true
}

/// The file that is to be copied. None: the bucket has it, or the run takes none of EvalAI's.
fn question(draft: &PlanBuilder<'_>) -> Option<Input> {
    let plan = draft.status.plan.as_ref();
    let plan = plan.filter(|plan| plan.agents() == Agents::Absent && draft.status.input.is_none())?;
    let bounds = plan.container()?.input.clone().unwrap_or_default();
    let evalai = draft.leaderboard().and_then(|board| board.evalai.as_ref());
    Some(Input {
        attempt: draft.status.attempt.unwrap_or_default(),
        server: evalai.map(Evalai::server).unwrap_or_default(),
        run_id: plan.run_id.clone(),
        storage: plan.storage.s3.clone(),
        submission: draft.spec().evalai?.submission,
        limit: bounds.max_bytes.bytes(),
    })
}

/// The submitted file has more bytes than `limit`.
pub(in super::super) fn too_large(limit: u64) -> Failure {
    let what = format!("The submitted file has more than the {limit} bytes that this leaderboard takes.");
    participant(Reason::InputInvalid, &what, "Submit a smaller file.")
}

fn show_first_try(draft: &mut PlanBuilder<'_>) {
    // From its first Job on it has its slot anyway.
    if !draft.status.has_run() {
        join(draft);
    }
    if !draft.waits_quietly(Wait::INPUT, draft.view.input.waited.unwrap_or_default()) {
        draft.waits(Reason::FetchingInput);
        show(draft, "The submitted file is being copied from EvalAI into the bucket.");
    }
}

fn show_failed_try(draft: &mut PlanBuilder<'_>, why: &str, is_refused: bool) {
    let why = sentence(why);
    let message = format!("The submitted file is not in the bucket yet: {why} It is tried again.");
    if is_refused {
        draft.stall_with(Reason::FetchingInput, &message);
    } else {
        draft.stalls_after(Wait::INPUT, Reason::FetchingInput, &message);
    }
    show(draft, &message);
}

fn show(draft: &mut PlanBuilder<'_>, message: &str) {
    draft.status.waiting = None;
    draft.show(Reason::FetchingInput, message);
    run::update_evalai(draft);
}
