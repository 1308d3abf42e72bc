//! A queue in SQS as a source of messages: opened when it is first read, and only read while the API server answers.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use aws_sdk_sqs::Client as Sqs;
use kube::api::ListParams;
use tokio::time::Instant;

use super::queue::{Reader, batch_size};
use crate::intake::shared::Shared;
use crate::intake::source::{Received, SetAside, Source, named};
use crate::kubernetes::call_within;
use leaderboard_api::{Leaderboard, Reason};
use leaderboard_base::clock::Clock;
use leaderboard_base::lock::lock;
use leaderboard_base::meter::Meter;
use leaderboard_policy::intake::route::{self, DeadReason, Rules};

/// How often the queue's attributes are read anew.
const REOPEN: Duration = Duration::from_mins(10);
/// An answer of the API server that is younger than this is taken for granted.
pub(super) const PULSE_AGE: Duration = Duration::from_secs(5);
/// How soon the API server must answer before messages are received.
pub(super) const PULSE_LIMIT: Duration = Duration::from_secs(5);

/// How to reach a queue.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Connection {
    pub region: Option<String>,
    pub endpoint: Option<String>,
}

/// The queues that Leaderboards name, each reached by the connection of the oldest of them.
pub(super) fn desired(leaderboards: &[Arc<Leaderboard>]) -> BTreeMap<String, Connection> {
    let way = |url: &str| {
        let readers = route::readers(url, leaderboards);
        let queue = route::queue_of(readers.first()?)?;
        let (region, endpoint) = (queue.region.clone(), queue.endpoint.clone());
        Some((url.to_owned(), Connection { region, endpoint }))
    };
    let queues = leaderboards.iter().filter_map(|lb| route::queue_of(lb));
    queues.filter_map(|queue| way(&queue.url)).collect()
}

/// Shows whether the API server answers: a message that is received in vain is a step towards its dead letter.
pub(super) struct Pulse {
    shared: Arc<Shared>,
    last: Mutex<Option<Instant>>,
}

impl Pulse {
    pub fn of(shared: Arc<Shared>) -> Self {
        let last = Mutex::default();
        Self { shared, last }
    }

    pub async fn check(&self) -> Result<(), String> {
        let last = *lock(&self.last);
        if last.is_some_and(|at| at.elapsed() < PULSE_AGE) {
            return Ok(());
        }
        let shared = &self.shared;
        let apis = shared.scope.namespaces.apis::<Leaderboard>(&shared.client);
        let first = ListParams::default().limit(1);
        let asked = apis
            .iter()
            .map(|api| call_within(PULSE_LIMIT, "a list", "one Leaderboard", api.list_metadata(&first)));
        let listed = futures::future::try_join_all(asked).await;
        listed.map_err(|error| error.cause())?;
        *lock(&self.last) = Some(Instant::now());
        // A watch that stays broken meanwhile is a reason to restart.
        shared.telemetry.liveness.answered();
        Ok(())
    }
}

/// See the module's text.
pub(super) struct SqsQueue {
    pub url: String,
    pub sqs: Sqs,
    pub meter: Meter,
    pub pulse: Arc<Pulse>,
    /// Open since then.
    pub reader: Option<(Reader, Instant)>,
}

impl SqsQueue {
    async fn open(&mut self) -> Result<&Reader, String> {
        let known = self.reader.take().filter(|(_, since)| since.elapsed() <= REOPEN);
        let open = if let Some(open) = known {
            open
        } else {
            let reader = Reader::open(self.sqs.clone(), &self.url, self.meter.clone()).await;
            (reader.map_err(|error| error.to_string())?, Instant::now())
        };
        Ok(&self.reader.insert(open).0)
    }

    fn reader(&self) -> Result<&Reader, String> {
        let open = self.reader.as_ref().map(|(reader, _)| reader);
        open.ok_or_else(|| format!("queue {} is not open; it is opened again", self.url))
    }
}

fn receipts<'a>(messages: &[&'a Received]) -> Vec<&'a str> {
    messages.iter().map(|message| message.receipt.as_str()).collect()
}

impl Source for SqsQueue {
    fn readers(&self, all: &[Arc<Leaderboard>]) -> Vec<Arc<Leaderboard>> {
        route::readers(&self.url, all)
    }

    fn rules(&self, readers: &[Arc<Leaderboard>]) -> Rules {
        route::rules(readers)
    }

    async fn receive(&mut self, each: Duration, clock: &Clock) -> Result<Vec<Received>, String> {
        let pulse = self.pulse.check().await;
        pulse.map_err(|text| {
            format!(
                "queue {} is not read while the API server does not answer: {text}",
                self.url
            )
        })?;
        let reader = self.open().await?;
        let received = reader.receive(batch_size(reader.visibility(), each), clock).await;
        received.map_err(|error| {
            self.reader = None;
            error.to_string()
        })
    }

    fn visibility(&self) -> Duration {
        self.reader
            .as_ref()
            .map(|(reader, _)| reader.visibility())
            .unwrap_or_default()
    }

    async fn hold(&self, messages: &[&Received], seconds: i32) -> Result<(), String> {
        let held = self.reader()?.hold(&receipts(messages), seconds).await;
        held.map_err(|error| error.to_string())
    }

    async fn delete(&self, messages: &[&Received]) -> Result<(), String> {
        let deleted = self.reader()?.delete(&receipts(messages)).await;
        deleted.map_err(|error| error.to_string())
    }

    async fn set_aside(&self, message: &Received, reason: &DeadReason, rules: &Rules) -> Result<SetAside, String> {
        let to = rules.dead_letter.as_ref();
        let to = to.ok_or("no Leaderboard of this queue has queue.sqs.deadLetterURL")?;
        let sent = self.reader()?.send_dead(to, message, reason).await;
        sent.map_err(|error| error.to_string())?;
        Ok(SetAside {
            reason: Reason::DeadLetter,
            note: format!("Moved to the dead-letter queue: {}", named(message, reason)),
        })
    }
}
