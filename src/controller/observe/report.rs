//! The report of a run: read from S3 once a period with If-None-Match, and always when its run or its Job has ended.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use jiff::Timestamp;
use kube::ResourceExt;

use super::{report_matters, uid_of};
use crate::controller::context::Context;
use crate::controller::view::{JobSight, PodView, ReportSight};
use crate::pod::report::{MAX_BYTES, REPORT_KEY, Report};
use crate::services::archive::Fetched;
use leaderboard_api::{Submission, SubmissionStatus};

/// Time one read may take; the pass goes on without it.
pub const READ_TIMEOUT: Duration = Duration::from_secs(10);

/// What was last read, by UID of the Submission.
#[derive(Default)]
pub struct Reports {
    known: Mutex<HashMap<String, Known>>,
}

#[derive(Clone)]
struct Known {
    etag: Option<String>,
    sight: Sight,
    read_at: Timestamp,
}

#[derive(Clone)]
enum Sight {
    Absent,
    Report(Arc<Report>),
}

impl Reports {
    /// Drops what is known of an object that is gone.
    pub fn forget(&self, uid: &str) {
        self.lock().remove(uid);
    }

    fn get(&self, uid: &str) -> Option<Known> {
        self.lock().get(uid).cloned()
    }

    fn put(&self, uid: &str, known: Known) {
        self.lock().insert(uid.to_owned(), known);
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, HashMap<String, Known>> {
        self.known.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Reads the report if this pass needs it.
pub async fn read(
    context: &Context,
    submission: &Submission,
    job: &JobSight,
    pod: Option<&PodView>,
    now: Timestamp,
) -> ReportSight {
    if !report_matters(submission, job) {
        return ReportSight::NotRead;
    }
    let Some(status) = &submission.status else {
        return ReportSight::NotRead;
    };
    let uid = uid_of(submission);
    let known = context.reports.get(&uid);
    let has_ended = pod.is_some_and(|pod| pod.run_ended.is_some());
    let live = !has_ended && job.ours().is_some_and(|j| j.end.is_none());
    if live && status.times.scheduled.is_none() {
        return ReportSight::NotRead;
    }
    let fresh = known
        .as_ref()
        .is_some_and(|k| now.duration_since(k.read_at).as_secs_f64() < context.half_period(submission));
    if let Some(known) = known.as_ref().filter(|_| live && fresh) {
        return sight(&known.sight, submission, status);
    }
    fetch(context, submission, status, known, now).await
}

/// Reads the report now, whatever the state.
pub async fn read_now(context: &Context, submission: &Submission, now: Timestamp) -> ReportSight {
    let Some(status) = &submission.status else {
        return ReportSight::NotRead;
    };
    let known = context.reports.get(&uid_of(submission));
    fetch(context, submission, status, known, now).await
}

async fn fetch(
    context: &Context,
    submission: &Submission,
    status: &SubmissionStatus,
    known: Option<Known>,
    now: Timestamp,
) -> ReportSight {
    let Some(plan) = &status.plan else {
        return ReportSight::NotRead;
    };
    let uid = uid_of(submission);
    let archive = context.archive(&plan.storage, &plan.run_id);
    let etag = known.as_ref().and_then(|k| k.etag.clone());
    let read = archive.get_if_none_match(REPORT_KEY, etag.as_deref(), MAX_BYTES as u64);
    let fetched = match context.buckets.call(&plan.storage, READ_TIMEOUT, read).await {
        Ok(fetched) => fetched,
        Err(error) => return ReportSight::Unreadable(error.to_string()),
    };
    let known = match (fetched, known) {
        (Fetched::NotModified, Some(known)) => Known { read_at: now, ..known },
        (Fetched::NotModified | Fetched::Absent, _) => Known {
            etag: None,
            sight: Sight::Absent,
            read_at: now,
        },
        (Fetched::Found(object), _) => match Report::parse(&object.bytes) {
            Ok(report) => Known {
                etag: object.etag,
                sight: Sight::Report(Arc::new(report)),
                read_at: now,
            },
            Err(error) => {
                tracing::warn!(submission = %submission.name_any(), %error, "a stored report is not used");
                return ReportSight::Unreadable(error.to_string());
            }
        },
    };
    let seen = sight(&known.sight, submission, status);
    context.reports.put(&uid, known);
    seen
}

fn sight(sight: &Sight, submission: &Submission, status: &SubmissionStatus) -> ReportSight {
    match sight {
        Sight::Absent => ReportSight::Absent,
        Sight::Report(report) if report.belongs_to(&uid_of(submission), status.attempt.unwrap_or(1)) => {
            ReportSight::Ours(Arc::clone(report))
        }
        Sight::Report(_) => ReportSight::Foreign,
    }
}
