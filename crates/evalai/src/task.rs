//! Carries out what one token's queue decides: takes requests out, sends them, brings the answers back.
//!
//! Started by `hub`, one for each server, namespace and token. Holds the queue's lock only for moments, never while it waits.

use std::sync::{Arc, Mutex, MutexGuard};
use std::time::Duration;

use futures::stream::{FuturesUnordered, StreamExt};
use tokio::sync::{Notify, Semaphore, oneshot, watch};
use tokio::time::Instant;

use super::answer::{Answer, Silence};
use super::client::Client;
use super::options::Options;
use super::queue::{Next, Now, Place, Queue, Ticket};
use super::request::{Reply, Request};
use super::types::{Key, Outline, Payload, PayloadProblem};
use leaderboard_base::clock::Clock;
use leaderboard_base::lock::lock;

/// How long answers are waited for at the end: longer than a write may take.
const DRAIN: Duration = Duration::from_secs(70);

/// State that the hub and the task of one token share.
pub(super) struct Shared {
    queue: Mutex<Queue>,
    pub client: Client,
    options: Arc<Options>,
    /// Notified of new updates and questions.
    pub notify: Notify,
    /// The queue's time counts from here.
    start: Instant,
}

impl Shared {
    pub fn new(queue: Queue, client: Client, options: Arc<Options>, start: Instant) -> Self {
        Self {
            queue: Mutex::new(queue),
            client,
            options,
            notify: Notify::new(),
            start,
        }
    }

    /// Makes a request for another. No answer comes if the task ends before.
    pub fn pass(&self, request: Request) -> oneshot::Receiver<Reply> {
        let answer = self.queue().pass(request, self.now());
        self.notify.notify_one();
        answer
    }

    /// The moment on the queue's clock.
    pub fn now(&self) -> Now {
        now(&self.options.clock, self.start)
    }

    /// The queue. A panic elsewhere leaves it whole: every change of it is one call.
    pub fn queue(&self) -> MutexGuard<'_, Queue> {
        lock(&self.queue)
    }

    /// Reports what has changed.
    pub fn publish(&self) {
        let (changes, sweep) = {
            let mut queue = self.queue();
            (queue.take_changes(), queue.take_sweep())
        };
        // A listener that is gone has no use for it.
        for change in changes {
            let _ = self.options.changed.send(change);
        }
        for row in sweep {
            let _ = self.options.sweep.send(row);
        }
    }
}

/// The moment, counted from `start`, and by the clock.
pub(super) fn now(clock: &Clock, start: Instant) -> Now {
    Now {
        at: start.elapsed(),
        wall: clock.now(),
    }
}

/// Parts of a task.
pub(super) struct Task {
    pub shared: Arc<Shared>,
    /// Places of payloads in memory: all queues have as many as one may hold.
    pub places: Arc<Semaphore>,
    pub closing: watch::Receiver<bool>,
    /// Asked when nothing is on its way: true, once, if nobody uses the token any more. Then it is not handed out again.
    pub is_unused: Box<dyn Fn() -> bool + Send + Sync>,
}

/// Runs until `closing` turns true, or its token is no longer used. Returns whether every write is answered: only then may
/// another process write at once.
pub(super) async fn run(task: Task) -> bool {
    let Task {
        shared,
        places,
        mut closing,
        is_unused,
    } = task;
    let (mut in_flight, mut reads) = (FuturesUnordered::new(), FuturesUnordered::new());
    while !*closing.borrow() {
        let wait = loop {
            let next = shared.queue().next(shared.now(), (shared.options.write_guard)());
            match next {
                Next::Send(ticket) => in_flight.push(send(&shared, ticket)),
                Next::Read(key, outline) => reads.push(read(&shared, &places, key, outline)),
                Next::Wait(until) => break until,
            }
        };
        let settled_at = shared.queue().settled_at(shared.now());
        if in_flight.is_empty() && settled_at.is_none() && is_unused() {
            return true;
        }
        let wait = wait.into_iter().chain(settled_at).min();
        shared.publish();
        let until = wait.map_or_else(|| Instant::now() + Duration::from_hours(1), |at| shared.start + at);
        tokio::select! {
            biased;
            _ = closing.changed() => {}
            Some((ticket, reply)) = in_flight.next(), if !in_flight.is_empty() => take(&shared, &ticket, reply),
            Some((key, payload)) = reads.next(), if !reads.is_empty() => {
                shared.queue().took_payload(&key, payload, shared.now());
            }
            () = shared.notify.notified() => {}
            () = tokio::time::sleep_until(until) => {}
        }
    }
    let answers = async {
        while let Some((ticket, reply)) = in_flight.next().await {
            take(&shared, &ticket, reply);
        }
    };
    shared.queue().pass_nothing();
    let all = tokio::time::timeout(DRAIN, answers).await.is_ok();
    all && shared.queue().settled_at(shared.now()).is_none()
}

/// Reads a payload once there is a place for it.
async fn read(
    shared: &Shared,
    places: &Arc<Semaphore>,
    key: Key,
    outline: Arc<Outline>,
) -> (Key, Result<(Payload, Place), PayloadProblem>) {
    let place = places.clone().acquire_owned().await.ok();
    let payload = (shared.options.payloads)(outline).await;
    (key, payload.map(|payload| (payload, place)))
}

/// Sends one request, unless the guard forbids writes since it was chosen, or the read of a write is too old by now. None as reply: it was
/// not sent.
async fn send(shared: &Shared, ticket: Ticket) -> (Ticket, Option<Reply>) {
    let write = ticket.request.is_write();
    let is_late = ticket.leave_by.is_some_and(|by| shared.now().at > by);
    if write && (!(shared.options.write_guard)() || is_late) {
        return (ticket, None);
    }
    let started = Instant::now();
    let reply = shared.client.send(&ticket.request).await;
    log(&ticket, &reply.answer(), started.elapsed());
    (ticket, Some(reply))
}

fn take(shared: &Shared, ticket: &Ticket, reply: Option<Reply>) {
    match reply {
        Some(reply) => shared.queue().answered(ticket, reply, shared.now()),
        None => shared.queue().not_sent(ticket),
    }
    shared.publish();
}

fn log(ticket: &Ticket, answer: &Answer<()>, took: Duration) {
    let request = ticket.request.op();
    let subject = ticket.request.submission();
    let _lines = subject.map(|subject| subject.log.span().entered());
    let milliseconds = u64::try_from(took.as_millis()).unwrap_or(u64::MAX);
    match answer {
        Answer::Done(()) => tracing::debug!(request, milliseconds, "EvalAI has answered"),
        Answer::Unanswered(Silence { sent: true, why }) if ticket.request.is_write() => {
            tracing::warn!(
                request,
                milliseconds,
                why,
                "EvalAI has not answered a write; no further write to this submission for a while"
            );
        }
        other => {
            let why = other.error().unwrap_or_default();
            tracing::warn!(request, milliseconds, why, "EvalAI request failed");
        }
    }
}
