//! The calls that a bucket's worker makes. Each has a limit of time and always comes back with an answer.

use std::sync::Arc;
use std::time::Duration;

use kube::Client;
use sha2::{Digest, Sha256};

use super::request::{Answer, Done, Sent, Target, What, Work};
use super::text_budget::{MAX_TEXT, TextBudget};
use crate::controller::submissions::failure_log;
use crate::controller::submissions::report_digest::{ReportDigest, ReportId};
use crate::controller::submissions::view::{TextProblem, Texts};
use crate::pod::report::{MAX_BYTES, OWNER_KEY, Owner, REPORT_KEY, Report, StoredFile};
use crate::services::archive::{Archive, ArchiveError, Fetched};
use crate::services::held_text::{HeldMemory, HeldText};

/// Time that reading a report, or writing the fence, may take.
const LIMIT: Duration = Duration::from_secs(10);
/// Time a text may take to be read.
const TEXT_LIMIT: Duration = Duration::from_secs(20);
/// Where logcopy puts the texts, below the run's prefix.
const STDOUT_KEY: &str = "evalai/stdout.txt";
const METADATA_KEY: &str = "evalai/metadata.json";

/// Does one piece of work.
pub(super) async fn carry_out(client: &Client, archive: &Archive, budget: &TextBudget, work: &Work) -> Done {
    let target = &work.target;
    match &work.what {
        What::Report { etag, .. } => Done::Report(report(archive, target, etag.as_deref()).await.0),
        What::Texts { sent } => {
            let (answer, found) = report(archive, target, None).await;
            let texts = match (&answer, found) {
                (Answer::Found { report: digest, .. }, Some(report)) => {
                    let is_end = !sent.as_ref().is_some_and(Sent::is_live);
                    Ok(texts(archive, digest.id, report, budget, is_end).await)
                }
                (Answer::Failed(why), _) => Err(why.clone()),
                _ => Err("the stored report is gone".to_owned()),
            };
            Done::Texts { report: answer, texts }
        }
        What::Fence { mark, left, .. } => {
            let write = archive.put(OWNER_KEY, Owner::new(mark).to_json());
            let written = within(LIMIT.min(*left), archive, write).await;
            if let Err(why) = &written {
                tracing::warn!(why, "the fence against a lost Pod was not written");
            }
            Done::Fence(written.map(|_| ()))
        }
        What::Log { demand, tail } => {
            Done::Log(failure_log::keep(client, archive, &target.namespace, demand, tail.clone()).await)
        }
    }
}

async fn within<T>(
    limit: Duration,
    archive: &Archive,
    call: impl Future<Output = Result<T, ArchiveError>>,
) -> Result<T, String> {
    match tokio::time::timeout(limit, call).await {
        Ok(result) => result.map_err(|error| error.to_string()),
        Err(_) => Err(no_answer(archive)),
    }
}

fn no_answer(archive: &Archive) -> String {
    format!("the bucket {} did not answer in time", archive.bucket())
}

async fn report(archive: &Archive, target: &Target, etag: Option<&str>) -> (Answer, Option<Report>) {
    let read = archive.get_if_none_match(REPORT_KEY, etag, MAX_BYTES as u64);
    let object = match within(LIMIT, archive, read).await {
        Ok(Fetched::NotModified) => return (Answer::NotModified, None),
        Ok(Fetched::Absent) => return (Answer::Absent, None),
        Ok(Fetched::Found(object)) => object,
        Err(why) => return (Answer::Failed(why), None),
    };
    match ReportDigest::read(&object.bytes, &target.submission_uid) {
        Ok(Some((digest, report))) => {
            let found = Answer::Found {
                etag: object.etag,
                report: Arc::new(digest),
            };
            (found, Some(report))
        }
        Ok(None) => (Answer::Foreign { etag: object.etag }, None),
        Err(error) => {
            tracing::warn!(%error, "a stored report is not used");
            (Answer::Failed(error.to_string()), None)
        }
    }
}

/// Reads the texts once there is a place for both.
async fn texts(archive: &Archive, of: ReportId, report: Report, budget: &TextBudget, is_end: bool) -> Texts {
    let (named, left_out) = named(&report);
    let bytes = named.iter().map(|(_, file)| file.size).sum();
    let read = match budget.place(bytes, is_end).await {
        Ok(place) => {
            let of = |key: &'static str| {
                let file = named.iter().find(|(named, _)| *named == key).map(|(_, file)| *file);
                text(archive, key, file, Arc::clone(&place))
            };
            futures::future::try_join(of(STDOUT_KEY), of(METADATA_KEY)).await
        }
        Err(no_place) => Err(TextProblem::Unread(no_place.to_string())),
    };
    if let Some(why) = read.as_ref().err().map(TextProblem::why).or(left_out.as_deref()) {
        tracing::warn!(why, "the texts of a result were not read");
    }
    let problem = read.as_ref().err().cloned();
    let (stdout, metadata) = read.unwrap_or_default();
    Texts {
        of,
        stdout,
        metadata,
        problem,
        left_out,
        result: report.results,
        partial: report.partial_results,
    }
}

/// The texts that a report names, and why one of them is left out.
fn named(report: &Report) -> (Vec<(&'static str, &StoredFile)>, Option<String>) {
    let all = [STDOUT_KEY, METADATA_KEY].map(|key| Some((key, report.files.get(key)?)));
    let (read, large): (Vec<_>, Vec<_>) = all.into_iter().flatten().partition(|(_, file)| file.size <= MAX_TEXT);
    let why = large.first().map(|(key, file)| {
        let (size, limit) = (file.size, MAX_TEXT >> 20);
        format!("{key} was left out: it has {size} bytes, and EvalAI is sent texts of up to {limit} MiB. It is in the bucket.")
    });
    (read, why)
}

/// A text counts only with the digest that the report names.
async fn text(
    archive: &Archive,
    key: &'static str,
    expected: Option<&StoredFile>,
    place: HeldMemory,
) -> Result<HeldText, TextProblem> {
    let Some(expected) = expected else {
        return Ok(HeldText::default());
    };
    let another = || TextProblem::unfit(key, "is of another round than the report");
    // One that is larger than it was would take up more than its place.
    let read = match tokio::time::timeout(TEXT_LIMIT, archive.get(key, expected.size)).await {
        Ok(Err(error)) if error.is_too_large() => return Err(another()),
        read => read
            .map_err(|_| no_answer(archive))
            .and_then(|read| read.map_err(|e| e.to_string())),
    };
    let object = read.map_err(TextProblem::Unread)?;
    let object = object.ok_or_else(|| TextProblem::unfit(key, "is missing although the report names it"))?;
    if hex::encode(Sha256::digest(&object.bytes)) != expected.sha256 {
        return Err(another());
    }
    let text = String::from_utf8(object.bytes).map_err(|_| TextProblem::unfit(key, "is not text"))?;
    Ok(HeldText::new(text, place))
}
