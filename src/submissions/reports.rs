//! The report of a run in its bucket. It is read for each demand of `decide`, and once a period while the run goes on.
//!
//! An end is decided only on a report that was requested after the end was seen, so the known stage is part of the question.

use std::sync::Arc;
use std::time::Duration;

use jiff::Timestamp;

use crate::ask::Asked;
use leaderboard_api::{Attempt, JobNumber, RunPlan, S3Bucket, effective};
use leaderboard_aws::archive::{Archive, ArchiveError, Fetched};
use leaderboard_aws::clients::Aws;
use leaderboard_contract::report::{MAX_BYTES, REPORT_KEY};
use leaderboard_policy::ask::{Ask, Failure, Lookup, Rank, Service};
use leaderboard_policy::report_digest::ReportDigest;
use leaderboard_policy::view::{ObservedReport, ReportDemand, ReportView, Stage};

/// Time before a read that failed is made again while a decision waits for it.
const READ_AGAIN: Duration = Duration::from_secs(10);

/// Where the files of a run are.
#[derive(Debug, PartialEq)]
pub struct RunFiles {
    storage: S3Bucket,
    /// Key prefix of the run in the bucket, with the final slash.
    prefix: String,
    /// UID that its reports name, if they are of the time before the object was restored from a backup.
    former_uid: Option<String>,
}

impl RunFiles {
    /// The files of the run with this plan, of the submission with this UID.
    pub fn of(plan: &RunPlan, uid: &str) -> Arc<Self> {
        Arc::new(Self {
            storage: plan.storage.s3.clone(),
            prefix: effective::key_prefix(&plan.storage.s3, &plan.run_id),
            former_uid: plan.submission_uid.clone().filter(|former| former != uid),
        })
    }

    pub(super) fn service(&self) -> Service {
        Service::bucket(&self.storage)
    }

    pub(super) fn archive(&self, aws: &Aws) -> Archive {
        Archive::of_storage(aws, &self.storage).at_prefix(self.prefix.clone())
    }
}

/// Asks for a report.
#[derive(Clone, Debug)]
pub struct Report {
    pub demand: ReportDemand,
    /// When the run ended, or was seen to have ended: of several that have, the oldest end is read first.
    pub ended: Timestamp,
    pub files: Arc<RunFiles>,
}

impl PartialEq for Report {
    fn eq(&self, other: &Self) -> bool {
        let (one, two) = (&self.demand, &other.demand);
        // The Pod goes with its Job.
        let is_of_pod = one.pod == two.pod || one.stage == Stage::JobEnded;
        (one.job, one.stage, one.period) == (two.job, two.stage, two.period) && is_of_pod && self.files == other.files
    }
}

/// The object that is stored where a report belongs.
#[derive(Clone, Debug, PartialEq)]
pub struct Stored {
    etag: Option<String>,
    /// None: it is another object's report.
    digest: Option<Arc<ReportDigest>>,
}

impl Ask for Report {
    /// None: there is none.
    type Answer = Option<Stored>;
    const AT_ONCE: usize = 512;
    const AT_ONCE_OF_A_SERVICE: usize = 64;
    const LONGEST: Duration = Duration::from_secs(10);
    // At most 100 a second. With more live runs than a period has room for, each is read in its turn.
    const SPACING: Duration = Duration::from_millis(10);

    fn service(&self) -> Service {
        self.files.service()
    }

    fn again(&self, result: &Result<Option<Stored>, Failure>, _failures: u32, _waited: Duration) -> Option<Duration> {
        match result {
            _ if self.demand.stage == Stage::Live => Some(self.demand.period),
            Ok(_) => None,
            Err(_) => Some(READ_AGAIN),
        }
    }

    /// Ends are read before what goes on.
    fn rank(&self) -> Rank {
        match self.demand.stage {
            Stage::Live => (1, 0),
            Stage::RunEnded | Stage::JobEnded => (0, self.ended.as_second()),
        }
    }

    /// A run that goes on again has another end.
    fn outdates(&self, older: &Self) -> bool {
        let goes_on = older.demand.job == self.demand.job && older.demand.stage > self.demand.stage;
        goes_on || older.files != self.files
    }
}

/// Reads the report, unless the bucket still holds the one that is known.
pub async fn read(aws: Aws, asked: Asked<Report>) -> Result<Option<Stored>, Failure> {
    let last = asked.last.as_ref().and_then(|last| last.result.as_ref().as_ref().ok());
    let known = last.and_then(Option::as_ref);
    let etag = known.and_then(|known| known.etag.as_deref());
    let files = &asked.question.files;
    let archive = files.archive(&aws);
    let object = match archive.get_if_none_match(REPORT_KEY, etag, MAX_BYTES as u64).await {
        Ok(Fetched::NotModified) => return Ok(known.cloned()),
        Ok(Fetched::Absent) => return Ok(None),
        Ok(Fetched::Found(object)) => object,
        Err(error) => return Err(silent(&error)),
    };
    let uid = files.former_uid.as_ref().unwrap_or(&asked.about.uid);
    let digest = ReportDigest::read(&object.bytes, uid).map_err(|error| {
        tracing::warn!(%error, "a stored report is not used");
        Failure::silent(error.to_string())
    })?;
    Ok(Some(Stored {
        etag: object.etag,
        digest: digest.map(Arc::new),
    }))
}

/// A bucket that refuses may be opened again at any moment, and what it held before still counts then.
pub(super) fn silent(error: &ArchiveError) -> Failure {
    Failure::silent(error.to_string())
}

/// The report as it is known, seen from a run that is at this Job with this Pod.
pub fn seen(lookup: &Lookup<Report>, job: JobNumber, pod: Option<&str>) -> ReportView {
    let last = lookup.last.as_ref();
    let is_of = |asked: &ReportDemand| {
        let is_of_pod = asked.pod.as_deref() == pod || asked.stage == Stage::JobEnded;
        asked.job == job && is_of_pod
    };
    let stage = last.map(|last| &last.question.demand).filter(|asked| is_of(asked));
    ReportView {
        stored: last.map_or(ObservedReport::NotRead, |last| match last.result.as_ref() {
            Ok(None) => ObservedReport::Absent,
            Ok(Some(stored)) => shown(stored, job.attempt, last.question.files.former_uid.is_some()),
            Err(failure) => ObservedReport::Unreadable(failure.why.clone()),
        }),
        stage: stage.map(|asked| asked.stage),
        waited: lookup.waited.unwrap_or_default(),
    }
}

/// The report as that of an attempt. `is_former`: the report is older than the object, which was restored from a backup. It may be of a
/// later attempt than the object knows. Its own Pods store reports of its attempt alone.
fn shown(stored: &Stored, wanted: Attempt, is_former: bool) -> ObservedReport {
    let is_ours = |digest: &&Arc<ReportDigest>| digest.attempt == wanted || (is_former && digest.attempt > wanted);
    match stored.digest.as_ref().filter(is_ours) {
        Some(digest) => ObservedReport::Ours(Arc::clone(digest)),
        None => ObservedReport::Foreign,
    }
}

#[cfg(test)]
mod tests;

#[cfg(test)]
mod read_tests;
