//! A submission that was run before its object lost its status, as a restore from a backup leaves it: what is `stored` of it shows whether
//! it has ended, and from where it goes on.

use std::time::Duration;

use super::plan_builder::{PlanBuilder, Terms};
use super::stored::{Found, found, may_be, note, stop, traces};
use super::{failure, pin, reading, reported};
use crate::controller::submissions::report_digest::{ReportDigest, StoredReport};
use crate::controller::submissions::view::{ObservedReport, Stage};
use crate::pod::run::Stop;
use leaderboard_api::conditions::{self, Truth};
use leaderboard_api::{ImportedEnd, ImportedState, SubmissionStatus, Times, effective, reasons};

/// Takes the end over that is stored, if there is one. Returns whether the submission does not go on to its turn.
pub(super) fn ends(draft: &mut PlanBuilder<'_>, terms: Terms<'_>) -> bool {
    let Some(traces) = traces(draft).filter(|_| may_be(draft)) else {
        return false;
    };
    let report = traces.report.as_deref();
    match found(traces, draft.spec().attempt, terms.info) {
        Found::Nothing => false,
        Found::Run => {
            if let Some(report) = report {
                reported::take(draft, &report.digest);
            }
            false
        }
        Found::Ended(state) => {
            show_end(draft, terms, state, report.map(|report| &report.digest));
            true
        }
        Found::Stored => {
            let Some(report) = report else { return false };
            let named = draft.spec().image.as_ref();
            let image = named.or_else(|| terms.info?.image.as_ref()).cloned();
            pin::pin(draft, terms, image.unwrap_or_default());
            take_end(draft, report);
            true
        }
    }
}

/// As if its Job had been seen and were gone: all that follows an end is then the same.
fn take_end(draft: &mut PlanBuilder<'_>, report: &StoredReport) {
    reported::take(draft, &report.digest);
    if let Some(plan) = draft.status.plan.as_mut() {
        plan.submission_uid = Some(report.submission_uid.clone());
    }
    let note = note(draft).unwrap_or_default();
    draft.status.job_name = Some(draft.job_name());
    draft.condition(conditions::ACCEPTED, Truth::True, reasons::RESTORED, &note);
    match stop(&report.digest).filter(|_| !report.digest.is_verdict()) {
        Some(Stop::Cancel) => draft.status.times.stopping = Some(draft.time()),
        Some(Stop::Retries | Stop::RunDeadline) => draft.fail(failure::before_restore()),
        Some(Stop::Interruption) | None => {}
    }
    draft.requeue_in(Duration::ZERO);
}

/// Whether an end that was taken over waits for the bucket: that it cannot be read at the moment is no reason to make a Job for it.
pub(super) fn awaits_report(draft: &PlanBuilder<'_>) -> bool {
    let report = &draft.view.report;
    let is_unread = matches!(report, ObservedReport::NotRead | ObservedReport::Unreadable(_));
    let is_open = is_unread || !reading::is_of(draft, Stage::JobEnded);
    let of_former = draft.status.plan.as_ref().and_then(|plan| plan.submission_uid.as_ref());
    let is_former = of_former.is_some() && of_former != draft.submission().metadata.uid.as_ref();
    let accepted = draft.status.condition(conditions::ACCEPTED);
    let is_restored = accepted.is_some_and(|c| c.reason == reasons::RESTORED);
    is_open && is_former && is_restored && draft.is_first_job() && draft.status.times.scheduled.is_none()
}

/// Shows an end that every system has: nothing is run, published or recorded again.
fn show_end(draft: &mut PlanBuilder<'_>, terms: Terms<'_>, state: ImportedState, report: Option<&ReportDigest>) {
    let complete = report.filter(|report| report.is_complete() && report.eligible);
    let score = complete.filter(|_| state == ImportedState::Finished);
    let end = ImportedEnd {
        state,
        track: terms.track.name.clone(),
        results_url: report.map(|_| effective::results_url(&terms.leaderboard.storage, &draft.submission().run_id())),
        progress: report.map(ReportDigest::progress),
        score: score.and_then(|report| report.score(true)),
        times: Times {
            submitted: draft.status.times.submitted.clone(),
            ..Times::default()
        },
        table: String::new(),
    };
    let what = "The submission had ended before its object was restored without a status; nothing was run, published or recorded again.";
    let generation = draft.submission().metadata.generation.unwrap_or_default();
    let team = draft.status.team.take();
    let now = draft.time();
    draft.status = SubmissionStatus::of_ended(draft.spec(), end, what, generation, &now);
    draft.status.team = team;
    draft.requeue_in(Duration::ZERO);
}
