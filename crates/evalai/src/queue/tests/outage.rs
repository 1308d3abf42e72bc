//! An hour without EvalAI, in each of the ways in which it can be away, on a clock of our own: what was finished meanwhile is
//! published within two minutes of its return, and the budget holds all the time.

use std::collections::BTreeMap;

use super::*;
use crate::budget::WINDOW;

const SUBMISSIONS: i64 = 20;
const OUTAGE: Duration = Duration::from_hours(1);
/// Pause that the server asks for with a 429.
const RETRY_AFTER: Duration = Duration::from_secs(56);
/// One way to the server and back.
const WAY: Duration = Duration::from_millis(200);

/// How EvalAI is away.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Away {
    /// Nobody listens.
    Refused,
    /// The proxy in front of it answers 502.
    Proxy,
    /// Its own page for an exception.
    Broken,
    /// 429, with a Retry-After.
    Throttled,
    /// Connections are accepted and nothing is answered, until the client gives up.
    Hanging,
    /// Reads are answered, writes end in its own page for an exception.
    ReadOnly,
}

struct Outage {
    bench: Bench,
    away: Away,
    begins: Duration,
    ends: Duration,
    statuses: BTreeMap<i64, Status>,
    /// Answers on their way.
    replies: Vec<(Duration, Ticket, Reply)>,
    sent: Vec<Duration>,
    /// Until when the server has asked for silence.
    quiet: Duration,
}

impl Outage {
    fn new(away: Away) -> Self {
        let mut bench = Bench::new();
        let pks: Vec<i64> = (1..=SUBMISSIONS).collect();
        bench.all_running(&pks);
        let begins = bench.at + Duration::from_secs(5);
        Self {
            bench,
            away,
            begins,
            ends: begins + OUTAGE,
            statuses: pks.into_iter().map(|pk| (pk, Status::Running)).collect(),
            replies: Vec::new(),
            sent: Vec::new(),
            quiet: Duration::ZERO,
        }
    }

    /// Plays until everything is published; hands back how long after the outage the last one was.
    fn play(mut self) -> Duration {
        let mut ends: Vec<(Duration, i64)> = (1..=SUBMISSIONS)
            .map(|pk| (self.begins + OUTAGE / 21 * u32::try_from(pk).unwrap(), pk))
            .collect();
        let limit = self.ends + Duration::from_mins(30);
        while self.statuses.values().any(|status| *status != Status::Finished) {
            assert!(self.bench.at < limit, "{:?}: {:?}", self.away, self.statuses);
            let wait = self.send_all();
            let next = [
                wait,
                self.replies.iter().map(|(at, ..)| *at).min(),
                ends.first().map(|(at, _)| *at),
            ];
            let next = next.into_iter().flatten().min().expect("something is to come");
            self.bench.at = self.bench.at.max(next);
            while let Some((_, pk)) = ends.first().copied().filter(|(at, _)| *at <= self.bench.at) {
                ends.remove(0);
                self.bench
                    .update(pk, 1, DesiredUpdate::Final(Outcome::Finished, results(43.0)));
            }
            self.deliver();
        }
        self.bench.at.saturating_sub(self.ends)
    }

    fn send_all(&mut self) -> Option<Duration> {
        loop {
            let now = self.bench.now();
            match next(&mut self.bench.queue, now, true) {
                Next::Read(..) => unreachable!("it was read"),
                Next::Wait(until) => return until,
                Next::Send(ticket) => {
                    assert!(
                        now.at >= self.quiet,
                        "{:?}: a request while it was to be silent",
                        self.away
                    );
                    self.sent.push(now.at);
                    let minute = self.sent.iter().rev().take_while(|sent| **sent + WINDOW > now.at);
                    assert!(minute.count() <= 54, "{:?}: over the budget", self.away);
                    let (after, reply) = self.reply(&ticket);
                    self.replies.push((now.at + after, ticket, reply));
                }
            }
        }
    }

    fn deliver(&mut self) {
        let at = self.bench.at;
        let (due, later) = std::mem::take(&mut self.replies)
            .into_iter()
            .partition(|(when, ..)| *when <= at);
        self.replies = later;
        for (_, ticket, reply) in due {
            if let Answer::Throttled(wait) = reply.answer() {
                self.quiet = self.quiet.max(at + wait);
            }
            self.bench.answer(&ticket, reply);
        }
    }

    fn reply(&mut self, ticket: &Ticket) -> (Duration, Reply) {
        let at = self.bench.at;
        let write = ticket.request.is_write();
        if at < self.begins || at >= self.ends || (self.away == Away::ReadOnly && !write) {
            return (WAY, self.healthy(ticket));
        }
        let silence = |sent| {
            Answer::Unanswered(Silence {
                sent,
                why: "silence".into(),
            })
        };
        let (after, answer) = match self.away {
            Away::Refused => (WAY, silence(false)),
            Away::Proxy => (WAY, silence(true)),
            Away::Broken | Away::ReadOnly => (WAY, Answer::Broken("EvalAI answered 500".into())),
            Away::Throttled => (WAY, Answer::Throttled(RETRY_AFTER)),
            Away::Hanging => (Duration::from_secs(if write { 65 } else { 30 }), silence(true)),
        };
        (after, as_reply(ticket, answer))
    }

    fn healthy(&mut self, ticket: &Ticket) -> Reply {
        match &ticket.request {
            Request::Get(subject) => Reply::Row(Answer::Done(row(subject.pk, self.statuses[&subject.pk]))),
            Request::List { .. } => Reply::Rows(Answer::Done(vec![])),
            Request::Final(subject, outcome, _) => {
                self.statuses.insert(subject.pk, Status::parse(outcome.as_str()));
                Reply::Written(Answer::Done(()))
            }
            other => panic!("{other:?} was not requested"),
        }
    }
}

fn as_reply(ticket: &Ticket, answer: Answer<()>) -> Reply {
    match ticket.request {
        Request::Get(_) => Reply::Row(answer.and_then(|()| Answer::Throttled(Duration::ZERO))),
        Request::List { .. } => Reply::Rows(answer.and_then(|()| Answer::Throttled(Duration::ZERO))),
        _ => Reply::Written(answer),
    }
}

#[test]
fn results_are_published_two_minutes_after_an_hour_without_evalai() {
    for away in [
        Away::Refused,
        Away::Proxy,
        Away::Broken,
        Away::Throttled,
        Away::Hanging,
        Away::ReadOnly,
    ] {
        let last = Outage::new(away).play();
        println!("{away:?}: {SUBMISSIONS} results, the last one {last:?} after the outage");
        assert!(
            last <= Duration::from_mins(2),
            "{away:?}: the last one came after {last:?}"
        );
    }
}

#[test]
fn a_server_that_does_not_answer_is_shown_after_a_minute_and_until_its_next_answer() {
    let mut bench = Bench::new();
    bench.serve();
    let board = || [Changed::Leaderboard(key(100))].into();
    let away = || {
        Reply::Rows(Answer::Unanswered(Silence {
            sent: false,
            why: "EvalAI could not be reached".into(),
        }))
    };
    let first = bench.expect("sweep of submitted");
    let since = bench.now().wall;
    bench.answer(&first, away());
    assert_eq!(bench.queue.silence(), None, "it may be back in a moment");
    bench.queue.take_changes();
    for _ in 0..90 {
        bench.wait(1.0);
        while let Some((_, ticket)) = bench.next() {
            bench.answer(&ticket, away());
        }
    }
    let shown = bench.queue.silence();
    assert!(
        shown.is_some_and(|(at, why)| at >= since && why.contains("could not be reached")),
        "{shown:?}"
    );
    assert_eq!(bench.queue.take_changes(), board(), "once");
    bench.wait(60.0);
    let ticket = bench.next().unwrap().1;
    bench.answer(&ticket, Reply::Rows(Answer::Refused(refusal(About::Request, 400))));
    assert_eq!(bench.queue.silence(), None);
    assert!(bench.queue.take_changes().contains(&Changed::Leaderboard(key(100))));
}
