//! Whose cancellation counts, and that none is overwritten knowingly.

use super::*;

#[test]
fn a_cancellation_is_found_by_the_next_list() {
    let mut bench = Bench::new();
    bench.running(7);
    bench.wish(7, 1, Wish::Partial(results(41.0)));
    bench.wait(10.0);
    bench.list(
        "list of cancelled",
        vec![row(7, Status::Cancelled), row(99, Status::Cancelled)],
    );
    assert_eq!(bench.view(7).ended, Some(Status::Cancelled));
    bench.wait(30.0);
    bench.expect_nothing();
    bench.wish(7, 1, Wish::Final(Outcome::Cancelled, results(41.0)));
    bench.get(7, row(7, Status::Cancelled));
    bench.expect_nothing();
    assert_eq!(bench.view(7).end, Some(Ended::Agreed(Status::Cancelled)));
}

#[test]
fn a_cancellation_that_a_write_under_way_may_undo_is_told_again() {
    let (mut bench, write) = partial_under_way();
    let list = next_list(&mut bench);
    bench.answer(&list, Reply::Rows(Answer::Done(vec![row(7, Status::Cancelled)])));
    bench.answer(&write, Reply::Written(Answer::Done(())));
    let view = bench.view(7);
    assert_eq!((view.ended, view.overtaken), (Some(Status::Cancelled), true));
    bench.wish(7, 1, Wish::Final(Outcome::Cancelled, results(41.0)));
    bench.get(7, row(7, Status::PartiallyEvaluated));
    bench.write("cancelled 7");
    assert!(matches!(
        bench.view(7).end,
        Some(Ended::Published {
            outcome: Outcome::Cancelled,
            ..
        })
    ));
}

#[test]
fn a_list_that_was_asked_for_before_a_write_may_tell_of_what_that_undid() {
    let (mut bench, write) = partial_under_way();
    let list = next_list(&mut bench);
    bench.answer(&write, Reply::Written(Answer::Done(())));
    bench.answer(&list, Reply::Rows(Answer::Done(vec![row(7, Status::Cancelled)])));
    assert!(bench.view(7).overtaken);
}

#[test]
fn a_cancellation_after_our_last_write_stands() {
    let (mut bench, write) = partial_under_way();
    bench.answer(&write, Reply::Written(Answer::Done(())));
    let list = next_list(&mut bench);
    bench.answer(&list, Reply::Rows(Answer::Done(vec![row(7, Status::Cancelled)])));
    let view = bench.view(7);
    assert_eq!((view.ended, view.overtaken), (Some(Status::Cancelled), false));
}

/// A running submission whose partial results EvalAI is working on.
fn partial_under_way() -> (Bench, Ticket) {
    let mut bench = Bench::new();
    bench.running(7);
    bench.wait(10.0);
    bench.list("list of cancelled", vec![]);
    bench.wish(7, 1, Wish::Partial(results(41.0)));
    let write = bench.expect("partial 7");
    (bench, write)
}

fn next_list(bench: &mut Bench) -> Ticket {
    bench.wait(10.0);
    bench.expect("list of cancelled")
}

#[test]
fn lists_reach_back_to_the_first_live_submission_only() {
    let mut bench = Bench::new();
    for (pk, submitted) in [(7, -60), (8, -900), (9, -30)] {
        bench.queue.live(&target(), &key(pk), pk, &run(pk, 1), wall(submitted));
    }
    let ticket = bench.list("list of cancelled", vec![]);
    assert!(matches!(ticket.request, Request::List { after, purpose: Purpose::Cancel, .. } if after == wall(-901)));
    bench.forget(8);
    while bench.next().is_some() {}
    bench.wait(10.0);
    let ticket = bench.list("list of cancelled", vec![]);
    assert!(matches!(ticket.request, Request::List { after, .. } if after == wall(-61)));
    for pk in [7, 9] {
        bench.forget(pk);
    }
    bench.wait(100.0);
    bench.expect_nothing();
}

#[test]
fn an_old_cancellation_does_not_end_a_resumed_attempt() {
    let mut bench = Bench::new();
    let old = Row {
        jobs: vec!["submission-7-1".into()],
        ..row(7, Status::Cancelled)
    };
    bench.ask(7, 2);
    bench.get(7, old.clone());
    bench.live(7, 2);
    let early = bench.expect("list of cancelled");
    assert_eq!((bench.view(7).answered, bench.view(7).ended), (2, None));
    bench.wish(7, 2, Wish::Queued);
    bench.write("queued 7");
    // Requested before EvalAI answered the PATCH: it shows the end of attempt 1.
    bench.answer(&early, Reply::Rows(Answer::Done(vec![old.clone()])));
    assert_eq!(bench.view(7).ended, None);
    bench.wait(10.0);
    bench.list("list of cancelled", vec![old]);
    assert_eq!(
        bench.view(7).ended,
        Some(Status::Cancelled),
        "requested after it: attempt 2 was cancelled"
    );
}

#[test]
fn a_cancellation_while_a_later_attempt_waits_ends_it() {
    let mut bench = Bench::new();
    bench.ask(7, 2);
    bench.get(7, row(7, Status::Resuming));
    bench.live(7, 2);
    bench.list("list of cancelled", vec![row(7, Status::Cancelled)]);
    assert_eq!(
        bench.view(7).ended,
        Some(Status::Cancelled),
        "EvalAI was not told of attempt 2, but had said resuming"
    );
}

#[test]
fn after_a_restart_the_job_name_tells_whose_cancellation_it_is() {
    for (job, ended) in [("submission-7-1", None), ("submission-7-2", Some(Status::Cancelled))] {
        let mut bench = Bench::new();
        bench.live(7, 2);
        let found = Row {
            jobs: vec![job.into()],
            ..row(7, Status::Cancelled)
        };
        bench.list("list of cancelled", vec![found]);
        assert_eq!(bench.view(7).ended, ended, "{job}");
    }
}

#[test]
fn a_cancellation_that_a_write_overtook_still_counts() {
    let mut bench = Bench::new();
    bench.running(7);
    bench.wait(9.0);
    bench.wish(7, 1, Wish::Partial(results(41.0)));
    bench.wait(1.0);
    let early = bench.expect("list of cancelled");
    bench.expect_nothing();
    bench.wish(7, 1, Wish::Final(Outcome::Failed, results(0.0)));
    let get = bench.expect("submission 7");
    bench.answer(&get, Reply::Row(Answer::Done(row(7, Status::Running))));
    let mut other = Bench::new();
    other.running(7);
    other.wait(10.0);
    let list = other.expect("list of cancelled");
    other.live(7, 1);
    other.queue.subs.get_mut(&key(7)).unwrap().wrote_at = other.at + Duration::from_millis(1);
    other.answer(&list, Reply::Rows(Answer::Done(vec![row(7, Status::Cancelled)])));
    assert_eq!(other.view(7).ended, Some(Status::Cancelled));
    bench.write("failed 7");
    bench.answer(&early, Reply::Rows(Answer::Done(vec![row(7, Status::Cancelled)])));
    assert_eq!(bench.view(7).ended, None, "what was published stands");
}

#[test]
fn partials_follow_a_list_by_two_seconds_at_most() {
    let mut bench = Bench::new();
    bench.running(7);
    bench.wait(2.1);
    bench.wish(7, 1, Wish::Partial(results(40.0)));
    bench.expect_nothing();
    bench.wish(7, 1, Wish::Partial(results(41.0)));
    bench.wait(7.9);
    bench.list("list of cancelled", vec![]);
    bench.wait(0.4);
    let ticket = bench.write("partial 7");
    assert!(
        matches!(&ticket.request, Request::Partial(_, payload) if *payload == results(41.0)),
        "the newest of both"
    );
    bench.expect_nothing();
}

#[test]
fn a_list_that_does_not_reach_back_far_enough_opens_no_window() {
    let mut bench = Bench::new();
    bench.running(7);
    bench.wait(3.0);
    bench.wish(7, 1, Wish::Partial(results(41.0)));
    bench.wait(7.0);
    let ticket = bench.expect("list of cancelled");
    let Request::List { challenge, purpose, .. } = ticket.request else {
        panic!("no list")
    };
    let short = Ticket {
        request: Request::List {
            challenge,
            purpose,
            after: wall(-59),
        },
        ..ticket
    };
    bench.answer(&short, Reply::Rows(Answer::Done(vec![])));
    bench.expect_nothing();
}

#[test]
fn somebody_elses_end_is_noticed_by_a_read_now_and_then() {
    let mut bench = Bench::new();
    bench.running(7);
    let mut reads = 0;
    for _ in 0..65 {
        bench.wait(10.0);
        while let Some((name, ticket)) = bench.next() {
            if matches!(ticket.request, Request::Get(_)) {
                reads += 1;
                bench.answer(&ticket, Reply::Row(Answer::Done(row(7, Status::Archived))));
            } else {
                assert_eq!(name, "list of cancelled");
                bench.answer(&ticket, Reply::Rows(Answer::Done(vec![])));
            }
        }
    }
    assert_eq!((reads, bench.view(7).ended), (1, Some(Status::Archived)));
}

#[test]
fn a_slow_list_is_too_old_for_partials_and_a_read_takes_its_place() {
    let mut bench = Bench::new();
    bench.running(7);
    bench.wait(10.0);
    bench.wish(7, 1, Wish::Partial(results(41.0)));
    let list = bench.expect("list of cancelled");
    bench.wait(3.0);
    bench.answer(&list, Reply::Rows(Answer::Done(vec![])));
    bench.get(7, row(7, Status::Running));
    bench.wait(0.4);
    bench.write("partial 7");
    bench.wish(7, 1, Wish::Partial(results(42.0)));
    bench.wait(0.2);
    bench.get(7, row(7, Status::Cancelled));
    bench.expect_nothing();
    assert_eq!(
        bench.view(7).ended,
        Some(Status::Cancelled),
        "and the read finds the cancellation before the next list"
    );
}

#[test]
fn a_partials_own_read_is_followed_at_once_by_the_partial() {
    let mut bench = Bench::new();
    bench.all_running(&[7, 8]);
    bench.wait(10.0);
    bench.wish(7, 1, Wish::Partial(results(41.0)));
    let list = bench.expect("list of cancelled");
    bench.wait(3.0);
    bench.answer(&list, Reply::Rows(Answer::Done(vec![])));
    let read = bench.expect("submission 7");
    // Meanwhile there is what would otherwise come first.
    bench.ask(9, 1);
    bench.wish(8, 1, Wish::Final(Outcome::Finished, results(50.0)));
    bench.answer(&read, Reply::Row(Answer::Done(row(7, Status::Running))));
    bench.write("partial 7");
    bench.expect("submission 8");
}

#[test]
fn a_partial_that_misses_every_list_gets_a_read_of_its_own() {
    let mut bench = Bench::new();
    bench.running(7);
    bench.wait(1.0);
    bench.wish(7, 1, Wish::Partial(results(41.0)));
    let begun = bench.at;
    loop {
        bench.wait(5.0);
        match bench.next() {
            None => {}
            Some((name, list)) if name == "list of cancelled" => {
                bench.answer(&list, Reply::Rows(Answer::Broken("EvalAI answered 500".into())));
            }
            Some((name, read)) => {
                assert_eq!(name, "submission 7");
                bench.answer(&read, Reply::Row(Answer::Done(row(7, Status::Running))));
                break;
            }
        }
    }
    let waited = bench.at.checked_sub(begun).unwrap();
    assert!((45..=55).contains(&waited.as_secs()), "{waited:?}");
    bench.write("partial 7");
}

#[test]
fn the_time_that_a_list_takes_is_taken_off_its_window() {
    let mut bench = Bench::new();
    bench.running(7);
    bench.wait(10.0);
    let list = bench.expect("list of cancelled");
    bench.wait(0.2);
    bench.answer(&list, Reply::Rows(Answer::Done(vec![])));
    bench.wait(0.2);
    bench.wish(7, 1, Wish::Partial(results(41.0)));
    bench.write("partial 7");
    bench.wish(7, 1, Wish::Partial(results(42.0)));
    bench.wait(0.2);
    bench.expect_nothing();
}

#[test]
fn with_slow_lists_progress_follows_a_read_of_its_own() {
    let mut bench = Bench::new();
    bench.ask(7, 1);
    bench.get(7, row(7, Status::Submitted));
    bench.live(7, 1);
    let list = bench.expect("list of cancelled");
    bench.wait(3.0);
    bench.answer(&list, Reply::Rows(Answer::Done(vec![])));
    bench.wait(5.0);
    bench.wish(7, 1, Wish::Running);
    bench.get(7, row(7, Status::Submitted));
    bench.write("running 7");
    bench.expect_nothing();
}
