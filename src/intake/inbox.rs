//! EvalAI's own queues as a source of messages, which become Submissions as those of SQS do in the bridge.
//!
//! Started by the controller's leader: it has the tokens, and a third of their requests are for these queues. EvalAI shows neither the id of
//! a message nor when it was sent. The time at which its row asked to be run takes the place of both, so a message that comes twice is a
//! repeat. EvalAI has no dead-letter queue: the log and an event keep what a message held that is deleted unused.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use jiff::Timestamp;
use tokio::time::{Instant, sleep};

use crate::intake::pollers::follow;
use crate::intake::shared::Shared;
use crate::intake::source::{Received, SetAside, Source, named};
use crate::leaderboards::operator;
use crate::runtime::objects::key_of;
use leaderboard_api::text::one_line;
use leaderboard_api::{EvalaiQueue, Leaderboard, Reason};
use leaderboard_base::backoff::Backoff;
use leaderboard_base::clock::Clock;
use leaderboard_base::object_key::ObjectKey;
use leaderboard_evalai::answer::{About, Answer};
use leaderboard_evalai::request::{Reply, Request};
use leaderboard_evalai::{Hub, Row};
use leaderboard_policy::intake::message;
use leaderboard_policy::intake::route::{DeadReason, Hindrance, OUTCOMES, Rules};

/// Most characters of a message that an event and the log quote.
const QUOTED: usize = 500;
/// How long EvalAI hides a message that was received.
const VISIBILITY: Duration = Duration::from_secs(30);
/// Waits before an empty queue is asked again. Three requests a minute at rest.
const IDLE: Backoff = Backoff::new(Duration::from_secs(5), Duration::from_secs(20));
/// EvalAI did not have a submission when its message came: a second message of it within so long shows that it is not there.
const MISSING: Duration = Duration::from_mins(10);

/// A queue, and the Leaderboard by whose token it is read: the oldest that names it.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Way {
    server: String,
    name: String,
    leaderboard: ObjectKey,
}

/// One queue.
struct Inbox {
    way: Way,
    hub: Hub,
    operator: String,
    /// Answers in a row without a message.
    empty: u32,
    /// Submissions that EvalAI does not have, and since when.
    missing: BTreeMap<i64, Instant>,
}

/// Reads the queues that this operator's Leaderboards name until the stop.
pub async fn read(shared: Arc<Shared>, hub: Hub, operator: String) {
    let metrics = Arc::clone(&shared.telemetry.metrics);
    let open = |_: &str, way: &Way| {
        for outcome in OUTCOMES {
            metrics.shared.messages.of([outcome]);
        }
        Inbox {
            way: way.clone(),
            hub: hub.clone(),
            operator: operator.clone(),
            empty: 0,
            missing: BTreeMap::new(),
        }
    };
    follow(shared, |all| desired(all, &operator), open).await;
}

fn desired(all: &[Arc<Leaderboard>], operator: &str) -> BTreeMap<String, Way> {
    let mut ways = BTreeMap::new();
    for leaderboard in by_age(all.to_vec()) {
        if let Some((server, queue)) = queue_of(&leaderboard, operator) {
            let name = queue.name.clone();
            let leaderboard = key_of(leaderboard.as_ref());
            ways.entry(format!("{server}: {name}")).or_insert(Way {
                server,
                name,
                leaderboard,
            });
        }
    }
    ways
}

/// The server and the queue that a Leaderboard of ours names, if it takes messages.
fn queue_of<'a>(leaderboard: &'a Leaderboard, operator: &str) -> Option<(String, &'a EvalaiQueue)> {
    let evalai = leaderboard.spec.evalai.as_ref()?;
    let is_read = leaderboard.metadata.deletion_timestamp.is_none() && operator::is_ours(leaderboard, operator);
    let queue = leaderboard.spec.evalai_queue().filter(|_| is_read)?;
    Some((evalai.server(), queue))
}

fn by_age(mut all: Vec<Arc<Leaderboard>>) -> Vec<Arc<Leaderboard>> {
    all.sort_by_key(|leaderboard| leaderboard.seniority());
    all
}

/// When a message was sent, if its row shows that, and why it makes no Submission.
fn origin(submission: i64, answer: Answer<Row>, now: Timestamp) -> Result<(Option<i64>, Option<Hindrance>), String> {
    let hindrance = match answer {
        Answer::Done(row) => match row.wanted_at() {
            // A row's times are its participant's to edit: one of the future would keep later resumes from being newer.
            Some(at) => return Ok((Some(at.min(now).as_millisecond()), None)),
            None => Hindrance::Hidden,
        },
        Answer::Refused(refusal) if refusal.about == About::Missing => {
            Hindrance::Unusable(format!("EvalAI has no submission {submission}"))
        }
        Answer::Refused(refusal) if refusal.is_of_another_challenge() => Hindrance::Unusable(format!(
            "EvalAI does not show submission {submission} to a host of this challenge: its row has a phase of another challenge"
        )),
        Answer::Refused(_) => Hindrance::Hidden,
        other => return Err(other.error().unwrap_or_default()),
    };
    Ok((None, Some(hindrance)))
}

impl Inbox {
    /// EvalAI's answer; none while the Leaderboard is not served.
    async fn ask(&self, request: Request) -> Option<Reply> {
        self.hub.pass(&self.way.leaderboard, request).await
    }

    /// Notes that EvalAI does not have a submission. True if it was not asked for before: one answer may be of a server that is just being
    /// replaced.
    fn is_first_miss(&mut self, submission: i64) -> bool {
        self.missing.retain(|_, since| since.elapsed() < MISSING);
        match self.missing.remove(&submission) {
            Some(_) => false,
            None => self.missing.insert(submission, Instant::now()).is_none(),
        }
    }

    /// The message with the facts of its row in EvalAI. None if it has to come back first, because the row was not read or is missing.
    async fn look_up(&mut self, body: String, receipt: String, now: Timestamp) -> Result<Option<Received>, String> {
        let (mut id, mut sent, mut hindrance) = ("evalai".to_owned(), None, None);
        if let Ok(message) = message::parse(&body) {
            let submission = message.submission;
            let Some(Reply::Row(answer)) = self.ask(Request::MessageRow(submission)).await else {
                return Ok(None);
            };
            let is_missing = matches!(&answer, Answer::Refused(refusal) if refusal.about == About::Missing);
            if is_missing && self.is_first_miss(submission) {
                return Ok(None);
            }
            (sent, hindrance) = origin(submission, answer, now)?;
            id = format!("evalai-{submission}-{}", sent.unwrap_or_default());
        }
        let now = now.as_millisecond();
        Ok(Some(Received {
            id,
            receipt,
            body,
            sent_ms: sent.unwrap_or(now),
            first_seen_ms: now,
            receives: 1,
            group: None,
            hindrance,
        }))
    }
}

impl Source for Inbox {
    fn readers(&self, all: &[Arc<Leaderboard>]) -> Vec<Arc<Leaderboard>> {
        let Way { server, name, .. } = &self.way;
        let names = |leaderboard: &&Arc<Leaderboard>| {
            queue_of(leaderboard, &self.operator).is_some_and(|(on, queue)| on == *server && queue.name == *name)
        };
        by_age(all.iter().filter(names).cloned().collect())
    }

    fn rules(&self, readers: &[Arc<Leaderboard>]) -> Rules {
        let queues = readers.iter().filter_map(|reader| queue_of(reader, &self.operator));
        let longest = queues.map(|(_, queue)| queue.unknown_after_seconds).max();
        Rules {
            unknown_after_ms: longest.unwrap_or_default() * 1000,
            is_common: true,
            ..Rules::default()
        }
    }

    async fn receive(&mut self, _: Duration, clock: &Clock) -> Result<Vec<Received>, String> {
        if self.empty > 0 {
            sleep(IDLE.bound(self.empty)).await;
        }
        self.empty = self.empty.saturating_add(1);
        let Some(Reply::Message(answer)) = self.ask(Request::Receive(self.way.name.clone())).await else {
            return Ok(Vec::new());
        };
        let Answer::Done(found) = answer else {
            return Err(answer.error().unwrap_or_default());
        };
        let (Some(receipt), false) = (found.receipt_handle, found.body.is_null()) else {
            return Ok(Vec::new());
        };
        self.empty = 0;
        let received = self.look_up(found.body.to_string(), receipt, clock.now()).await?;
        Ok(received.into_iter().collect())
    }

    fn visibility(&self) -> Duration {
        VISIBILITY
    }

    /// It comes back after the same time anyway.
    async fn hold(&self, _: &[&Received], _: i32) -> Result<(), String> {
        Ok(())
    }

    async fn delete(&self, messages: &[&Received]) -> Result<(), String> {
        for message in messages {
            let request = Request::DeleteMessage(self.way.name.clone(), message.receipt.clone());
            let answer = self.ask(request).await.map(|reply| reply.answer());
            let why = match answer {
                Some(Answer::Done(())) => continue,
                Some(other) => other.error().unwrap_or_default(),
                None => "its Leaderboard is not served".to_owned(),
            };
            return Err(format!(
                "a message of EvalAI's queue {} was not deleted: {why}",
                self.way.name
            ));
        }
        Ok(())
    }

    async fn set_aside(&self, message: &Received, reason: &DeadReason, _: &Rules) -> Result<SetAside, String> {
        let text = one_line(&message.body, QUOTED);
        let (queue, what) = (&self.way.name, named(message, reason));
        Ok(SetAside {
            reason: Reason::MessageDropped,
            note: format!("Deleted from EvalAI's queue {queue}: {what}. It was {text}"),
        })
    }
}

#[cfg(test)]
mod tests;
