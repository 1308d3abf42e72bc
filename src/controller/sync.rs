//! The controller's side of EvalAI and DynamoDB: turns views of the services into what `decide` reads, and what `decide`
//! wants into wishes and rows. Never waits for either; reads S3 for the texts of a result.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};

use jiff::{SignedDuration, Timestamp};
use kube::ResourceExt;

use super::bucket::BucketError;
use super::context::Context;
use super::decide::Tell;
use super::observe::{report, uid_of};
use super::reruns;
use super::result_texts::{self, TextError};
use super::view::{EvalaiEnd, EvalaiInfo, EvalaiView, RecordView, ReportSight, Standing, View};
use crate::services::ObjectKey;
use crate::services::evalai::{
    self, DesiredUpdate, Ended, Hub, ImageAnswer, Outcome, Payload, Run, Status, Subject, SubmissionState, Target,
};
use crate::services::table::Recorder;
use leaderboard_api::{Ingested, Leaderboard, Rerun, Submission, SubmissionStatus, conditions, names};

/// How long an end waits to be told for a result that cannot be read: as long as the end itself.
pub(super) const END_WAITS: SignedDuration = SignedDuration::from_hours(24);
/// What is left to tell an end in before the finalizer of a deleted object gives up.
const BEFORE_RELEASE: SignedDuration = SignedDuration::from_mins(2);

/// Doors to both services, and what each Leaderboard needs to go through them.
pub struct Sync {
    pub hub: Hub,
    pub recorder: Recorder,
    targets: Mutex<HashMap<String, Arc<Target>>>,
}

impl Sync {
    pub fn new(hub: Hub, recorder: Recorder) -> Self {
        Self {
            hub,
            recorder,
            targets: Mutex::default(),
        }
    }

    /// A Leaderboard's way to EvalAI, renewed whenever its spec or token changes.
    pub fn set_target(&self, leaderboard: &Leaderboard, target: Option<Arc<Target>>) {
        let mut targets = self.targets.lock().unwrap_or_else(PoisonError::into_inner);
        match target {
            Some(target) => targets.insert(uid_of(leaderboard), target),
            None => targets.remove(&uid_of(leaderboard)),
        };
    }

    fn target(&self, leaderboard: &Leaderboard) -> Option<Arc<Target>> {
        self.targets
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .get(&uid_of(leaderboard))
            .cloned()
    }

    /// What EvalAI is known to say of a submission.
    /// `known` looks another Submission up by its name.
    pub fn evalai_view(
        &self,
        leaderboard: Option<&Leaderboard>,
        submission: &Submission,
        known: impl Fn(&str) -> Option<Arc<Submission>>,
    ) -> Option<EvalaiView> {
        submission.spec.evalai?;
        let Some(seen) = self.hub.view(&object_key(submission)) else {
            let ready = leaderboard.is_some_and(|l| self.target(l).is_some());
            let error = (!ready).then(|| "the Leaderboard's token is not known yet; see its status".to_owned());
            return Some(EvalaiView {
                error,
                ..EvalaiView::default()
            });
        };
        let rerun_of = seen
            .row
            .as_ref()
            .and_then(|row| reruns::original(row, submission, known));
        Some(map_view(&seen, submission, rerun_of))
    }

    /// What is known of a submission's row. None without a table.
    pub fn record_view(&self, leaderboard: &Leaderboard, submission: &Submission) -> Option<RecordView> {
        leaderboard.spec.table.as_ref()?;
        let attempt = submission.status.as_ref().and_then(|s| s.attempt);
        let seen = self
            .recorder
            .view(&object_key(submission))
            .filter(|seen| Some(seen.attempt) == attempt);
        Some(seen.map_or_else(RecordView::default, |s| RecordView {
            end_written: s.end_written,
            error: s.error,
        }))
    }

    /// Asks EvalAI whether a submission wants to run, or what became of one that has ended.
    pub fn ask(&self, view: &View) {
        let Some(subject) = self.subject(view) else { return };
        let wants_image = wants_image(&view.submission);
        let asked = self.hub.ask(&subject, wants_image);
        log_refused(&view.submission, asked);
    }

    /// Looks for a submission's end in EvalAI from now on, also while it waits before anything of it runs.
    pub fn follow(&self, view: &View, status: &SubmissionStatus) {
        let Some(subject) = self.subject(view) else { return };
        let since = status.times.submitted.as_ref().map_or(view.now, |t| t.0);
        let followed = self.hub.live(&subject, since);
        log_refused(&view.submission, followed);
    }

    /// Tells EvalAI. Texts that cannot be read now are told by a later pass.
    pub async fn tell(&self, context: &Context, view: &View, status: &SubmissionStatus, tell: Tell) {
        let Some(subject) = self.subject(view) else { return };
        let update = match tell {
            Tell::Queued => Some(DesiredUpdate::Queued),
            Tell::Running => Some(DesiredUpdate::Running),
            Tell::Partial => partial(context, view).await.map(DesiredUpdate::Partial),
            Tell::Finished => final_wish(context, view, status, Outcome::Finished).await,
            Tell::Failed => final_wish(context, view, status, Outcome::Failed).await,
            Tell::Cancelled => final_wish(context, view, status, Outcome::Cancelled).await,
        };
        if matches!(tell, Tell::Queued | Tell::Running) {
            self.follow(view, status);
        }
        if let Some(update) = update {
            log_refused(&view.submission, self.hub.update(&subject, update));
        }
    }

    /// Nothing more is wanted of EvalAI for this object.
    pub fn forget(&self, submission: &Submission) {
        self.hub.forget(&object_key(submission));
    }

    /// Writes the row, or lets the next write carry it. That of a finished submission has the metrics of what was stored last.
    pub async fn record(&self, context: &Context, view: &View, status: &SubmissionStatus, end: bool) {
        let table = view.leaderboard.as_ref().and_then(|l| l.spec.table.as_ref());
        let Some(table) = table else { return };
        let sight = if result_texts::is_finished(status) {
            last_report(context, view).await
        } else {
            ReportSight::NotRead
        };
        if matches!(sight, ReportSight::Unreadable(_)) && may_wait(view, status, END_WAITS) {
            return;
        }
        if end && !matches!(sight, ReportSight::Unreadable(_)) {
            context.memory.note_read(&view.submission);
        }
        if let Some(row) = result_texts::row(sight.ours().map(Arc::as_ref), status) {
            self.recorder
                .record(table, &object_key(view.submission.as_ref()), row, end);
        }
    }

    /// Drops everything of an object that is gone.
    pub fn gone(&self, key: &ObjectKey) {
        self.hub.forget(key);
        self.recorder.forget(key);
    }

    fn subject(&self, view: &View) -> Option<Subject> {
        let evalai = view.submission.spec.evalai?;
        let target = self.target(view.leaderboard.as_deref()?)?;
        Some(Subject {
            target,
            key: object_key(view.submission.as_ref()),
            pk: evalai.submission,
            run: run_of(&view.submission),
        })
    }
}

/// The present attempt, as EvalAI's side has to know it.
fn run_of(submission: &Submission) -> Run {
    let attempt = submission.spec.attempt;
    let status = submission.status.as_ref().filter(|s| s.attempt == Some(attempt));
    Run {
        attempt,
        job: names::job(&submission.name_any(), attempt, 0),
        by_hand: !Ingested::of(submission).is_some_and(|record| record.has_begun(attempt)),
        has_job: status.is_some_and(|s| s.job_name.is_some() || s.retry > 0),
    }
}

async fn partial(context: &Context, view: &View) -> Option<Arc<Payload>> {
    let report = view.report.ours()?;
    let leaderboard = object_key(view.leaderboard.as_deref()?);
    let is_shown = context.sync.hub.shows_partial(&leaderboard, result_texts::phase(view));
    let read = result_texts::partial_payload(context, view, report, is_shown).await;
    let attempt = view.submission.spec.attempt;
    // What takes too long or is not there is left out: the next route has a result of its own.
    if !matches!(read, Err(TextError::Unread(BucketError::Refused(_)))) {
        context.memory.told_partial(&view.submission, attempt, report.done);
    }
    let unread = |why: &TextError| {
        tracing::warn!(submission = %view.submission.name_any(), %why, "the texts of a partial result were not read");
    };
    Some(Arc::new(read.inspect_err(unread).ok()?))
}

/// The report as it is stored at the end; passes after the end read none.
async fn last_report(context: &Context, view: &View) -> ReportSight {
    let sight = match view.report.ours() {
        Some(report) => ReportSight::Ours(Arc::clone(report)),
        None => report::read_now(context, &view.submission, view.now).await,
    };
    if let ReportSight::Unreadable(why) = &sight {
        note_unread(context, view, why);
    }
    sight
}

/// The status tells it until the result could be read, our own log once.
fn note_unread(context: &Context, view: &View, why: &str) {
    if view.unread.is_none() {
        tracing::warn!(submission = %view.submission.name_any(), %why, "the result cannot be read, so its end waits");
    }
    context.memory.note_unread(&view.submission, why);
}

/// Whether an end that is told once waits for its result: so long after it was decided, and not until the finalizer gives up.
fn may_wait(view: &View, status: &SubmissionStatus, longest: SignedDuration) -> bool {
    let end = conditions::get(&status.conditions, conditions::FINISHED);
    let until = |from: Timestamp, time: SignedDuration| from.checked_add(time).unwrap_or(Timestamp::MAX);
    let patience = until(end.map_or(view.now, |c| c.last_transition_time.0), longest);
    let Some(deleted) = &view.submission.metadata.deletion_timestamp else {
        return view.now < patience;
    };
    let seconds = view
        .leaderboard
        .as_ref()
        .map_or(0, |l| l.spec.deadlines.finalize_seconds);
    let release = until(deleted.0, SignedDuration::from_secs(seconds) - BEFORE_RELEASE);
    view.now < patience.min(release)
}

async fn final_wish(
    context: &Context,
    view: &View,
    status: &SubmissionStatus,
    outcome: Outcome,
) -> Option<DesiredUpdate> {
    let sight = last_report(context, view).await;
    let mut payload = match &sight {
        ReportSight::Ours(report) => match result_texts::payload(context, view, report).await {
            Ok(payload) => {
                context.memory.note_read(&view.submission);
                payload
            }
            Err(error) if may_wait(view, status, error.patience()) => {
                note_unread(context, view, &error.to_string());
                return None;
            }
            Err(_) => result_texts::without_texts(view, report),
        },
        // What is Finished is nothing without its result.
        ReportSight::Unreadable(_) if outcome == Outcome::Finished || may_wait(view, status, END_WAITS) => return None,
        _ => Payload {
            phase: result_texts::phase(view),
            result: "[]".into(),
            ..Payload::default()
        },
    };
    payload.stderr = result_texts::stderr(status);
    if outcome == Outcome::Failed {
        let uid = uid_of(view.submission.as_ref());
        let tail = context.failure_logs.tail(&uid, status);
        result_texts::add_log(&mut payload, tail, result_texts::log_readers(view));
    }
    Some(DesiredUpdate::Final(outcome, Arc::new(payload)))
}

/// Whether it is run only with an image that EvalAI names.
fn wants_image(submission: &Submission) -> bool {
    let status = submission.status.as_ref();
    let has_ended = status.is_some_and(|s| conditions::is_true(&s.conditions, conditions::FINISHED));
    submission.spec.image.is_none() && !has_ended
}

fn map_view(seen: &SubmissionState, submission: &Submission, rerun_of: Option<Rerun>) -> EvalaiView {
    let attempt = submission.spec.attempt;
    // An image that was asked for is waited for; why there is none is an answer too.
    let image_known = !wants_image(submission) || seen.image.is_some();
    let present = seen.attempt == attempt;
    let ended = seen.ended.filter(|_| present);
    let answered = seen.answered >= attempt;
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
                status: ended.unwrap_or(row.status).as_str().to_owned(),
                phase: row.phase,
                team_id: row.team_id.map(|id| id.to_string()).unwrap_or_default(),
                team_name: row.team_name.clone(),
                submitted_at: row.submitted_at,
                rerun_of,
                image,
                image_problem,
            }),
        read_at: seen.read_at,
        cancelled: ended.is_some(),
        overtaken: ended.is_some() && seen.overtaken,
        end: seen
            .end
            .as_ref()
            .filter(|_| present)
            .map(|end| map_end(end, seen.read_at)),
        team_id: seen.row.as_ref().and_then(|row| row.team_id).map(|id| id.to_string()),
        error: seen.last_error.clone(),
    }
}

fn map_end(end: &Ended, read_at: Option<Timestamp>) -> EvalaiEnd {
    match end {
        Ended::Published { at, .. } => EvalaiEnd::Published { at: *at },
        Ended::Agreed(_) => EvalaiEnd::Published {
            at: read_at.unwrap_or_else(Timestamp::now),
        },
        Ended::Otherwise(status) => EvalaiEnd::Ended {
            status: status.as_str().to_owned(),
        },
        Ended::Refused(message) => EvalaiEnd::Refused {
            message: message.clone(),
        },
    }
}

fn log_refused(submission: &Submission, result: Result<(), evalai::client::ClientError>) {
    if let Err(error) = result {
        tracing::error!(submission = %submission.name_any(), %error, "cannot create EvalAI client");
    }
}

fn object_key(object: &impl ResourceExt) -> ObjectKey {
    ObjectKey {
        namespace: object.namespace().unwrap_or_default(),
        name: object.name_any(),
        uid: uid_of(object),
    }
}

#[cfg(test)]
#[path = "sync_tests.rs"]
mod tests;
