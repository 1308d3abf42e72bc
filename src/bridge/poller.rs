//! Reads one queue: receives, lets `route` and `ingest` decide, and carries the fate of each message out.
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

use super::ingest::{self, Incoming, Outcome, Source};
use super::message::{self, Message};
use super::queue::{QueueError, Reader, Received, batch_size};
use super::route::{self, DeadReason, Envelope, Fate, Rules};
use super::world::{self, World};
use super::{PULSE_LIMIT, Shared};
use leaderboard_api::{Leaderboard, names, reasons};

/// Longest time that one message may take; half of it is over when its visibility is extended.
const MESSAGE_LIMIT: Duration = Duration::from_secs(20);
/// What a visibility is extended to at least, in seconds.
const EXTENSION: i32 = 30;
/// The longest visibility that SQS allows, in seconds.
const LONGEST_VISIBILITY: i32 = 43_200;
/// How often the queue's attributes are read anew.
const REOPEN: Duration = Duration::from_mins(10);
/// Longest pause after a failure.
const LONGEST_PAUSE: Duration = Duration::from_mins(1);
/// Time between two events with the same reason about one queue.
const EVENT_PAUSE: Duration = Duration::from_mins(1);

/// Reads one queue.
pub struct Poller {
    url: String,
    sqs: Sqs,
    shared: Arc<Shared>,
    world: watch::Receiver<World>,
    stop: watch::Receiver<bool>,
    reader: Option<(Reader, Instant)>,
    /// Mean time that a message takes.
    each: Duration,
    events: HashMap<&'static str, Instant>,
}

/// The Leaderboards that read the queue, while one batch is dealt with.
struct Readers {
    all: Vec<Arc<Leaderboard>>,
    rules: Rules,
    is_complete: bool,
    /// The same read without a cache, when a message is about to be given up.
    fresh: OnceCell<Option<(Vec<Arc<Leaderboard>>, bool)>>,
}

impl Poller {
    /// A poller of the queue at `url` that runs until `stop` becomes true.
    pub fn new(
        url: String,
        sqs: Sqs,
        shared: Arc<Shared>,
        world: watch::Receiver<World>,
        stop: watch::Receiver<bool>,
    ) -> Self {
        Self {
            url,
            sqs,
            shared,
            world,
            stop,
            reader: None,
            each: Duration::from_millis(50),
            events: HashMap::new(),
        }
    }

    /// Reads the queue until it is told to stop, and finishes what is in hand.
    pub async fn run(mut self) {
        let mut failures: u32 = 0;
        while !*self.stop.borrow() {
            let Err(problem) = self.round().await else {
                failures = 0;
                continue;
            };
            failures = failures.saturating_add(1);
            let pause = pause(failures, fastrand::f64());
            tracing::warn!(
                queue = self.url,
                problem,
                retry_seconds = pause.as_secs_f64(),
                "the queue is not read"
            );
            if !*self.stop.borrow() {
                self.shared.settings.health.queue(&self.url, Some(problem));
            }
            let _ = tokio::time::timeout(pause, self.stop.wait_for(|stop| *stop)).await;
        }
    }

    /// Receives once and deals with what came.
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
        if !received.is_empty() {
            self.batch(received).await;
        }
        Ok(())
    }

    async fn receive(&mut self) -> Result<Vec<Received>, QueueError> {
        if self.reader.as_ref().is_none_or(|(_, since)| since.elapsed() > REOPEN) {
            let observer = self.shared.settings.observer.clone();
            self.reader = Some((
                Reader::open(self.sqs.clone(), &self.url, observer).await?,
                Instant::now(),
            ));
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
            self.shared.settings.health.queue(&self.url, None);
        }
        Ok(received)
    }

    async fn batch(&mut self, received: Vec<Received>) {
        let Some((reader, since)) = self.reader.take() else {
            return;
        };
        let begun = Instant::now();
        let readers = Readers::of(&self.url, &self.world.borrow());
        let fates = self.fates(&reader, &received, &readers).await;
        let count = u32::try_from(received.len()).unwrap_or(1);
        self.each = (self.each * 3 + begun.elapsed() / count) / 4;
        let mut deletes = Vec::new();
        for (message, mut fate) in received.iter().zip(fates) {
            if let Fate::Dead(reason) = &fate {
                fate = self.bury(&reader, message, reason, &readers).await;
            }
            self.shared.settings.observer.messages(fate.word(), 1);
            match fate {
                Fate::Delete(_) | Fate::Dead(_) => deletes.push(message.receipt.as_str()),
                Fate::Later { seconds, .. } => report(reader.hold(&[&message.receipt], seconds).await),
                Fate::Lapse | Fate::Ingest { .. } => {}
            }
        }
        report(reader.delete(&deletes).await);
        self.reader = Some((reader, since));
    }

    /// Decides on all messages at once; extends their visibility if half of it is over before all are decided.
    async fn fates(&self, reader: &Reader, received: &[Received], readers: &Readers) -> Vec<Fate> {
        let work = join_all(received.iter().map(|message| self.fate(message, readers)));
        let receipts: Vec<&str> = received.iter().map(|message| message.receipt.as_str()).collect();
        let seconds = i32::try_from(reader.visibility().as_secs()).unwrap_or(i32::MAX);
        let seconds = seconds.clamp(EXTENSION, LONGEST_VISIBILITY);
        let extend = async { report(reader.hold(&receipts, seconds).await) };
        extended(work, reader.visibility() / 2, extend).await
    }

    async fn fate(&self, received: &Received, readers: &Readers) -> Fate {
        let envelope = Envelope {
            content: message::parse(&received.body),
            sent_ms: received.sent_ms,
            receives: received.receives,
        };
        let fate = match route::route(&envelope, &readers.all, now_ms(), readers.is_complete) {
            // The watch may be behind: nothing is given up on its word alone.
            Fate::Dead(DeadReason::Unknown(_)) => match self.fresh(readers).await {
                Some((fresh, is_complete)) => route::route(&envelope, fresh, now_ms(), *is_complete),
                None => Fate::Lapse,
            },
            fate => fate,
        };
        match (&envelope.content, fate) {
            (Ok(content), Fate::Ingest { namespace, leaderboard }) => {
                let incoming = incoming(content, received);
                self.ingest(&namespace, &leaderboard, &incoming, &envelope, &readers.rules)
                    .await
            }
            (_, fate) => fate,
        }
    }

    async fn ingest(
        &self,
        namespace: &str,
        leaderboard: &str,
        incoming: &Incoming,
        envelope: &Envelope,
        rules: &Rules,
    ) -> Fate {
        let api = Api::namespaced(self.shared.client.clone(), namespace);
        let applied = tokio::time::timeout(MESSAGE_LIMIT, ingest::apply(&api, leaderboard, incoming)).await;
        let submission = format!("{namespace}/{}", names::submission(incoming.submission));
        let Ok(outcome) = applied else {
            tracing::warn!(
                submission,
                leaderboard,
                "the API server is too slow; the message will come back"
            );
            return Fate::Lapse;
        };
        match &outcome {
            Ok(Outcome::Created) => tracing::info!(submission, leaderboard, "created"),
            Ok(Outcome::Bumped(attempt)) => tracing::info!(submission, leaderboard, attempt, "resumed"),
            Ok(Outcome::Repeat | Outcome::Refused | Outcome::NotNew) => {
                tracing::debug!(submission, leaderboard, "a repeat");
            }
            Ok(Outcome::Deleting) => tracing::info!(submission, leaderboard, "the old one is still being deleted"),
            Ok(Outcome::IdTaken(owner)) => tracing::warn!(
                submission,
                leaderboard,
                owner,
                "another object has the name of this submission; rename or delete it"
            ),
            Err(error) => tracing::warn!(submission, leaderboard, %error, "not ingested"),
        }
        route::settle(envelope, &outcome, rules, now_ms())
    }

    /// Moves a message to the dead-letter queue, or lets it come back later if that can't be done.
    async fn bury(&mut self, reader: &Reader, message: &Received, reason: &DeadReason, readers: &Readers) -> Fate {
        let what = format!("message {} ({}): {}", message.id, reason.word(), reason.detail());
        let problem = match &readers.rules.dead_letter {
            None => "no Leaderboard of this queue has queue.deadLetterURL".to_owned(),
            Some(url) => match reader.send_dead(url, message, reason).await {
                Ok(()) => {
                    tracing::warn!(queue = self.url, message = message.id, reason = reason.word(), "{what}");
                    self.tell(
                        readers,
                        "DeadLetter",
                        &format!("Moved to the dead-letter queue: {what}"),
                    )
                    .await;
                    return Fate::Dead(reason.clone());
                }
                Err(error) => error.to_string(),
            },
        };
        tracing::warn!(
            queue = self.url,
            message = message.id,
            reason = reason.word(),
            problem,
            "{what}"
        );
        let note = format!("A message can't be used and stays in the queue: {what}. {problem}");
        self.tell(readers, reasons::QUEUE_BLOCKED, &note).await;
        route::blocked(message.receives)
    }

    /// An event on the oldest Leaderboard of the queue.
    async fn tell(&mut self, readers: &Readers, reason: &'static str, note: &str) {
        let is_recent = self.events.get(reason).is_some_and(|at| at.elapsed() < EVENT_PAUSE);
        let Some(leaderboard) = readers.all.first().filter(|_| !is_recent) else {
            return;
        };
        self.events.insert(reason, Instant::now());
        let event = Event {
            type_: EventType::Warning,
            reason: reason.to_owned(),
            note: Some(note.chars().take(1000).collect()),
            action: "ReadQueue".to_owned(),
            secondary: None,
        };
        let reference = leaderboard.object_ref(&());
        let published = self.shared.recorder.publish(&event, &reference);
        match tokio::time::timeout(PULSE_LIMIT, published).await {
            Ok(Ok(())) => {}
            Ok(Err(error)) => tracing::warn!(error = world::chain(&error), reason, "an event could not be written"),
            Err(_) => tracing::warn!(reason, "an event could not be written in time"),
        }
    }

    /// The Leaderboards as they are now, asked once for a batch.
    async fn fresh<'a>(&self, readers: &'a Readers) -> Option<&'a (Vec<Arc<Leaderboard>>, bool)> {
        let ask = || async {
            let api = world::api(self.shared.client.clone(), self.shared.settings.namespace.as_deref());
            let answer = tokio::time::timeout(PULSE_LIMIT, world::read(&api)).await;
            let world = answer.ok()?.ok()?;
            Some((route::readers(&self.url, &world.leaderboards()), world.is_complete()))
        };
        readers.fresh.get_or_init(ask).await.as_ref()
    }
}

impl Readers {
    fn of(url: &str, world: &World) -> Self {
        let all = route::readers(url, &world.leaderboards());
        Self {
            rules: route::rules(&all),
            all,
            is_complete: world.is_complete(),
            fresh: OnceCell::new(),
        }
    }
}

fn incoming(content: &Message, received: &Received) -> Incoming {
    Incoming {
        challenge: content.challenge,
        phase: content.phase,
        submission: content.submission,
        image: content.image.clone(),
        source: Source::Message(received.id.clone()),
        sent_ms: received.sent_ms,
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

/// Doubles from 1 s to a minute, between half of it and all.
fn pause(failures: u32, chance: f64) -> Duration {
    let whole = Duration::from_secs(1 << failures.saturating_sub(1).min(6)).min(LONGEST_PAUSE);
    whole.mul_f64(0.5 + chance / 2.0)
}

fn now_ms() -> i64 {
    jiff::Timestamp::now().as_millisecond()
}

fn report(done: Result<(), QueueError>) {
    if let Err(error) = done {
        tracing::warn!(%error, "messages will come back early");
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

    #[test]
    fn pauses_double_up_to_a_minute() {
        let seconds: Vec<u64> = [1, 2, 3, 6, 7, 40]
            .map(|failures| pause(failures, 1.0).as_secs())
            .into();
        assert_eq!(seconds, [1, 2, 4, 32, 60, 60]);
        assert_eq!(pause(2, 0.0), Duration::from_secs(1));
    }
}
