//! The controller's side of EvalAI and DynamoDB: turns views of the services into what `decide` reads, and what `decide`
//! wants into updates and rows. Never waits for either. Decides nothing.

use std::collections::HashMap;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use kube::ResourceExt;

use super::observe::workers::Workers;
use super::records::{self, Record};
use super::result_texts;
use crate::ask::Asker;
use crate::runtime::objects::{key_of, log_span_of, uid};
use leaderboard_api::{Ingested, JobNumber, Leaderboard, Submission, SubmissionStatus, names};
use leaderboard_base::lock::lock;
use leaderboard_base::object_key::ObjectKey;
use leaderboard_evalai as evalai;
use leaderboard_evalai::{
    DesiredUpdate, Ended, Hub, ImageAnswer, Outcome, Patience, Publisher, Run, Status, Subject, SubmissionState, Target,
};
use leaderboard_policy::allowed::Allowed;
use leaderboard_policy::submissions::{EvalaiUpdate, TableUpdate, patience};
use leaderboard_policy::view::{EvalaiEnd, EvalaiInfo, EvalaiView, RecordView, Standing, View};

/// Doors to both services, and what each Leaderboard needs to go through them.
pub struct ExternalSystems {
    pub hub: Hub,
    pub records: Asker<Record>,
    allowed: Allowed,
    targets: Mutex<HashMap<String, Arc<Target>>>,
}

impl ExternalSystems {
    pub fn new(hub: Hub, records: Asker<Record>, allowed: Allowed) -> Self {
        Self {
            hub,
            records,
            allowed,
            targets: Mutex::default(),
        }
    }

    /// The first name that a Leaderboard may not use, in words; nothing of it is started or recorded then.
    pub fn refusal(&self, leaderboard: &Leaderboard) -> Option<String> {
        self.allowed.refusal(leaderboard).map(|refused| refused.to_string())
    }

    /// A Leaderboard's way to EvalAI, renewed whenever its spec or token changes.
    pub fn serve(&self, leaderboard: &Leaderboard, target: Target) {
        let key = key_of(leaderboard);
        if let Err(error) = self.hub.serve(&key, &target) {
            tracing::error!(leaderboard = %key, %error, "cannot create EvalAI client");
        }
        lock(&self.targets).insert(key.uid, Arc::new(target));
    }

    /// Nothing more of a Leaderboard goes to EvalAI.
    pub fn retire(&self, leaderboard: &Leaderboard) {
        lock(&self.targets).remove(uid(leaderboard));
        self.hub.retire(&key_of(leaderboard));
    }

    fn target(&self, leaderboard: &Leaderboard) -> Option<Arc<Target>> {
        lock(&self.targets).get(uid(leaderboard)).cloned()
    }

    /// The last known state of a submission in EvalAI. None for a submission that is not of EvalAI.
    pub fn evalai_view(
        &self,
        leaderboard: Option<&Leaderboard>,
        submission: &Submission,
        waited: Duration,
    ) -> Option<EvalaiView> {
        let evalai = submission.spec.evalai?;
        let view = if let Some(seen) = self.hub.view(&key_of(submission)) {
            let observes = leaderboard.is_some_and(|board| board.spec.observes());
            let wants_image = wants_image(submission, leaderboard);
            EvalaiView {
                shows_partial: leaderboard.is_some_and(|board| self.hub.shows_partial(&key_of(board), evalai.phase)),
                ..map_view(&as_observed(seen, observes), submission, wants_image)
            }
        } else {
            let cancelled_as_of = |board: &Leaderboard| self.hub.cancelled_as_of(&key_of(board), evalai.submission);
            let is_ready = leaderboard.is_some_and(|board| self.target(board).is_some());
            EvalaiView {
                error: (!is_ready).then(|| "the Leaderboard's token is not known yet; see its status".to_owned()),
                cancelled_as_of: leaderboard.and_then(cancelled_as_of),
                ..EvalaiView::default()
            }
        };
        Some(EvalaiView {
            waited,
            writes_from: self.hub.writes_from(),
            ..view
        })
    }

    /// The last known state of a submission's row. None without a table.
    pub fn record_view(&self, leaderboard: &Leaderboard, submission: &Submission) -> Option<RecordView> {
        leaderboard.spec.dynamo_table()?;
        if let Some(refusal) = self.refusal(leaderboard) {
            return Some(RecordView {
                error: Some(refusal),
                ..RecordView::default()
            });
        }
        let attempt = submission.status.as_ref().map(result_texts::attempt_of_run);
        let seen = |attempt| records::seen(&self.records.get(uid(submission)), attempt);
        Some(attempt.map(seen).unwrap_or_default())
    }

    /// Asks EvalAI whether a submission wants to run, or what became of one that has ended.
    pub fn ask(&self, view: &View) {
        let Some(subject) = self.subject(view) else { return };
        let wants_image = wants_image(&view.submission, view.leaderboard.as_deref());
        let asked = self.hub.ask(&subject, wants_image);
        log_refused(asked);
    }

    /// Looks for a submission's end in EvalAI from now on.
    pub fn follow(&self, view: &View, status: &SubmissionStatus) {
        let Some(subject) = self.subject(view) else { return };
        let since = status.times.submitted.as_ref().map_or(view.now, |t| t.0);
        let followed = self.hub.live(&subject, since);
        log_refused(followed);
    }

    /// Updates EvalAI with what the view shows. `workers` have the log of a failure.
    pub fn update_evalai(&self, workers: &Workers, view: &View, status: &SubmissionStatus, update: EvalaiUpdate) {
        let Some(subject) = self.subject(view) else { return };
        let Some(publisher) = Publisher::of(subject) else {
            return;
        };
        let with_end = |outcome| final_update(workers, view, status, outcome);
        let desired = match update {
            EvalaiUpdate::Queued => DesiredUpdate::Queued,
            EvalaiUpdate::Running => DesiredUpdate::Running,
            EvalaiUpdate::Partial { is_shown } => {
                let outline = result_texts::outline(view, status, is_shown, Patience::ENDLESS);
                DesiredUpdate::Partial(Arc::new(outline))
            }
            EvalaiUpdate::Finished => with_end(Outcome::Finished),
            EvalaiUpdate::Failed => with_end(Outcome::Failed),
            EvalaiUpdate::Cancelled => with_end(Outcome::Cancelled),
        };
        log_refused(self.hub.update(&publisher, desired));
    }

    /// Writes the row, or lets the next write carry it.
    pub fn record(&self, view: &View, status: &SubmissionStatus, update: TableUpdate) {
        let leaderboard = view.leaderboard.as_ref().filter(|_| view.not_allowed.is_none());
        let Some(table) = leaderboard.and_then(|l| l.spec.dynamo_table()) else {
            return;
        };
        let submission = view.submission.as_ref();
        if let Some(row) = result_texts::row(view.report.ours().map(Arc::as_ref), status) {
            let record = Record {
                table: table.clone(),
                row: row.into(),
                is_end: update != TableUpdate::Progress,
            };
            records::record(&self.records, &key_of(submission), record, log_span_of(submission));
        }
    }

    /// Drops everything of an object that is gone, or whose end both systems have.
    pub fn gone(&self, key: &ObjectKey) {
        lock(&self.targets).remove(&key.uid);
        self.hub.forget(key);
        self.records.forget(&key.uid);
    }

    fn subject(&self, view: &View) -> Option<Subject> {
        let evalai = view.submission.spec.evalai?;
        let target = self.target(view.leaderboard.as_deref()?)?;
        Some(Subject {
            target,
            key: key_of(view.submission.as_ref()),
            pk: evalai.submission,
            run: run_of(&view.submission),
        })
    }
}

/// The present attempt, as EvalAI's side has to know it.
fn run_of(submission: &Submission) -> Run {
    let attempt = submission.present_attempt();
    let status = submission.status.as_ref();
    let is_restart = status.is_some_and(SubmissionStatus::is_restart);
    Run {
        attempt,
        job: names::job(&submission.name_any(), JobNumber::first(attempt)),
        by_hand: !is_restart && !Ingested::of(submission).is_some_and(|record| record.has_begun(attempt)),
        has_job: is_restart || status.is_some_and(SubmissionStatus::has_run),
        ended: status.and_then(|s| s.times.finished.as_ref()).map(|time| time.0),
        log: log_span_of(submission),
    }
}

fn final_update(workers: &Workers, view: &View, status: &SubmissionStatus, outcome: Outcome) -> DesiredUpdate {
    let mut outline = result_texts::outline(view, status, false, patience(view, status));
    outline.stderr = result_texts::stderr(status);
    if outcome == Outcome::Failed {
        let tail = workers.tail(&view.submission, status);
        result_texts::add_log(&mut outline, tail, result_texts::log_readers(view));
    }
    DesiredUpdate::Final(outcome, Arc::new(outline))
}

/// True if a submission names no image and has not ended, so that it needs the image that EvalAI names. A Leaderboard of files needs none.
fn wants_image(submission: &Submission, leaderboard: Option<&Leaderboard>) -> bool {
    let status = submission.status.as_ref();
    let has_ended = status.is_some_and(SubmissionStatus::has_ended);
    let takes_images = leaderboard.is_none_or(|board| !board.spec.evaluation.takes_files());
    takes_images && submission.spec.image.is_none() && !has_ended
}

/// In Observe mode only a cancel in EvalAI ends our run; `finished` and `failed` are the other program's.
fn as_observed(seen: SubmissionState, observes: bool) -> SubmissionState {
    let is_others = |status: &Status| observes && matches!(status, Status::Finished | Status::Failed);
    SubmissionState {
        ended: seen.ended.filter(|status| !is_others(status)),
        ..seen
    }
}

fn map_view(seen: &SubmissionState, submission: &Submission, wants_image: bool) -> EvalaiView {
    let attempt = submission.present_attempt();
    // An image that was asked for is waited for; why there is none is an answer too.
    let image_known = !wants_image || seen.image.is_some();
    let present = seen.attempt == attempt;
    let ended = seen.ended.filter(|_| present);
    let answered = seen.answered >= Some(attempt);
    let (image, image_problem) = match seen.image.clone() {
        Some(ImageAnswer::Named(image)) => (Some(image), None),
        Some(ImageAnswer::NotAnImage(why)) => (None, Some(why)),
        Some(ImageAnswer::Unread(_)) | None => (None, None),
    };
    EvalaiView {
        info: seen
            .row
            .as_ref()
            .filter(|_| answered && image_known)
            .map(|row| EvalaiInfo {
                standing: match (ended, row.status) {
                    (Some(_), _) => Standing::Ended,
                    (None, Status::Resuming) => Standing::Resumed,
                    (None, _) => Standing::Wanted,
                },
                status: ended.unwrap_or(row.status),
                phase: row.phase,
                team_id: row.team_id.map(|id| id.to_string()).unwrap_or_default(),
                team_name: row.team_name.clone(),
                submitted_at: row.submitted_at,
                resumed_at: row.resumed_at,
                last_attempt: row.last_attempt(),
                image,
                image_problem,
            }),
        read_at: seen.read_at,
        cancelled: ended.is_some(),
        overtaken: ended.is_some() && seen.overtaken,
        end: seen.end.as_ref().filter(|_| present).map(map_end),
        unread: seen.unread.clone().filter(|_| present),
        partial_done: seen.partial_done.filter(|_| present),
        team_id: seen.row.as_ref().and_then(|row| row.team_id).map(|id| id.to_string()),
        error: seen.last_error.clone(),
        ..EvalaiView::default()
    }
}

fn map_end(end: &Ended) -> EvalaiEnd {
    match end {
        // It was there before our own end, which then is a cancel: nothing else of ours leaves it as it is.
        Ended::Agreed {
            status: status @ Status::Finished,
            ..
        }
        | Ended::Otherwise(status) => EvalaiEnd::Ended(*status),
        Ended::Published { at, .. } | Ended::Agreed { at, .. } => EvalaiEnd::Published { at: *at },
        Ended::Refused(message) => EvalaiEnd::Refused {
            message: message.clone(),
        },
    }
}

fn log_refused(result: Result<(), evalai::ClientError>) {
    if let Err(error) = result {
        tracing::error!(%error, "cannot create EvalAI client");
    }
}

#[cfg(test)]
mod tests;
