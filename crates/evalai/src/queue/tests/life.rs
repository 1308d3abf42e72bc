//! Writes of a submission over its life.

use super::*;

#[test]
fn a_whole_life_is_written_step_by_step() {
    let mut bench = Bench::new();
    bench.running(7);
    assert_eq!(bench.view(7).progress, Some(Progress::Running));
    bench.update(7, 1, DesiredUpdate::Partial(results(41.0)));
    bench.read_and_write(7, "partial");
    bench.update(7, 1, DesiredUpdate::Partial(results(41.0)));
    bench.expect_nothing();
    bench.wait(3.0);
    bench.update(7, 1, DesiredUpdate::Final(Outcome::Finished, results(43.0)));
    bench.get(7, row(7, Status::PartiallyEvaluated));
    bench.write("finished 7");
    let at = now(bench.at).wall;
    let outcome = Outcome::Finished;
    assert_eq!(bench.view(7).end, Some(Ended::Published { outcome, at }));
    bench.update(7, 1, DesiredUpdate::Final(Outcome::Finished, results(43.0)));
    bench.update(7, 1, DesiredUpdate::Final(Outcome::Cancelled, results(44.0)));
    bench.live(7, 1);
    bench.wait(100.0);
    bench.expect_nothing();
    bench.forget(7);
    assert!(bench.queue.view(&key(7)).is_none() && bench.queue.lanes.is_empty() && bench.queue.pks.is_empty());
}

#[test]
fn every_change_wakes_its_object_once_and_repeats_wake_nobody() {
    let mut bench = Bench::new();
    bench.running(7);
    let woken = [Changed::Submission(key(7))].into();
    assert_eq!(bench.queue.take_changes(), woken);
    bench.wait(10.0);
    bench.list("list of cancelled", vec![]);
    bench.wait(600.0);
    bench.list("list of cancelled", vec![]);
    let read = Row {
        jobs: vec!["submission-7-1".into()],
        ..row(7, Status::Running)
    };
    bench.get(7, read.clone());
    assert_eq!(bench.queue.take_changes(), [].into(), "a read that shows what is known");
    let now = bench.now();
    assert!(!bench.queue.update(&of(7, 1), DesiredUpdate::Running, now));
    assert!(!bench.queue.live(&of(7, 1), wall(-60)));
}

#[test]
fn progress_names_the_job_once() {
    let mut bench = Bench::new();
    bench.update(7, 1, DesiredUpdate::Queued);
    bench.get(7, row(7, Status::Submitted));
    let ticket = bench.write("queued 7");
    assert!(matches!(&ticket.request, Request::Progress(_, _, Some(job)) if job == "submission-7-1"));
    bench.update(7, 1, DesiredUpdate::Running);
    let named = Row {
        jobs: vec!["submission-7-1".into()],
        ..row(7, Status::Queued)
    };
    bench.get(7, named);
    let ticket = bench.write("running 7");
    assert!(matches!(&ticket.request, Request::Progress(_, _, None)));
}

#[test]
fn queued_is_left_out_where_running_is_wanted_already() {
    let mut bench = Bench::new();
    bench.update(7, 1, DesiredUpdate::Queued);
    let read = bench.expect("submission 7");
    bench.update(7, 1, DesiredUpdate::Running);
    bench.answer(&read, Reply::Row(Answer::Done(row(7, Status::Submitted))));
    bench.write("running 7");
    bench.expect_nothing();
}

#[test]
fn what_evalai_shows_already_is_not_written_again() {
    let mut bench = Bench::new();
    bench.update(7, 1, DesiredUpdate::Running);
    bench.get(7, row(7, Status::Running));
    bench.expect_nothing();
    assert_eq!(bench.view(7).progress, Some(Progress::Running));
}

#[test]
fn a_submission_that_evalai_has_ended_does_not_run() {
    for status in [
        Status::Cancelled,
        Status::Archived,
        Status::Deleted,
        Status::Ignored,
        Status::Finished,
        Status::Failed,
    ] {
        let mut bench = Bench::new();
        bench.ask(7, 1);
        bench.get(7, row(7, status));
        assert_eq!(
            (bench.view(7).answered, bench.view(7).ended),
            (Some(Attempt(1)), Some(status))
        );
        bench.update(7, 1, DesiredUpdate::Queued);
        bench.wait(100.0);
        bench.expect_nothing();
    }
    let mut bench = Bench::new();
    bench.ask(7, 1);
    let ticket = bench.expect("submission 7");
    bench.answer(&ticket, Reply::Row(Answer::Refused(refusal(About::Missing, 404))));
    assert_eq!(bench.view(7).ended, None, "one answer is none");
    bench.wait(29.0);
    bench.expect_nothing();
    bench.wait(1.5);
    let ticket = bench.expect("submission 7");
    bench.answer(&ticket, Reply::Row(Answer::Refused(refusal(About::Missing, 404))));
    assert_eq!(bench.view(7).ended, Some(Status::Missing));
}

#[test]
fn one_answer_that_a_submission_does_not_exist_ends_no_run() {
    let missing = || Reply::Row(Answer::Refused(refusal(About::Missing, 404)));
    let mut bench = Bench::new();
    bench.running(7);
    // As often as it likes, if a read in between finds it.
    for _ in 0..3 {
        bench.wait(70.0);
        bench.list("list of cancelled", vec![]);
        let ticket = bench.expect("submission 7");
        bench.answer(&ticket, missing());
        let view = bench.view(7);
        assert_eq!(view.ended, None);
        assert!(view.last_error.unwrap().contains("before that counts"));
        bench.wait(31.0);
        bench.list("list of cancelled", vec![]);
        bench.get(7, row(7, Status::Running));
        assert_eq!(bench.view(7).last_error, None);
    }
}

#[test]
fn a_participant_who_calls_a_run_finished_neither_ends_it_nor_keeps_its_results() {
    let mut bench = Bench::new();
    bench.running(7);
    bench.update(7, 1, DesiredUpdate::Partial(results(41.0)));
    bench.read_and_write(7, "partial");
    bench.wait(70.0);
    bench.list("list of cancelled", vec![]);
    bench.get(7, row(7, Status::Finished));
    assert_eq!(bench.view(7).ended, None);
    bench.update(7, 1, DesiredUpdate::Partial(results(42.0)));
    bench.get(7, row(7, Status::Finished));
    bench.write("partial 7");
    bench.update(7, 1, DesiredUpdate::Final(Outcome::Failed, results(0.0)));
    bench.get(7, row(7, Status::Finished));
    bench.write("failed 7");
    let failed = Outcome::Failed;
    assert!(matches!(bench.view(7).end, Some(Ended::Published { outcome, .. }) if outcome == failed));
}

#[test]
fn after_a_restart_a_run_with_a_job_is_still_not_finished_by_others() {
    let mut bench = Bench::new();
    let run = Run {
        has_job: true,
        ..run(7, 1)
    };
    let finished = Row {
        jobs: vec![run.job.clone()],
        ..row(7, Status::Finished)
    };
    let now = bench.now();
    bench.queue.ask(&subject(&key(7), 7, &run), false, now);
    bench.get(7, finished.clone());
    assert_eq!((bench.view(7).answered, bench.view(7).ended), (Some(Attempt(1)), None));
    bench
        .queue
        .update(&subject(&key(7), 7, &run), DesiredUpdate::Running, now);
    bench.get(7, finished);
    bench.write("running 7");
}

#[test]
fn an_object_that_was_made_anew_does_not_run_again_what_is_finished() {
    let mut bench = Bench::new();
    bench.ask(7, 1);
    let finished = Row {
        jobs: vec!["submission-7-1".into()],
        ..row(7, Status::Finished)
    };
    bench.get(7, finished);
    assert_eq!(bench.view(7).ended, Some(Status::Finished));
}

#[test]
fn an_unknown_status_starts_nothing_and_ends_nothing() {
    let mut bench = Bench::new();
    bench.ask(7, 1);
    bench.get(7, row(7, Status::Unknown));
    let view = bench.view(7);
    assert_eq!((view.answered, view.ended), (None, None));
    assert!(view.last_error.is_some_and(|why| why.contains("does not know")));
    bench.wait(59.0);
    bench.expect_nothing();
    bench.wait(1.0);
    bench.get(7, row(7, Status::Submitted));
    assert_eq!(
        (bench.view(7).answered, bench.view(7).last_error),
        (Some(Attempt(1)), None)
    );
}

#[test]
fn results_that_cannot_be_right_are_not_sent() {
    let mut bench = Bench::new();
    let empty = Arc::new(Outline {
        phase: 1,
        ..Outline::default()
    });
    bench.update(7, 1, DesiredUpdate::Final(Outcome::Finished, empty.clone()));
    bench.get(7, row(7, Status::Running));
    assert!(matches!(bench.view(7).end, Some(Ended::Refused(_))));
    bench.update(7, 1, DesiredUpdate::Final(Outcome::Finished, empty.clone()));
    bench.expect_nothing();
    bench.update(7, 1, DesiredUpdate::Final(Outcome::Failed, empty));
    bench.get(7, row(7, Status::Running));
    bench.write("failed 7");
    let foreign = Arc::new(Outline {
        phase: 2,
        ..Outline::clone(&results(1.0))
    });
    bench.update(8, 1, DesiredUpdate::Final(Outcome::Finished, foreign));
    bench.get(8, row(8, Status::Running));
    bench.expect_nothing();
    assert!(matches!(bench.view(8).end, Some(Ended::Refused(why)) if why.contains("phase 1, not to phase 2")));
}

#[test]
fn an_end_waits_for_its_own_read() {
    let mut bench = Bench::new();
    bench.ask(7, 1);
    bench.get(7, row(7, Status::Running));
    bench.update(7, 1, DesiredUpdate::Final(Outcome::Finished, results(43.0)));
    bench.wait(0.1);
    bench.update(7, 1, DesiredUpdate::Final(Outcome::Failed, results(43.0)));
    let get = bench.expect("submission 7");
    bench.answer(&get, Reply::Row(Answer::Done(row(7, Status::Cancelled))));
    bench.expect_nothing();
    assert_eq!(bench.view(7).end, Some(Ended::Otherwise(Status::Cancelled)));
}

#[test]
fn an_end_replaces_what_was_requested_before() {
    let mut bench = Bench::new();
    bench.update(7, 1, DesiredUpdate::Queued);
    bench.update(7, 1, DesiredUpdate::Partial(results(41.0)));
    bench.update(7, 1, DesiredUpdate::Final(Outcome::Finished, results(43.0)));
    bench.update(7, 1, DesiredUpdate::Running);
    bench.update(7, 1, DesiredUpdate::Partial(results(42.0)));
    bench.get(7, row(7, Status::Submitted));
    bench.write("finished 7");
    bench.wait(100.0);
    bench.expect_nothing();
}

#[test]
fn a_later_attempt_makes_the_requests_of_the_earlier_one_void() {
    let mut bench = Bench::new();
    bench.running(7);
    bench.update(7, 1, DesiredUpdate::Final(Outcome::Failed, results(1.0)));
    bench.get(7, row(7, Status::Running));
    let put = bench.expect("failed 7");
    bench.ask(7, 2);
    bench.update(7, 1, DesiredUpdate::Final(Outcome::Failed, results(2.0)));
    bench.expect_nothing();
    bench.answer(&put, Reply::Written(Answer::Done(())));
    assert_eq!((bench.view(7).attempt, bench.view(7).end), (Attempt(2), None));
    bench.wait(2.5);
    bench.get(7, row(7, Status::Failed));
    assert_eq!((bench.view(7).answered, bench.view(7).ended), (Some(Attempt(2)), None));
}

#[test]
fn an_image_is_downloaded_only_where_it_is_missing_and_costs_nothing() {
    let mut bench = Bench::new();
    let now = bench.now();
    bench.queue.ask(&of(7, 1), true, now);
    let found = Row {
        input_file: Some("http://files/x.json".into()),
        ..row(7, Status::Submitted)
    };
    bench.get(7, found);
    let used = bench.queue.usage(now).used;
    let ticket = bench.expect("image 7");
    bench.answer(&ticket, Reply::Image(Answer::Refused(refusal(About::Request, 404))));
    assert!(matches!(bench.view(7).image, Some(ImageAnswer::Unread(_))));
    bench.wait(5.0);
    let ticket = bench.expect("image 7");
    let named = ImageAnswer::Named("registry.example/a:1".into());
    bench.answer(&ticket, Reply::Image(Answer::Done(named.clone())));
    assert_eq!(bench.view(7).image, Some(named));
    assert_eq!(bench.queue.usage(now).used, used);
    bench.wait(100.0);
    bench.expect_nothing();
}

/// A submission whose image is asked for, up to the download of its file.
fn image_wanted(bench: &mut Bench, attempt: i64) -> Ticket {
    let now = bench.now();
    bench.queue.ask(&of(7, attempt), true, now);
    let found = Row {
        input_file: Some("http://files/x.json".into()),
        ..row(7, Status::Resuming)
    };
    bench.get(7, found);
    bench.expect("image 7")
}

#[test]
fn a_file_that_was_read_and_names_no_image_is_not_read_again_in_that_attempt() {
    let mut bench = Bench::new();
    let ticket = image_wanted(&mut bench, 1);
    let problem = ImageAnswer::NotAnImage("the uploaded file is no JSON".into());
    bench.answer(&ticket, Reply::Image(Answer::Done(problem.clone())));
    assert_eq!(
        (bench.view(7).image, bench.view(7).last_error),
        (Some(problem), None),
        "it is an answer, not a failed request"
    );
    for _ in 0..20 {
        bench.wait(60.0);
        bench.expect_nothing();
    }
    image_wanted(&mut bench, 2);
}

#[test]
fn the_file_of_a_submission_that_is_over_is_not_fetched() {
    let mut bench = Bench::new();
    let ticket = image_wanted(&mut bench, 1);
    bench.answer(&ticket, Reply::Image(Answer::Refused(refusal(About::Request, 404))));
    bench.update(7, 1, DesiredUpdate::Final(Outcome::Cancelled, results(0.0)));
    bench.get(7, row(7, Status::Cancelled));
    for _ in 0..20 {
        bench.wait(60.0);
        bench.expect_nothing();
    }
}

#[test]
fn a_submission_whose_file_is_missing_is_still_heard_of() {
    for (status, overtaken) in [(Status::Cancelled, false), (Status::Deleted, true)] {
        let mut bench = Bench::new();
        let ticket = image_wanted(&mut bench, 1);
        let gone = || Reply::Image(Answer::Refused(refusal(About::Request, 404)));
        bench.answer(&ticket, gone());
        bench.live(7, 1);
        let begun = bench.at;
        while bench.view(7).ended.is_none() {
            bench.wait(1.0);
            while let Some((name, ticket)) = bench.next() {
                let reply = match ticket.request {
                    Request::Image(..) => gone(),
                    // Deleted, it is in no list.
                    Request::List { .. } => Reply::Rows(Answer::Done(vec![])),
                    _ => Reply::Row(Answer::Done(row(7, status))),
                };
                bench.answer(&ticket, reply);
                assert!(!name.starts_with("image") || bench.view(7).last_error.is_some());
            }
            assert!(bench.at.checked_sub(begun).unwrap() <= Duration::from_secs(66));
        }
        assert_eq!(
            (bench.view(7).ended, bench.view(7).overtaken),
            (Some(status), overtaken)
        );
        bench.wait(60.0);
        bench.expect_nothing();
    }
}

#[test]
fn a_read_that_goes_well_does_not_hide_that_the_file_is_missing() {
    let mut bench = Bench::new();
    let ticket = image_wanted(&mut bench, 1);
    bench.answer(&ticket, Reply::Image(Answer::Refused(refusal(About::Request, 404))));
    let why = bench.view(7).last_error;
    assert!(why.is_some());
    bench.live(7, 1);
    let (mut files, mut reads) = (0, 0);
    for _ in 0..300 {
        bench.wait(1.0);
        while let Some((_, ticket)) = bench.next() {
            let reply = match ticket.request {
                Request::Image(..) => {
                    files += 1;
                    Reply::Image(Answer::Refused(refusal(About::Request, 404)))
                }
                Request::List { .. } => Reply::Rows(Answer::Done(vec![])),
                _ => {
                    reads += 1;
                    let found = bench.view(7).row.unwrap();
                    Reply::Row(Answer::Done(Row::clone(&found)))
                }
            };
            bench.answer(&ticket, reply);
            assert_eq!(bench.view(7).last_error, why);
        }
    }
    assert!((3..10).contains(&files), "{files}: its pauses grow, whatever is read");
    assert!(reads >= 4, "{reads}");
}

#[test]
fn a_challenge_that_nothing_needs_any_more_is_forgotten() {
    let mut bench = Bench::new();
    bench.serve();
    bench.ask(7, 1);
    assert_eq!(bench.queue.challenges.len(), 1);
    let now = bench.now();
    bench.queue.retire(&key(100), now);
    assert_eq!(bench.queue.challenges.len(), 1, "a submission is asked about there");
    bench.forget(7);
    assert!(bench.queue.challenges.is_empty());
}
