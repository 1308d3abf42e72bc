//! Order of requests, how many go at once, and requests for a whole challenge.

use serde_json::Value;

use super::*;
use crate::labels::Misfit;
use crate::row::Challenge;

#[test]
fn the_first_in_the_order_goes_first() {
    let mut bench = Bench::new();
    bench.all_running(&[1, 2, 3]);
    bench.serve();
    bench.list("sweep of submitted", vec![]);
    bench.list("sweep of resuming", vec![]);
    bench.update(1, 1, DesiredUpdate::Partial(results(1.0)));
    bench.update(10, 1, DesiredUpdate::Queued);
    bench.ask(11, 1);
    bench.update(2, 1, DesiredUpdate::Final(Outcome::Cancelled, results(1.0)));
    bench.update(3, 1, DesiredUpdate::Final(Outcome::Failed, results(1.0)));
    bench.wait(10.0);
    let (mut sent, mut tickets) = (Vec::new(), Vec::new());
    while let Some((name, ticket)) = bench.next() {
        match &ticket.request {
            Request::List { .. } => bench.answer(&ticket, Reply::Rows(Answer::Done(vec![]))),
            Request::Phases(_) => bench.answer(&ticket, Reply::Phases(Answer::Refused(refusal(About::Request, 401)))),
            _ => tickets.push(ticket),
        }
        sent.push(name);
    }
    // Two writes, and one that another read may lead to, have to be left in the budget.
    let expected = [
        "list of cancelled",
        "submission 2",
        "submission 3",
        "phases",
        "submission 11",
    ];
    assert_eq!(sent, expected, "{sent:?}");
    for (ticket, write) in tickets.iter().zip(["cancelled 2", "failed 3"]) {
        let pk = ticket.request.submission().unwrap().pk;
        bench.answer(ticket, Reply::Row(Answer::Done(row(pk, Status::Running))));
        bench.write(write);
    }
    for rest in ["submission 10", "submission 1"] {
        bench.wait(2.5);
        bench.expect(rest);
    }
}

#[test]
fn what_has_failed_twice_goes_behind_all_others() {
    let mut bench = Bench::new();
    bench.running(7);
    bench.queue.timing.refresh = Duration::from_hours(1);
    bench.update(7, 1, DesiredUpdate::Final(Outcome::Finished, results(43.0)));
    for _ in 0..2 {
        bench.get(7, row(7, Status::Running));
        let put = bench.expect("finished 7");
        bench.answer(&put, Reply::Written(Answer::Broken("EvalAI answered 500".into())));
        bench.wait(61.0);
        bench.list("list of cancelled", vec![]);
    }
    bench.live(8, 1);
    bench.update(8, 1, DesiredUpdate::Partial(results(41.0)));
    bench.read_and_write(8, "partial");
    bench.read_and_write(7, "finished");
}

#[test]
fn one_request_a_submission_and_four_in_all() {
    let mut bench = Bench::new();
    for pk in 1..=5 {
        bench.ask(pk, 1);
        bench.update(pk, 1, DesiredUpdate::Queued);
    }
    let tickets: Vec<_> = std::iter::from_fn(|| bench.next()).collect();
    assert_eq!(tickets.len(), 4, "{tickets:?}");
    bench.answer(&tickets[0].1, Reply::Row(Answer::Done(row(1, Status::Submitted))));
    let names: Vec<_> = std::iter::from_fn(|| bench.next()).map(|(name, _)| name).collect();
    assert_eq!(names.len(), 1);
    // An object applied anew under another uid is the same submission.
    let mut bench = Bench::new();
    bench.ask(7, 1);
    bench.expect("submission 7");
    bench.forget(7);
    let again = Key {
        uid: "another".into(),
        ..key(7)
    };
    let now = bench.now();
    bench.queue.ask(&subject(&again, 7, &run(7, 1)), false, now);
    bench.expect_nothing();
}

#[test]
fn lists_that_are_wanted_more_often_than_the_budget_allows_leave_enough_for_the_rest() {
    for (period, requests_per_minute) in [(2, 27), (1, 54), (10, 6)] {
        let mut bench = Bench::new();
        let often = Target {
            period: Duration::from_secs(period),
            requests_per_minute,
            ..target()
        };
        let now = bench.now();
        bench.queue.serve(&key(100), &often, now);
        bench.live(7, 1);
        bench.update(7, 1, DesiredUpdate::Final(Outcome::Finished, results(43.0)));
        bench.ask(8, 1);
        bench.live(9, 1);
        let mut sent = Vec::new();
        for _ in 0..300 {
            bench.wait(1.0);
            while let Some((name, ticket)) = bench.next() {
                let reply = match &ticket.request {
                    Request::List { .. } => Reply::Rows(Answer::Done(vec![])),
                    Request::Get(subject) => Reply::Row(Answer::Done(row(subject.pk, Status::Submitted))),
                    Request::Phases(_) => Reply::Phases(Answer::Done(vec![])),
                    Request::Splits(_) => Reply::Splits(Answer::Done(vec![])),
                    _ => Reply::Written(Answer::Done(())),
                };
                bench.answer(&ticket, reply);
                sent.push(name);
            }
        }
        for wanted in [
            "finished 7",
            "submission 8",
            "sweep of submitted",
            "sweep of resuming",
            "list of cancelled",
        ] {
            assert!(
                sent.iter().any(|name| name == wanted),
                "{requests_per_minute} requests a minute, a list every {period} s: no {wanted} in {sent:?}"
            );
        }
    }
}

#[test]
fn a_leaderboard_is_checked_at_its_start_and_hourly() {
    let mut bench = Bench::new();
    bench.serve();
    bench.list("sweep of submitted", vec![]);
    bench.list("sweep of resuming", vec![]);
    let split = Split {
        id: 3,
        phase: 1,
        dataset_split: 5,
        schema: Schema {
            labels: vec!["Driving score".into()],
            default_order_by: Some("Driving score".into()),
            metadata: Value::Null,
        },
    };
    for round in 0..2 {
        let ticket = bench.expect("phases");
        bench.answer(&ticket, Reply::Phases(Answer::Done(vec![phase(1)])));
        let ticket = bench.expect("splits");
        bench.answer(&ticket, Reply::Splits(Answer::Done(vec![split.clone()])));
        let ticket = bench.expect("dataset split");
        let codename = if round == 0 { "leaderboard" } else { "other" };
        let answer = DatasetSplit {
            codename: codename.into(),
        };
        bench.answer(&ticket, Reply::DatasetSplit(Answer::Done(answer)));
        // The schema leaves the order open.
        let ticket = bench.expect("phase split");
        let answer = if round == 0 {
            Answer::Done(PhaseSplit { is_descending: false })
        } else {
            Answer::Refused(refusal(About::Request, 403))
        };
        bench.answer(&ticket, Reply::PhaseSplit(answer));
        let (labels, error) = bench.queue.labels(&key(100));
        let labels = labels.unwrap();
        assert_eq!((labels.ok(), error), (round == 0, None));
        let order = labels.rankings.get(&1).map(|ranking| ranking.order);
        assert_eq!(order, (round == 0).then_some(Order::Ascending));
        assert_eq!(bench.queue.take_changes(), [Changed::Leaderboard(key(100))].into());
        bench.wait(3600.0);
        bench.list("sweep of submitted", vec![]);
        bench.list("sweep of resuming", vec![]);
    }
    let ticket = bench.expect("phases");
    bench.answer(&ticket, Reply::Phases(Answer::Refused(refusal(About::Request, 401))));
    let (labels, error) = bench.queue.labels(&key(100));
    assert!(
        labels.is_some() && error.is_some(),
        "the old check stands, and why there is no newer one"
    );
    let now = bench.now();
    bench.queue.retire(&key(100), now);
    bench.wait(3600.0);
    bench.expect_nothing();
}

fn phase(id: i64) -> Phase {
    Phase {
        id,
        shows_partial: false,
    }
}

#[test]
fn of_a_challenge_whose_submissions_are_files_it_is_read_who_evaluates_them() {
    let remote = Challenge::default();
    let local = Challenge {
        is_remote: false,
        ..remote
    };
    let of_images = Challenge {
        is_static: true,
        ..remote
    };
    let hidden = Answer::Refused(refusal(About::Request, 406));
    for (answer, expected) in [
        (Some(Answer::Done(local)), Some(Misfit::NotRemote { challenge: 1 })),
        (Some(Answer::Done(remote)), None),
        (
            Some(Answer::Done(of_images)),
            Some(Misfit::StaticCodeUpload { challenge: 1 }),
        ),
        (Some(hidden), None),
        (None, None),
    ] {
        let mut bench = Bench::new();
        let board = Target {
            takes_files: answer.is_some(),
            ..target()
        };
        let now = bench.now();
        bench.queue.serve(&key(100), &board, now);
        bench.list("sweep of submitted", vec![]);
        bench.list("sweep of resuming", vec![]);
        let ticket = bench.expect("phases");
        bench.answer(&ticket, Reply::Phases(Answer::Done(vec![phase(1)])));
        let ticket = bench.expect("splits");
        bench.answer(&ticket, Reply::Splits(Answer::Done(vec![])));
        if let Some(answer) = answer.clone() {
            let ticket = bench.expect("challenge");
            bench.answer(&ticket, Reply::Challenge(answer));
        }
        bench.expect_nothing();
        let mut problems = bench.queue.labels(&key(100)).0.unwrap().problems;
        problems.retain(|problem| matches!(problem, Misfit::NotRemote { .. } | Misfit::StaticCodeUpload { .. }));
        assert_eq!(problems, Vec::from_iter(expected), "{answer:?}");
    }
}

#[test]
fn a_list_that_is_refused_for_the_challenge_has_the_challenge_checked_at_once() {
    let mut bench = Bench::new();
    bench.serve();
    bench.list("sweep of submitted", vec![]);
    bench.list("sweep of resuming", vec![]);
    let ticket = bench.expect("phases");
    bench.answer(&ticket, Reply::Phases(Answer::Done(vec![phase(1)])));
    let ticket = bench.expect("splits");
    bench.answer(&ticket, Reply::Splits(Answer::Done(vec![])));
    bench.wait(60.0);
    let forbidden = || refusal(About::Challenge, 401);
    let ticket = bench.expect("sweep of submitted");
    bench.answer(&ticket, Reply::Rows(Answer::Refused(forbidden())));
    let ticket = bench.expect("sweep of resuming");
    bench.answer(&ticket, Reply::Rows(Answer::Refused(forbidden())));
    bench.queue.take_changes();
    let ticket = bench.expect("phases");
    bench.answer(&ticket, Reply::Phases(Answer::Refused(forbidden())));
    assert!(bench.queue.challenge_refused(&key(100)).is_some());
    assert_eq!(bench.queue.take_changes(), [Changed::Leaderboard(key(100))].into());
    // From now on it is checked each minute anyway.
    bench.expect_nothing();
}

#[test]
fn lists_keep_their_period_however_slow_they_are() {
    let mut bench = Bench::new();
    bench.running(7);
    bench.wait(10.0);
    // Its own reads are another test's.
    bench.queue.timing.refresh = Duration::from_hours(1);
    for _ in 0..5 {
        let ticket = bench.expect("list of cancelled");
        bench.wait(3.0);
        bench.answer(&ticket, Reply::Rows(Answer::Done(vec![])));
        bench.wait(6.9);
        bench.expect_nothing();
        bench.wait(0.1);
    }
    // A server that needs longer than that is never asked twice at the same time, and is given a rest.
    let ticket = bench.expect("list of cancelled");
    bench.wait(25.0);
    bench.expect_nothing();
    bench.answer(&ticket, Reply::Rows(Answer::Done(vec![])));
    bench.wait(2.4);
    bench.expect_nothing();
    bench.wait(0.2);
    bench.expect("list of cancelled");
}

#[test]
fn many_ends_do_not_keep_the_list_of_cancelled_ones_waiting() {
    let mut bench = Bench::new();
    bench.live(500, 1);
    for pk in 1..=200 {
        bench.update(pk, 1, DesiredUpdate::Final(Outcome::Failed, results(1.0)));
    }
    let (mut lists, mut ends) = (Vec::new(), 0);
    for _ in 0..2400 {
        bench.wait(0.1);
        while let Some((name, ticket)) = bench.next() {
            let reply = match &ticket.request {
                Request::List { .. } => {
                    lists.push(bench.at);
                    Reply::Rows(Answer::Done(vec![]))
                }
                Request::Get(subject) => Reply::Row(Answer::Done(row(subject.pk, Status::Running))),
                _ => {
                    assert!(name.starts_with("failed"), "{name}");
                    ends += 1;
                    Reply::Written(Answer::Done(()))
                }
            };
            bench.answer(&ticket, reply);
        }
    }
    let longest = lists
        .windows(2)
        .map(|pair| pair[1].saturating_sub(pair[0]))
        .max()
        .unwrap();
    assert!(longest < Duration::from_secs(16), "{longest:?} without a list");
    assert!(ends > 80, "{ends} ends in four minutes");
}

/// The longest times without a row of one live submission and without a list of cancelled ones, of so many, in twenty minutes.
fn longest_gaps(live: i64) -> (Duration, Duration) {
    let mut bench = Bench::new();
    for pk in 1..=live {
        bench.live(pk, 1);
    }
    let begun = bench.at;
    let mut reads = vec![begun; usize::try_from(live).unwrap() + 1];
    let (mut listed, mut unread, mut unlisted) = (begun, Duration::ZERO, Duration::ZERO);
    while bench.at < begun + Duration::from_mins(20) {
        bench.wait(0.1);
        while let Some((_, ticket)) = bench.next() {
            let reply = if let Request::Get(subject) = &ticket.request {
                let read = &mut reads[usize::try_from(subject.pk).unwrap()];
                unread = unread.max(bench.at.checked_sub(*read).unwrap());
                *read = bench.at;
                Reply::Row(Answer::Done(row(subject.pk, Status::Running)))
            } else {
                unlisted = unlisted.max(bench.at.checked_sub(listed).unwrap());
                listed = bench.at;
                Reply::Rows(Answer::Done(vec![]))
            };
            bench.answer(&ticket, reply);
        }
    }
    (unread, unlisted)
}

#[test]
fn live_submissions_are_read_in_turn_by_half_of_the_requests_at_most() {
    for (live, longest) in [(1, 45), (10, 45), (40, 95), (300, 700)] {
        let (unread, unlisted) = longest_gaps(live);
        assert!(
            unread <= Duration::from_secs(longest),
            "{live}: {unread:?} without a read"
        );
        assert!(
            unlisted < Duration::from_secs(16),
            "{live}: {unlisted:?} without a list"
        );
    }
}

#[test]
fn what_runs_by_one_token_keeps_no_end_of_another_token_of_the_same_user_waiting() {
    let purse = Purse::new(54, Duration::ZERO);
    let queue = || {
        Queue::new(
            Timing::default(),
            purse.share(54, Duration::ZERO),
            Duration::ZERO,
            now(Duration::ZERO),
        )
    };
    let mut queues = [queue(), queue()];
    // Far more reads are due than there are requests.
    queues[0].timing.refresh = Duration::ZERO;
    for pk in 1..=300 {
        queues[0].live(&of(pk, 1), wall(-60));
    }
    for pk in 1001..=1010 {
        let end = DesiredUpdate::Final(Outcome::Failed, results(1.0));
        queues[1].update(&of(pk, 1), end, now(Duration::ZERO));
    }
    let mut at = Duration::from_mins(1);
    let (begun, mut ends, mut sent) = (at, 0, 0);
    while ends < 10 {
        at += Duration::from_millis(10);
        for queue in &mut queues {
            while let Next::Send(ticket) = next(queue, now(at), true) {
                sent += 1;
                ends += usize::from(ticket.request.is_write());
                let reply = match &ticket.request {
                    Request::List { .. } => Reply::Rows(Answer::Done(vec![])),
                    Request::Get(subject) => Reply::Row(Answer::Done(row(subject.pk, Status::Running))),
                    _ => Reply::Written(Answer::Done(())),
                };
                at += Duration::from_millis(1);
                queue.answered(&ticket, reply, now(at));
            }
        }
    }
    let took = at.saturating_sub(begun);
    assert!(took < Duration::from_mins(2), "{took:?} for ten ends, {sent} requests");
}
