//! State that all requests share: the rows, the knobs, the log and the throttle behind their locks, and the clock. Made by `server`, used
//! by the handlers and [`crate::control`]. Knows no HTTP.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

use jiff::{Timestamp, Unit};
use tokio::sync::watch;

use crate::errors;
use crate::faults::Knobs;
use crate::log::RequestLog;
use crate::queue::{MemoryQueues, Queues};
use crate::reply::Reply;
use crate::seed::{Seed, SeedError};
use crate::state::State;
use crate::throttle::Throttle;

/// Requests a minute without signing in.
const ANONYMOUS_LIMIT: usize = 100;

/// Settings of a stand-in.
pub struct Config {
    /// The rows at first, and after a reset.
    pub seed: Seed,
    /// Requests per user and minute; 0 is no limit.
    pub throttle: usize,
    /// Where messages go.
    pub queues: Arc<dyn Queues>,
}

impl Config {
    /// The built-in seed, 60 requests a minute, and queues in memory, which are handed back as well.
    pub fn in_memory() -> Result<(Self, Arc<MemoryQueues>), SeedError> {
        let queues = Arc::new(MemoryQueues::default());
        Ok((
            Self {
                seed: Seed::built_in()?,
                throttle: 60,
                queues: Arc::clone(&queues) as Arc<dyn Queues>,
            },
            queues,
        ))
    }
}

/// Everything the requests share.
pub(crate) struct App {
    pub(crate) queues: Arc<dyn Queues>,
    /// Held by the PUT whose turn it is: the server works on one after the other.
    pub(crate) turn: tokio::sync::Mutex<()>,
    state: Mutex<State>,
    knobs: Mutex<Knobs>,
    log: Mutex<RequestLog>,
    throttle: Mutex<Throttle>,
    limit: usize,
    started: Instant,
    pub(crate) changes: watch::Sender<u64>,
    pub(crate) stop: watch::Sender<bool>,
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Now, to the microsecond, as the server's database keeps it.
#[allow(clippy::disallowed_methods, reason = "a stand-in for another program")]
pub(crate) fn now() -> Timestamp {
    let now = Timestamp::now();
    now.round(Unit::Microsecond).unwrap_or(now)
}

impl App {
    pub(crate) fn new(config: Config) -> Self {
        Self {
            queues: config.queues,
            turn: tokio::sync::Mutex::default(),
            state: Mutex::new(State::new(config.seed)),
            knobs: Mutex::default(),
            log: Mutex::default(),
            throttle: Mutex::default(),
            limit: config.throttle,
            started: Instant::now(),
            changes: watch::Sender::new(0),
            stop: watch::Sender::new(false),
        }
    }

    pub(crate) fn state(&self) -> MutexGuard<'_, State> {
        lock(&self.state)
    }

    pub(crate) fn knobs(&self) -> MutexGuard<'_, Knobs> {
        lock(&self.knobs)
    }

    pub(crate) fn log(&self) -> MutexGuard<'_, RequestLog> {
        lock(&self.log)
    }

    pub(crate) fn forget_throttle(&self) {
        lock(&self.throttle).clear();
    }

    pub(crate) fn check_throttle(&self, user: Option<u64>) -> Result<(), Reply> {
        let limit = self.knobs().throttle.unwrap_or(self.limit);
        let (key, limit) = match user {
            Some(id) => (format!("user {id}"), limit),
            None if limit == 0 => return Ok(()),
            None => ("anonymous".to_owned(), ANONYMOUS_LIMIT),
        };
        lock(&self.throttle)
            .check(&key, limit, self.started.elapsed())
            .map_err(throttled)
    }

    pub(crate) fn changed(&self) {
        self.changes.send_modify(|count| *count += 1);
    }

    /// Waits until `ready` holds, without a limit of its own. It is asked at once, and again at each change.
    pub(crate) async fn until(&self, mut ready: impl FnMut() -> bool) {
        let mut changes = self.changes.subscribe();
        loop {
            changes.mark_unchanged();
            if ready() || changes.changed().await.is_err() {
                return;
            }
        }
    }
}

pub(crate) fn throttled(seconds: u64) -> Reply {
    let unit = if seconds == 1 { "second" } else { "seconds" };
    let seconds = seconds.to_string();
    Reply::error(&errors::THROTTLED, &[&seconds, unit]).with("retry-after", seconds)
}
