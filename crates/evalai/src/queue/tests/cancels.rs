//! Cancellations: which of them count, and that none is overwritten knowingly.

use super::*;

#[test]
fn a_cancellation_is_found_by_the_next_list() {
    let mut bench = Bench::new();
    bench.running(7);
    bench.update(7, 1, DesiredUpdate::Partial(results(41.0)));
    bench.wait(10.0);
    bench.list(
        "list of cancelled",
        vec![row(7, Status::Cancelled), row(99, Status::Cancelled)],
    );
    assert_eq!(bench.view(7).ended, Some(Status::Cancelled));
    bench.wait(30.0);
    bench.expect_nothing();
    bench.update(7, 1, DesiredUpdate::Final(Outcome::Cancelled, results(41.0)));
    bench.get(7, row(7, Status::Cancelled));
    bench.expect_nothing();
    let agreed = bench.view(7).end;
    assert!(matches!(
        agreed,
        Some(Ended::Agreed {
            status: Status::Cancelled,
            ..
        })
    ));
    // Another's list brings the row again: it is published since the first time.
    bench.live(8, 1);
    bench.wait(20.0);
    let read_at = bench.view(7).read_at;
    bench.list("list of cancelled", vec![row(7, Status::Cancelled)]);
    assert!(bench.view(7).read_at > read_at);
    assert_eq!(bench.view(7).end, agreed);
}

#[test]
fn a_submission_with_its_end_is_woken_once_when_a_list_shows_it_as_cancelled() {
    let mut bench = Bench::new();
    bench.serve();
    bench.live(8, 1);
    bench.answer_all(Status::Running);
    let board = key(100);
    let lists = |bench: &mut Bench, rows: Vec<Row>| {
        bench.wait(10.0);
        bench.queue.take_changes();
        while let Some((name, ticket)) = bench.next() {
            let rows = if name == "list of cancelled" {
                rows.clone()
            } else {
                vec![]
            };
            bench.answer(&ticket, Reply::Rows(Answer::Done(rows)));
        }
        let woken = |change| matches!(change, Changed::Submission(key) if key.name == "submission-7");
        bench.queue.take_changes().into_iter().any(woken)
    };
    assert!(!lists(&mut bench, vec![]));
    assert_eq!(bench.queue.cancelled_as_of(&board, 7), None);
    let shown = || vec![row(7, Status::Cancelled), row(8, Status::Running)];
    assert!(lists(&mut bench, shown()));
    let first = bench.queue.cancelled_as_of(&board, 7);
    assert!(first.is_some_and(|at| at < bench.now().wall));
    assert_eq!(
        bench.queue.cancelled_as_of(&board, 8),
        None,
        "one that runs is followed otherwise"
    );
    assert!(!lists(&mut bench, shown()), "once");
    assert!(bench.queue.cancelled_as_of(&board, 7) > first);
    assert!(!lists(&mut bench, vec![]));
    assert_eq!(bench.queue.cancelled_as_of(&board, 7), None);
}

#[test]
fn a_cancellation_that_a_write_under_way_may_undo_is_sent_again() {
    let (mut bench, write) = partial_under_way();
    let list = next_list(&mut bench);
    bench.answer(&list, Reply::Rows(Answer::Done(vec![row(7, Status::Cancelled)])));
    bench.answer(&write, Reply::Written(Answer::Done(())));
    let view = bench.view(7);
    assert_eq!((view.ended, view.overtaken), (Some(Status::Cancelled), true));
    bench.update(7, 1, DesiredUpdate::Final(Outcome::Cancelled, results(41.0)));
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
fn a_list_that_was_asked_for_before_a_write_may_show_what_that_undid() {
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
    bench.update(7, 1, DesiredUpdate::Partial(results(41.0)));
    bench.get(7, row(7, Status::Running));
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
        bench.queue.live(&of(pk, 1), wall(submitted));
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
    assert_eq!((bench.view(7).answered, bench.view(7).ended), (Some(Attempt(2)), None));
    bench.update(7, 2, DesiredUpdate::Queued);
    bench.get(7, old.clone());
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
fn a_cancel_before_the_first_read_of_an_attempt_that_evalai_has_asked_for_stays() {
    for (by_hand, ended) in [(true, None), (false, Some(Status::Cancelled))] {
        let mut bench = Bench::new();
        let run = Run { by_hand, ..run(7, 2) };
        let cancelled = Row {
            jobs: vec!["submission-7-1".into()],
            ..row(7, Status::Cancelled)
        };
        let now = bench.now();
        bench.queue.ask(&subject(&key(7), 7, &run), false, now);
        bench.get(7, cancelled.clone());
        assert_eq!((bench.view(7).answered, bench.view(7).ended), (Some(Attempt(2)), ended));
        bench
            .queue
            .update(&subject(&key(7), 7, &run), DesiredUpdate::Queued, now);
        if ended.is_some() {
            bench.expect_nothing();
        } else {
            bench.get(7, cancelled);
            bench.write("queued 7");
        }
    }
}

#[test]
fn a_row_that_was_live_before_a_restart_is_ended_by_what_ends_it_then() {
    for (status, ended) in [
        (Status::Cancelled, Some(Status::Cancelled)),
        (Status::Failed, Some(Status::Failed)),
        // Participants can write it.
        (Status::Finished, None),
        (Status::Running, None),
    ] {
        let mut bench = Bench::new();
        bench.running(7);
        bench.wait(2.0);
        bench.ask(7, 2);
        bench.get(7, row(7, status));
        assert_eq!((bench.view(7).answered, bench.view(7).ended), (Some(Attempt(2)), ended));
        if ended.is_none() {
            bench.update(7, 2, DesiredUpdate::Queued);
            bench.get(7, row(7, status));
            bench.write("queued 7");
        }
    }
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
        "EvalAI did not know of attempt 2, but had shown resuming"
    );
}

#[test]
fn after_a_restart_the_job_name_shows_whose_cancellation_it_is() {
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
    bench.wait(10.0);
    let early = bench.expect("list of cancelled");
    bench.expect_nothing();
    bench.update(7, 1, DesiredUpdate::Final(Outcome::Failed, results(0.0)));
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
fn a_deleted_submission_is_noticed_within_a_minute_and_cancelled_in_evalai() {
    let mut bench = Bench::new();
    bench.running(7);
    let begun = bench.at;
    while bench.view(7).ended.is_none() {
        bench.wait(1.0);
        // Deleted after the last read, it is in no list of cancelled ones.
        while let Some((_, ticket)) = bench.next() {
            let reply = match ticket.request {
                Request::List { .. } => Reply::Rows(Answer::Done(vec![])),
                _ => Reply::Row(Answer::Done(row(7, Status::Deleted))),
            };
            bench.answer(&ticket, reply);
        }
        let waited = bench.at.checked_sub(begun).unwrap();
        assert!(waited <= Duration::from_secs(61), "{waited:?}");
    }
    let view = bench.view(7);
    assert_eq!((view.ended, view.overtaken), (Some(Status::Deleted), true));
    bench.update(7, 1, DesiredUpdate::Final(Outcome::Cancelled, results(41.0)));
    bench.get(7, row(7, Status::Deleted));
    bench.write("cancelled 7");
    assert!(matches!(bench.view(7).end, Some(Ended::Published { .. })));
    bench.wait(600.0);
    bench.expect_nothing();
}

#[test]
fn the_end_of_a_deleted_submission_is_cancelled_once_whatever_it_was() {
    for outcome in [Outcome::Finished, Outcome::Failed] {
        let mut bench = Bench::new();
        bench.running(7);
        bench.update(7, 1, DesiredUpdate::Final(outcome, results(43.0)));
        bench.get(7, row(7, Status::Deleted));
        bench.write("cancelled 7");
        assert_eq!(bench.view(7).end, Some(Ended::Otherwise(Status::Deleted)));
        bench.wait(600.0);
        bench.expect_nothing();
    }
    for outcome in [Outcome::Finished, Outcome::Cancelled] {
        let mut bench = Bench::new();
        bench.running(7);
        bench.update(7, 1, DesiredUpdate::Final(outcome, results(43.0)));
        bench.get(7, row(7, Status::Ignored));
        bench.expect_nothing();
        assert!(
            bench.view(7).end.is_some(),
            "it had come to its end before it was deleted"
        );
    }
}

#[test]
fn a_deleted_submission_that_waits_is_found_by_the_sweep() {
    let mut bench = Bench::new();
    bench.ask(7, 1);
    bench.get(7, row(7, Status::Submitted));
    bench.serve();
    bench.list("sweep of submitted", vec![row(7, Status::Deleted)]);
    assert_eq!(bench.view(7).ended, Some(Status::Deleted));
}

#[test]
fn each_write_follows_at_once_a_read_of_its_own() {
    for (update, write) in [
        (DesiredUpdate::Partial(results(41.0)), "partial 7"),
        (DesiredUpdate::Final(Outcome::Cancelled, results(41.0)), "cancelled 7"),
    ] {
        let mut bench = Bench::new();
        bench.all_running(&[7, 8]);
        bench.update(7, 1, update);
        let read = bench.expect("submission 7");
        // Meanwhile there is what would otherwise come first.
        bench.ask(9, 1);
        bench.update(8, 1, DesiredUpdate::Final(Outcome::Finished, results(50.0)));
        bench.answer(&read, Reply::Row(Answer::Done(row(7, Status::Running))));
        bench.write(write);
    }
}

#[test]
fn a_read_that_is_not_followed_at_once_is_made_again() {
    let mut bench = Bench::new();
    bench.running(7);
    bench.update(7, 1, DesiredUpdate::Partial(results(41.0)));
    bench.get(7, row(7, Status::Running));
    // The lease is away for a moment.
    let now = bench.now();
    assert!(matches!(next(&mut bench.queue, now, false), Next::Wait(_)));
    bench.wait(2.5);
    bench.get(7, row(7, Status::Running));
    bench.write("partial 7");
}

/// How long the server works on a write, from its read of the row to its answer.
const WORK: Duration = Duration::from_millis(80);
/// One way to the server.
const WAY: Duration = Duration::from_millis(5);

/// A cancel so long after a list was answered, and a update two seconds after that list. How long before the server began with
/// the write that undid the cancel it had come; none if it stands.
fn undone(update: &DesiredUpdate, offset: Duration) -> Option<Duration> {
    let mut bench = Bench::new();
    bench.ask(7, 1);
    bench.get(7, row(7, Status::Submitted));
    bench.live(7, 1);
    bench.list("list of cancelled", vec![]);
    let cancel = bench.at + offset;
    bench.wait(2.0);
    bench.update(7, 1, update.clone());
    while let Some((_, ticket)) = bench.next() {
        bench.at += WAY;
        let arrived = bench.at;
        if ticket.request.is_write() {
            return (cancel <= arrived + WORK).then(|| arrived.saturating_sub(cancel));
        }
        bench.at += WAY;
        let cancelled = cancel <= arrived;
        let status = if cancelled {
            Status::Cancelled
        } else {
            Status::Submitted
        };
        bench.answer(&ticket, Reply::Row(Answer::Done(row(7, status))));
    }
    assert_eq!(bench.view(7).ended, Some(Status::Cancelled));
    None
}

#[test]
fn forty_cancels_aimed_between_a_list_and_a_write_are_undone_only_while_the_server_works_on_it() {
    // The way of the read's answer and of the write; all moments of this clock differ by a little.
    let on_the_way = WAY * 2 + Duration::from_millis(1);
    for update in [
        DesiredUpdate::Queued,
        DesiredUpdate::Running,
        DesiredUpdate::Partial(results(41.0)),
    ] {
        // From the list to the update in steps of 100 ms, then through read and write in steps of 10 ms.
        let offsets = (0..20)
            .map(|step| step * 100)
            .chain((0..20).map(|step| 1_990 + step * 10));
        let undone: Vec<_> = offsets
            .filter_map(|offset| undone(&update, Duration::from_millis(offset)))
            .collect();
        let before = undone.iter().filter(|before| **before > on_the_way).count();
        println!(
            "{} of 40 undone, {before} of them before the write was on its way",
            undone.len()
        );
        assert_eq!(before, 0, "{update:?}: {undone:?}");
        assert!((5..12).contains(&undone.len()), "{update:?}: {undone:?}");
    }
}

#[test]
fn a_cancel_is_not_written_over_what_had_finished_before_any_run_of_ours() {
    for has_job in [false, true] {
        let mut bench = Bench::new();
        let mut cancelled = of(7, 1);
        cancelled.run.has_job = has_job;
        let now = bench.now();
        let end = DesiredUpdate::Final(Outcome::Cancelled, results(43.0));
        bench.queue.update(&cancelled, end, now);
        bench.get(7, row(7, Status::Finished));
        if has_job {
            bench.write("cancelled 7");
        }
        bench.expect_nothing();
        let kept = matches!(
            bench.view(7).end,
            Some(Ended::Agreed {
                status: Status::Finished,
                ..
            })
        );
        assert_eq!(kept, !has_job, "{:?}", bench.view(7).end);
    }
}

#[test]
fn a_write_that_was_chosen_and_not_sent_in_time_is_read_for_again() {
    let mut bench = Bench::new();
    bench.live(7, 1);
    bench.list("list of cancelled", vec![]);
    bench.update(7, 1, DesiredUpdate::Running);
    bench.get(7, row(7, Status::Queued));
    let chosen = bench.expect("running 7");
    let left = chosen.leave_by.unwrap().checked_sub(chosen.requested).unwrap();
    assert!(left <= Duration::from_secs(1), "{left:?}");
    bench.queue.not_sent(&chosen);
    bench.get(7, row(7, Status::Cancelled));
    bench.expect_nothing();
    assert_eq!(bench.view(7).ended, Some(Status::Cancelled));
}
