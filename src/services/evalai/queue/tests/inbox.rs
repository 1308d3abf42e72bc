//! The challenge's queue in EvalAI: one message at a time, within its share, behind what is urgent.

use serde_json::{Value, json};

use super::*;
use crate::services::evalai::row::Received;
use crate::services::evalai::types::{Arrival, InboxTrouble, Origin, Settled};

const QUEUE: &str = "carla-1";

fn with_inbox() -> Target {
    Target {
        inbox: Some(QUEUE.into()),
        ..target()
    }
}

fn message(pk: i64) -> Value {
    json!({"challenge_pk": "1", "phase_pk": "1", "submission_pk": pk})
}

fn received(body: Value) -> Reply {
    let receipt_handle = (!body.is_null()).then(|| "handle".to_owned());
    Reply::Message(Answer::Done(Received { body, receipt_handle }))
}

fn refused(about: About) -> Refusal {
    refusal(about, 400)
}

impl Bench {
    /// A Leaderboard with a queue is served, and all but the queue is asked and quiet for an hour.
    fn reading() -> Self {
        let mut bench = Self::new();
        let now = bench.now();
        let target = Target {
            sweep: Duration::from_hours(1),
            ..with_inbox()
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

    /// The next request has to receive, and gets this.
    fn receive(&mut self, body: Value) {
        let ticket = self.expect("message");
        self.answer(&ticket, received(body));
    }

    /// The next request has to read the row of a message, and gets this.
    fn read_message(&mut self, answer: Answer<Row>) {
        let ticket = self.expect("row of a message");
        self.answer(&ticket, Reply::Row(answer));
    }

    fn arrival(&mut self) -> (u64, Arrival) {
        let mut all = self.queue.take_arrivals();
        assert_eq!(all.len(), 1, "{all:?}");
        all.remove(0)
    }

    fn settle(&mut self, serial: u64, settled: Settled) {
        let now = self.now();
        self.queue.settle_message(QUEUE, serial, settled, now);
    }

    fn delete(&mut self, reply: Reply) {
        let ticket = self.expect("deletion of a message");
        assert!(
            matches!(&ticket.request, Request::DeleteMessage(queue, receipt) if queue == QUEUE && receipt == "handle")
        );
        self.answer(&ticket, reply);
    }

    fn trouble(&mut self) -> Option<InboxTrouble> {
        let now = self.now();
        self.queue.inbox_trouble(&key(100), now)
    }

    /// How long nothing is sent, in seconds.
    fn quiet(&mut self) -> u64 {
        let begun = self.at;
        loop {
            match self.next_or_wait() {
                Ok((name, ticket)) => {
                    assert_eq!(name, "message");
                    self.answer(&ticket, received(Value::Null));
                    return ticket.requested.saturating_sub(begun).as_secs();
                }
                Err(until) => self.at = until.unwrap(),
            }
        }
    }
}

#[test]
fn a_message_is_deleted_only_when_the_controller_has_taken_it_in() {
    let mut bench = Bench::reading();
    bench.receive(message(7));
    bench.read_message(Answer::Done(row(7, Status::Submitted)));
    let (serial, arrival) = bench.arrival();
    assert_eq!(
        (arrival.server.as_str(), arrival.queue.as_str()),
        ("http://evalai", QUEUE)
    );
    assert_eq!(arrival.origin, Origin::Wanted(wall(-60)));
    assert_eq!(serde_json::from_str::<Value>(&arrival.body).unwrap(), message(7));
    bench.expect_nothing();
    bench.settle(serial, Settled::Delete);
    bench.delete(Reply::Written(Answer::Done(())));
    // There may be more.
    bench.wait(4.0);
    bench.receive(Value::Null);
}

#[test]
fn a_message_that_is_left_comes_back_and_others_come_first() {
    let mut bench = Bench::reading();
    bench.receive(message(7));
    bench.read_message(Answer::Done(row(7, Status::Submitted)));
    let (serial, _) = bench.arrival();
    bench.settle(serial, Settled::Leave);
    bench.wait(4.9);
    bench.expect_nothing();
    bench.wait(0.2);
    bench.receive(message(8));
    // An answer about the old one is of no account.
    bench.settle(serial, Settled::Delete);
    bench.wait(4.0);
    bench.read_message(Answer::Done(row(8, Status::Submitted)));
}

#[test]
fn what_evalai_shows_of_a_message_goes_with_it() {
    let resumed = Row {
        resumed_at: Some(wall(-5)),
        ..row(7, Status::Resuming)
    };
    let of_another = Refusal {
        message: "EvalAI answered 401: Sorry, you are not authorized to access this submission.".into(),
        ..refusal(About::Request, 401)
    };
    for (answer, origin) in [
        (Answer::Done(resumed), Origin::Wanted(wall(-5))),
        (Answer::Done(Row::missing(7)), Origin::Hidden),
        (Answer::Refused(refused(About::Missing)), Origin::Missing),
        (Answer::Refused(refused(About::Request)), Origin::Hidden),
        // A page of a proxy shows nothing of the submission.
        (Answer::Refused(refusal(About::Request, 401)), Origin::Hidden),
        (Answer::Refused(of_another), Origin::Foreign),
    ] {
        let mut bench = Bench::reading();
        bench.receive(message(7));
        bench.read_message(answer.clone());
        if origin == Origin::Missing {
            // One such answer is none; the message comes back.
            assert!(bench.queue.take_arrivals().is_empty());
            bench.wait(30.0);
            bench.receive(message(7));
            bench.read_message(answer);
        }
        assert_eq!(bench.arrival().1.origin, origin);
    }
    // No row can be asked for.
    for body in [
        json!("text"),
        json!([1]),
        json!({"submission_pk": -1}),
        json!({"submission_pk": "x"}),
    ] {
        let mut bench = Bench::reading();
        bench.receive(body.clone());
        let (_, arrival) = bench.arrival();
        assert_eq!((arrival.body, arrival.origin), (body.to_string(), Origin::Hidden));
    }
}

#[test]
fn an_empty_queue_is_asked_ever_more_slowly() {
    let mut bench = Bench::reading();
    bench.receive(Value::Null);
    let waits: Vec<u64> = (0..4).map(|_| bench.quiet()).collect();
    assert_eq!(waits, [5, 10, 20, 20]);
    // A message makes it quick again.
    bench.wait(20.0);
    bench.receive(message(7));
    bench.read_message(Answer::Done(row(7, Status::Submitted)));
    let (serial, _) = bench.arrival();
    bench.settle(serial, Settled::Delete);
    bench.delete(Reply::Written(Answer::Done(())));
    bench.wait(4.0);
    bench.receive(Value::Null);
    assert_eq!(bench.quiet(), 5);
}

#[test]
fn a_refusal_is_shown_at_once_and_a_failure_after_five_minutes() {
    let mut bench = Bench::reading();
    let ticket = bench.expect("message");
    bench.answer(&ticket, Reply::Message(Answer::Refused(refused(About::Request))));
    let shown = bench.trouble().unwrap();
    assert_eq!((shown.is_refused, shown.why.as_str()), (true, "EvalAI answered 400"));
    assert!(bench.queue.take_changes().contains(&Changed::Leaderboard(key(100))));
    bench.wait(5.0);
    bench.receive(Value::Null);
    assert_eq!(bench.trouble(), None);
    assert!(bench.queue.take_changes().contains(&Changed::Leaderboard(key(100))));
    let begun = bench.at;
    while bench.at.saturating_sub(begun) < Duration::from_mins(6) {
        match bench.next_or_wait() {
            Ok((_, ticket)) => bench.answer(&ticket, Reply::Message(Answer::Broken("EvalAI answered 500".into()))),
            Err(until) => bench.at = until.unwrap(),
        }
        let is_long = bench.at.saturating_sub(begun) > Duration::from_secs(330);
        assert!(bench.trouble().is_none() || bench.at.saturating_sub(begun) > Duration::from_secs(290));
        assert!(bench.trouble().is_some() || !is_long);
    }
}

#[test]
fn what_goes_wrong_brings_the_message_back() {
    let broken = || Answer::Broken("EvalAI answered 500".into());
    // The row cannot be read.
    let mut bench = Bench::reading();
    bench.receive(message(7));
    bench.read_message(broken());
    bench.wait(5.0);
    bench.receive(message(7));
    bench.read_message(Answer::Done(row(7, Status::Submitted)));
    // It cannot be deleted: its receipt has lapsed.
    let (serial, _) = bench.arrival();
    bench.settle(serial, Settled::Delete);
    bench.wait(4.0);
    bench.delete(Reply::Written(Answer::Broken("EvalAI answered 500".into())));
    bench.wait(5.0);
    bench.receive(message(7));
    bench.wait(4.0);
    bench.read_message(Answer::Done(row(7, Status::Submitted)));
    // Nobody takes it in.
    let (serial, _) = bench.arrival();
    bench.wait(60.0);
    bench.expect_nothing();
    bench.wait(5.0);
    bench.receive(message(7));
    bench.settle(serial, Settled::Delete);
    bench.read_message(Answer::Done(row(7, Status::Submitted)));
}

fn throttled<T>() -> Answer<T> {
    Answer::Throttled(Duration::from_secs(30))
}

#[test]
fn throttling_costs_no_message() {
    let mut bench = Bench::reading();
    bench.receive(message(7));
    let ticket = bench.expect("row of a message");
    bench.answer(&ticket, Reply::Row(throttled()));
    bench.wait(29.0);
    bench.expect_nothing();
    bench.wait(1.5);
    bench.read_message(Answer::Done(row(7, Status::Submitted)));
    let (serial, _) = bench.arrival();
    bench.settle(serial, Settled::Delete);
    bench.delete(Reply::Written(throttled()));
    bench.wait(31.0);
    bench.delete(Reply::Written(Answer::Done(())));
    assert_eq!(bench.trouble(), None);
}

#[test]
fn only_a_leader_reads_and_only_what_a_leaderboard_names() {
    let mut bench = Bench::reading();
    let now = bench.now();
    assert!(matches!(bench.queue.next(now, false), Next::Wait(_)));
    bench.receive(message(7));
    let now = bench.now();
    bench.queue.retire(&key(100), now);
    bench.wait(60.0);
    bench.expect_nothing();
}

/// All that is sent in these minutes while each receive brings a message, as names.
fn busy_minutes(bench: &mut Bench, minutes: u64) -> Vec<(Duration, String)> {
    let (end, mut pk, mut sent) = (bench.at + Duration::from_mins(minutes), 1000, Vec::new());
    while bench.at < end {
        match bench.next_or_wait() {
            Ok((name, ticket)) => {
                let reply = match &ticket.request {
                    Request::Receive(_) => {
                        pk += 1;
                        received(message(pk))
                    }
                    Request::MessageRow(_, pk) => Reply::Row(Answer::Done(row(*pk, Status::Submitted))),
                    Request::Get(subject) => Reply::Row(Answer::Done(row(subject.pk, Status::Running))),
                    Request::List { .. } => Reply::Rows(Answer::Done(vec![])),
                    _ => Reply::Written(Answer::Done(())),
                };
                bench.answer(&ticket, reply);
                for (serial, _) in bench.queue.take_arrivals() {
                    bench.settle(serial, Settled::Delete);
                }
                sent.push((ticket.requested, name));
            }
            Err(until) => bench.at = until.unwrap_or(end).min(end),
        }
    }
    sent
}

fn of_queue(name: &str) -> bool {
    ["message", "row of a message", "deletion of a message"].contains(&name)
}

#[test]
fn a_full_queue_takes_a_third_of_the_requests_and_ends_come_first() {
    let mut bench = Bench::reading();
    let sent = busy_minutes(&mut bench, 5);
    let times: Vec<Duration> = sent
        .iter()
        .filter(|(_, name)| of_queue(name))
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
