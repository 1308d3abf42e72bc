//! Messages of EvalAI's own queues: each becomes a Submission, as the bridge makes them of messages in SQS, by the same rules and the
//! same `ingest`.
//!
//! Started by the controller's leader. EvalAI shows neither the id of a message nor when it was sent. The time at which its row asked
//! to be run takes the place of both, so a message that comes twice is a repeat.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use jiff::Timestamp;
use kube::runtime::events::{Event, EventType, Recorder};
use kube::{Api, Client, Resource, ResourceExt};
use tokio::sync::mpsc;
use tokio::time::{Instant, sleep_until};
use tracing::Instrument;

use crate::bridge::ages::Ages;
use crate::bridge::ingest::{self, Incoming, IngestError, Outcome};
use crate::bridge::message::{self, Malformed, Message};
use crate::bridge::route::{self, DeadReason, Envelope, MessageOutcome, Rules};
use crate::controller::leaderboards::operator;
use crate::kubernetes::{Watch, call};
use crate::observability::metrics::Metrics;
use crate::services::evalai::{Arrival, Arrived, Origin, Settled};
use leaderboard_api::text::one_line;
use leaderboard_api::{Evalai, EvalaiQueue, Leaderboard, Submission, reasons};

/// Most characters of a message that an event and the log quote.
const QUOTED: usize = 500;
/// A message that is left comes back after EvalAI's 30 s, once those before it were read, which takes three requests each.
const SEEN_AGAIN: Duration = Duration::from_mins(5);

/// What messages are taken in with.
pub(super) struct Intake {
    pub client: Client,
    pub leaderboards: Watch<Leaderboard>,
    /// Who drives the Leaderboards that count.
    pub operator: String,
    pub recorder: Recorder,
    pub metrics: Arc<Metrics>,
}

/// What a message means, before anything is written.
#[derive(Clone, Debug, PartialEq, Eq)]
enum Verdict {
    /// Make or bump its Submission.
    Ingest {
        namespace: String,
        leaderboard: String,
        message: Message,
        sent_ms: i64,
    },
    /// It is of no use, now or later.
    Drop(DeadReason),
    /// It may be of use later.
    Leave,
    /// It is another reader's.
    Foreign,
}

impl Intake {
    /// Takes messages in until their sender is gone.
    pub(super) async fn into_cluster(self, mut arrived: mpsc::UnboundedReceiver<Arrived>) {
        let mut waiting = Waiting::new(&self.metrics);
        loop {
            let arrived = tokio::select! {
                arrived = arrived.recv() => arrived,
                () = waiting.expired() => continue,
            };
            let Some(arrived) = arrived else { return };
            let settled = self.take(&arrived.arrival, &mut waiting).await;
            if settled == Settled::Delete {
                waiting.forget(&arrived.arrival);
            }
            arrived.settle(settled);
        }
    }

    async fn take(&self, arrival: &Arrival, waiting: &mut Waiting) -> Settled {
        // Asked first: what is complete now has all that is read below.
        let is_complete = self.leaderboards.is_complete();
        let readers = readers(&self.leaderboards.store.state(), &self.operator, arrival);
        let now_ms = Timestamp::now().as_millisecond();
        let verdict = judge(arrival, &readers, now_ms, is_complete);
        if let Some(sent_ms) = sent_ms(arrival, now_ms).filter(|_| verdict != Verdict::Foreign) {
            waiting.keep(arrival, sent_ms);
        }
        match verdict {
            Verdict::Leave | Verdict::Foreign => Settled::Leave,
            Verdict::Drop(reason) => self.drop(arrival, &readers, &reason).await,
            Verdict::Ingest {
                namespace,
                leaderboard,
                message,
                sent_ms,
            } => {
                let span = ingest::span(&namespace, &leaderboard, message.submission);
                let incoming = incoming(&message, sent_ms);
                let outcome = self.ingest(&namespace, &leaderboard, &incoming).instrument(span).await;
                let envelope = envelope(Ok(message), sent_ms);
                match route::settle(&envelope, &outcome, &rules(&readers), now_ms) {
                    MessageOutcome::Delete(_) => Settled::Delete,
                    MessageOutcome::Dead(reason) => self.drop(arrival, &readers, &reason).await,
                    MessageOutcome::Later { .. } | MessageOutcome::Lapse | MessageOutcome::Ingest { .. } => {
                        Settled::Leave
                    }
                }
            }
        }
    }

    /// Applies it, and logs what came of it.
    async fn ingest(&self, namespace: &str, leaderboard: &str, incoming: &Incoming) -> Result<Outcome, IngestError> {
        let api: Api<Submission> = Api::namespaced(self.client.clone(), namespace);
        let outcome = ingest::apply(&api, leaderboard, incoming).await;
        match &outcome {
            Ok(outcome) => tracing::info!(%outcome, "a message of EvalAI was taken in"),
            Err(error) => tracing::warn!(%error, "a message of EvalAI was not taken in"),
        }
        outcome
    }

    /// Deletes a message that nothing can be made of. EvalAI has no dead-letter queue: the log and an event keep what it held.
    async fn drop(&self, arrival: &Arrival, readers: &[Arc<Leaderboard>], reason: &DeadReason) -> Settled {
        let (queue, text) = (&arrival.queue, one_line(&arrival.body, QUOTED));
        let (reason, detail) = (reason.as_str(), reason.detail());
        tracing::warn!(
            queue,
            reason,
            detail,
            text,
            "a message of EvalAI cannot be used and is deleted"
        );
        let Some(oldest) = readers.first() else {
            return Settled::Delete;
        };
        let note = format!("A message of EvalAI's queue {queue} was deleted: {detail} ({reason}). It was {text}");
        let event = Event {
            type_: EventType::Warning,
            reason: reasons::MESSAGE_DROPPED.to_owned(),
            note: Some(one_line(&note, 1000)),
            action: "ReadQueue".to_owned(),
            secondary: None,
        };
        let reference = oldest.object_ref(&());
        let published = self.recorder.publish(&event, &reference);
        if let Err(error) = call("an event", &oldest.name_any(), published).await {
            tracing::warn!(queue, reason, "{error}");
        }
        Settled::Delete
    }
}

fn queue_of(leaderboard: &Leaderboard) -> Option<&EvalaiQueue> {
    leaderboard.spec.evalai.as_ref()?.queue.as_ref()
}

/// The Leaderboards that read the queue, the oldest first.
fn readers(all: &[Arc<Leaderboard>], operator: &str, arrival: &Arrival) -> Vec<Arc<Leaderboard>> {
    let reads = |leaderboard: &&Arc<Leaderboard>| {
        leaderboard.spec.evalai.as_ref().map(Evalai::server).as_ref() == Some(&arrival.server)
            && queue_of(leaderboard).is_some_and(|queue| queue.name == arrival.queue)
            && leaderboard.metadata.deletion_timestamp.is_none()
            && operator::is_ours(leaderboard, operator)
    };
    let mut readers: Vec<_> = all.iter().filter(reads).cloned().collect();
    readers.sort_by_key(|leaderboard| leaderboard.seniority());
    readers
}

/// A message waits as long as the most patient reader allows.
fn rules(readers: &[Arc<Leaderboard>]) -> Rules {
    let waits = readers.iter().filter_map(|leaderboard| queue_of(leaderboard));
    Rules {
        unknown_after_ms: waits.map(|queue| queue.unknown_after_seconds).max().unwrap_or_default() * 1000,
        ..Rules::default()
    }
}

/// Decides on a message.
fn judge(arrival: &Arrival, readers: &[Arc<Leaderboard>], now_ms: i64, is_complete: bool) -> Verdict {
    let content = message::parse(&arrival.body);
    if let Ok(message) = &content {
        let challenges = readers
            .iter()
            .filter_map(|leaderboard| leaderboard.spec.evalai.as_ref());
        // An EvalAI in debug mode has one queue for all challenges: what others wait for is not ours to delete.
        if challenges
            .into_iter()
            .all(|evalai| evalai.challenge != message.challenge)
        {
            return Verdict::Foreign;
        }
        let submission = message.submission;
        let unusable = match arrival.origin {
            Origin::Missing => Some(format!("EvalAI has no submission {submission}")),
            Origin::Foreign => Some(format!(
                "EvalAI does not show submission {submission} to a host of this challenge: its row has a phase of another challenge"
            )),
            Origin::Wanted(_) | Origin::Hidden => None,
        };
        if let Some(why) = unusable {
            return Verdict::Drop(DeadReason::Malformed(why));
        }
    }
    let sent_ms = sent_ms(arrival, now_ms);
    let envelope = envelope(content, sent_ms.unwrap_or(now_ms));
    match (
        route::route_by(&rules(readers), &envelope, readers, now_ms, is_complete),
        envelope.content,
        sent_ms,
    ) {
        (MessageOutcome::Dead(reason), ..) => Verdict::Drop(reason),
        (MessageOutcome::Ingest { namespace, leaderboard }, Ok(message), Some(sent_ms)) => Verdict::Ingest {
            namespace,
            leaderboard,
            message,
            sent_ms,
        },
        _ => Verdict::Leave,
    }
}

/// A row's times are its participant's to edit: one of the future would keep later resumes from being newer.
fn sent_ms(arrival: &Arrival, now_ms: i64) -> Option<i64> {
    match arrival.origin {
        Origin::Wanted(time) => Some(time.as_millisecond().min(now_ms)),
        Origin::Missing | Origin::Foreign | Origin::Hidden => None,
    }
}

/// How old the messages are that were handed over and are not deleted, by queue. EvalAI shows no id of one: its text takes that place.
struct Waiting {
    by_queue: BTreeMap<String, Ages>,
    metrics: Arc<Metrics>,
}

impl Waiting {
    fn new(metrics: &Arc<Metrics>) -> Self {
        Self {
            by_queue: BTreeMap::new(),
            metrics: Arc::clone(metrics),
        }
    }

    fn keep(&mut self, arrival: &Arrival, sent_ms: i64) {
        let until = Instant::now() + SEEN_AGAIN;
        self.change(&arrival.queue, |ages| ages.keep(&arrival.body, sent_ms, until));
    }

    fn forget(&mut self, arrival: &Arrival) {
        self.change(&arrival.queue, |ages| ages.forget(&arrival.body));
    }

    fn change(&mut self, queue: &str, change: impl FnOnce(&mut Ages)) {
        let ages = self.by_queue.entry(queue.to_owned()).or_default();
        change(ages);
        self.metrics.set_oldest_message(queue, ages.oldest_ms());
    }

    /// Waits until a message has not come back in time, and forgets it.
    async fn expired(&mut self) {
        let next = self.by_queue.values().filter_map(Ages::next_expiry).min();
        let Some(next) = next else {
            return std::future::pending().await;
        };
        sleep_until(next).await;
        for (queue, ages) in &mut self.by_queue {
            ages.expire(Instant::now());
            self.metrics.set_oldest_message(queue, ages.oldest_ms());
        }
    }
}

/// EvalAI shows no id of a message.
fn incoming(message: &Message, sent_ms: i64) -> Incoming {
    Incoming::of(message, format!("evalai-{sent_ms}"), sent_ms)
}

fn envelope(content: Result<Message, Malformed>, sent_ms: i64) -> Envelope {
    Envelope {
        content,
        sent_ms,
        receives: 1,
    }
}

#[cfg(test)]
#[path = "inbox_tests.rs"]
mod tests;
