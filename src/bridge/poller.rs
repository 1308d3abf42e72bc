//! Reads one queue: receives, lets `route` and `ingest` decide, and carries out the outcome of each message.
//!
//! One task for each queue, started and stopped by the supervisor. Holds no policy.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use aws_sdk_sqs::Client as Sqs;
use futures::future::{join, join_all};
use kube::runtime::events::{Event, EventType};
use kube::{Api, Resource};
use tokio::sync::{OnceCell, watch};
use tokio::time::Instant;
use tracing::Instrument;

use super::ages::Ages;
use super::ingest::{self, Incoming, IngestError, Outcome};
use super::leaderboards::Leaderboards;
use super::message;
use super::queue::{QueueError, Reader, Received, batch_size};
use super::route::{self, DeadReason, Envelope, Later, MessageOutcome, Rules};
use super::{PULSE_LIMIT, Shared};
use crate::backoff::Backoff;
use crate::kubernetes::call_within;
use leaderboard_api::text::one_line;
use leaderboard_api::{Leaderboard, reasons};

/// Longest time that one message may take; half of it is over when its visibility is extended.
const MESSAGE_LIMIT: Duration = Duration::from_secs(20);
/// What a visibility is extended to at least, in seconds.
const EXTENSION: i32 = 30;
/// The longest visibility that SQS allows, in seconds.
const LONGEST_VISIBILITY: i32 = 43_200;
/// How often the queue's attributes are read anew.
const REOPEN: Duration = Duration::from_mins(10);
/// A message that can be received again is, within so long: a receive looks into a part of the queue.
const SEEN_AGAIN: Duration = Duration::from_mins(1);
/// Pauses after failures in a row.
const RETRY: Backoff = Backoff::new(Duration::from_secs(1), Duration::from_mins(1));
/// Time between two events with the same reason about one queue.
const EVENT_PAUSE: Duration = Duration::from_mins(1);

/// Reads one queue.
pub struct Poller {
    url: String,
    sqs: Sqs,
    shared: Arc<Shared>,
    stop: watch::Receiver<bool>,
    reader: Option<(Reader, Instant)>,
    /// Mean time that a message takes.
    each: Duration,
    ages: Ages,
    events: HashMap<&'static str, Instant>,
}

/// The Leaderboards that read the queue, while one batch is processed.
struct Readers {
    all: Vec<Arc<Leaderboard>>,
    rules: Rules,
    is_complete: bool,
    /// The same read without a cache, when a message is about to be given up.
    fresh: OnceCell<Option<Leaderboards>>,
}

impl Poller {
    /// A poller of the queue at `url` that runs until `stop` becomes true.
    pub fn new(url: String, sqs: Sqs, shared: Arc<Shared>, stop: watch::Receiver<bool>) -> Self {
        Self {
            url,
            sqs,
            shared,
            stop,
            reader: None,
            each: Duration::from_millis(50),
            ages: Ages::default(),
            events: HashMap::new(),
        }
    }

    /// Reads the queue until the stop, and finishes what is in hand.
    pub async fn run(mut self) {
        let mut failures: u32 = 0;
        while !*self.stop.borrow() {
            let Err(problem) = self.round().await else {
                failures = 0;
                continue;
            };
            failures = failures.saturating_add(1);
            let pause = RETRY.after(failures);
            tracing::warn!(
                queue = self.url,
                problem,
                retry_seconds = pause.as_secs_f64(),
                "the queue is not read"
            );
            if !*self.stop.borrow() {
                self.shared.problems.set(&self.url, Some(problem));
            }
            let _ = tokio::time::timeout(pause, self.stop.wait_for(|stop| *stop)).await;
        }
        self.shared.telemetry.metrics.set_oldest_message(&self.url, None);
    }

    /// Receives once and processes what came.
    async fn round(&mut self) -> Result<(), String> {
        let pulse = self.shared.check_pulse().await;
        pulse.map_err(|text| {
            format!(
                "queue {} is not read while the API server does not answer: {text}",
                self.url
            )
        })?;
        let received = self.receive().await.map_err(|error| {
            self.reader = None;
            error.to_string()
        })?;
        self.remember(&received);
        if !received.is_empty() {
            self.batch(received).await;
            self.show_oldest();
        }
        Ok(())
    }

    /// What was received is in hand; what was to come back by now, and did not, is gone.
    fn remember(&mut self, received: &[Received]) {
        let now = Instant::now();
        let visibility = self.reader.as_ref().map(|(reader, _)| reader.visibility());
        let until = now + visibility.unwrap_or_default() + SEEN_AGAIN;
        for message in received {
            self.ages.keep(&message.id, message.sent_ms, until);
        }
        self.ages.expire(now);
        self.show_oldest();
    }

    fn show_oldest(&self) {
        let oldest = self.ages.oldest_ms();
        self.shared.telemetry.metrics.set_oldest_message(&self.url, oldest);
    }

    async fn receive(&mut self) -> Result<Vec<Received>, QueueError> {
        if self.reader.as_ref().is_none_or(|(_, since)| since.elapsed() > REOPEN) {
            let meter = self.shared.aws.meter().clone();
            self.reader = Some((Reader::open(self.sqs.clone(), &self.url, meter).await?, Instant::now()));
        }
        let Some((reader, _)) = &self.reader else {
            return Ok(Vec::new());
        };
        let most = batch_size(reader.visibility(), self.each);
        let mut stop = self.stop.clone();
        let received = tokio::select! {
            _ = stop.wait_for(|stop| *stop) => return Ok(Vec::new()),
            received = reader.receive(most) => received?,
        };
        if !*self.stop.borrow() {
            self.shared.problems.set(&self.url, None);
        }
        Ok(received)
    }

    async fn batch(&mut self, received: Vec<Received>) {
        let Some((reader, since)) = self.reader.take() else {
            return;
        };
        let begun = Instant::now();
        let readers = Readers::of(
            &self.url,
            &Leaderboards::cached(&self.shared.leaderboards, &self.shared.scope.allowed),
        );
        let outcomes = self.outcomes(&reader, &received, &readers).await;
        let count = u32::try_from(received.len()).unwrap_or(1);
        self.each = (self.each * 3 + begun.elapsed() / count) / 4;
        let mut deletes = Vec::new();
        for (message, mut outcome) in received.iter().zip(outcomes) {
            if let MessageOutcome::Dead(reason) = &outcome {
                outcome = self.dead_letter(&reader, message, reason, &readers).await;
            }
            self.shared
                .telemetry
                .metrics
                .messages
                .total
                .of([outcome.as_str()])
                .inc();
            match outcome {
                MessageOutcome::Delete(_) | MessageOutcome::Dead(_) => deletes.push(message),
                MessageOutcome::Later { seconds, why } => {
                    self.left(message, seconds, why);
                    report(reader.hold(&[&message.receipt], seconds).await);
                }
                MessageOutcome::Lapse | MessageOutcome::Ingest { .. } => {}
            }
        }
        self.delete(&reader, &deletes).await;
        self.reader = Some((reader, since));
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

    async fn delete(&mut self, reader: &Reader, messages: &[&Received]) {
        let receipts: Vec<_> = messages.iter().map(|message| message.receipt.as_str()).collect();
        let deleted = reader.delete(&receipts).await;
        if deleted.is_ok() {
            for message in messages {
                self.ages.forget(&message.id);
            }
        }
        report(deleted);
    }

    /// Decides on all messages at once; extends their visibility if half of it is over before all are decided.
    async fn outcomes(&self, reader: &Reader, received: &[Received], readers: &Readers) -> Vec<MessageOutcome> {
        let work = join_all(received.iter().map(|message| self.outcome(message, readers)));
        let receipts: Vec<&str> = received.iter().map(|message| message.receipt.as_str()).collect();
        let seconds = i32::try_from(reader.visibility().as_secs()).unwrap_or(i32::MAX);
        let seconds = seconds.clamp(EXTENSION, LONGEST_VISIBILITY);
        let extend = async { report(reader.hold(&receipts, seconds).await) };
        extended(work, reader.visibility() / 2, extend).await
    }

    async fn outcome(&self, received: &Received, readers: &Readers) -> MessageOutcome {
        let envelope = Envelope {
            content: message::parse(&received.body),
            sent_ms: received.sent_ms,
            receives: received.receives,
        };
        let outcome = match route::route(&envelope, &readers.all, now_ms(), readers.is_complete) {
            // The watch may be behind: nothing is given up by its cache alone.
            MessageOutcome::Dead(DeadReason::Unknown(_)) => match self.fresh(readers).await {
                Some(fresh) => route::route(&envelope, &fresh.all, now_ms(), fresh.is_complete),
                None => MessageOutcome::Lapse,
            },
            outcome => outcome,
        };
        match (&envelope.content, outcome) {
            (Ok(content), MessageOutcome::Ingest { namespace, leaderboard }) => {
                let incoming = Incoming::of(content, received.id.clone(), received.sent_ms);
                let span = ingest::span(&namespace, &leaderboard, incoming.submission);
                let ingested = self.ingest(&namespace, &leaderboard, &incoming).instrument(span).await;
                ingested.map_or(MessageOutcome::Lapse, |ingested| {
                    route::settle(&envelope, &ingested, &readers.rules, now_ms())
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
                let waited = now_ms().saturating_sub(incoming.sent_ms);
                let waited = Duration::from_millis(u64::try_from(waited).unwrap_or_default());
                self.shared
                    .telemetry
                    .metrics
                    .messages
                    .wait
                    .observe(waited.as_secs_f64());
            }
            Ok(Outcome::Repeat | Outcome::NotNew) => {
                tracing::debug!("a repeat");
            }
            Ok(Outcome::Refused) => tracing::warn!("{}", Outcome::Refused),
            Ok(Outcome::Stopping) => {
                tracing::info!("the attempt before is still being stopped; the message comes back");
            }
            Ok(Outcome::Deleting) => {
                tracing::info!("the Submission of this name is still being deleted; the message comes back");
            }
            Ok(Outcome::IdTaken(owner)) => tracing::warn!(
                owner,
                "another object has the name of this submission; rename or delete it"
            ),
            Err(error) => tracing::warn!(%error, "not ingested"),
        }
        Some(outcome)
    }

    /// Moves a message to the dead-letter queue, or lets it come back later if that can't be done.
    async fn dead_letter(
        &mut self,
        reader: &Reader,
        message: &Received,
        reason: &DeadReason,
        readers: &Readers,
    ) -> MessageOutcome {
        let what = format!("message {} ({}): {}", message.id, reason.as_str(), reason.detail());
        let problem = match &readers.rules.dead_letter {
            None => "no Leaderboard of this queue has queue.deadLetterURL".to_owned(),
            Some(url) => match reader.send_dead(url, message, reason).await {
                Ok(()) => {
                    tracing::warn!(
                        queue = self.url,
                        message = message.id,
                        reason = reason.as_str(),
                        "{what}"
                    );
                    self.publish(
                        readers,
                        reasons::DEAD_LETTER,
                        &format!("Moved to the dead-letter queue: {what}"),
                    )
                    .await;
                    return MessageOutcome::Dead(reason.clone());
                }
                Err(error) => error.to_string(),
            },
        };
        tracing::warn!(
            queue = self.url,
            message = message.id,
            reason = reason.as_str(),
            problem,
            "{what}"
        );
        let note = format!("A message can't be used and stays in the queue: {what}. {problem}");
        self.publish(readers, reasons::QUEUE_BLOCKED, &note).await;
        route::blocked(message.receives)
    }

    /// An event on the oldest Leaderboard of the queue.
    async fn publish(&mut self, readers: &Readers, reason: &'static str, note: &str) {
        let is_recent = self.events.get(reason).is_some_and(|at| at.elapsed() < EVENT_PAUSE);
        let Some(leaderboard) = readers.all.first().filter(|_| !is_recent) else {
            return;
        };
        self.events.insert(reason, Instant::now());
        let event = Event {
            type_: EventType::Warning,
            reason: reason.to_owned(),
            note: Some(one_line(note, 1000)),
            action: "ReadQueue".to_owned(),
            secondary: None,
        };
        let reference = leaderboard.object_ref(&());
        let published = self.shared.recorder.publish(&event, &reference);
        let name = reference.name.as_deref().unwrap_or_default();
        if let Err(error) = call_within(PULSE_LIMIT, "an event", name, published).await {
            tracing::warn!(reason, "{error}");
        }
    }

    /// The Leaderboards as they are now, asked once for a batch.
    async fn fresh<'a>(&self, readers: &'a Readers) -> Option<&'a Leaderboards> {
        let ask = || async {
            let read = Leaderboards::read(&self.shared.client, &self.shared.scope);
            let read = call_within(PULSE_LIMIT, "the Leaderboards", &self.url, read)
                .await
                .ok()?;
            Some(Leaderboards {
                all: route::readers(&self.url, &read.all),
                ..read
            })
        };
        readers.fresh.get_or_init(ask).await.as_ref()
    }
}

impl Readers {
    fn of(url: &str, leaderboards: &Leaderboards) -> Self {
        let all = route::readers(url, &leaderboards.all);
        Self {
            rules: route::rules(&all),
            all,
            is_complete: leaderboards.is_complete,
            fresh: OnceCell::new(),
        }
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

fn now_ms() -> i64 {
    jiff::Timestamp::now().as_millisecond()
}

fn report(done: Result<(), QueueError>) {
    if let Err(error) = done {
        tracing::warn!(%error, "messages could not be held any longer and will come back early");
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
