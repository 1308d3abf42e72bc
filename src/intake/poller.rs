//! Reads one queue: receives, lets `route` and `ingest` decide, and carries out the outcome of each message.
//!
//! One task for each queue, whatever its `source`, started and stopped by `pollers`. Holds no policy.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use futures::future::{join, join_all};
use kube::runtime::events::{Event, EventType};
use kube::{Api, Resource};
use tokio::sync::OnceCell;
use tokio::time::Instant;
use tracing::Instrument;

use super::ages::Ages;
use super::ingest::{self, Incoming, IngestError};
use super::leaderboards::Leaderboards;
use super::shared::Shared;
use super::source::{Received, Source, named};
use crate::kubernetes::call_within;
use crate::metrics::Metrics;
use leaderboard_api::text::one_line;
use leaderboard_api::{Leaderboard, Reason};
use leaderboard_base::backoff::Backoff;
use leaderboard_base::shutdown::Stop;
use leaderboard_policy::intake::message;
use leaderboard_policy::intake::route::{self, DeadReason, Envelope, Later, MessageOutcome, Outcome, Rules};

/// Longest time that one message may take; half of it is over when its visibility is extended.
const MESSAGE_LIMIT: Duration = Duration::from_secs(20);
/// Shortest time by which a visibility is extended, in seconds.
const EXTENSION: i32 = 30;
/// The longest visibility that SQS allows, in seconds.
const LONGEST_VISIBILITY: i32 = 43_200;
/// Time within which a free message is received again. A receive looks into a part of the queue, and earlier messages come first.
const SEEN_AGAIN: Duration = Duration::from_mins(5);
/// How soon the API server must answer about events and Leaderboards.
const CALL_LIMIT: Duration = Duration::from_secs(5);
/// Pauses after failures in a row.
const RETRY: Backoff = Backoff::new(Duration::from_secs(1), Duration::from_mins(1));
/// Time between two events with the same reason about one queue.
const EVENT_PAUSE: Duration = Duration::from_mins(1);

/// Reads one queue.
pub struct Poller<S> {
    queue: String,
    source: S,
    shared: Arc<Shared>,
    stop: Stop,
    /// Mean time that a message takes.
    each: Duration,
    ages: Ages,
    events: HashMap<Reason, Instant>,
}

/// The Leaderboards that read the queue, while one batch is processed.
struct Readers {
    all: Vec<Arc<Leaderboard>>,
    rules: Rules,
    is_complete: bool,
    /// The Leaderboards, read without a cache when a message is about to be given up. None inside: that read failed.
    fresh: OnceCell<Option<Leaderboards>>,
}

impl<S: Source> Poller<S> {
    /// A poller of a queue that runs until `stop`.
    pub fn new(queue: String, source: S, shared: Arc<Shared>, stop: Stop) -> Self {
        Self {
            queue,
            source,
            shared,
            stop,
            each: Duration::from_millis(50),
            ages: Ages::default(),
            events: HashMap::new(),
        }
    }

    /// Reads the queue until the stop, and finishes what is in hand.
    pub async fn run(mut self) {
        let mut failures: u32 = 0;
        while !self.stop.is_set() {
            let Err(problem) = self.round().await else {
                failures = 0;
                continue;
            };
            failures = failures.saturating_add(1);
            let pause = RETRY.after(failures);
            tracing::warn!(
                queue = self.queue,
                problem,
                retry_seconds = pause.as_secs_f64(),
                "the queue is not read"
            );
            if !self.stop.is_set() {
                self.shared.problems.set(&self.queue, Some(problem));
            }
            let _ = tokio::time::timeout(pause, self.stop.wait()).await;
        }
        self.metrics().set_oldest_message(&self.queue, None);
    }

    fn now_ms(&self) -> i64 {
        self.shared.telemetry.clock.now().as_millisecond()
    }

    /// Receives once and processes what came.
    async fn round(&mut self) -> Result<(), String> {
        let received = self.receive().await?;
        self.remember(&received);
        if !received.is_empty() {
            self.batch(received).await;
            self.show_oldest();
        }
        Ok(())
    }

    /// Notes the age of each received message, and forgets messages that did not come back in time.
    fn remember(&mut self, received: &[Received]) {
        let now = Instant::now();
        let until = now + self.source.visibility() + SEEN_AGAIN;
        for message in received {
            self.ages.keep(&message.id, message.sent_ms, until);
        }
        self.ages.expire(now);
        self.show_oldest();
    }

    fn metrics(&self) -> &Metrics {
        &self.shared.telemetry.metrics
    }

    fn show_oldest(&self) {
        self.metrics().set_oldest_message(&self.queue, self.ages.oldest_ms());
    }

    async fn receive(&mut self) -> Result<Vec<Received>, String> {
        let received = tokio::select! {
            biased;
            // A message that was handed out would wait until its time is over.
            received = self.source.receive(self.each, &self.shared.telemetry.clock) => received?,
            () = self.stop.wait() => return Ok(Vec::new()),
        };
        if !self.stop.is_set() {
            self.shared.problems.set(&self.queue, None);
        }
        Ok(received)
    }

    async fn batch(&mut self, received: Vec<Received>) {
        let begun = Instant::now();
        let cached = Leaderboards::cached(&self.shared.leaderboards, &self.shared.scope.allowed);
        let all = self.source.readers(&cached.all);
        let readers = Readers {
            rules: self.source.rules(&all),
            all,
            is_complete: cached.is_complete,
            fresh: OnceCell::new(),
        };
        let outcomes = self.outcomes(&received, &readers).await;
        let count = u32::try_from(received.len()).unwrap_or(1);
        self.each = (self.each * 3 + begun.elapsed() / count) / 4;
        let mut deletes = Vec::new();
        for (message, mut outcome) in received.iter().zip(outcomes) {
            if let MessageOutcome::Dead(reason) = &outcome {
                outcome = self.set_aside(message, reason, &readers).await;
            }
            self.metrics().shared.messages.of([outcome.as_str()]).inc();
            match outcome {
                MessageOutcome::Delete(_) | MessageOutcome::Dead(_) => deletes.push(message),
                MessageOutcome::Later { seconds, why } => {
                    self.left(message, seconds, why);
                    report(self.source.hold(&[message], seconds).await);
                }
                MessageOutcome::Lapse | MessageOutcome::Ingest { .. } => {}
            }
        }
        self.delete(&deletes).await;
    }

    /// A message stays in the queue and comes back after so many seconds. How long another reader takes is not ours to show.
    fn left(&mut self, message: &Received, seconds: i32, why: Later) {
        let hidden = Duration::from_secs(u64::try_from(seconds).unwrap_or_default());
        match why {
            Later::Foreign => self.ages.forget(&message.id),
            Later::Unknown | Later::Deleting | Later::Stopping | Later::Refused | Later::Blocked => {
                let until = Instant::now() + hidden + SEEN_AGAIN;
                self.ages.keep(&message.id, message.sent_ms, until);
            }
        }
    }

    async fn delete(&mut self, messages: &[&Received]) {
        let deleted = self.source.delete(messages).await;
        if deleted.is_ok() {
            for message in messages {
                self.ages.forget(&message.id);
            }
        }
        report(deleted);
    }

    /// Decides on all messages at once; extends their visibility if half of it is over before all are decided.
    async fn outcomes(&self, received: &[Received], readers: &Readers) -> Vec<MessageOutcome> {
        let work = join_all(received.iter().map(|message| self.outcome(message, readers)));
        let messages: Vec<&Received> = received.iter().collect();
        let visibility = self.source.visibility();
        let seconds = i32::try_from(visibility.as_secs()).unwrap_or(i32::MAX);
        let seconds = seconds.clamp(EXTENSION, LONGEST_VISIBILITY);
        let extend = async { report(self.source.hold(&messages, seconds).await) };
        extended(work, visibility / 2, extend).await
    }

    async fn outcome(&self, received: &Received, readers: &Readers) -> MessageOutcome {
        let envelope = Envelope {
            content: message::parse(&received.body),
            sent_ms: received.sent_ms,
            receives: received.receives,
            hindrance: received.hindrance.clone(),
        };
        let rules = &readers.rules;
        let outcome = match route::route(rules, &envelope, &readers.all, self.now_ms(), readers.is_complete) {
            // The watch may be behind: nothing is given up by its cache alone.
            MessageOutcome::Dead(DeadReason::Unknown(_)) => match self.fresh(readers).await {
                Some(fresh) => {
                    let rules = self.source.rules(&fresh.all);
                    route::route(&rules, &envelope, &fresh.all, self.now_ms(), fresh.is_complete)
                }
                None => MessageOutcome::Lapse,
            },
            outcome => outcome,
        };
        match (&envelope.content, outcome) {
            (Ok(content), MessageOutcome::Ingest { namespace, leaderboard }) => {
                let incoming = Incoming::of(content, received.id.clone(), received.sent_ms);
                let span = ingest::span(&namespace, &leaderboard, incoming.evalai.submission);
                let ingested = self.ingest(&namespace, &leaderboard, &incoming).instrument(span).await;
                ingested.map_or(MessageOutcome::Lapse, |ingested| {
                    route::settle(&envelope, &ingested.map_err(Into::into), rules, self.now_ms())
                })
            }
            (_, outcome) => outcome,
        }
    }

    /// Applies it, and logs what came of it. None: there was no answer in time.
    async fn ingest(
        &self,
        namespace: &str,
        leaderboard: &str,
        incoming: &Incoming,
    ) -> Option<Result<Outcome, IngestError>> {
        let api = Api::namespaced(self.shared.client.clone(), namespace);
        let applied = tokio::time::timeout(MESSAGE_LIMIT, ingest::apply(&api, leaderboard, incoming)).await;
        let Ok(outcome) = applied else {
            tracing::warn!("the API server is too slow; the message will come back");
            return None;
        };
        match &outcome {
            Ok(Outcome::Created | Outcome::Bumped(_)) => {
                let waited = self.now_ms().saturating_sub(incoming.sent_ms);
                let waited = Duration::from_millis(u64::try_from(waited).unwrap_or_default());
                self.metrics().shared.message_wait.observe(waited.as_secs_f64());
            }
            Ok(Outcome::Repeat | Outcome::NotNew) => tracing::debug!("a repeat"),
            Ok(outcome @ (Outcome::Refused | Outcome::IdTaken(_))) => tracing::warn!("{outcome}"),
            Ok(outcome @ (Outcome::Stopping | Outcome::Deleting)) => {
                tracing::info!("{outcome}; the message comes back");
            }
            Err(error) => tracing::warn!(%error, "not ingested"),
        }
        Some(outcome)
    }

    /// Keeps a message that cannot be used where people find it, or lets it come back later if that can't be done.
    async fn set_aside(&mut self, message: &Received, reason: &DeadReason, readers: &Readers) -> MessageOutcome {
        let aside = self.source.set_aside(message, reason, &readers.rules).await;
        let (event, note) = match &aside {
            Ok(aside) => (aside.reason, aside.note.clone()),
            Err(problem) => {
                let what = named(message, reason);
                let note = format!("A message can't be used and stays in the queue: {what}. {problem}");
                (Reason::QueueBlocked, note)
            }
        };
        let (queue, reason_name) = (&self.queue, reason.as_str());
        tracing::warn!(queue, message = message.id, reason = reason_name, "{note}");
        self.publish(readers, event, &note).await;
        match aside {
            Ok(_) => MessageOutcome::Dead(reason.clone()),
            Err(_) => route::blocked(message.receives),
        }
    }

    /// An event on the oldest Leaderboard of the queue.
    async fn publish(&mut self, readers: &Readers, reason: Reason, note: &str) {
        let is_recent = self.events.get(&reason).is_some_and(|at| at.elapsed() < EVENT_PAUSE);
        let Some(leaderboard) = readers.all.first().filter(|_| !is_recent) else {
            return;
        };
        self.events.insert(reason, Instant::now());
        let event = Event {
            type_: EventType::Warning,
            reason: reason.as_str().to_owned(),
            note: Some(one_line(note, 1000)),
            action: "ReadQueue".to_owned(),
            secondary: None,
        };
        let reference = leaderboard.object_ref(&());
        let published = self.shared.recorder.publish(&event, &reference);
        let name = reference.name.as_deref().unwrap_or_default();
        if let Err(error) = call_within(CALL_LIMIT, "an event", name, published).await {
            tracing::warn!(%reason, "{error}");
        }
    }

    /// The Leaderboards as they are now, asked once for a batch.
    async fn fresh<'a>(&self, readers: &'a Readers) -> Option<&'a Leaderboards> {
        let ask = || async {
            let read = Leaderboards::read(&self.shared.client, &self.shared.scope);
            let read = call_within(CALL_LIMIT, "the Leaderboards", &self.queue, read)
                .await
                .ok()?;
            Some(Leaderboards {
                all: self.source.readers(&read.all),
                ..read
            })
        };
        readers.fresh.get_or_init(ask).await.as_ref()
    }
}

/// Does the work; extends its lease once if it is not done by half of it.
async fn extended<T>(work: impl Future<Output = T>, half: Duration, extend: impl Future<Output = ()>) -> T {
    let mut work = std::pin::pin!(work);
    tokio::select! {
        biased;
        done = &mut work => return done,
        () = tokio::time::sleep(half) => {}
    }
    join(work, extend).await.0
}

fn report(done: Result<(), String>) {
    if let Err(error) = done {
        tracing::warn!(error, "messages could not be held any longer and will come back early");
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicU32, Ordering};

    use super::*;

    #[tokio::test(start_paused = true)]
    async fn a_lease_is_extended_once_and_only_if_the_work_takes_more_than_half_of_it() {
        let half = Duration::from_secs(15);
        for (work, want) in [(0, 0), (14, 0), (16, 1), (600, 1)] {
            let count = AtomicU32::new(0);
            let extend = async { _ = count.fetch_add(1, Ordering::Relaxed) };
            let begun = Instant::now();
            extended(tokio::time::sleep(Duration::from_secs(work)), half, extend).await;
            assert_eq!(count.into_inner(), want, "{work} s");
            assert_eq!(begun.elapsed().as_secs(), work);
        }
    }
}
