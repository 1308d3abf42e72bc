//! Answers that are none, refusals, a broken server, no lease, no token.

use super::*;

#[test]
fn an_unanswered_end_is_read_again_only_when_the_server_must_have_given_up() {
    let mut bench = Bench::new();
    bench.running(7);
    bench.update(7, 1, DesiredUpdate::Final(Outcome::Finished, results(43.0)));
    bench.get(7, row(7, Status::Running));
    let put = bench.expect("finished 7");
    bench.wait(65.0);
    bench.answer(&put, unanswered());
    let why = bench.view(7).last_error;
    assert_eq!(why.as_deref(), Some("EvalAI did not answer in time"));
    assert!(bench.is_unsure());
    bench.forget(7);
    bench.update(7, 1, DesiredUpdate::Final(Outcome::Finished, results(43.0)));
    bench.wait(74.9);
    bench.expect_nothing();
    bench.wait(0.1);
    bench.get(7, row(7, Status::Finished));
    bench.write("finished 7");
    assert!(matches!(bench.view(7).end, Some(Ended::Published { .. })));
    assert!(!bench.is_unsure());
}

#[test]
fn an_unanswered_write_is_followed_by_a_read_before_any_other_write() {
    let mut bench = Bench::new();
    bench.running(7);
    bench.update(7, 1, DesiredUpdate::Partial(results(41.0)));
    bench.get(7, row(7, Status::Running));
    let put = bench.expect("partial 7");
    bench.answer(&put, unanswered());
    bench.wait(74.0);
    let list = bench.expect("list of cancelled");
    bench.answer(&list, Reply::Rows(Answer::Done(vec![])));
    bench.expect_nothing();
    bench.wait(1.5);
    bench.get(7, row(7, Status::PartiallyEvaluated));
    bench.write("partial 7");
    assert_eq!(bench.view(7).last_error, None);
}

#[test]
fn a_request_that_never_left_is_tried_again_soon() {
    let mut bench = Bench::new();
    bench.update(7, 1, DesiredUpdate::Queued);
    bench.get(7, row(7, Status::Submitted));
    let patch = bench.expect("queued 7");
    let silence = Silence {
        sent: false,
        why: "EvalAI could not be reached".into(),
    };
    bench.answer(&patch, Reply::Written(Answer::Unanswered(silence)));
    assert_eq!(bench.view(7).last_error.as_deref(), Some("EvalAI could not be reached"));
    bench.expect_nothing();
    bench.wait(5.0);
    bench.get(7, row(7, Status::Submitted));
    bench.write("queued 7");
}

#[test]
fn throttling_stops_everything_for_as_long_as_asked() {
    let mut bench = Bench::new();
    bench.ask(7, 1);
    let get = bench.expect("submission 7");
    bench.answer(&get, Reply::Row(Answer::Throttled(Duration::from_secs(56))));
    bench.ask(8, 1);
    bench.wait(55.9);
    bench.expect_nothing();
    bench.wait(0.1);
    bench.get(7, row(7, Status::Submitted));
    assert_eq!(bench.view(7).last_error, None, "that is no error of this submission");
}

#[test]
fn a_refused_end_is_reported_tried_again_later_and_at_once_with_other_texts() {
    let mut bench = Bench::new();
    bench.running(7);
    bench.update(7, 1, DesiredUpdate::Final(Outcome::Finished, results(43.0)));
    bench.get(7, row(7, Status::Running));
    let put = bench.expect("finished 7");
    bench.answer(&put, Reply::Written(Answer::Refused(refusal(About::Request, 400))));
    assert_eq!(bench.view(7).end, Some(Ended::Refused("EvalAI answered 400".into())));
    bench.update(7, 1, DesiredUpdate::Final(Outcome::Finished, results(43.0)));
    bench.wait(10.0);
    bench.expect_nothing();
    bench.update(7, 1, DesiredUpdate::Final(Outcome::Finished, results(44.0)));
    assert_eq!(bench.view(7).end, None);
    bench.get(7, row(7, Status::Running));
    let put = bench.expect("finished 7");
    bench.answer(&put, Reply::Written(Answer::Refused(refusal(About::Request, 400))));
    bench.wait(599.0);
    bench.expect_nothing();
    bench.wait(1.0);
    bench.get(7, row(7, Status::Running));
    bench.write("finished 7");
    assert!(matches!(bench.view(7).end, Some(Ended::Published { .. })));
}

/// A submission whose result EvalAI's row refuses: it belongs to another phase there.
fn refused_here() -> Bench {
    let mut bench = Bench::new();
    bench.running(7);
    bench.update(7, 1, DesiredUpdate::Final(Outcome::Finished, results(43.0)));
    bench.get(7, of_phase_2(Status::Running));
    assert!(matches!(bench.view(7).end, Some(Ended::Refused(why)) if why.contains("phase 2, not to phase 1")));
    bench
}

fn of_phase_2(status: Status) -> Row {
    Row {
        phase: Some(2),
        ..row(7, status)
    }
}

#[test]
fn a_result_that_was_refused_here_is_tried_again_from_time_to_time() {
    let mut bench = refused_here();
    bench.update(7, 1, DesiredUpdate::Final(Outcome::Finished, results(43.0)));
    bench.wait(599.0);
    bench.expect_nothing();
    bench.wait(1.0);
    bench.get(7, of_phase_2(Status::Running));
    bench.wait(599.0);
    bench.expect_nothing();
    bench.wait(1.0);
    bench.read_and_write(7, "finished");
    assert!(matches!(bench.view(7).end, Some(Ended::Published { .. })));
    assert_eq!(bench.view(7).last_error, None);
}

#[test]
fn a_refused_result_becomes_cancelled_when_evalai_ends_it_later() {
    for status in [Status::Cancelled, Status::Archived] {
        let mut bench = refused_here();
        bench.wait(600.0);
        bench.get(7, of_phase_2(status));
        bench.expect_nothing();
        assert_eq!(bench.view(7).end, Some(Ended::Otherwise(status)));
    }
    // A list that is asked for other submissions brings it sooner.
    let mut bench = refused_here();
    bench.live(8, 1);
    bench.wait(30.0);
    bench.list("list of cancelled", vec![of_phase_2(Status::Cancelled)]);
    assert_eq!(bench.view(7).end, Some(Ended::Otherwise(Status::Cancelled)));
}

#[test]
fn a_list_that_brings_a_refused_result_does_not_put_off_its_next_try() {
    let mut bench = refused_here();
    bench.serve();
    let begun = bench.at;
    let mut tried = None;
    while tried.is_none() && bench.at < begun + Duration::from_mins(15) {
        bench.wait(10.0);
        while let Some((name, ticket)) = bench.next() {
            let reply = match &ticket.request {
                Request::List { .. } => Reply::Rows(Answer::Done(vec![of_phase_2(Status::Submitted)])),
                Request::Phases(_) => Reply::Phases(Answer::Done(vec![])),
                Request::Splits(_) => Reply::Splits(Answer::Done(vec![])),
                _ => {
                    assert_eq!(name, "submission 7");
                    tried = Some(bench.at.saturating_sub(begun).as_secs());
                    break;
                }
            };
            bench.answer(&ticket, reply);
        }
    }
    assert!(tried.is_some_and(|after| (590..=610).contains(&after)), "{tried:?}");
}

#[test]
fn a_write_to_a_row_that_only_a_read_finds_waits_and_lets_others_through() {
    let mut bench = Bench::new();
    bench.running(7);
    bench.update(7, 1, DesiredUpdate::Final(Outcome::Finished, results(43.0)));
    bench.get(7, row(7, Status::Running));
    let put = bench.expect("finished 7");
    bench.answer(&put, Reply::Written(Answer::Refused(refusal(About::Missing, 404))));
    assert_eq!(bench.view(7).last_error.as_deref(), Some("EvalAI answered 404"));
    bench.wait(4.0);
    bench.expect_nothing();
    bench.update(8, 1, DesiredUpdate::Final(Outcome::Failed, results(1.0)));
    bench.read_and_write(8, "failed");
    bench.expect_nothing();
    bench.wait(2.5);
    bench.get(7, Row::missing(7));
    bench.expect_nothing();
    assert_eq!(bench.view(7).end, Some(Ended::Otherwise(Status::Missing)));
}

#[test]
fn a_broken_server_is_left_alone_longer_each_time() {
    let mut bench = Bench::new();
    bench.update(7, 1, DesiredUpdate::Final(Outcome::Finished, results(43.0)));
    // An outage of an hour is over within two minutes; after that it is the row.
    let waits = [30.0, 60.0].into_iter().chain([90.0; 58]).chain([600.0, 600.0]);
    for wait in waits {
        bench.get(7, row(7, Status::Finished));
        let put = bench.expect("finished 7");
        bench.answer(&put, Reply::Written(Answer::Broken("EvalAI answered 500".into())));
        bench.wait(wait - 0.1);
        bench.expect_nothing();
        bench.wait(0.1);
    }
}

#[test]
fn without_the_lease_and_after_a_takeover_only_reads_are_sent() {
    let mut bench = Bench::with_writes_after(75);
    bench.ask(7, 1);
    bench.get(7, row(7, Status::Submitted));
    bench.live(7, 1);
    bench.update(7, 1, DesiredUpdate::Queued);
    bench.list("list of cancelled", vec![]);
    bench.update(8, 1, DesiredUpdate::Final(Outcome::Failed, results(1.0)));
    bench.expect_nothing();
    bench.wait(15.0);
    let now = bench.now();
    assert!(matches!(next(&mut bench.queue, now, false), Next::Send(t) if matches!(t.request, Request::List { .. })));
    let Next::Wait(Some(again)) = next(&mut bench.queue, now, false) else {
        panic!("a write is sent without the lease")
    };
    assert_eq!(again, now.at + Duration::from_secs(1));
    let names: Vec<_> = std::iter::from_fn(|| bench.next()).map(|(name, _)| name).collect();
    assert_eq!(names[0], "submission 8", "{names:?}");
}

#[test]
fn what_waits_for_the_first_write_is_woken_once_when_it_may_be_sent() {
    let mut bench = Bench::with_writes_after(75);
    bench.serve();
    while let Some((_, ticket)) = bench.next() {
        match ticket.request {
            Request::Phases(_) => bench.answer(&ticket, Reply::Phases(Answer::Done(vec![]))),
            Request::Splits(_) => bench.answer(&ticket, Reply::Splits(Answer::Done(vec![]))),
            _ => bench.answer(&ticket, Reply::Rows(Answer::Done(vec![]))),
        }
    }
    bench.ask(7, 1);
    bench.get(7, row(7, Status::Submitted));
    bench.update(8, 1, DesiredUpdate::Final(Outcome::Failed, results(1.0)));
    bench.queue.take_changes();
    let now = bench.now();
    let Next::Wait(Some(until)) = next(&mut bench.queue, now, true) else {
        panic!("a write is sent before its time")
    };
    assert!(until <= Duration::from_secs(75), "{until:?}");
    assert_eq!(bench.queue.take_changes(), [].into());
    bench.wait(15.0);
    bench.expect("submission 8");
    let woken = [Changed::Submission(key(8)), Changed::Leaderboard(key(100))];
    assert_eq!(bench.queue.take_changes(), woken.into());
    bench.next();
    assert_eq!(bench.queue.take_changes(), [].into(), "once");
}

#[test]
fn a_refused_token_is_reported_and_tried_again_after_a_minute_or_its_renewal() {
    let mut bench = Bench::new();
    bench.serve();
    let ticket = bench.expect("sweep of submitted");
    bench.answer(&ticket, Reply::Rows(Answer::Refused(refusal(About::Token, 401))));
    assert_eq!(bench.queue.token_refused(), Some("EvalAI answered 401"));
    assert_eq!(bench.queue.take_changes(), [Changed::Leaderboard(key(100))].into());
    bench.ask(7, 1);
    bench.wait(59.0);
    bench.expect_nothing();
    let (now, settled) = (bench.now(), bench.at);
    let leaving = bench.queue.part_with(&key(100), settled, now);
    bench.queue = queue_of(54, Duration::ZERO, now);
    bench.queue.take_over(leaving);
    bench.wait(10.0);
    bench.get(7, row(7, Status::Submitted));
    assert_eq!(bench.queue.token_refused(), None);
}

#[test]
fn a_user_who_is_no_host_is_refused_for_that_challenge_and_stops_no_other() {
    let mut bench = Bench::new();
    bench.serve();
    let no_host = || Answer::Refused(refusal(About::Challenge, 401));
    let mut phases = 0;
    while let Some((_, ticket)) = bench.next() {
        match ticket.request {
            Request::Phases(_) => {
                phases += 1;
                bench.answer(&ticket, Reply::Phases(no_host()));
            }
            _ => bench.answer(&ticket, Reply::Rows(Answer::Refused(refusal(About::Challenge, 400)))),
        }
    }
    assert_eq!(phases, 1);
    assert_eq!(bench.queue.challenge_refused(&key(100)), Some("EvalAI answered 401"));
    assert_eq!(
        (bench.queue.token_refused(), bench.queue.challenge_refused(&key(101))),
        (None, None)
    );
    bench.ask(7, 1);
    bench.get(7, row(7, Status::Submitted));
    bench.wait(60.0);
    while let Some((_, ticket)) = bench.next() {
        match ticket.request {
            Request::Phases(_) => bench.answer(&ticket, Reply::Phases(Answer::Done(vec![]))),
            Request::Splits(_) => bench.answer(&ticket, Reply::Splits(Answer::Done(vec![]))),
            _ => bench.answer(&ticket, Reply::Rows(Answer::Done(vec![]))),
        }
    }
    assert_eq!(bench.queue.challenge_refused(&key(100)), None);
}
