//! An SQS queue: that it exists, and how much of it is in flight. Called by the controller's checks of a Leaderboard; messages are the
//! bridge's alone.

use std::collections::HashMap;

use aws_sdk_sqs::types::QueueAttributeName;

use super::fault::{self, Fault};
use crate::clients::Aws;
use crate::metered::Metered;
use leaderboard_api as api;

/// Why a queue could not be checked.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("queue {url}: {text}; {}", self.next_step())]
pub struct QueueError {
    /// Its URL.
    pub url: String,
    /// Kind of failure.
    pub fault: Fault,
    /// SQS's message.
    pub text: String,
}

impl QueueError {
    fn next_step(&self) -> &'static str {
        match self.fault {
            Fault::Denied => {
                "the controller cannot check whether it exists: give its AWS identity sqs:GetQueueAttributes on it"
            }
            Fault::Missing => {
                "create it, or correct queue.sqs.url, queue.sqs.deadLetterURL, queue.sqs.region and queue.sqs.endpoint"
            }
            Fault::Refused => "check queue.sqs.url, queue.sqs.deadLetterURL, queue.sqs.region and queue.sqs.endpoint",
            Fault::Throttled | Fault::Unavailable | Fault::Conflict => {
                "it is retried; check queue.sqs.endpoint and the network if this stays"
            }
        }
    }
}

/// A queue as SQS shows it. Its numbers are approximate, and up to a minute old.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Reading {
    /// Messages that a receive would get.
    pub visible: u64,
    /// Messages that were received, and are neither deleted nor visible again.
    pub in_flight: u64,
}

impl Reading {
    const ATTRIBUTES: [QueueAttributeName; 2] = [
        QueueAttributeName::ApproximateNumberOfMessages,
        QueueAttributeName::ApproximateNumberOfMessagesNotVisible,
    ];

    fn of(attributes: Option<&HashMap<QueueAttributeName, String>>) -> Self {
        let number = |name| {
            attributes
                .and_then(|all| all.get(&name)?.parse().ok())
                .unwrap_or_default()
        };
        Self {
            visible: number(QueueAttributeName::ApproximateNumberOfMessages),
            in_flight: number(QueueAttributeName::ApproximateNumberOfMessagesNotVisible),
        }
    }
}

/// Checks whether a queue answers: the one that is read, or its dead-letter queue.
pub async fn check(aws: &Aws, queue: &api::SqsQueue, url: &str) -> Result<Reading, QueueError> {
    let client = aws.sqs(queue.region.as_deref(), queue.endpoint.as_deref());
    let request = client.get_queue_attributes().queue_url(url);
    let request = request.set_attribute_names(Some(Reading::ATTRIBUTES.to_vec())).send();
    let answer = aws.meter().aws("sqs", "GetQueueAttributes", request).await;
    let answer = answer.map(|output| Reading::of(output.attributes()));
    answer.map_err(|error| QueueError {
        url: url.to_owned(),
        fault: fault::of(&error),
        text: fault::sentence(&error),
    })
}
