//! One SQS queue: receive, extend, postpone, delete, move to the dead-letter queue.
//!
//! Called by `sqs`. Knows no Leaderboards and no policy; errors name the queue and what to do.

use std::time::Duration;

use aws_sdk_sqs::Client;
use aws_sdk_sqs::config::http::HttpResponse;
use aws_sdk_sqs::error::{ProvideErrorMetadata, SdkError};
use aws_sdk_sqs::operation::receive_message::ReceiveMessageOutput;
use aws_sdk_sqs::types::{
    ChangeMessageVisibilityBatchRequestEntry, DeleteMessageBatchRequestEntry, Message, MessageAttributeValue,
    MessageSystemAttributeName, QueueAttributeName,
};
use thiserror::Error;

use super::dead_letter::{self, DeadLetter};
use crate::intake::source::Received;
use leaderboard_aws::fault::{self, Fault};
use leaderboard_aws::metered::Metered;
use leaderboard_base::clock::Clock;
use leaderboard_base::meter::Meter;
use leaderboard_policy::intake::route::DeadReason;

/// How long a receive waits for a message, in seconds: the longest that SQS allows.
const LONG_POLL: i32 = 20;
/// Most messages of one receive, and entries of one batch.
const BATCH: i32 = 10;
/// SQS's own default, used when the attribute may not be read.
const DEFAULT_VISIBILITY: Duration = Duration::from_secs(30);

/// How the name of a FIFO queue ends.
const FIFO: &str = ".fifo";

/// Why a queue could not be used.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[error("queue {queue}: {action} failed: {text}; {}", self.next_step())]
pub struct QueueError {
    /// URL of the queue.
    pub queue: String,
    /// The action that failed, by its IAM name without `sqs:`.
    pub action: &'static str,
    /// Class of the failure.
    pub fault: Fault,
    /// SQS's message.
    pub text: String,
}

impl QueueError {
    fn next_step(&self) -> String {
        match self.fault {
            Fault::Denied => format!(
                "check the operator's AWS credentials and that they allow sqs:{}",
                self.action
            ),
            Fault::Missing => {
                "check queue.sqs.url, queue.sqs.region and queue.sqs.endpoint of its Leaderboards".to_owned()
            }
            Fault::Refused => "check the queue's settings".to_owned(),
            Fault::Throttled | Fault::Unavailable | Fault::Conflict => "it is retried".to_owned(),
        }
    }
}

/// A queue that is open for reading.
pub struct Reader {
    client: Client,
    url: String,
    visibility: Duration,
    meter: Meter,
}

impl Reader {
    /// Opens a queue: reads how long its messages stay invisible.
    pub async fn open(client: Client, url: &str, meter: Meter) -> Result<Self, QueueError> {
        let mut reader = Self {
            client,
            url: url.to_owned(),
            visibility: DEFAULT_VISIBILITY,
            meter,
        };
        let request = reader.client.get_queue_attributes().queue_url(url);
        let request = request.attribute_names(QueueAttributeName::VisibilityTimeout);
        match reader.call("GetQueueAttributes", request.send()).await {
            Ok(output) => {
                let all = output.attributes();
                let seconds = all.and_then(|all| all.get(&QueueAttributeName::VisibilityTimeout)?.parse().ok());
                reader.visibility = seconds.map_or(DEFAULT_VISIBILITY, Duration::from_secs);
            }
            Err(error) if error.fault == Fault::Denied => {
                tracing::warn!(queue = url, %error, "SQS's default visibility of 30 s is assumed");
            }
            Err(error) => return Err(error),
        }
        Ok(reader)
    }

    /// How long a received message is ours.
    pub fn visibility(&self) -> Duration {
        self.visibility
    }

    /// Waits up to 20 s for up to `most` messages. One whose times SQS does not show counts from now.
    pub async fn receive(&self, most: i32, clock: &Clock) -> Result<Vec<Received>, QueueError> {
        let request = self
            .client
            .receive_message()
            .queue_url(&self.url)
            .max_number_of_messages(most)
            .wait_time_seconds(LONG_POLL)
            .message_system_attribute_names(MessageSystemAttributeName::SentTimestamp)
            .message_system_attribute_names(MessageSystemAttributeName::ApproximateFirstReceiveTimestamp)
            .message_system_attribute_names(MessageSystemAttributeName::ApproximateReceiveCount)
            .message_system_attribute_names(MessageSystemAttributeName::MessageGroupId)
            .send();
        let output: ReceiveMessageOutput = self.call("ReceiveMessage", request).await?;
        let now = clock.now().as_millisecond();
        let messages = output.messages.unwrap_or_default().into_iter();
        Ok(messages.filter_map(|message| received(message, now)).collect())
    }

    /// Keeps messages of one receive invisible for so many seconds from now. A lease that is lost already is no error: the message
    /// then comes back, and ingest is safe twice.
    pub async fn hold(&self, receipts: &[&str], seconds: i32) -> Result<(), QueueError> {
        let mut request = self.client.change_message_visibility_batch().queue_url(&self.url);
        for (id, receipt) in receipts.iter().enumerate() {
            let entry = ChangeMessageVisibilityBatchRequestEntry::builder()
                .id(id.to_string())
                .receipt_handle(*receipt)
                .visibility_timeout(seconds)
                .build();
            request = request.entries(entry.map_err(|error| self.unsendable("ChangeMessageVisibility", &error))?);
        }
        self.call("ChangeMessageVisibility", request.send()).await.map(|_| ())
    }

    /// Deletes messages of one receive. A single message that can't be deleted comes back and is a repeat then; only a failure of the
    /// whole request is an error.
    pub async fn delete(&self, receipts: &[&str]) -> Result<(), QueueError> {
        if receipts.is_empty() {
            return Ok(());
        }
        let mut request = self.client.delete_message_batch().queue_url(&self.url);
        for (id, receipt) in receipts.iter().enumerate() {
            let entry = DeleteMessageBatchRequestEntry::builder()
                .id(id.to_string())
                .receipt_handle(*receipt)
                .build();
            request = request.entries(entry.map_err(|error| self.unsendable("DeleteMessage", &error))?);
        }
        let output = self.call("DeleteMessage", request.send()).await?;
        // An invalid receipt means that it is deleted, or was received again and is deleted then.
        let failed = output.failed().iter();
        for failed in failed.filter(|failed| !failed.code().ends_with("ReceiptHandleIsInvalid")) {
            let (queue, code, text) = (&self.url, failed.code(), failed.message().unwrap_or_default());
            tracing::warn!(queue, code, text, "a message could not be deleted and will come back");
        }
        Ok(())
    }

    /// Puts a copy of a message into the dead-letter queue; the caller then deletes it here. A crash between the two
    /// makes two copies. One that is refused is sent again in a smaller form: it may be too large for that queue.
    pub async fn send_dead(&self, to: &str, message: &Received, reason: &DeadReason) -> Result<(), QueueError> {
        let mut sent = Ok(());
        for letter in dead_letter::forms(message, reason, &self.url) {
            sent = self.send(to, message, letter).await;
            if !matches!(&sent, Err(error) if error.fault == Fault::Refused) {
                break;
            }
        }
        sent.map_err(|error| QueueError {
            queue: to.to_owned(),
            ..error
        })
    }

    async fn send(&self, to: &str, message: &Received, letter: DeadLetter) -> Result<(), QueueError> {
        let mut request = self.client.send_message().queue_url(to).message_body(letter.body);
        for (name, text) in letter.attributes {
            let value = MessageAttributeValue::builder()
                .data_type("String")
                .string_value(text)
                .build();
            request = request.message_attributes(name, value.map_err(|error| self.unsendable("SendMessage", &error))?);
        }
        // A queue that is not FIFO refuses the id, and has no use for the group.
        if let Some(group) = message.group.as_ref().filter(|_| to.ends_with(FIFO)) {
            request = request.message_group_id(group).message_deduplication_id(&message.id);
        }
        self.call("SendMessage", request.send()).await.map(|_| ())
    }

    /// Counts a call and turns an error into one that names the queue.
    async fn call<T, E>(
        &self,
        action: &'static str,
        request: impl Future<Output = Result<T, SdkError<E, HttpResponse>>> + Send,
    ) -> Result<T, QueueError>
    where
        E: ProvideErrorMetadata + std::error::Error + 'static,
    {
        let answer = self.meter.aws("sqs", action, request).await;
        answer.map_err(|error| self.failed(action, fault::of(&error), fault::sentence(&error)))
    }

    fn unsendable(&self, action: &'static str, error: &aws_sdk_sqs::error::BuildError) -> QueueError {
        self.failed(action, Fault::Refused, error.to_string())
    }

    fn failed(&self, action: &'static str, fault: Fault, text: String) -> QueueError {
        let queue = self.url.clone();
        QueueError {
            queue,
            action,
            fault,
            text,
        }
    }
}

/// How many messages to ask for, so that all are ingested within half of their visibility.
pub fn batch_size(visibility: Duration, each: Duration) -> i32 {
    let fit = visibility.as_millis() / 2 / each.as_millis().max(1);
    i32::try_from(fit).unwrap_or(i32::MAX).clamp(1, BATCH)
}

fn received(message: Message, now: i64) -> Option<Received> {
    let attributes = message.attributes.unwrap_or_default();
    let number = |name| attributes.get(&name).and_then(|text| text.parse::<i64>().ok());
    Some(Received {
        id: message.message_id?,
        receipt: message.receipt_handle?,
        body: message.body.unwrap_or_default(),
        sent_ms: number(MessageSystemAttributeName::SentTimestamp).unwrap_or(now),
        first_seen_ms: number(MessageSystemAttributeName::ApproximateFirstReceiveTimestamp).unwrap_or(now),
        receives: number(MessageSystemAttributeName::ApproximateReceiveCount)
            .and_then(|count| i32::try_from(count).ok())
            .unwrap_or(1),
        group: attributes.get(&MessageSystemAttributeName::MessageGroupId).cloned(),
        hindrance: None,
    })
}

#[cfg(test)]
mod tests {
    use std::collections::VecDeque;
    use std::sync::{Arc, Mutex};

    use aws_sdk_sqs::config::{BehaviorVersion, Credentials, Region};
    use axum::body::Bytes;
    use axum::extract::State;
    use axum::http::StatusCode;
    use serde_json::Value;
    use tokio::net::TcpListener;

    use super::*;
    use leaderboard_aws::clients::Aws;
    use leaderboard_base::lock::lock;

    /// The messages that a queue was sent, and how many of the next ones it finds too large.
    type Sent = Arc<Mutex<(VecDeque<Value>, usize)>>;

    async fn answer(State(sent): State<Sent>, body: Bytes) -> (StatusCode, &'static str) {
        let mut sent = lock(&sent);
        sent.0.push_back(serde_json::from_slice(&body).unwrap());
        if sent.1 > 0 {
            sent.1 -= 1;
            let refused = r#"{"__type":"com.amazonaws.sqs#InvalidParameterValue","message":"Message must be shorter"}"#;
            return (StatusCode::BAD_REQUEST, refused);
        }
        (StatusCode::OK, r#"{"MessageId":"d-1","MD5OfMessageBody":"x"}"#)
    }

    /// A reader of a queue of the test's own.
    async fn reader(too_large: usize) -> (Reader, Sent) {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let url = format!("http://{}", listener.local_addr().unwrap());
        let sent = Sent::new(Mutex::new((VecDeque::new(), too_large)));
        let app = axum::Router::new().fallback(answer).with_state(sent.clone());
        tokio::spawn(async move { axum::serve(listener, app).await.unwrap() });
        let config = aws_config::defaults(BehaviorVersion::latest())
            .http_client(aws_smithy_http_client::Builder::new().build_http())
            .credentials_provider(Credentials::new("a", "b", None, None, "test"))
            .region(Region::new("us-east-1"))
            .load()
            .await;
        let reader = Reader {
            client: Aws::from_config(config).sqs(None, Some(&url)),
            url: format!("{url}/1/queue"),
            visibility: DEFAULT_VISIBILITY,
            meter: Meter::default(),
        };
        (reader, sent)
    }

    fn message() -> Received {
        Received {
            id: "m-1".into(),
            receipt: "r".into(),
            body: r#"{"submission_pk":7}"#.into(),
            sent_ms: 0,
            first_seen_ms: 0,
            receives: 1,
            group: Some("1-3".into()),
            hindrance: None,
        }
    }

    #[tokio::test]
    async fn a_dead_letter_that_is_too_large_is_cut_and_blocks_nothing() {
        let reason = DeadReason::Unknown("nobody serves it".into());
        for too_large in 0..=3 {
            let (reader, sent) = reader(too_large).await;
            let done = reader.send_dead("https://q/dead", &message(), &reason).await;
            assert_eq!(done.is_ok(), too_large < 3, "{done:?}");
            let sent = &lock(&sent).0;
            assert_eq!(sent.len(), (too_large + 1).min(3));
            let last = sent.back().unwrap();
            let is_cut = last["MessageBody"].as_str().unwrap().contains("cut_from_message");
            assert_eq!(is_cut, too_large >= 2, "{last}");
            assert_eq!(last["MessageAttributes"]["detail"].is_null(), too_large == 1, "{last}");
        }
    }

    #[tokio::test]
    async fn only_a_fifo_queue_gets_a_group_and_an_id_against_duplicates() {
        let reason = DeadReason::Malformed("no JSON".into());
        for (to, is_fifo) in [("https://q/dead", false), ("https://q/dead.fifo", true)] {
            let (reader, sent) = reader(0).await;
            reader.send_dead(to, &message(), &reason).await.unwrap();
            let sent = lock(&sent).0.pop_front().unwrap();
            assert_eq!(sent["MessageDeduplicationId"].is_string(), is_fifo, "{to}");
            assert_eq!(sent["MessageGroupId"].is_string(), is_fifo, "{to}");
        }
    }

    #[test]
    fn only_as_many_as_fit_in_half_the_visibility() {
        let ms = Duration::from_millis;
        for (visibility, each, want) in [
            (30_000, 20, 10),
            (30_000, 2_000, 7),
            (30_000, 60_000, 1),
            (0, 20, 1),
            (30_000, 0, 10),
        ] {
            assert_eq!(batch_size(ms(visibility), ms(each)), want, "{visibility} {each}");
        }
    }

    #[test]
    fn an_error_names_the_queue_and_the_next_step() {
        let error = |fault| QueueError {
            queue: "https://q/1".into(),
            action: "ReceiveMessage",
            fault,
            text: "text".into(),
        };
        assert_eq!(
            error(Fault::Denied).to_string(),
            "queue https://q/1: ReceiveMessage failed: text; check the operator's AWS credentials and that they allow sqs:ReceiveMessage"
        );
        assert!(
            error(Fault::Missing)
                .to_string()
                .ends_with("check queue.sqs.url, queue.sqs.region and queue.sqs.endpoint of its Leaderboards")
        );
        assert!(error(Fault::Throttled).to_string().ends_with("it is retried"));
    }
}
