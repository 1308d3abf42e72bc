//! What EvalAI, the table and the bucket hold of a submission that was run before its object lost its status.

use super::plan_builder::PlanBuilder;
use crate::controller::submissions::foreign_runs::Traces;
use crate::controller::submissions::report_digest::ReportDigest;
use crate::controller::submissions::view::{EvalaiInfo, ObservedTraces, Standing};
use crate::pod::run::Stop;
use leaderboard_api::{Attempt, ImportedState, effective, names};

/// What is known of a submission that was run before.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Found {
    /// Nothing of ours: it begins.
    Nothing,
    /// A run of ours that has not ended.
    Run,
    /// The bucket holds an end that not every system may have.
    Stored,
    /// Every system has this end.
    Ended(ImportedState),
}

/// Whether the object has no status of a run, so that one may be stored of which it knows nothing.
pub(super) fn may_be(draft: &PlanBuilder<'_>) -> bool {
    draft.status.plan.is_none() && has_not_run(draft)
}

fn has_not_run(draft: &PlanBuilder<'_>) -> bool {
    // What is only observed and what is checked have places of their own.
    !draft.status.has_run() && !draft.observes() && !draft.spec().check
}

/// Whether it is marked as one that was run before. EvalAI's are looked for anyway; of a local one nothing else shows it.
pub(super) fn is_marked(draft: &PlanBuilder<'_>) -> bool {
    let labels = draft.submission().metadata.labels.as_ref();
    let by_velero = labels.is_some_and(|all| all.contains_key(names::LABEL_VELERO_RESTORE));
    let is_local = draft.spec().evalai.is_none();
    // The finalizer comes with the first Job.
    draft.is_adopted() || by_velero || (is_local && draft.has_finalizer())
}

/// Whether EvalAI's own end may be one of ours.
pub(super) fn may_have_ended(draft: &PlanBuilder<'_>, info: &EvalaiInfo) -> bool {
    may_be(draft) && info.standing == Standing::Ended && state_of(&info.status).is_some()
}

/// Whether what is stored is taken up, although no attempt was asked for that does so.
pub(super) fn takes_up(draft: &PlanBuilder<'_>, info: Option<&EvalaiInfo>) -> bool {
    let found = traces(draft).map(|traces| found(traces, draft.spec().attempt, info));
    matches!(found, Some(Found::Run | Found::Stored))
}

/// By how many attempts row and report are ahead of the object: it may be older than the last resume. The row takes no attempt that
/// is not above its own, or the same before its end.
pub(super) fn attempts_ahead(draft: &PlanBuilder<'_>) -> i64 {
    let Some(traces) = traces(draft) else { return 0 };
    let row = traces.row.as_ref().filter(|row| row.is_ours);
    let of_row = row.and_then(|row| Some(row.attempt?.saturating_add(i64::from(row_end(&row.status).is_some()))));
    let of_report = traces.report.as_ref().map(|report| report.digest.attempt.0);
    let latest = of_row.into_iter().chain(of_report).max();
    latest.map_or(0, |attempt| attempt.saturating_sub(draft.spec().attempt.0).max(0))
}

/// What to show of a run that goes on; none for one that begins.
pub(super) fn note(draft: &PlanBuilder<'_>) -> Option<String> {
    let plan = draft.status.plan.as_ref()?;
    let report = traces(draft)?.report.as_ref()?;
    let place = effective::results_url(&plan.storage, &plan.run_id);
    Some(format!(
        "The submission was run before and its object had lost its status; it goes on from {place}, where {} of {} routes are done.",
        report.digest.done, report.digest.total
    ))
}

pub(super) fn traces<'a>(draft: &PlanBuilder<'a>) -> Option<&'a Traces> {
    let is_asked = draft.spec().evalai.is_some() || is_marked(draft);
    let view = draft.view;
    match &view.traces {
        ObservedTraces::Answered(answer) if is_asked && has_not_run(draft) => answer.found.as_ref().ok(),
        _ => None,
    }
}

/// What table, bucket and EvalAI together show of attempt `wanted`.
pub(super) fn found(traces: &Traces, wanted: Attempt, info: Option<&EvalaiInfo>) -> Found {
    let row = traces.row.as_ref().filter(|row| row.is_ours);
    let row_end = row
        .filter(|row| row.attempt >= Some(wanted.0))
        .and_then(|row| row_end(&row.status));
    let report = traces.report.as_ref().map(|report| &report.digest);
    let is_complete = report.is_some_and(|report| report.is_complete() && report.eligible);
    let has_end =
        report.is_some_and(|report| report.attempt >= wanted && (report.is_verdict() || stop(report).is_some()));
    let run = if traces.stored.is_ours {
        Found::Run
    } else {
        Found::Nothing
    };
    let Some(info) = info else {
        return match row_end {
            Some(state) => Found::Ended(state),
            None if has_end => Found::Stored,
            None => run,
        };
    };
    match (info.standing, state_of(&info.status)) {
        (Standing::Wanted, _) if has_end => Found::Stored,
        // EvalAI resumes only what has failed: what is stored is of an earlier attempt.
        (Standing::Resumed | Standing::Wanted, _) => run,
        (Standing::Ended, Some(ImportedState::Finished)) if is_complete && row.is_some() && row_end.is_none() => {
            Found::Stored
        }
        // Participants can write `finished` too: it counts with the results alone.
        (Standing::Ended, Some(ImportedState::Finished)) if is_complete || row_end == Some(ImportedState::Finished) => {
            Found::Ended(ImportedState::Finished)
        }
        (Standing::Ended, Some(ImportedState::Failed)) if row.is_some() || traces.stored.is_ours => {
            Found::Ended(ImportedState::Failed)
        }
        // A host's re-run cancels what was finished; its state stays.
        (Standing::Ended, Some(ImportedState::Cancelled)) => row_end.map_or(Found::Nothing, Found::Ended),
        (Standing::Ended, _) => Found::Nothing,
    }
}

/// The end that EvalAI's status names.
fn state_of(status: &str) -> Option<ImportedState> {
    match status {
        "finished" => Some(ImportedState::Finished),
        "failed" => Some(ImportedState::Failed),
        "cancelled" => Some(ImportedState::Cancelled),
        _ => None,
    }
}

fn row_end(status: &str) -> Option<ImportedState> {
    state_of(&status.to_ascii_lowercase())
}

/// The stop with which a run has ended for good; one whose node was taken away goes on.
pub(super) fn stop(report: &ReportDigest) -> Option<Stop> {
    let stop = report.stopped.filter(|_| report.is_final)?;
    (stop != Stop::Interruption).then_some(stop)
}
