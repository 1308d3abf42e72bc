//! Writes rows in the background: one task for each table, at most one write in 2 s, each only while this process leads.
//!
//! The controller hands rows in and reads views, both from memory; changes wake the object. The ledger
//! chooses what is written next.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::Duration;

use futures::FutureExt;
use futures::future::BoxFuture;
use tokio::sync::{Notify, mpsc};
use tokio::time::Instant;

use super::ledger::{Ledger, RowState, RowUpdate, TableId};
use super::{Row, Table, TableError, Written};
use crate::services::aws::Aws;
use leaderboard_api as api;
use leaderboard_base::backoff::Backoff;
use leaderboard_base::lock::lock;
use leaderboard_base::object_key::ObjectKey;
use leaderboard_base::spans::LogSpan;
use leaderboard_base::tasks::Tasks;

/// A worker that nobody gives a row ends after this long.
const LINGERS: Duration = Duration::from_mins(1);
/// Time between the starts of two writes to one table: the stock table has one write unit.
const SPACING: Duration = Duration::from_secs(2);
/// Pauses after failures in a row, half of which is no less than the spacing.
const RETRY: Backoff = Backoff::new(Duration::from_secs(4), Duration::from_mins(5));
/// How often a guard that forbids writes is asked again.
const FENCE_PAUSE: Duration = Duration::from_secs(1);

/// Writes one row; a seam for tests.
trait Store: Send + Sync + 'static {
    fn write(&self, table: &api::Table, row: Arc<Row>) -> BoxFuture<'static, Result<Written, TableError>>;
}

/// Records submissions in their tables.
#[derive(Clone)]
pub struct Recorder {
    shared: Arc<Shared>,
}

struct Shared {
    ledger: Mutex<Ledger>,
    tables: Mutex<HashMap<TableId, Arc<Notify>>>,
    store: Box<dyn Store>,
    may_write: Box<dyn Fn() -> bool + Send + Sync>,
    wake: mpsc::UnboundedSender<ObjectKey>,
    tasks: Tasks,
}

impl Recorder {
    /// A recorder whose tasks run until the stop of `tasks`. `may_write` is asked right before each write; `wake` gets each
    /// object whose view has changed.
    pub fn new(
        aws: Aws,
        may_write: impl Fn() -> bool + Send + Sync + 'static,
        wake: mpsc::UnboundedSender<ObjectKey>,
        tasks: Tasks,
    ) -> Self {
        let store = Dynamo {
            aws,
            known: Arc::default(),
        };
        Self::with_store(Box::new(store), may_write, wake, tasks)
    }

    fn with_store(
        store: Box<dyn Store>,
        may_write: impl Fn() -> bool + Send + Sync + 'static,
        wake: mpsc::UnboundedSender<ObjectKey>,
        tasks: Tasks,
    ) -> Self {
        let shared = Shared {
            ledger: Mutex::default(),
            tables: Mutex::default(),
            store,
            may_write: Box::new(may_write),
            wake,
            tasks,
        };
        Self { shared: shared.into() }
    }

    /// Hands in the newest row of an object; `end`: it is the last of its attempt. Cheap, and safe to call
    /// in each reconcile: what is written or waiting already is not written again.
    pub fn record(&self, table: &api::Table, key: &ObjectKey, row: Row, end: bool, log: LogSpan) {
        let id = TableId::from(table);
        let update = RowUpdate {
            row: row.into(),
            end,
            log,
        };
        if !self.shared.ledger().record(id.clone(), key, update, Instant::now()) {
            return;
        }
        let mut tables = lock(&self.shared.tables);
        let notify = tables.entry(id.clone()).or_insert_with(|| {
            let notify = Arc::new(Notify::new());
            let worker = Worker {
                shared: self.shared.clone(),
                table: table.clone(),
                id,
                notify: notify.clone(),
            };
            self.shared.tasks.may_end(format!("table {}", table.name), worker.run());
            notify
        });
        notify.notify_one();
    }

    /// What is known of an object's newest row; None if none was handed in.
    pub fn view(&self, key: &ObjectKey) -> Option<RowState> {
        self.shared.ledger().view(key)
    }

    /// How many rows have waited for a table for a while.
    pub fn waiting(&self, table: &api::Table) -> usize {
        self.shared.ledger().waiting(&TableId::from(table), Instant::now())
    }

    /// Forgets an object; a row of it that waits is not written any more.
    pub fn forget(&self, key: &ObjectKey) {
        self.shared.ledger().forget(key);
    }
}

impl Shared {
    fn ledger(&self) -> MutexGuard<'_, Ledger> {
        lock(&self.ledger)
    }
}

/// Writes the rows of one table.
struct Worker {
    shared: Arc<Shared>,
    table: api::Table,
    id: TableId,
    notify: Arc<Notify>,
}

impl Worker {
    /// Ends between two writes: one that has begun is finished.
    async fn run(self) {
        let stop = self.shared.tasks.stop();
        let mut failures: u32 = 0;
        while !stop.is_set() {
            let next = self.shared.ledger().next(&self.id);
            let pause = match next {
                None => None,
                Some(_) if !(self.shared.may_write)() => Some(Instant::now() + FENCE_PAUSE),
                Some((key, update)) => {
                    let begun = Instant::now();
                    let is_sick = self.write(key, update).await;
                    failures = if is_sick { failures.saturating_add(1) } else { 0 };
                    Some(begun + if failures == 0 { SPACING } else { RETRY.after(failures) })
                }
            };
            let wait = async {
                match pause {
                    Some(until) => {
                        tokio::time::sleep_until(until).await;
                        false
                    }
                    // For a long time nobody has written a row.
                    None => tokio::time::timeout(LINGERS, self.notify.notified()).await.is_err() && self.leaves(),
                }
            };
            tokio::select! {
                () = stop.wait() => {}
                is_over = wait => if is_over { return },
            }
        }
    }

    /// Takes the worker away, unless somebody has handed a row in meanwhile.
    fn leaves(&self) -> bool {
        let mut tables = lock(&self.shared.tables);
        let is_idle = self.shared.ledger().next(&self.id).is_none();
        if is_idle {
            tables.remove(&self.id);
        }
        is_idle
    }

    /// Writes one row. True if the table could not be written.
    async fn write(&self, key: ObjectKey, update: RowUpdate) -> bool {
        let result = self.shared.store.write(&self.table, update.row.clone()).await;
        let is_sick = result.as_ref().is_err_and(TableError::is_of_the_table);
        if let Err(error) = &result {
            let span = update.log.span();
            span.in_scope(|| tracing::warn!(%error, "the row is not in the table"));
        }
        let is_news = self
            .shared
            .ledger()
            .report(&self.id, &key, &update, result, Instant::now());
        if is_news {
            // Nobody listens any more once the controller has ended.
            let _ = self.shared.wake.send(key);
        }
        is_sick
    }
}

/// DynamoDB, with the tables that have been described.
struct Dynamo {
    aws: Aws,
    known: Arc<Mutex<HashMap<TableId, Table>>>,
}

impl Store for Dynamo {
    fn write(&self, table: &api::Table, row: Arc<Row>) -> BoxFuture<'static, Result<Written, TableError>> {
        let (aws, table, known) = (self.aws.clone(), table.clone(), self.known.clone());
        async move {
            let id = TableId::from(&table);
            let found = lock(&known).get(&id).cloned();
            let described = if let Some(described) = found {
                described
            } else {
                let described = Table::describe(&aws, &table).await?;
                lock(&known).insert(id.clone(), described.clone());
                described
            };
            let written = described.write(&row).await;
            if matches!(written, Err(TableError::Missing { .. } | TableError::Refused { .. })) {
                // It may have been made again with other keys.
                lock(&known).remove(&id);
            }
            written
        }
        .boxed()
    }
}

#[cfg(test)]
#[path = "recorder_tests.rs"]
mod tests;
