//! A queue of EvalAI's messages, as the poller reads it: `sqs` of the bridge, and the controller's `inbox`.

use std::sync::Arc;
use std::time::Duration;

use leaderboard_api::{Leaderboard, Reason};
use leaderboard_base::clock::Clock;
use leaderboard_policy::intake::route::{DeadReason, Hindrance, Rules};

/// A message that was received and is ours until its visibility lapses.
#[derive(Clone, Debug)]
pub struct Received {
    /// Names it whenever it is received.
    pub id: String,
    /// Handle that deletes this receive of the message.
    pub receipt: String,
    /// The body.
    pub body: String,
    /// When it was sent, in milliseconds since 1970.
    pub sent_ms: i64,
    /// When it was first received, in milliseconds since 1970.
    pub first_seen_ms: i64,
    /// How often it has been received, this time included.
    pub receives: i32,
    /// Group of a message in a FIFO queue.
    pub group: Option<String>,
    /// Why it makes no Submission, whatever its text.
    pub hindrance: Option<Hindrance>,
}

/// The event about a message that cannot be used, and was kept or dropped.
pub struct SetAside {
    pub reason: Reason,
    pub note: String,
}

/// A message that cannot be used, and why, in one sentence.
pub fn named(message: &Received, reason: &DeadReason) -> String {
    format!("message {} ({}): {}", message.id, reason.as_str(), reason.detail())
}

/// See the module's text. An error is one sentence for people.
pub trait Source: Send + Sync + 'static {
    /// The Leaderboards that read the queue, the oldest first. Leaderboards that are being deleted take nothing more.
    fn readers(&self, all: &[Arc<Leaderboard>]) -> Vec<Arc<Leaderboard>>;

    /// The rules that its readers set for its messages.
    fn rules(&self, readers: &[Arc<Leaderboard>]) -> Rules;

    /// Waits for as many messages as can be used in time, if each takes so long. One whose time is not known counts from now.
    fn receive(&mut self, each: Duration, clock: &Clock) -> impl Future<Output = Result<Vec<Received>, String>> + Send;

    /// How long a received message is ours.
    fn visibility(&self) -> Duration;

    /// Keeps messages invisible for so many seconds from now, where the queue can do that.
    fn hold(&self, messages: &[&Received], seconds: i32) -> impl Future<Output = Result<(), String>> + Send;

    /// Deletes messages. One that cannot be deleted comes back and is a repeat then.
    fn delete(&self, messages: &[&Received]) -> impl Future<Output = Result<(), String>> + Send;

    /// Keeps a message that cannot be used where people find it. The caller then deletes it.
    fn set_aside(
        &self,
        message: &Received,
        reason: &DeadReason,
        rules: &Rules,
    ) -> impl Future<Output = Result<SetAside, String>> + Send;
}
