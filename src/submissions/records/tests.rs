//! Rows that are handed in and written, under a clock that only the test moves.

use tokio::time::Instant;

use super::*;
use crate::ask::state::State;

struct Bench {
    state: State<Record>,
    began: Instant,
    now: Instant,
}

fn row(table: &str, attempt: i64, progress: &str, is_end: bool) -> Record {
    let row = Row {
        attempt,
        progress: progress.into(),
        run_id: "7".into(),
        ..Row::default()
    };
    Record {
        table: serde_json::from_value(serde_json::json!({"name": table})).unwrap(),
        row: Arc::new(row),
        is_end,
    }
}

fn throttled() -> Result<Written, Failure> {
    Err(failure(&TableError::Passing {
        table: "t".into(),
        action: "UpdateItem",
        text: "slow down".into(),
    }))
}

fn refused() -> Result<Written, Failure> {
    Err(failure(&TableError::Key {
        table: "t".into(),
        key: "team_id".into(),
        problem: "is empty: the team is not known".into(),
    }))
}

fn view(end_written: bool, error: Option<&str>) -> RecordView {
    RecordView {
        end_written,
        superseded_by: None,
        error: error.map(str::to_owned),
    }
}

impl Bench {
    fn new() -> Self {
        let now = Instant::now();
        Self {
            state: State::default(),
            began: now,
            now,
        }
    }

    fn record(&mut self, uid: &str, record: Record) {
        let key = ObjectKey {
            namespace: "ns".into(),
            name: uid.into(),
            uid: uid.into(),
        };
        self.state.want(&key, record, LogSpan::default(), self.now);
    }

    fn seen(&self, uid: &str, attempt: i64) -> RecordView {
        seen(&self.state.get(uid, self.now), attempt)
    }

    /// Writes all that is due within so many seconds. Returns whose rows, when, and whether that was news.
    fn writes(&mut self, seconds: u64, result: impl Fn() -> Result<Written, Failure>) -> Vec<(String, u64, bool)> {
        let (until, mut written) = (self.now + Duration::from_secs(seconds), Vec::new());
        while self.now < until {
            while let Some(work) = self.state.next(self.now) {
                let is_news = self.state.done(&work, result(), self.now);
                let second = (self.now - self.began).as_secs();
                written.push((work.asked.about.uid.clone(), second, is_news));
            }
            self.now += Duration::from_millis(500);
        }
        written
    }
}

#[test]
fn an_older_row_replaces_no_newer_one_but_for_another_table() {
    let end = row("t", 1, "9/9", true);
    assert!(row("t", 1, "3/9", false).is_older_than(&end), "the end stays");
    assert!(!row("t", 2, "3/9", false).is_older_than(&end), "but for a resume");
    assert!(!row("u", 1, "3/9", false).is_older_than(&end));
    assert!(!end.is_older_than(&end));
}

#[test]
fn a_table_is_written_at_most_every_two_seconds_and_ends_go_first() {
    let mut bench = Bench::new();
    for (uid, is_end) in [("a", false), ("b", false), ("c", true)] {
        bench.record(uid, row("t", 1, "1/9", is_end));
    }
    bench.record("d", row("u", 1, "1/9", false));
    let mut written = bench.writes(10, || Ok(Written::Stored));
    written.sort_by_key(|(uid, at, _)| (*at, uid.clone()));
    let order: Vec<(&str, u64)> = written.iter().map(|(uid, at, _)| (uid.as_str(), *at)).collect();
    assert_eq!(order, [("c", 0), ("d", 0), ("a", 2), ("b", 4)]);
    bench.record("a", row("t", 1, "1/9", false));
    assert_eq!(bench.writes(60, || Ok(Written::Stored)), [], "it is written already");
}

#[test]
fn rows_that_wait_for_long_are_counted_table_by_table() {
    let mut bench = Bench::new();
    for uid in ["a", "b", "c"] {
        bench.record(uid, row("t", 1, "9/9", true));
    }
    bench.record("d", row("u", 1, "9/9", true));
    let waiting = |bench: &Bench, table| {
        let service = row(table, 1, "", true).service();
        bench.state.waiting(&service, ON_ITS_WAY, bench.now)
    };
    assert_eq!(waiting(&bench, "t"), 0, "they are on their way");
    bench.writes(11, throttled);
    assert_eq!((waiting(&bench, "t"), waiting(&bench, "u")), (3, 1));
    bench.writes(60, || Ok(Written::Stored));
    assert_eq!(waiting(&bench, "t"), 0);
}

#[test]
fn a_sick_table_is_tried_ever_more_slowly_until_it_is_well() {
    let mut bench = Bench::new();
    bench.record("a", row("t", 1, "9/9", true));
    let tries = bench.writes(126, throttled);
    assert!(
        (6..=7).contains(&tries.len()),
        "4+8+16+32+64 s, or half of it: {tries:?}"
    );
    assert!(
        tries.iter().skip(1).all(|(.., is_news)| !is_news),
        "the same is no news"
    );
    let error = Some("table t: UpdateItem failed: slow down; it is retried");
    assert_eq!(bench.seen("a", 1), view(false, error));
    bench.record("a", row("t", 1, "8/9", true));
    assert_eq!(
        bench.seen("a", 1),
        view(false, error),
        "the newer row is not there either"
    );
    bench.writes(300, || Ok(Written::Stored));
    assert_eq!(bench.seen("a", 1), view(true, None));
    assert_eq!(bench.seen("a", 2), view(false, None), "of another attempt");
}

#[test]
fn a_row_refused_for_its_own_sake_waits_for_another_or_five_minutes() {
    let mut bench = Bench::new();
    bench.record("a", row("t", 1, "1/9", true));
    assert_eq!(bench.writes(290, refused).len(), 1);
    let error = Some("table t: key team_id is empty: the team is not known");
    assert_eq!(bench.seen("a", 1), view(false, error));
    bench.record("a", row("t", 1, "2/9", true));
    assert_eq!(bench.writes(2, refused).len(), 1);
    assert_eq!(bench.writes(300, || Ok(Written::Stored)).len(), 1);
}

#[test]
fn a_stale_end_is_an_error_until_there_is_another_row_and_a_stale_partial_row_is_none() {
    for next in [row("t", 1, "cancelled", true), row("t", 2, "1/9", false)] {
        let mut bench = Bench::new();
        let stale = || Ok(Written::Stale { kept: 3 });
        bench.record("a", row("t", 1, "1/9", false));
        bench.writes(2, stale);
        assert_eq!(bench.seen("a", 1), view(false, None));
        bench.record("a", row("t", 1, "9/9", true));
        bench.writes(2, stale);
        let error = "table t already holds attempt 3 of submission 7; the row is left as it is";
        let superseded = RecordView {
            superseded_by: Some(3),
            ..view(false, Some(error))
        };
        assert_eq!(bench.seen("a", 1), superseded);
        assert_eq!(bench.writes(600, stale), [], "it would be refused again");
        let (attempt, is_end) = (next.row.attempt, next.is_end);
        bench.record("a", next);
        assert_eq!(bench.seen("a", attempt), view(false, None));
        bench.writes(2, || Ok(Written::Stored));
        assert_eq!(bench.seen("a", attempt), view(is_end, None));
    }
}

#[test]
fn what_a_table_has_taken_is_not_in_the_one_that_the_leaderboard_has_now() {
    let mut bench = Bench::new();
    bench.record("a", row("t", 1, "9/9", true));
    bench.writes(2, || Ok(Written::Stored));
    bench.record("a", row("u", 1, "9/9", true));
    assert_eq!(bench.seen("a", 1), view(false, None));
    assert_eq!(bench.writes(2, || Ok(Written::Stored)).len(), 1);
    assert_eq!(bench.seen("a", 1), view(true, None));
}
