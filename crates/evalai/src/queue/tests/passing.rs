//! Requests about the challenge's queue in EvalAI, which others wait for: within their share, behind what is urgent.

use serde_json::Value;
use tokio::sync::oneshot::Receiver;

use super::*;
use crate::row::Received;
use crate::types::InboxTrouble;

const QUEUE: &str = "carla-1";

fn received() -> Reply {
    Reply::Message(Answer::Done(Received {
        body: Value::Null,
        receipt_handle: None,
    }))
}

impl Bench {
    /// A Leaderboard with a queue is served, and all but the queue is asked and quiet for an hour.
    fn reading() -> Self {
        let mut bench = Self::new();
        let now = bench.now();
        let target = Target {
            sweep: Duration::from_hours(1),
            inbox: Some(QUEUE.into()),
            ..target()
        };
        bench.queue.serve(&key(100), &target, now);
        for _ in 0..2 {
            let (_, ticket) = bench.next().unwrap();
            bench.answer(&ticket, Reply::Rows(Answer::Done(vec![])));
        }
        let ticket = bench.expect("phases");
        bench.answer(&ticket, Reply::Phases(Answer::Done(vec![])));
        let ticket = bench.expect("splits");
        bench.answer(&ticket, Reply::Splits(Answer::Done(vec![])));
        bench
    }

    fn pass(&mut self) -> Receiver<Reply> {
        let now = self.now();
        self.queue.pass(Request::Receive(QUEUE.into()), now)
    }

    fn trouble(&mut self) -> Option<InboxTrouble> {
        let now = self.now();
        self.queue.inbox_trouble(&key(100), now)
    }
}

#[test]
fn each_answer_is_handed_to_what_made_its_request() {
    let mut bench = Bench::reading();
    let (mut first, mut second) = (bench.pass(), bench.pass());
    let ticket = bench.expect("message");
    bench.answer(&ticket, received());
    bench.wait(4.0);
    let ticket = bench.expect("message");
    bench.answer(&ticket, Reply::Message(Answer::Broken("EvalAI answered 500".into())));
    let (first, second) = (first.try_recv().unwrap(), second.try_recv().unwrap());
    assert_eq!(first.answer(), Answer::Done(()));
    assert!(matches!(second.answer(), Answer::Broken(_)), "{second:?}");
    bench.wait(60.0);
    bench.expect_nothing();
}

#[test]
fn throttling_and_a_refused_token_cost_no_request() {
    for answer in [
        Answer::Throttled(Duration::from_secs(30)),
        Answer::Refused(refusal(About::Token, 401)),
    ] {
        let mut bench = Bench::reading();
        let mut waits = bench.pass();
        let ticket = bench.expect("message");
        bench.answer(&ticket, Reply::Message(answer.clone()));
        bench.wait(29.0);
        bench.expect_nothing();
        bench.wait(32.0);
        let ticket = bench.expect("message");
        bench.answer(&ticket, received());
        let found = waits.try_recv().map(|reply| reply.answer());
        assert_eq!((found, bench.trouble()), (Ok(Answer::Done(())), None), "{answer:?}");
    }
}

#[test]
fn only_a_leader_reads() {
    let mut bench = Bench::reading();
    bench.pass();
    let now = bench.now();
    assert!(matches!(next(&mut bench.queue, now, false), Next::Wait(_)));
    bench.expect("message");
}

#[test]
fn a_refusal_is_shown_at_once_and_a_failure_after_five_minutes() {
    let mut bench = Bench::reading();
    bench.pass();
    let ticket = bench.expect("message");
    bench.answer(&ticket, Reply::Message(Answer::Refused(refusal(About::Request, 400))));
    let shown = bench.trouble().unwrap();
    assert_eq!((shown.is_refused, shown.why.as_str()), (true, "EvalAI answered 400"));
    assert!(bench.queue.take_changes().contains(&Changed::Leaderboard(key(100))));
    bench.wait(5.0);
    bench.pass();
    let ticket = bench.expect("message");
    bench.answer(&ticket, received());
    assert_eq!(bench.trouble(), None);
    assert!(bench.queue.take_changes().contains(&Changed::Leaderboard(key(100))));
    for minute in 0..7 {
        bench.pass();
        let ticket = bench.expect("message");
        bench.answer(&ticket, Reply::Message(Answer::Broken("EvalAI answered 500".into())));
        assert_eq!(bench.trouble().is_some(), minute >= 5, "minute {minute}");
        bench.wait(60.1);
    }
}

/// All that is sent in these minutes while a request of another follows each answer, as names.
fn busy_minutes(bench: &mut Bench, minutes: u64) -> Vec<(Duration, String)> {
    let (end, mut sent) = (bench.at + Duration::from_mins(minutes), Vec::new());
    let mut waits = bench.pass();
    while bench.at < end {
        match bench.next_or_wait() {
            Ok((name, ticket)) => {
                let reply = match &ticket.request {
                    Request::Receive(_) => received(),
                    Request::Get(subject) => Reply::Row(Answer::Done(row(subject.pk, Status::Running))),
                    Request::List { .. } => Reply::Rows(Answer::Done(vec![])),
                    _ => Reply::Written(Answer::Done(())),
                };
                bench.answer(&ticket, reply);
                if waits.try_recv().is_ok() {
                    waits = bench.pass();
                }
                sent.push((ticket.requested, name));
            }
            Err(until) => bench.at = until.unwrap_or(end).min(end),
        }
    }
    sent
}

#[test]
fn requests_of_others_are_a_third_at_most_and_ends_come_first() {
    let mut bench = Bench::reading();
    let sent = busy_minutes(&mut bench, 5);
    let times: Vec<Duration> = sent
        .iter()
        .filter(|(_, name)| *name == "message")
        .map(|(at, _)| *at)
        .collect();
    for (index, at) in times.iter().enumerate() {
        let within = times[..=index]
            .iter()
            .filter(|other| **other + Duration::from_mins(1) > *at)
            .count();
        assert!(within <= 18, "{within} requests of the queue within a minute");
    }
    assert!(
        times.len() >= 85,
        "{} requests of the queue in five minutes",
        times.len()
    );
    // Forty ends, two requests each, are there as soon as without a queue.
    let ends_take = |mut bench: Bench| {
        for pk in 1..=40 {
            bench.update(pk, 1, DesiredUpdate::Final(Outcome::Failed, results(1.0)));
        }
        let begun = bench.at;
        let sent = busy_minutes(&mut bench, 4);
        let last = sent
            .iter()
            .filter(|(_, name)| name.starts_with("failed"))
            .map(|(at, _)| *at)
            .max();
        assert_eq!(sent.iter().filter(|(_, name)| name.starts_with("failed")).count(), 40);
        last.unwrap().saturating_sub(begun)
    };
    let mut without = Bench::new();
    without.wait(120.0);
    let mut with = Bench::reading();
    with.wait(120.0);
    let (with, without) = (ends_take(with), ends_take(without));
    assert!(
        with <= without + Duration::from_secs(3),
        "{with:?}, without a queue {without:?}"
    );
}
