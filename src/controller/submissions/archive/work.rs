//! The calls that a bucket's worker makes. Each has a limit of time and always comes back with an answer.

use std::sync::Arc;
use std::time::Duration;

use kube::Client;

use super::request::{Answer, Done, Target, What, Work};
use crate::controller::submissions::failure_log;
use crate::controller::submissions::report_digest::ReportDigest;
use crate::services::archive::{Archive, ArchiveError, Fetched};
use leaderboard_contract::report::{MAX_BYTES, OWNER_KEY, Owner, REPORT_KEY};

/// Time that reading a report, or writing the fence, may take.
const LIMIT: Duration = Duration::from_secs(10);

/// Does one piece of work.
pub(super) async fn carry_out(client: &Client, archive: &Archive, work: &Work) -> Done {
    let target = &work.target;
    match &work.what {
        What::Report { etag, .. } => Done::Report(report(archive, target, etag.as_deref()).await),
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

async fn report(archive: &Archive, target: &Target, etag: Option<&str>) -> Answer {
    let read = archive.get_if_none_match(REPORT_KEY, etag, MAX_BYTES as u64);
    let object = match within(LIMIT, archive, read).await {
        Ok(Fetched::NotModified) => return Answer::NotModified,
        Ok(Fetched::Absent) => return Answer::Absent,
        Ok(Fetched::Found(object)) => object,
        Err(why) => return Answer::Failed(why),
    };
    let etag = object.etag;
    match ReportDigest::read(&object.bytes, &target.submission_uid) {
        Ok(Some(digest)) => Answer::Found {
            etag,
            report: Arc::new(digest),
        },
        Ok(None) => Answer::Foreign { etag },
        Err(error) => {
            tracing::warn!(%error, "a stored report is not used");
            Answer::Failed(error.to_string())
        }
    }
}
