//! Payloads from a bucket: when they are read, how much of them is held, and what becomes of them.

use super::*;

fn unfit() -> PayloadProblem {
    PayloadProblem::Unfit("evalai/stdout.txt is of another round than the report".into())
}

fn hangs() -> PayloadProblem {
    PayloadProblem::Unread("the bucket did not answer in time".into())
}

impl Bench {
    /// Next read, which has to be of this submission.
    pub(super) fn reads(&mut self, pk: i64) -> Arc<Outline> {
        let now = self.now();
        match self.queue.next(now, true) {
            Next::Read(found, outline) => {
                assert_eq!(found, key(pk));
                outline
            }
            other => panic!("{other:?}, expected a read of {pk}"),
        }
    }

    fn reads_nothing(&mut self) {
        let now = self.now();
        let next = self.queue.next(now, true);
        assert!(matches!(next, Next::Wait(_)), "{next:?}");
    }

    pub(super) fn found(&mut self, pk: i64, answer: Result<Payload, PayloadProblem>) {
        let now = self.now();
        self.queue
            .took_payload(&key(pk), answer.map(|payload| (payload, None)), now);
    }

    /// An end of a submission that runs.
    fn end(&mut self, pk: i64, outline: Arc<Outline>) {
        self.update(pk, 1, DesiredUpdate::Final(Outcome::Finished, outline));
    }
}

#[test]
fn the_payload_is_there_before_the_row_is_read_and_gone_after_the_write() {
    let mut bench = Bench::new();
    bench.end(7, results(43.0));
    let outline = bench.reads(7);
    // However long that takes, nothing else is held up by it.
    bench.ask(8, 1);
    bench.get(8, row(8, Status::Submitted));
    bench.wait(30.0);
    bench.reads_nothing();
    bench.found(7, Ok(stored(&outline)));
    bench.read_and_write(7, "finished");
    assert!(bench.queue.held.is_empty());
}

#[test]
fn a_payload_is_dropped_after_each_answer_and_read_again() {
    for answer in [
        Answer::Throttled(Duration::from_secs(1)),
        Answer::Refused(refusal(About::Request, 400)),
        Answer::Broken("EvalAI answered 500".into()),
    ] {
        let mut bench = Bench::new();
        bench.end(7, results(43.0));
        bench.get(7, row(7, Status::Running));
        let put = bench.expect("finished 7");
        bench.answer(&put, Reply::Written(answer));
        assert!(bench.queue.held.is_empty(), "others need the memory");
        bench.wait(600.0);
        bench.reads(7);
    }
}

#[test]
fn a_newer_update_drops_the_payload_of_the_older_one() {
    let mut bench = Bench::new();
    bench.running(7);
    bench.update(7, 1, DesiredUpdate::Partial(results(41.0)));
    let older = bench.reads(7);
    bench.update(7, 1, DesiredUpdate::Partial(results(42.0)));
    bench.found(7, Ok(stored(&older)));
    let newer = bench.reads(7);
    assert_eq!(*newer, *results(42.0));
    bench.found(7, Ok(stored(&newer)));
    bench.update(7, 1, DesiredUpdate::Final(Outcome::Finished, results(43.0)));
    assert_eq!(*bench.reads(7), *results(43.0));
}

#[test]
fn two_payloads_are_held_at_once_and_give_their_places_up_when_no_write_begins() {
    let mut bench = Bench::new();
    for (pk, score) in [(1, 41.0), (2, 42.0), (3, 43.0)] {
        bench.end(pk, results(score));
        bench.wait(0.1);
    }
    let mut gets = Vec::new();
    for pk in [1, 2] {
        let outline = bench.reads(pk);
        bench.found(pk, Ok(stored(&outline)));
        gets.push(bench.expect(&format!("submission {pk}")));
    }
    bench.reads_nothing();
    for get in &gets {
        bench.answer(get, Reply::Row(Answer::Throttled(Duration::from_mins(1))));
    }
    bench.reads_nothing();
    assert_eq!(bench.queue.held.len(), 2);
    bench.wait(15.0);
    bench.reads_nothing();
    assert!(bench.queue.held.is_empty(), "others may have the places");
    // Shortly before EvalAI may be asked again.
    bench.wait(36.0);
    bench.reads(1);
}

#[test]
fn partial_results_that_do_not_fit_are_left_out() {
    for problem in [unfit(), hangs()] {
        let mut bench = Bench::new();
        bench.running(7);
        bench.update(7, 1, DesiredUpdate::Partial(results(41.0)));
        bench.reads(7);
        bench.found(7, Err(problem));
        bench.wait(5.0);
        bench.reads_nothing();
        assert_eq!((bench.view(7).partial_done, bench.view(7).last_error), (None, None));
        bench.update(7, 1, DesiredUpdate::Partial(results(42.0)));
        bench.reads(7);
    }
}

#[test]
fn partial_results_are_sent_once_for_each_route() {
    let mut bench = Bench::new();
    bench.running(7);
    bench.update(7, 1, DesiredUpdate::Partial(results(41.0)));
    bench.read_and_write(7, "partial");
    assert_eq!(bench.view(7).partial_done, Some(41));
    bench.wait(5.0);
    // Another report with as many routes.
    bench.update(7, 1, DesiredUpdate::Partial(results(41.5)));
    bench.reads_nothing();
    // What the leaderboard does not want is not tried again either.
    bench.update(7, 1, DesiredUpdate::Partial(results(42.0)));
    let outline = bench.reads(7);
    bench.found(7, Ok(Payload::bare(&outline)));
    assert!(bench.view(7).last_error.is_some());
    bench.update(7, 1, DesiredUpdate::Partial(results(42.0)));
    bench.reads_nothing();
}

#[test]
fn an_end_whose_texts_cannot_be_read_says_so_and_is_tried_again_later_each_time() {
    let mut bench = Bench::new();
    bench.end(7, results(43.0));
    for wait in [5.0, 10.0, 20.0, 40.0, 60.0, 60.0] {
        bench.reads(7);
        bench.found(7, Err(unfit()));
        let why = bench.view(7).unread;
        assert!(why.is_some_and(|why| why.contains("another round")));
        bench.wait(wait - 0.1);
        bench.reads_nothing();
        bench.wait(0.1);
    }
    bench.read_and_write(7, "finished");
    assert_eq!(bench.view(7).unread, None);
}

#[test]
fn a_bucket_that_hangs_for_one_end_keeps_no_end_of_another_bucket_waiting() {
    let mut bench = Bench::new();
    for pk in 1..=100 {
        bench.end(pk, results_in("hangs", 1.0));
    }
    bench.end(200, results_in("answers", 2.0));
    let mut tries = 0;
    loop {
        let now = bench.now();
        match bench.queue.next(now, true) {
            Next::Read(of, outline) if of == key(200) => break bench.found(200, Ok(stored(&outline))),
            Next::Read(of, _) => {
                tries += 1;
                bench.wait(10.0);
                let now = bench.now();
                bench.queue.took_payload(&of, Err(hangs()), now);
            }
            other => panic!("{other:?}"),
        }
    }
    assert!(tries <= 2, "{tries} reads of the bucket that hangs");
    bench.read_and_write(200, "finished");
}
