//! Reads what EvalAI is sent of a result: the results of the report that was decided on, and the texts that it names.
//!
//! Called by EvalAI's side, right before the row of the submission is read. Each read has a limit of time.

use std::sync::Arc;
use std::time::Duration;

use futures::FutureExt;
use jiff::Timestamp;
use sha2::{Digest, Sha256};

use leaderboard_aws::archive::Archive;
use leaderboard_aws::clients::Aws;
use leaderboard_base::clock::Clock;
use leaderboard_contract::keys::{METADATA, STDOUT};
use leaderboard_contract::report::{ContentId, MAX_BYTES, REPORT_KEY, Report, StoredFile};
use leaderboard_evalai::{Outline, Payload, PayloadProblem, PayloadReader, StoredResult};
use leaderboard_policy::report_digest::MAX_TEXT;

/// Time that one read may take.
const LIMIT: Duration = Duration::from_secs(10);

/// The reader of the runs' buckets.
pub fn reader(aws: Aws, clock: Clock) -> PayloadReader {
    Arc::new(move |outline| {
        let (aws, now) = (aws.clone(), clock.now());
        async move {
            match &outline.stored {
                Some(stored) => read(&aws, &outline, stored, now).await,
                None => Ok(Payload::bare(&outline)),
            }
        }
        .boxed()
    })
}

async fn read(aws: &Aws, outline: &Outline, stored: &StoredResult, now: Timestamp) -> Result<Payload, PayloadProblem> {
    let archive = Archive::of_storage(aws, &stored.storage).at_prefix(stored.prefix.clone());
    let (bare, patience) = (Payload::bare(outline), stored.patience);
    let report = match report(&archive, stored.report).await {
        Ok(report) => report,
        Err(problem) => return left_out(bare, problem, now < patience.report),
    };
    let so_far = report.partial_results.filter(|_| stored.so_far);
    let found = Payload {
        result: so_far.unwrap_or(report.results),
        ..bare
    };
    let of = |key| text(&archive, key, report.files.get(key));
    match futures::future::try_join(of(STDOUT), of(METADATA)).await {
        Ok((stdout, metadata)) => Ok(Payload {
            stdout,
            metadata,
            ..found
        }),
        Err(problem @ PayloadProblem::Unread(_)) => left_out(found, problem, now < patience.unread),
        Err(problem @ PayloadProblem::Unfit(_)) => left_out(found, problem, now < patience.unfit),
    }
}

/// The payload without the part that has the problem; the problem itself while that part is awaited.
fn left_out(found: Payload, problem: PayloadProblem, is_awaited: bool) -> Result<Payload, PayloadProblem> {
    if is_awaited {
        return Err(problem);
    }
    let (PayloadProblem::Unread(why) | PayloadProblem::Unfit(why)) = problem;
    tracing::warn!(why, "EvalAI is sent a result without what cannot be read");
    Ok(found)
}

/// The very report that was decided on: its digest covers the Pod and the attempt that it names.
async fn report(archive: &Archive, id: ContentId) -> Result<Report, PayloadProblem> {
    let bytes = get(archive, REPORT_KEY, MAX_BYTES as u64).await?;
    if ContentId::of(&bytes) != id {
        return Err(unfit(REPORT_KEY, "is another one than was decided on"));
    }
    Report::parse(&bytes).map_err(|error| PayloadProblem::Unfit(error.to_string()))
}

/// A text counts only with the digest that the report names.
async fn text(archive: &Archive, key: &str, expected: Option<&StoredFile>) -> Result<String, PayloadProblem> {
    let Some(expected) = expected.filter(|file| file.size <= MAX_TEXT) else {
        return Ok(String::new());
    };
    let bytes = get(archive, key, expected.size).await?;
    if hex::encode(Sha256::digest(&bytes)) != expected.sha256 {
        return Err(unfit(key, "is of another round than the report"));
    }
    String::from_utf8(bytes).map_err(|_| unfit(key, "is not text"))
}

async fn get(archive: &Archive, key: &str, limit: u64) -> Result<Vec<u8>, PayloadProblem> {
    match tokio::time::timeout(LIMIT, archive.get(key, limit)).await {
        Ok(Ok(Some(object))) => Ok(object.bytes),
        Ok(Ok(None)) => Err(unfit(key, "is missing")),
        Ok(Err(error)) if error.is_too_large() => Err(unfit(key, "is of another round than the report")),
        Ok(Err(error)) => Err(PayloadProblem::Unread(error.to_string())),
        Err(_) => {
            let bucket = archive.bucket();
            Err(PayloadProblem::Unread(format!(
                "the bucket {bucket} did not answer in time"
            )))
        }
    }
}

fn unfit(key: &str, problem: &str) -> PayloadProblem {
    PayloadProblem::Unfit(format!("{key} {problem}"))
}

#[cfg(test)]
mod tests;
