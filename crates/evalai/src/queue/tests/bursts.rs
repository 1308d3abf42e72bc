//! A thousand submissions that end at once: what is published when, what else goes on meanwhile, and what is left of it.

use super::*;

/// As many as end on the evening of a deadline.
const ENDS: i64 = 1000;
/// Submissions with partial results that go on.
const LIVE: std::ops::RangeInclusive<i64> = 2001..=2010;
/// Submissions of which it is asked whether they may run.
const ASKED: std::ops::RangeInclusive<i64> = 3001..=3020;
/// Ids of a list of cancelled submissions.
const OLD: std::ops::RangeInclusive<i64> = 5001..=7000;
/// Seconds that a list of 2,000 rows takes the real server.
const SLOW_LIST: f64 = 23.0;

/// When a request was sent, and which.
type Sent = Vec<(Duration, String)>;

/// A server that takes its time for lists alone.
struct Server {
    bench: Bench,
    lists: Vec<(Duration, Ticket)>,
    list_seconds: f64,
    sent: Sent,
}

impl Server {
    fn new(list_seconds: f64) -> Self {
        Self {
            bench: Bench::new(),
            lists: Vec::new(),
            list_seconds,
            sent: Vec::new(),
        }
    }

    /// Lets time go on until something holds; none after `limit`.
    fn until(&mut self, limit: Duration, mut holds: impl FnMut(&Queue) -> bool) -> Option<Duration> {
        let begun = self.bench.at;
        while self.bench.at < begun + limit {
            self.answer_lists();
            let next = loop {
                if holds(&self.bench.queue) {
                    return Some(self.bench.at.saturating_sub(begun));
                }
                match self.bench.next_or_wait() {
                    Ok((name, ticket)) => {
                        self.sent.push((self.bench.at.saturating_sub(begun), name));
                        self.answer(ticket);
                    }
                    Err(until) => break until,
                }
            };
            let lists = self.lists.iter().map(|(due, _)| *due);
            let next = lists.chain(next).min();
            self.bench.at = next.unwrap_or(begun + limit).max(self.bench.at);
        }
        None
    }

    fn answer(&mut self, ticket: Ticket) {
        match &ticket.request {
            Request::List { .. } => {
                let due = self.bench.at + Duration::from_secs_f64(self.list_seconds);
                self.lists.push((due, ticket));
            }
            Request::Get(subject) => {
                let row = row(subject.pk, Status::Running);
                self.bench.answer(&ticket, Reply::Row(Answer::Done(row)));
            }
            _ => self.bench.answer(&ticket, Reply::Written(Answer::Done(()))),
        }
    }

    fn answer_lists(&mut self) {
        let (due, later): (Vec<_>, Vec<_>) = std::mem::take(&mut self.lists)
            .into_iter()
            .partition(|(due, _)| *due <= self.bench.at);
        self.lists = later;
        for (_, ticket) in due {
            let (ids, status) = match &ticket.request {
                Request::List {
                    purpose: Purpose::SweepSubmitted,
                    ..
                } => (ASKED, Status::Submitted),
                _ => (OLD, Status::Cancelled),
            };
            let rows = ids.map(|pk| row(pk, status)).collect();
            self.bench.answer(&ticket, Reply::Rows(Answer::Done(rows)));
        }
    }

    /// Live submissions, of which each has newer partial results.
    fn partials(&mut self) {
        for pk in LIVE {
            self.bench.live(pk, 1);
            self.bench.update(pk, 1, DesiredUpdate::Running);
            self.bench.update(pk, 1, DesiredUpdate::Partial(results(1.0)));
        }
    }

    /// All end at the same moment, but for what their objects show: the higher the id, the earlier.
    fn ends(&mut self) {
        for pk in 1..=ENDS {
            let mut subject = of(pk, 1);
            subject.run.ended = Some(wall(-pk));
            let now = self.bench.now();
            let end = DesiredUpdate::Final(Outcome::Finished, results(1.0));
            self.bench.queue.update(&subject, end, now);
        }
    }

    fn usage(&mut self) -> Usage {
        let now = self.bench.now();
        self.bench.queue.usage(now)
    }

    /// When each request whose name begins so was sent.
    fn times(&self, prefix: &str) -> Vec<Duration> {
        let of = self.sent.iter().filter(|(_, name)| name.starts_with(prefix));
        of.map(|(at, _)| *at).collect()
    }

    fn ids(&self, prefix: &str) -> Vec<i64> {
        let of = self.sent.iter().filter_map(|(_, name)| name.strip_prefix(prefix));
        of.map(|id| id.trim().parse().unwrap()).collect()
    }
}

fn left(queue: &Queue) -> usize {
    queue.subs.values().filter(|sub| sub.has_end_to_publish()).count()
}

fn all_published(queue: &Queue) -> bool {
    left(queue) == 0
}

#[test]
fn a_thousand_ends_are_published_the_oldest_first_and_before_partial_results() {
    let mut server = Server::new(0.0);
    server.partials();
    server.ends();
    let took = server.until(Duration::from_hours(2), all_published).unwrap();
    // Two requests each at 54 a minute, less six lists of cancelled submissions.
    let minutes = took.as_secs_f64() / 60.0;
    assert!((40.0..44.0).contains(&minutes), "the last one after {minutes:.1} min");
    println!("{ENDS} ends at once are published after {minutes:.1} min");
    let oldest_first: Vec<i64> = (1..=ENDS).rev().collect();
    assert_eq!(server.ids("finished "), oldest_first);
    let partial = server.times("partial ");
    assert!(partial.is_empty(), "partial results before the last end: {partial:?}");
}

#[test]
fn the_last_end_is_expected_when_it_comes() {
    for (live, ends_left) in [(false, ENDS), (true, ENDS), (true, ENDS / 4)] {
        let mut server = Server::new(0.0);
        if live {
            server.partials();
        }
        server.ends();
        let ends_left = usize::try_from(ends_left).unwrap();
        server
            .until(Duration::from_hours(2), |queue| left(queue) <= ends_left)
            .unwrap();
        let usage = server.usage();
        assert_eq!(usage.waiting, ends_left);
        let expected = usage.last_expected.unwrap().duration_since(server.bench.now().wall);
        let took = server.until(Duration::from_hours(2), all_published).unwrap();
        let difference = expected.as_secs_f64() - took.as_secs_f64();
        assert!(
            difference.abs() < 60.0 + took.as_secs_f64() / 10.0,
            "{ends_left} ends, live {live}: expected after {expected:?}, took {took:?}"
        );
        assert_eq!((server.usage().waiting, server.usage().last_expected), (0, None));
    }
}

#[test]
fn lists_of_2000_rows_that_take_23_seconds_hold_no_end_up() {
    let mut slow = Server::new(SLOW_LIST);
    slow.bench.serve();
    slow.partials();
    for pk in ASKED {
        slow.bench.ask(pk, 1);
    }
    slow.ends();
    let took = slow.until(Duration::from_hours(2), all_published).unwrap();
    assert!(took < Duration::from_mins(44), "{took:?}");
    let ends = slow.times("finished ");
    let gap = ends
        .windows(2)
        .map(|pair| pair[1].saturating_sub(pair[0]))
        .max()
        .unwrap();
    // After a burst the budget itself allows nothing for ten seconds of a minute.
    assert!(gap < Duration::from_secs(16), "{gap:?} without an end");
    let lists = slow.times("list of cancelled");
    assert!(lists.len() > 60, "{} lists of cancelled submissions", lists.len());
}

#[test]
fn a_question_whether_a_submission_may_run_waits_a_minute_for_ends_and_no_longer() {
    for asked in [1, 20] {
        let mut server = Server::new(0.0);
        server.ends();
        for pk in 3001..3001 + asked {
            server.bench.ask(pk, 1);
        }
        let answered = |queue: &Queue| {
            let listed = |pk| {
                queue
                    .view(&key(pk))
                    .is_some_and(|view| view.answered == Some(Attempt(1)))
            };
            (3001..3001 + asked).any(listed)
        };
        let took = server.until(Duration::from_mins(5), answered);
        let took = took.unwrap_or_else(|| panic!("{asked} asked: no answer in five minutes"));
        assert!(took < Duration::from_secs(75), "{asked} asked: {took:?}");
    }
}

#[test]
fn nothing_is_remembered_of_a_thousand_that_are_published_and_forgotten() {
    let mut server = Server::new(0.0);
    server.ends();
    // The object of one goes while its end is on the way.
    let (name, ticket) = loop {
        server.bench.wait(1.0);
        if let Some(sent) = server.bench.next() {
            break sent;
        }
    };
    assert_eq!(name, format!("submission {}", ticket.request.submission().unwrap().pk));
    let early = ticket.request.submission().unwrap().pk;
    server.bench.forget(early);
    server
        .bench
        .answer(&ticket, Reply::Row(Answer::Done(row(early, Status::Running))));
    server.until(Duration::from_hours(2), all_published).unwrap();
    for pk in (1..=ENDS).filter(|pk| *pk != early) {
        server.bench.forget(pk);
    }
    let queue = &mut server.bench.queue;
    queue.take_changes();
    let left = (
        queue.subs.len(),
        queue.pks.len(),
        queue.lanes.len(),
        queue.challenges.len(),
    );
    assert_eq!((left, queue.changes.len(), queue.sweep.len()), ((0, 0, 0, 0), 0, 0));
}

/// All that follows the start is over by then.
const SETTLED: Duration = Duration::from_mins(5);

/// Requests of each kind in ten minutes at rest, with so many running submissions and a Leaderboard that serves them.
fn at_rest(live: i64) -> BTreeMap<String, usize> {
    let mut bench = Bench::new();
    bench.serve();
    for pk in 1..=live {
        bench.live(pk, 1);
    }
    let mut sent = BTreeMap::new();
    let begun = bench.at + SETTLED;
    let end = begun + Duration::from_mins(10);
    while bench.at < end {
        let until = loop {
            let (name, ticket) = match bench.next_or_wait() {
                Ok(sent) => sent,
                Err(until) => break until,
            };
            let reply = match &ticket.request {
                Request::Get(subject) => Reply::Row(Answer::Done(row(subject.pk, Status::Running))),
                Request::Phases(_) => Reply::Phases(Answer::Done(vec![])),
                Request::Splits(_) => Reply::Splits(Answer::Done(vec![])),
                _ => Reply::Rows(Answer::Done(vec![])),
            };
            if bench.at >= begun {
                let kind = name.trim_end_matches(|c: char| c.is_ascii_digit() || c == ' ');
                *sent.entry(kind.to_owned()).or_insert(0) += 1;
            }
            bench.answer(&ticket, reply);
        };
        bench.at = until.unwrap_or(end).max(bench.at);
    }
    sent
}

#[test]
fn requests_at_rest_are_half_of_the_budget_at_most_for_what_runs() {
    for (live, cancelled, alone) in [(1, 60, 15), (5, 60, 75), (18, 60, 265), (100, 60, 265), (200, 60, 240)] {
        let sent = at_rest(live);
        let of = |kind: &str| sent.get(kind).copied().unwrap_or_default();
        let sweeps = of("sweep of submitted") + of("sweep of resuming");
        let all: usize = sent.values().sum();
        println!("{live} running: {all} requests in ten minutes: {sent:?}");
        for (kind, found, expected) in [
            ("list of cancelled", of("list of cancelled"), cancelled),
            ("submission", of("submission"), alone),
            ("sweeps", sweeps, 20),
            ("all", all, cancelled + alone + 20),
        ] {
            assert!(
                found.abs_diff(expected) <= 2 + expected / 8,
                "{live} running: {found} of {kind}: {sent:?}"
            );
        }
    }
}
