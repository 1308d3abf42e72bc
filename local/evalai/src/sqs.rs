//! The challenges' queues in SQS, or in whatever answers as SQS does. Used through [`crate::Queues`] only.

use std::collections::HashMap;
use std::time::Duration;

use aws_sdk_sqs::config::timeout::TimeoutConfig;
use aws_sdk_sqs::config::{BehaviorVersion, Credentials, Region};
use aws_sdk_sqs::error::SdkError;
use aws_sdk_sqs::operation::get_queue_url::GetQueueUrlError;
use aws_sdk_sqs::types::QueueAttributeName;
use aws_sdk_sqs::{Client, Config};
use futures::future::{BoxFuture, FutureExt};
use tokio::sync::Mutex;

use crate::queue::{Message, QueueError, Queues, Received};
use crate::views::is_fifo;

/// How long EvalAI keeps a message: 4 days.
const RETENTION_SECONDS: &str = "345600";
/// How long one call may take.
const CALL_TIMEOUT: Duration = Duration::from_secs(10);

/// Queues in SQS.
pub struct SqsQueues {
    client: Client,
    urls: Mutex<HashMap<String, String>>,
}

impl SqsQueues {
    /// Queues behind a plain-HTTP endpoint (`http://127.0.0.1:4566`). The AWS variables for key, secret and region are
    /// honored; a stand-in takes any.
    pub fn new(endpoint: &str) -> Self {
        let variable = |name: &str, default: &str| std::env::var(name).unwrap_or_else(|_| default.to_owned());
        let credentials = Credentials::new(
            variable("AWS_ACCESS_KEY_ID", "test"),
            variable("AWS_SECRET_ACCESS_KEY", "test"),
            std::env::var("AWS_SESSION_TOKEN").ok(),
            None,
            "environment",
        );
        let config = Config::builder()
            .behavior_version(BehaviorVersion::v2026_01_12())
            .endpoint_url(endpoint)
            .region(Region::new(variable("AWS_REGION", "us-east-1")))
            .credentials_provider(credentials)
            .timeout_config(TimeoutConfig::builder().operation_timeout(CALL_TIMEOUT).build())
            .http_client(aws_smithy_http_client::Builder::new().build_http())
            .build();
        Self {
            client: Client::from_conf(config),
            urls: Mutex::new(HashMap::new()),
        }
    }

    /// The queue's URL; the queue is made if there is none, with the attributes EvalAI gives it.
    async fn url(&self, queue: &str) -> Result<String, QueueError> {
        let mut urls = self.urls.lock().await;
        if let Some(url) = urls.get(queue) {
            return Ok(url.clone());
        }
        let url = match self.client.get_queue_url().queue_name(queue).send().await {
            Ok(found) => found.queue_url,
            Err(error)
                if error
                    .as_service_error()
                    .is_some_and(GetQueueUrlError::is_queue_does_not_exist) =>
            {
                let mut create = self.client.create_queue().queue_name(queue);
                create = create.attributes(QueueAttributeName::MessageRetentionPeriod, RETENTION_SECONDS);
                if is_fifo(queue) {
                    create = create.attributes(QueueAttributeName::FifoQueue, "true");
                }
                create
                    .send()
                    .await
                    .map_err(|error| failed(queue, "its creation", &error))?
                    .queue_url
            }
            Err(error) => return Err(failed(queue, "the look-up of its URL", &error)),
        };
        let url = url.unwrap_or_default();
        urls.insert(queue.to_owned(), url.clone());
        Ok(url)
    }

    /// A queue that was deleted and made again may have another URL.
    async fn forget<T>(&self, queue: &str, result: Result<T, QueueError>) -> Result<T, QueueError> {
        if result.is_err() {
            self.urls.lock().await.remove(queue);
        }
        result
    }
}

fn failed<E, R>(queue: &str, action: &'static str, error: &SdkError<E, R>) -> QueueError
where
    E: std::error::Error + 'static,
    R: std::fmt::Debug,
{
    QueueError::Failed {
        queue: queue.to_owned(),
        action,
        reason: chain(error),
    }
}

/// The error and what is behind it, as text.
fn chain(error: &dyn std::error::Error) -> String {
    let causes = std::iter::successors(error.source(), |cause| cause.source());
    causes.fold(error.to_string(), |text, cause| format!("{text}: {cause}"))
}

impl Queues for SqsQueues {
    fn send<'a>(&'a self, queue: &'a str, message: &'a Message) -> BoxFuture<'a, Result<(), QueueError>> {
        async move {
            let url = self.url(queue).await?;
            let send = self
                .client
                .send_message()
                .queue_url(url)
                .message_body(message.body.to_string());
            let send = send.set_message_group_id(message.group.clone());
            let result = send.set_message_deduplication_id(message.dedup.clone()).send().await;
            self.forget(
                queue,
                result.map(|_| ()).map_err(|error| failed(queue, "a message", &error)),
            )
            .await
        }
        .boxed()
    }

    fn receive<'a>(&'a self, queue: &'a str) -> BoxFuture<'a, Result<Option<Received>, QueueError>> {
        async move {
            let url = self.url(queue).await?;
            let received = self.client.receive_message().queue_url(url).send().await;
            let received = received.map_err(|error| failed(queue, "a receive", &error));
            let messages = self.forget(queue, received).await?.messages.unwrap_or_default();
            let received = |message: aws_sdk_sqs::types::Message| Received {
                body: message.body.unwrap_or_default(),
                receipt_handle: message.receipt_handle.unwrap_or_default(),
            };
            Ok(messages.into_iter().next().map(received))
        }
        .boxed()
    }

    fn delete<'a>(&'a self, queue: &'a str, receipt_handle: &'a str) -> BoxFuture<'a, Result<(), QueueError>> {
        async move {
            let url = self.url(queue).await?;
            let deleted = self
                .client
                .delete_message()
                .queue_url(url)
                .receipt_handle(receipt_handle)
                .send()
                .await;
            deleted.map(|_| ()).map_err(|error| failed(queue, "a delete", &error))
        }
        .boxed()
    }
}
