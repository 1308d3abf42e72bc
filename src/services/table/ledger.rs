//! Which row of which object is to be written next: the recorder's memory, pure, with the time handed in.
//!
//! Of an object's rows the newest wins: a later attempt over an earlier one, an end over what comes before it.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use tokio::time::Instant;

use super::{Row, TableError, Written};
use leaderboard_api as api;
use leaderboard_base::object_key::ObjectKey;
use leaderboard_base::spans::LogSpan;

/// How long a row that was refused for its own sake is not retried.
const REFUSED: Duration = Duration::from_mins(5);
/// A row that waits for less is on its way.
const ON_ITS_WAY: Duration = Duration::from_secs(10);

/// What identifies a table and how it is reached.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct TableId {
    name: String,
    region: Option<String>,
    endpoint: Option<String>,
    keys: Option<(String, String)>,
}

impl From<&api::Table> for TableId {
    fn from(table: &api::Table) -> Self {
        Self {
            name: table.name.clone(),
            region: table.region.clone(),
            endpoint: table.endpoint.clone(),
            keys: table.partition_key.clone().zip(table.sort_key.clone()),
        }
    }
}

/// What is known of an object's newest row.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RowState {
    /// The newest attempt that a row was handed in for.
    pub attempt: i64,
    /// True if the end of that attempt is in the table.
    pub end_written: bool,
    /// The attempt of the row that the table keeps in place of that end.
    pub superseded_by: Option<i64>,
    /// Why the newest row is not in the table.
    pub error: Option<String>,
}

/// A row that is to be written.
#[derive(Clone, Debug, PartialEq)]
pub struct RowUpdate {
    pub row: Arc<Row>,
    pub end: bool,
    /// For the log.
    pub log: LogSpan,
}

#[derive(Debug)]
struct Entry {
    table: TableId,
    /// Place in line, kept while newer rows replace older ones.
    turn: u64,
    /// When it began to wait.
    since: Instant,
    newest: RowUpdate,
    is_pending: bool,
    is_written: bool,
    superseded_by: Option<i64>,
    refused_until: Option<Instant>,
    error: Option<String>,
}

/// All rows of all tables.
#[derive(Debug, Default)]
pub struct Ledger {
    entries: HashMap<ObjectKey, Entry>,
    turns: u64,
}

impl Ledger {
    /// Takes a row in. False if there is nothing to write for it.
    pub fn record(&mut self, table: TableId, key: &ObjectKey, update: RowUpdate, now: Instant) -> bool {
        self.turns += 1;
        let turn = self.turns;
        if let Some(entry) = self.entries.get_mut(key).filter(|entry| entry.table == table) {
            let old = &entry.newest;
            let is_older = (update.row.attempt, update.end) < (old.row.attempt, old.end);
            let waits = entry.refused_until.is_some_and(|until| now < until);
            let is_known = update == *old && (entry.is_pending || entry.is_written || waits);
            if is_older || is_known {
                return false;
            }
            if update.row.attempt != old.row.attempt || entry.superseded_by.is_some() {
                entry.error = None;
            }
            if !entry.is_pending {
                (entry.turn, entry.since) = (turn, now);
            }
            entry.newest = update;
            (entry.is_pending, entry.is_written, entry.refused_until) = (true, false, None);
            entry.superseded_by = None;
            return true;
        }
        let entry = Entry {
            table,
            turn,
            since: now,
            newest: update,
            is_pending: true,
            is_written: false,
            superseded_by: None,
            refused_until: None,
            error: None,
        };
        self.entries.insert(key.clone(), entry);
        true
    }

    /// The row of a table that goes next: ends first, then who has waited longest.
    pub fn next(&self, table: &TableId) -> Option<(ObjectKey, RowUpdate)> {
        let waiting = self
            .entries
            .iter()
            .filter(|(_, entry)| entry.is_pending && entry.table == *table);
        let first = waiting.min_by_key(|(_, entry)| (!entry.newest.end, entry.turn));
        first.map(|(key, entry)| (key.clone(), entry.newest.clone()))
    }

    /// How many rows have waited for a table for longer than one takes.
    pub fn waiting(&self, table: &TableId, now: Instant) -> usize {
        let waits = |entry: &&Entry| entry.is_pending && entry.table == *table && entry.since + ON_ITS_WAY < now;
        self.entries.values().filter(waits).count()
    }

    /// Takes in what became of a write to a table. True if the view of the object has changed.
    pub fn report(
        &mut self,
        table: &TableId,
        key: &ObjectKey,
        update: &RowUpdate,
        result: Result<Written, TableError>,
        now: Instant,
    ) -> bool {
        let before = self.view(key);
        self.turns += 1;
        // A Leaderboard may have got another table meanwhile, which has nothing of this write.
        let Some(entry) = self.entries.get_mut(key).filter(|entry| entry.table == *table) else {
            return false;
        };
        let is_newest = entry.newest == *update;
        match stale_is_an_error(&entry.table, update, result) {
            Ok(()) if is_newest => {
                (entry.is_pending, entry.is_written, entry.error) = (false, true, None);
            }
            Err(error) if error.is_of_the_table() => {
                // The others of this table get their turn.
                entry.turn = self.turns;
                entry.error = Some(error.to_string());
            }
            Err(error) if is_newest => {
                (entry.is_pending, entry.refused_until) = (false, Some(now + REFUSED));
                entry.superseded_by = match error {
                    TableError::Stale { kept, .. } => Some(kept),
                    _ => None,
                };
                entry.error = Some(error.to_string());
            }
            // A newer row waits already; what became of the older one means nothing.
            Ok(()) | Err(_) => {}
        }
        self.view(key) != before
    }

    /// What is known of an object.
    pub fn view(&self, key: &ObjectKey) -> Option<RowState> {
        self.entries.get(key).map(|entry| RowState {
            attempt: entry.newest.row.attempt,
            end_written: entry.newest.end && entry.is_written,
            superseded_by: entry.superseded_by,
            error: entry.error.clone(),
        })
    }

    #[cfg(test)]
    pub fn len(&self) -> usize {
        self.entries.len()
    }

    /// Forgets an object; what was not written stays unwritten.
    pub fn forget(&mut self, key: &ObjectKey) {
        self.entries.remove(key);
    }
}

/// A row before the end that comes too late is no error; an end that was not stored is.
fn stale_is_an_error(
    table: &TableId,
    update: &RowUpdate,
    result: Result<Written, TableError>,
) -> Result<(), TableError> {
    match result? {
        Written::Stale { kept } if update.end => Err(TableError::Stale {
            table: table.name.clone(),
            run_id: update.row.run_id.clone(),
            kept,
        }),
        Written::Stored | Written::Stale { .. } => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn table(name: &str) -> TableId {
        TableId {
            name: name.into(),
            region: None,
            endpoint: None,
            keys: None,
        }
    }

    fn key(name: &str) -> ObjectKey {
        ObjectKey {
            namespace: "ns".into(),
            name: name.into(),
            uid: "u".into(),
        }
    }

    fn update(attempt: i64, progress: &str, end: bool) -> RowUpdate {
        let row = Row {
            attempt,
            progress: progress.into(),
            run_id: "7".into(),
            ..Row::default()
        };
        RowUpdate {
            row: row.into(),
            end,
            log: LogSpan::default(),
        }
    }

    fn view(attempt: i64, end_written: bool, error: Option<&str>) -> RowState {
        RowState {
            attempt,
            end_written,
            superseded_by: None,
            error: error.map(str::to_owned),
        }
    }

    fn throttled() -> TableError {
        TableError::Passing {
            table: "t".into(),
            action: "UpdateItem",
            text: "slow down".into(),
        }
    }

    #[test]
    fn the_newest_row_wins_and_what_is_known_is_not_written_again() {
        let (mut ledger, now, a) = (Ledger::default(), Instant::now(), key("a"));
        let mut record = |update: RowUpdate| {
            (
                ledger.record(table("t"), &a, update, now),
                ledger.next(&table("t")).unwrap().1,
            )
        };
        assert_eq!(record(update(1, "1/9", false)), (true, update(1, "1/9", false)));
        assert_eq!(record(update(1, "1/9", false)), (false, update(1, "1/9", false)));
        assert_eq!(record(update(1, "2/9", false)), (true, update(1, "2/9", false)));
        assert_eq!(record(update(1, "9/9", true)), (true, update(1, "9/9", true)));
        assert_eq!(
            record(update(1, "3/9", false)),
            (false, update(1, "9/9", true)),
            "the end stays"
        );
        assert_eq!(
            record(update(2, "3/9", false)),
            (true, update(2, "3/9", false)),
            "but for a resume"
        );
        assert_eq!(record(update(1, "9/9", true)), (false, update(2, "3/9", false)));
    }

    #[test]
    fn rows_that_wait_for_long_are_counted_table_by_table() {
        let (mut ledger, now) = (Ledger::default(), Instant::now());
        for name in ["a", "b", "c"] {
            ledger.record(table("t"), &key(name), update(1, "9/9", true), now);
        }
        ledger.record(table("u"), &key("d"), update(1, "9/9", true), now);
        let (soon, late) = (now + ON_ITS_WAY, now + ON_ITS_WAY + Duration::from_secs(1));
        assert_eq!(ledger.waiting(&table("t"), soon), 0, "they are on their way");
        assert_eq!(
            (ledger.waiting(&table("t"), late), ledger.waiting(&table("u"), late)),
            (3, 1)
        );
        ledger.report(
            &table("t"),
            &key("a"),
            &update(1, "9/9", true),
            Ok(Written::Stored),
            late,
        );
        ledger.report(&table("t"), &key("b"), &update(1, "9/9", true), Err(throttled()), late);
        // A newer row waits as long as the one that it replaces.
        ledger.record(table("t"), &key("c"), update(2, "1/9", false), late);
        assert_eq!(ledger.waiting(&table("t"), late), 2);
    }

    #[test]
    fn an_end_is_written_once() {
        let (mut ledger, now, a) = (Ledger::default(), Instant::now(), key("a"));
        ledger.record(table("t"), &a, update(1, "9/9", true), now);
        assert_eq!(ledger.view(&a), Some(view(1, false, None)));
        assert!(ledger.report(&table("t"), &a, &update(1, "9/9", true), Ok(Written::Stored), now));
        assert_eq!(ledger.view(&a), Some(view(1, true, None)));
        assert_eq!(ledger.next(&table("t")), None);
        assert!(!ledger.record(table("t"), &a, update(1, "9/9", true), now));
        ledger.forget(&a);
        assert_eq!(ledger.view(&a), None);
        assert!(!ledger.report(&table("t"), &a, &update(1, "9/9", true), Ok(Written::Stored), now));
    }

    #[test]
    fn a_row_that_was_replaced_while_it_was_written_leaves_the_newer_one_waiting() {
        let (mut ledger, now, a) = (Ledger::default(), Instant::now(), key("a"));
        ledger.record(table("t"), &a, update(1, "1/9", false), now);
        let (_, first) = ledger.next(&table("t")).unwrap();
        ledger.record(table("t"), &a, update(1, "2/9", false), now);
        assert!(!ledger.report(&table("t"), &a, &first, Ok(Written::Stored), now));
        assert_eq!(ledger.next(&table("t")).unwrap().1, update(1, "2/9", false));
    }

    #[test]
    fn what_a_table_has_taken_is_not_in_the_one_that_the_leaderboard_has_now() {
        let (mut ledger, now, a) = (Ledger::default(), Instant::now(), key("a"));
        ledger.record(table("t"), &a, update(1, "9/9", true), now);
        let (_, first) = ledger.next(&table("t")).unwrap();
        assert!(ledger.record(table("u"), &a, update(1, "9/9", true), now));
        assert!(!ledger.report(&table("t"), &a, &first, Ok(Written::Stored), now));
        assert_eq!(ledger.view(&a), Some(view(1, false, None)));
        assert!(!ledger.report(&table("t"), &a, &first, Err(throttled()), now));
        assert_eq!(ledger.next(&table("u")).unwrap().1, first);
    }

    #[test]
    fn ends_go_first_then_who_waited_longest_each_table_for_itself() {
        let (mut ledger, now) = (Ledger::default(), Instant::now());
        for (name, end) in [("a", false), ("b", false), ("c", true)] {
            ledger.record(table("t"), &key(name), update(1, "1/9", end), now);
        }
        ledger.record(table("u"), &key("d"), update(1, "1/9", true), now);
        ledger.record(table("t"), &key("a"), update(1, "2/9", false), now);
        let mut order = Vec::new();
        while let Some((key, update)) = ledger.next(&table("t")) {
            ledger.report(&table("t"), &key, &update, Ok(Written::Stored), now);
            order.push(key.name);
        }
        assert_eq!(order, ["c", "a", "b"]);
    }

    #[test]
    fn a_failure_of_the_table_lets_the_others_try_and_keeps_the_row() {
        let (mut ledger, now) = (Ledger::default(), Instant::now());
        ledger.record(table("t"), &key("a"), update(1, "1/9", false), now);
        ledger.record(table("t"), &key("b"), update(1, "1/9", false), now);
        assert!(ledger.report(&table("t"), &key("a"), &update(1, "1/9", false), Err(throttled()), now));
        assert_eq!(
            ledger.view(&key("a")),
            Some(view(
                1,
                false,
                Some("table t: UpdateItem failed: slow down; it is retried")
            ))
        );
        assert_eq!(ledger.next(&table("t")).unwrap().0, key("b"));
        ledger.report(
            &table("t"),
            &key("b"),
            &update(1, "1/9", false),
            Ok(Written::Stored),
            now,
        );
        assert_eq!(ledger.next(&table("t")).unwrap().0, key("a"));
        assert!(ledger.report(
            &table("t"),
            &key("a"),
            &update(1, "1/9", false),
            Ok(Written::Stored),
            now
        ));
        assert_eq!(ledger.view(&key("a")), Some(view(1, false, None)));
    }

    #[test]
    fn a_row_refused_for_its_own_sake_waits_for_another_or_five_minutes() {
        let (mut ledger, now, a) = (Ledger::default(), Instant::now(), key("a"));
        let refused = || TableError::Key {
            table: "t".into(),
            key: "team_id".into(),
            problem: "is empty: the team is not known".into(),
        };
        ledger.record(table("t"), &a, update(1, "1/9", true), now);
        ledger.report(&table("t"), &a, &update(1, "1/9", true), Err(refused()), now);
        let error = Some("table t: key team_id is empty: the team is not known");
        assert_eq!(ledger.view(&a), Some(view(1, false, error)));
        assert_eq!(ledger.next(&table("t")), None);
        assert!(!ledger.record(table("t"), &a, update(1, "1/9", true), now));
        assert!(ledger.record(table("t"), &a, update(1, "2/9", true), now));
        ledger.report(&table("t"), &a, &update(1, "2/9", true), Err(refused()), now);
        assert!(ledger.record(table("t"), &a, update(1, "2/9", true), now + REFUSED));
    }

    #[test]
    fn a_stale_end_is_an_error_and_a_stale_partial_row_is_not() {
        let (mut ledger, now, a) = (Ledger::default(), Instant::now(), key("a"));
        ledger.record(table("t"), &a, update(1, "1/9", false), now);
        let stale = || Ok(Written::Stale { kept: 3 });
        assert!(!ledger.report(&table("t"), &a, &update(1, "1/9", false), stale(), now));
        ledger.record(table("t"), &a, update(1, "9/9", true), now);
        ledger.report(&table("t"), &a, &update(1, "9/9", true), stale(), now);
        let error = "table t already holds attempt 3 of submission 7; the row is left as it is";
        let superseded = RowState {
            superseded_by: Some(3),
            ..view(1, false, Some(error))
        };
        assert_eq!(ledger.view(&a), Some(superseded));
        assert_eq!(ledger.next(&table("t")), None, "it would be refused again");
    }

    #[test]
    fn an_end_is_superseded_until_there_is_another_row() {
        for next in [update(1, "cancelled", true), update(2, "1/9", false)] {
            let (mut ledger, now, a) = (Ledger::default(), Instant::now(), key("a"));
            ledger.record(table("t"), &a, update(1, "9/9", true), now);
            let stale = Ok(Written::Stale { kept: 1 });
            assert!(ledger.report(&table("t"), &a, &update(1, "9/9", true), stale, now));
            let attempt = next.row.attempt;
            let is_end = next.end;
            assert!(ledger.record(table("t"), &a, next.clone(), now));
            assert_eq!(ledger.view(&a), Some(view(attempt, false, None)));
            ledger.report(&table("t"), &a, &next, Ok(Written::Stored), now);
            assert_eq!(ledger.view(&a), Some(view(attempt, is_end, None)));
        }
    }
}
