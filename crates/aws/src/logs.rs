//! CloudWatch Logs: batches of events within the API's limits, into one stream each.
//!
//! Called by the Pod's log shipper. Knows streams and events; which file becomes which stream is its caller's.

use std::time::Duration;

use aws_sdk_cloudwatchlogs::error::{ProvideErrorMetadata, SdkError};
use aws_sdk_cloudwatchlogs::types::InputLogEvent;

use crate::clients::Aws;
use crate::fault::{self, Fault};
use leaderboard_api::LogGroup;

/// Events of one request.
const MAX_EVENTS: usize = 10_000;
/// Bytes of one request, each event counted with its overhead.
pub const MAX_BYTES: usize = 1 << 20;
/// Bytes that each event costs beyond its text.
pub const OVERHEAD: usize = 26;
/// Bytes of one event's text.
pub const MAX_TEXT: usize = (256 << 10) - OVERHEAD;

/// Events go to one group.
#[derive(Clone, Debug)]
pub struct LogClient {
    client: aws_sdk_cloudwatchlogs::Client,
    group: String,
}

/// One line of a log.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LogEvent {
    /// Milliseconds since 1970.
    pub time: i64,
    /// At most [`MAX_TEXT`] bytes, never empty.
    pub text: String,
}

/// A request that CloudWatch did not carry out.
#[derive(thiserror::Error, Debug)]
#[error("{op} {group}/{stream} in CloudWatch Logs: {}", .miss.after(.why))]
pub struct LogsError {
    /// Operation, as a verb.
    op: &'static str,
    /// The group.
    group: String,
    /// The stream.
    stream: String,
    /// Its message, or the client's.
    why: String,
    /// Consequence for the events.
    pub miss: Miss,
}

/// Consequence of a failed request for its events.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Miss {
    /// They are refused.
    Refused,
    /// The stream does not exist.
    NoStream,
    /// It takes no more requests for now: nothing of this one is stored.
    Throttled,
    /// No answer came: they may be there or not.
    Unanswered,
}

impl Miss {
    fn after(self, why: &str) -> String {
        match self {
            Self::Refused | Self::NoStream => format!("{why}. {HINT}"),
            Self::Throttled => format!("too many requests ({why}). It is tried again."),
            Self::Unanswered => format!("no answer ({why}). {HINT}"),
        }
    }
}

const HINT: &str = "Check that logs.cloudWatch of the leaderboard exists (the controller makes it where logs.cloudWatch.retentionDays \
                    is set), and logs:CreateLogStream, logs:PutLogEvents and logs:GetLogEvents of the Pod's identity; \
                    results do not depend on it.";

impl LogsError {
    /// True if the same request may succeed in a moment.
    pub fn is_transient(&self) -> bool {
        matches!(self.miss, Miss::Throttled | Miss::Unanswered)
    }
}

impl LogClient {
    /// The group of a Leaderboard.
    pub fn of_group(aws: &Aws, group: &LogGroup) -> Self {
        Self {
            client: aws.logs(group.region.as_deref(), group.endpoint.as_deref()),
            group: group.name.clone(),
        }
    }

    /// Makes a stream; one that is there already is fine.
    pub async fn create_stream(&self, stream: &str) -> Result<(), LogsError> {
        let request = self.client.create_log_stream().log_group_name(&self.group);
        match request.log_stream_name(stream).send().await {
            Ok(_) => Ok(()),
            Err(error) if error.code() == Some("ResourceAlreadyExistsException") => Ok(()),
            Err(error) => Err(self.failed("creating", stream, &error)),
        }
    }

    /// Writes one batch: at most [`MAX_EVENTS`] and [`MAX_BYTES`], in the order of their times.
    pub async fn put(&self, stream: &str, events: &[LogEvent]) -> Result<(), LogsError> {
        const OP: &str = "writing to";
        let built: Result<Vec<_>, _> = events
            .iter()
            .map(|event| {
                InputLogEvent::builder()
                    .timestamp(event.time)
                    .message(&event.text)
                    .build()
            })
            .collect();
        let built = built.map_err(|error| self.error(OP, stream, error.to_string(), Miss::Refused))?;
        let request = self.client.put_log_events().log_group_name(&self.group);
        let request = request.log_stream_name(stream).set_log_events(Some(built));
        let answer = request.send().await.map_err(|error| self.failed(OP, stream, &error))?;
        if let Some(rejected) = answer.rejected_log_events_info() {
            tracing::warn!(
                stream,
                too_old_until = rejected.too_old_log_event_end_index(),
                expired_until = rejected.expired_log_event_end_index(),
                too_new_from = rejected.too_new_log_event_start_index(),
                "CloudWatch Logs rejected events for their age"
            );
        }
        Ok(())
    }

    /// The newest event of a stream, to find out whether an unanswered batch arrived.
    pub async fn last(&self, stream: &str) -> Result<Option<LogEvent>, LogsError> {
        let request = self.client.get_log_events().log_group_name(&self.group);
        let request = request.log_stream_name(stream).start_from_head(false).limit(1);
        let answer = request
            .send()
            .await
            .map_err(|error| self.failed("reading", stream, &error))?;
        let last = answer.events().last();
        Ok(last.and_then(|event| {
            Some(LogEvent {
                time: event.timestamp()?,
                text: event.message()?.to_owned(),
            })
        }))
    }

    fn failed<E>(
        &self,
        op: &'static str,
        stream: &str,
        error: &SdkError<E, aws_sdk_cloudwatchlogs::config::http::HttpResponse>,
    ) -> LogsError
    where
        E: ProvideErrorMetadata + std::error::Error + 'static,
    {
        let answered = error.raw_response().is_some_and(|raw| raw.status().as_u16() < 500);
        let miss = match error.code() {
            _ if fault::of(error) == Fault::Throttled => Miss::Throttled,
            Some("ResourceNotFoundException") if answered => Miss::NoStream,
            _ if answered => Miss::Refused,
            _ => Miss::Unanswered,
        };
        self.error(op, stream, fault::sentence(error), miss)
    }

    fn error(&self, op: &'static str, stream: &str, why: String, miss: Miss) -> LogsError {
        LogsError {
            op,
            group: self.group.clone(),
            stream: stream.to_owned(),
            why,
            miss,
        }
    }
}

/// The next batch of a log: as many whole lines as one request may have, and how many bytes they are. `rest`: the last
/// line counts although it has no end. Empty lines are left out since the API refuses them.
pub fn cut(bytes: &[u8], rest: bool, time: i64) -> (Vec<LogEvent>, usize) {
    let (mut events, mut consumed, mut cost) = (Vec::new(), 0, 0);
    for line in bytes.split_inclusive(|byte| *byte == b'\n') {
        if !rest && !line.ends_with(b"\n") {
            break;
        }
        let text = String::from_utf8_lossy(line);
        let pieces = pieces(text.trim_end_matches(['\n', '\r']));
        cost += pieces.iter().map(|piece| piece.len() + OVERHEAD).sum::<usize>();
        if !events.is_empty() && (cost > MAX_BYTES || events.len() + pieces.len() > MAX_EVENTS) {
            break;
        }
        consumed += line.len();
        events.extend(pieces.into_iter().map(|text| LogEvent {
            time,
            text: text.to_owned(),
        }));
    }
    (events, consumed)
}

fn pieces(mut line: &str) -> Vec<&str> {
    let mut pieces = Vec::new();
    while !line.is_empty() {
        let (piece, after) = line.split_at(line.floor_char_boundary(MAX_TEXT));
        pieces.push(piece);
        line = after;
    }
    pieces
}

/// Time between two requests to one stream: the API takes five a second.
pub const BETWEEN_BATCHES: Duration = Duration::from_millis(200);

#[cfg(test)]
mod tests {
    use super::*;

    fn texts(bytes: &[u8], rest: bool) -> (Vec<String>, usize) {
        let (events, consumed) = cut(bytes, rest, 1);
        (events.into_iter().map(|event| event.text).collect(), consumed)
    }

    #[test]
    fn whole_lines_become_events_and_empty_ones_nothing() {
        assert_eq!(texts(b"a\n\nb\r\nc", false), (vec!["a".to_owned(), "b".to_owned()], 6));
        assert_eq!(texts(b"a\nc", true), (vec!["a".to_owned(), "c".to_owned()], 3));
        assert_eq!(texts(b"\n\n", false), (vec![], 2));
        assert_eq!(texts(b"\xff\n", false), (vec!["\u{fffd}".to_owned()], 2));
    }

    #[test]
    fn a_long_line_is_cut_between_characters() {
        let line = "é".repeat(MAX_TEXT / 2 + 10);
        let (cut, consumed) = texts(line.as_bytes(), true);
        assert_eq!((cut.len(), consumed), (2, line.len()));
        assert!(cut.iter().all(|piece| piece.len() <= MAX_TEXT));
        assert_eq!(cut.concat(), line);
    }

    #[test]
    fn a_batch_keeps_both_limits() {
        let (events, consumed) = cut(&b"x\n".repeat(10_001), false, 1);
        assert_eq!((events.len(), consumed), (MAX_EVENTS, 20_000));
        let (events, _) = cut(&[b"x".repeat(200 << 10), b"\n".to_vec()].concat().repeat(9), false, 1);
        assert_eq!(events.len(), 5);
        let (events, _) = cut(
            &b"xxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxx\n".repeat(10_000),
            false,
            1,
        );
        assert!(events.iter().map(|event| event.text.len() + OVERHEAD).sum::<usize>() <= MAX_BYTES);
        assert!(events.len() < 10_000);
    }
}
