//! The calls that a bucket's worker makes. Each has a limit of time and always comes back with an answer.

use std::sync::Arc;
use std::time::Duration;

use kube::Client;
use sha2::{Digest, Sha256};

use super::request::{Answer, Done, Target, What, Work};
use crate::controller::submissions::failure_log;
use crate::controller::submissions::report_digest::{ReportDigest, ReportId};
use crate::controller::submissions::view::{TextProblem, Texts};
use crate::pod::report::{MAX_BYTES, OWNER_KEY, Owner, REPORT_KEY, Report};
use crate::pod::upload::hex;
use crate::services::archive::{Archive, ArchiveError, Fetched};

/// Time that reading a report, or writing the fence, may take.
const LIMIT: Duration = Duration::from_secs(10);
/// Time a text may take to be read.
const TEXT_LIMIT: Duration = Duration::from_secs(20);
/// Largest text that is passed on to EvalAI, in bytes.
const MAX_TEXT: u64 = 16 << 20;
/// Where logcopy puts the texts, below the run's prefix.
const STDOUT_KEY: &str = "evalai/stdout.txt";
const METADATA_KEY: &str = "evalai/metadata.json";

/// Does one piece of work.
pub(super) async fn carry_out(client: &Client, archive: &Archive, work: &Work) -> Done {
    let target = &work.target;
    match &work.what {
        What::Report { etag, .. } => Done::Report(report(archive, target, &work.uid, etag.as_deref()).await.0),
        What::Texts { .. } => {
            let (answer, found) = report(archive, target, &work.uid, None).await;
            let texts = match (&answer, found) {
                (Answer::Found { report: digest, .. }, Some(report)) => {
                    Ok(texts(archive, target, digest.id, report).await)
                }
                (Answer::Failed(why), _) => Err(why.clone()),
                _ => Err("the stored report is gone".to_owned()),
            };
            Done::Texts { report: answer, texts }
        }
        What::Fence { mark, left, .. } => {
            let write = archive.put(OWNER_KEY, Owner::new(mark).to_json());
            let written = within(LIMIT.min(*left), target, write).await;
            if let Err(why) = &written {
                let (object, why) = (&target.name, why.as_str());
                tracing::warn!(submission = %object, why, "the fence against a lost Pod was not written");
            }
            Done::Fence(written.map(|_| ()))
        }
        What::Log { demand, tail } => {
            let object = (target.namespace.as_str(), target.name.as_str());
            Done::Log(failure_log::keep(client, archive, object, demand, tail.clone()).await)
        }
    }
}

async fn within<T>(
    limit: Duration,
    target: &Target,
    call: impl Future<Output = Result<T, ArchiveError>>,
) -> Result<T, String> {
    match tokio::time::timeout(limit, call).await {
        Ok(result) => result.map_err(|error| error.to_string()),
        Err(_) => Err(format!("the bucket {} did not answer in time", target.storage.bucket)),
    }
}

async fn report(archive: &Archive, target: &Target, uid: &str, etag: Option<&str>) -> (Answer, Option<Report>) {
    let read = archive.get_if_none_match(REPORT_KEY, etag, MAX_BYTES as u64);
    let object = match within(LIMIT, target, read).await {
        Ok(Fetched::NotModified) => return (Answer::NotModified, None),
        Ok(Fetched::Absent) => return (Answer::Absent, None),
        Ok(Fetched::Found(object)) => object,
        Err(why) => return (Answer::Failed(why), None),
    };
    match ReportDigest::read(&object.bytes, uid) {
        Ok(Some((digest, report))) => {
            let found = Answer::Found {
                etag: object.etag,
                report: Arc::new(digest),
            };
            (found, Some(report))
        }
        Ok(None) => (Answer::Foreign { etag: object.etag }, None),
        Err(error) => {
            tracing::warn!(submission = %target.name, %error, "a stored report is not used");
            (Answer::Failed(error.to_string()), None)
        }
    }
}

async fn texts(archive: &Archive, target: &Target, of: ReportId, report: Report) -> Texts {
    let text = |key| text(archive, target, &report, key);
    let read = futures::future::try_join(text(STDOUT_KEY), text(METADATA_KEY)).await;
    if let Err(problem) = &read {
        tracing::warn!(submission = %target.name, why = problem.why(), "the texts of a result were not read");
    }
    let problem = read.as_ref().err().cloned();
    let (stdout, metadata) = read.unwrap_or_default();
    Texts {
        of,
        result: report.results,
        partial: report.partial_results,
        stdout,
        metadata,
        problem,
    }
}

/// A text counts only with the digest that the report names.
async fn text(archive: &Archive, target: &Target, report: &Report, key: &'static str) -> Result<String, TextProblem> {
    let Some(expected) = report.files.get(key) else {
        return Ok(String::new());
    };
    let read = within(TEXT_LIMIT, target, archive.get(key, MAX_TEXT)).await;
    let object = read.map_err(TextProblem::Unread)?;
    let object = object.ok_or_else(|| TextProblem::unfit(key, "is missing although the report names it"))?;
    if hex(&Sha256::digest(&object.bytes)) != expected.sha256 {
        return Err(TextProblem::unfit(key, "is of another round than the report"));
    }
    String::from_utf8(object.bytes).map_err(|_| TextProblem::unfit(key, "is not text"))
}
