//! The file that a participant has uploaded to EvalAI, copied into the bucket of its run right before its Job.
//!
//! Anyone who has its address may be able to read the file. So the address is taken from EvalAI's side for each copy, and is kept nowhere.

use futures::stream::{self, BoxStream, StreamExt};
use hyper::body::Bytes;
use tokio::time::{Instant, timeout_at};

use super::reports::silent;
use crate::ask::Asked;
use leaderboard_aws::archive::{Archive, StreamError};
use leaderboard_aws::clients::Aws;
use leaderboard_contract::keys::INPUT_FILE;
use leaderboard_evalai::{Hub, InputError, InputStream};
use leaderboard_policy::ask::Failure;
use leaderboard_policy::questions::{Absence, Fetched, INPUT_LIMIT, Input};

/// Why a file was not read; None: the time for it was over.
type Unread = Option<InputError>;

/// Copies the file, and logs the outcome.
pub async fn copy((aws, hub): (Aws, Hub), asked: Asked<Input>) -> Result<Fetched, Failure> {
    let fetched = fetch(&aws, &hub, &asked).await;
    match &fetched {
        Ok(fetched) => tracing::info!(%fetched, "the submitted file was asked for"),
        Err(failure) => tracing::warn!(why = failure.why, "the submitted file was not copied"),
    }
    fetched
}

async fn fetch(aws: &Aws, hub: &Hub, asked: &Asked<Input>) -> Result<Fetched, Failure> {
    let end = Instant::now() + INPUT_LIMIT;
    let Some(address) = hub.input_address(&asked.about) else {
        return Err(Failure::silent("EvalAI has not given out the address of the file."));
    };
    let stream = match hub.open_input(&address).await {
        Ok(stream) => until(stream, end),
        Err(error) => return unread(Some(error), asked),
    };
    let question = &asked.question;
    let archive = Archive::of_run(aws, &question.storage, &question.run_id);
    match archive.put_stream(INPUT_FILE, stream, question.limit).await {
        Ok(file) => Ok(Fetched::Stored(file)),
        Err(StreamError::TooLarge(_)) => Ok(Fetched::TooLarge),
        Err(StreamError::Broken(why)) => unread(why, asked),
        Err(StreamError::Archive(error)) => Err(silent(&error)),
    }
}

/// A stream that fails at this moment, if it is not over by then. So an upload is aborted, which the end of the question's own time would
/// not do.
fn until(stream: InputStream, end: Instant) -> BoxStream<'static, Result<Bytes, Unread>> {
    let chunks = stream::unfold(stream, move |mut stream| async move {
        let next = match timeout_at(end, stream.next()).await {
            // Chunks that are always there are late, too, where the bucket takes them slowly.
            Ok(next) if Instant::now() < end => next.map(|chunk| chunk.map_err(Some)),
            Ok(_) | Err(_) => Some(Err(None)),
        };
        next.map(|chunk| (chunk, stream))
    });
    chunks.boxed()
}

/// The answer about a file that was not read. The times that it was missing are counted from answer to answer.
fn unread(why: Unread, asked: &Asked<Input>) -> Result<Fetched, Failure> {
    let why = match why {
        Some(InputError::Gone(status)) => Absence::Status(status),
        Some(InputError::NoFile) => Absence::NoFile,
        None => Absence::Late,
        Some(InputError::Refused(why)) => return Err(Failure { is_refused: true, why }),
        Some(InputError::Silent(why)) => return Err(Failure::silent(why)),
    };
    let last = asked.last.as_ref().filter(|last| last.question == asked.question);
    let before = match last.map(|last| last.result.as_ref()) {
        Some(Ok(Fetched::Missing { times, .. })) => *times,
        _ => 0,
    };
    let times = before.saturating_add(1);
    Ok(Fetched::Missing { why, times })
}

#[cfg(test)]
mod tests;
