//! What a report shows of a run: progress, score, workers, and what its host should know of scores and logs.

use super::status::PlanBuilder;
use crate::controller::submissions::report_digest::{ReportDigest, clamp};
use leaderboard_api::conditions::{self, Truth};
use leaderboard_api::text::sentence;
use leaderboard_api::{WorkerStatus, reasons};
use leaderboard_contract::report::Logs;

/// Takes in how far the run is.
pub(super) fn take(draft: &mut PlanBuilder<'_>, report: &ReportDigest) {
    draft.status.progress = Some(report.progress());
    let is_complete = report.is_final && report.done == report.total;
    if let Some(score) = report.score(is_complete) {
        draft.status.score = Some(score);
        draft.status.metrics.clone_from(&report.metrics);
    }
    let old = std::mem::take(&mut draft.status.workers);
    draft.status.workers = report
        .workers
        .iter()
        .map(|worker| {
            let known = old.iter().find(|k| k.id == clamp(worker.id));
            WorkerStatus {
                id: clamp(worker.id),
                done: clamp(worker.done),
                total: clamp(worker.total),
                // The kubelet counts them: a report can know of a crash before its end shows whose fault it was.
                crashes: known.map_or(0, |k| k.crashes),
                state: worker.state,
                last: known.and_then(|k| k.last.clone()),
                ended_from_outside: known.map_or(0, |k| k.ended_from_outside),
                environment_failed: known.is_some_and(|k| k.environment_failed),
            }
        })
        .collect();
    note_scores(draft, report);
    note_logs(draft, report);
}

/// A report of before a restore may be of a later attempt than the object knows of. The table's row counts on from it.
pub(super) fn count_attempts(draft: &mut PlanBuilder<'_>) {
    let present = draft.status.attempt.unwrap_or_default();
    let (Some(report), Some(plan)) = (draft.view.report.ours(), draft.status.plan.as_mut()) else {
        return;
    };
    let ahead = report.attempt.0.saturating_sub(present.0);
    plan.earlier_attempts = plan.earlier_attempts.max(ahead);
}

/// Whether a report can be of the present Job, rather than of one before it whose end is settled: it stays where it is until the present
/// Job's first round. The Pod decides. Without one, what was stopped is the present Job's only if that is being ended too.
pub(super) fn is_of_present_job(draft: &PlanBuilder<'_>, report: &ReportDigest) -> bool {
    draft.is_first_job()
        || match &draft.view.pod {
            Some(pod) => pod.uid == report.pod_uid,
            None => report.stopped.is_none() || draft.is_to_stop(),
        }
}

/// Reports that scores do not follow from the infractions, and that they do again.
fn note_scores(draft: &mut PlanBuilder<'_>, report: &ReportDigest) {
    let (truth, reason, message) = match &report.warning {
        Some(first) => {
            let message = format!("Scores do not follow from the infractions: {}", sentence(first));
            (Truth::False, reasons::UNEXPLAINED_SCORES, message)
        }
        None if draft.status.condition(conditions::PLAUSIBLE).is_none() => return,
        None => (Truth::True, reasons::SCORES_EXPLAINED, String::new()),
    };
    draft.condition(conditions::PLAUSIBLE, truth, reason, &message);
}

/// Reports that CloudWatch refuses the lines of the run, and that it takes them again.
fn note_logs(draft: &mut PlanBuilder<'_>, report: &ReportDigest) {
    let is_known = draft.status.condition(conditions::LOGGED).is_some();
    match &report.logs {
        Some(Logs::Refused(why)) => {
            let why = sentence(why);
            draft.condition(conditions::LOGGED, Truth::False, reasons::LOGS_REFUSED, &why);
        }
        Some(Logs::Sent) if is_known => {
            draft.condition(conditions::LOGGED, Truth::True, reasons::LOGS_SENT, "");
        }
        _ => {}
    }
}
