//! The file that a participant has uploaded to EvalAI, copied into the bucket of its run right before its Job.
//!
//! Anyone who has its address may be able to read the file. So the address is taken from EvalAI's side for each copy, and is kept nowhere.

use std::time::Duration;

use futures::stream::{self, StreamExt};
use tokio::time::{Instant, timeout_at};

use super::reports::silent;
use crate::ask::{Asked, Asker, Wake};
use leaderboard_aws::archive::{Archive, StreamError};
use leaderboard_aws::clients::Aws;
use leaderboard_base::tasks::Tasks;
use leaderboard_contract::keys::INPUT_FILE;
use leaderboard_evalai::{Hub, InputError, InputStream};
use leaderboard_policy::ask::Failure;
use leaderboard_policy::questions::{Fetched, Input};

/// Time that a file may take. When it is over an upload is aborted, which the end of the question's own time would not do.
const LIMIT: Duration = Duration::from_mins(30);

/// Starts the task that copies.
pub fn start(aws: &Aws, hub: &Hub, tasks: &Tasks, wake: Wake) -> Asker<Input> {
    let (aws, hub) = (aws.clone(), hub.clone());
    Asker::start("inputs", tasks, wake, move |asked| {
        let (aws, hub) = (aws.clone(), hub.clone());
        async move {
            let fetched = fetch(&aws, &hub, &asked).await;
            match &fetched {
                Ok(fetched) => tracing::info!(%fetched, "the submitted file was asked for"),
                Err(failure) => tracing::warn!(why = failure.why, "the submitted file was not copied"),
            }
            fetched
        }
    })
}

async fn fetch(aws: &Aws, hub: &Hub, asked: &Asked<Input>) -> Result<Fetched, Failure> {
    let end = Instant::now() + LIMIT;
    let Some(address) = hub.input_address(&asked.about) else {
        return Err(Failure::silent("EvalAI has not given out the address of the file."));
    };
    let stream = match hub.open_input(&address).await {
        Ok(stream) => until(stream, end),
        Err(error) => return unread(error, asked),
    };
    let question = &asked.question;
    let archive = Archive::of_run(aws, &question.storage, &question.run_id);
    match archive.put_stream(INPUT_FILE, stream, question.limit).await {
        Ok(file) => Ok(Fetched::Stored(file)),
        Err(StreamError::TooLarge(_)) => Ok(Fetched::TooLarge),
        Err(StreamError::Broken(error)) => unread(error, asked),
        Err(StreamError::Archive(error)) => Err(silent(&error)),
    }
}

/// A stream that fails at this moment, if it is not over by then.
fn until(stream: InputStream, end: Instant) -> InputStream {
    let late = || {
        let why = format!("the file did not come within {} s", LIMIT.as_secs());
        Some(Err(InputError::Silent(why)))
    };
    let chunks = stream::unfold(stream, move |mut stream| async move {
        let next = timeout_at(end, stream.next()).await.unwrap_or_else(|_| late());
        next.map(|chunk| (chunk, stream))
    });
    chunks.boxed()
}

/// The answer about a file that was not read. The times that its address has not had it are counted from answer to answer.
fn unread(error: InputError, asked: &Asked<Input>) -> Result<Fetched, Failure> {
    match error {
        InputError::Gone(status) => {
            let last = asked.last.as_ref().filter(|last| last.question == asked.question);
            let before = match last.map(|last| last.result.as_ref()) {
                Some(Ok(Fetched::Gone { times, .. })) => *times,
                _ => 0,
            };
            let times = before.saturating_add(1);
            Ok(Fetched::Gone { status, times })
        }
        InputError::Refused(why) => Err(Failure { is_refused: true, why }),
        InputError::Silent(why) => Err(Failure::silent(why)),
    }
}

#[cfg(test)]
mod tests;
