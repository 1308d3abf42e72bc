//! Where the messages go: the trait, and queues in memory for tests that need no SQS. `sqs` has the real ones.

use std::collections::HashMap;
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use futures::future::{BoxFuture, FutureExt};
use serde_json::Value;
use thiserror::Error;

/// A message as EvalAI sends it: no attributes, no delay.
#[derive(Debug, Clone, PartialEq)]
pub struct Message {
    /// The body, sent as its JSON text.
    pub body: Value,
    /// `MessageGroupId`, for FIFO queues.
    pub group: Option<String>,
    /// `MessageDeduplicationId`, for FIFO queues.
    pub dedup: Option<String>,
}

/// A message as it is received: the text of its body and its receipt handle.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Received {
    /// The body.
    pub body: String,
    /// The handle that deletes it.
    pub receipt_handle: String,
}

/// Why a queue refused an action.
#[derive(Debug, Error)]
pub enum QueueError {
    /// The service refused or did not answer.
    #[error("the queue {queue} did not take {action}: {reason}; is the SQS endpoint up?")]
    Failed {
        /// Its name.
        queue: String,
        /// The refused action.
        action: &'static str,
        /// Its message.
        reason: String,
    },
    /// The receipt handle is none of this queue's.
    #[error("the queue {queue} does not know this receipt handle; receive the message again")]
    BadHandle {
        /// Its name.
        queue: String,
    },
}

/// The queues of all challenges. Each is made when it is first used.
pub trait Queues: Send + Sync {
    /// Sends a message.
    fn send<'a>(&'a self, queue: &'a str, message: &'a Message) -> BoxFuture<'a, Result<(), QueueError>>;
    /// Receives at most one message at once, without waiting.
    fn receive<'a>(&'a self, queue: &'a str) -> BoxFuture<'a, Result<Option<Received>, QueueError>>;
    /// Deletes a message.
    fn delete<'a>(&'a self, queue: &'a str, receipt_handle: &'a str) -> BoxFuture<'a, Result<(), QueueError>>;
}

/// A new queue's visibility.
const VISIBILITY: Duration = Duration::from_secs(30);

#[derive(Debug)]
struct Held {
    message: Message,
    hidden_until: Option<Instant>,
    handle: String,
}

/// Queues in memory: visibility 30 s, and in FIFO queues one message of a group at a time.
#[derive(Debug, Default)]
pub struct MemoryQueues {
    queues: Mutex<HashMap<String, Vec<Held>>>,
}

impl MemoryQueues {
    /// Every message in a queue, hidden or not, oldest first.
    pub fn messages(&self, queue: &str) -> Vec<Message> {
        self.with(queue, |held| held.iter().map(|held| held.message.clone()).collect())
    }

    fn with<R>(&self, queue: &str, act: impl FnOnce(&mut Vec<Held>) -> R) -> R {
        let mut queues = self.queues.lock().unwrap_or_else(PoisonError::into_inner);
        act(queues.entry(queue.to_owned()).or_default())
    }

    fn take(held: &mut [Held], now: Instant) -> Option<Received> {
        let hidden = |held: &Held| held.hidden_until.is_some_and(|until| until > now);
        let blocked: Vec<_> = held
            .iter()
            .filter(|h| hidden(h))
            .filter_map(|h| h.message.group.clone())
            .collect();
        let free = |h: &&mut Held| !hidden(h) && h.message.group.as_ref().is_none_or(|group| !blocked.contains(group));
        let next = held.iter_mut().find(free)?;
        next.hidden_until = Some(now + VISIBILITY);
        next.handle = uuid();
        Some(Received {
            body: next.message.body.to_string(),
            receipt_handle: next.handle.clone(),
        })
    }
}

impl Queues for MemoryQueues {
    fn send<'a>(&'a self, queue: &'a str, message: &'a Message) -> BoxFuture<'a, Result<(), QueueError>> {
        let held = Held {
            message: message.clone(),
            hidden_until: None,
            handle: String::new(),
        };
        self.with(queue, |queue| queue.push(held));
        async { Ok(()) }.boxed()
    }

    fn receive<'a>(&'a self, queue: &'a str) -> BoxFuture<'a, Result<Option<Received>, QueueError>> {
        let received = self.with(queue, |held| Self::take(held, Instant::now()));
        async { Ok(received) }.boxed()
    }

    fn delete<'a>(&'a self, queue: &'a str, receipt_handle: &'a str) -> BoxFuture<'a, Result<(), QueueError>> {
        let found = self.with(queue, |held| {
            let before = held.len();
            held.retain(|held| held.handle != receipt_handle);
            held.len() < before
        });
        let result = if found {
            Ok(())
        } else {
            Err(QueueError::BadHandle {
                queue: queue.to_owned(),
            })
        };
        async { result }.boxed()
    }
}

/// A random UUID, version 4.
pub fn uuid() -> String {
    let bits = fastrand::u128(..) & !(0xf << 76) & !(0b11 << 62) | 4 << 76 | 0b10 << 62;
    let hex = format!("{bits:032x}");
    [&hex[..8], &hex[8..12], &hex[12..16], &hex[16..20], &hex[20..]].join("-")
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[tokio::test]
    async fn a_group_is_blocked_while_one_of_its_messages_is_under_way() {
        let queues = MemoryQueues::default();
        for (group, number) in [("1-1", 1), ("1-1", 2), ("1-2", 3)] {
            let message = Message {
                body: json!(number),
                group: Some(group.to_owned()),
                dedup: Some(uuid()),
            };
            queues.send("q.fifo", &message).await.unwrap();
        }
        let first = queues.receive("q.fifo").await.unwrap().unwrap();
        let second = queues.receive("q.fifo").await.unwrap().unwrap();
        assert_eq!((first.body.as_str(), second.body.as_str()), ("1", "3"));
        assert_eq!(queues.receive("q.fifo").await.unwrap(), None);
        queues.delete("q.fifo", &first.receipt_handle).await.unwrap();
        assert_eq!(queues.receive("q.fifo").await.unwrap().unwrap().body, "2");
        let error = queues.delete("q.fifo", &first.receipt_handle).await.unwrap_err();
        assert!(error.to_string().contains("q.fifo"));
    }

    #[test]
    fn uuids_are_of_version_4() {
        let uuid = uuid();
        let shape: Vec<_> = uuid.split('-').map(str::len).collect();
        assert_eq!(shape, [8, 4, 4, 4, 12], "{uuid}");
        assert_eq!(&uuid[14..15], "4");
        assert!("89ab".contains(&uuid[19..20]), "{uuid}");
    }
}
