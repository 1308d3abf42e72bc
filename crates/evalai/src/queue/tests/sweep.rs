//! Sweeps of a phase: their answers and finds.

use super::*;
use crate::row::Challenge;
use crate::types::Swept;

#[test]
fn the_sweep_answers_all_submissions_that_wait_to_hear_whether_they_may_run() {
    let mut bench = Bench::new();
    bench.serve();
    for pk in 1..=100 {
        bench.ask(pk, 1);
    }
    let rows = (1..=99).map(|pk| row(pk, Status::Submitted)).collect();
    bench.list("sweep of submitted", rows);
    assert!((1..=99).all(|pk| bench.view(pk).answered == Some(Attempt(1))));
    bench.list("sweep of resuming", vec![]);
    let ticket = bench.expect("phases");
    bench.answer(&ticket, Reply::Phases(Answer::Refused(refusal(About::Request, 401))));
    bench.get(100, row(100, Status::Resuming));
    bench.expect_nothing();
}

#[test]
fn the_sweep_hands_out_what_was_lost_and_nothing_else() {
    let mut bench = Bench::new();
    bench.serve();
    bench.ask(7, 1);
    let at = |pk, seconds| Row {
        submitted_at: Some(wall(seconds)),
        ..row(pk, Status::Submitted)
    };
    let resumed = Row {
        status: Status::Resuming,
        resumed_at: Some(wall(-200)),
        ..at(5, -1_000_000)
    };
    // Known, lost, too young, from before the Leaderboard.
    bench.list(
        "sweep of submitted",
        vec![at(7, -1000), at(1, -1000), at(2, -30), at(3, -7200)],
    );
    let ticket = bench.list("sweep of resuming", vec![resumed]);
    assert!(matches!(ticket.request, Request::List { after, .. } if after < wall(-100 * 86_400)));
    let swept: Vec<_> = bench
        .queue
        .take_sweep()
        .into_iter()
        .map(|row| (row.server, row.submission, row.kind, row.time))
        .collect();
    let server = target().api_server;
    assert_eq!(
        swept,
        [
            (server.clone(), 1, Swept::New, wall(-1000)),
            (server, 5, Swept::Resuming, wall(-200))
        ]
    );
    let mut again = 0;
    for _ in 0..11 {
        bench.wait(60.0);
        while let Some((name, ticket)) = bench.next() {
            let rows = if name == "sweep of submitted" {
                vec![at(1, -1000)]
            } else {
                vec![]
            };
            match ticket.request {
                Request::Phases(_) => bench.answer(&ticket, Reply::Phases(Answer::Done(vec![]))),
                Request::Splits(_) => bench.answer(&ticket, Reply::Splits(Answer::Done(vec![]))),
                _ => bench.answer(&ticket, Reply::Rows(Answer::Done(rows))),
            }
        }
        again += bench.queue.take_sweep().len();
    }
    assert_eq!(again, 1, "once more after ten minutes");
}

#[test]
fn the_sweep_says_of_a_row_whether_its_challenge_has_static_code_uploads_and_waits_for_that_where_files_are_taken() {
    let old = || Row {
        submitted_at: Some(wall(-1000)),
        ..row(1, Status::Submitted)
    };
    for (takes_files, is_static, expected) in [
        (true, true, [None, Some(true)]),
        (true, false, [None, Some(false)]),
        (false, true, [Some(false), None]),
    ] {
        let mut bench = Bench::new();
        let board = Target {
            takes_files,
            ..target()
        };
        let now = bench.now();
        bench.queue.serve(&key(100), &board, now);
        let swept = |bench: &mut Bench| {
            bench.list("sweep of submitted", vec![old()]);
            bench.list("sweep of resuming", vec![]);
            let rows = bench.queue.take_sweep();
            rows.first().map(|row| row.is_static_code_upload)
        };
        let first = swept(&mut bench);
        let ticket = bench.expect("phases");
        bench.answer(&ticket, Reply::Phases(Answer::Done(vec![])));
        let ticket = bench.expect("splits");
        bench.answer(&ticket, Reply::Splits(Answer::Done(vec![])));
        if takes_files {
            let settings = Challenge {
                is_static,
                ..Challenge::default()
            };
            let ticket = bench.expect("challenge");
            bench.answer(&ticket, Reply::Challenge(Answer::Done(settings)));
        }
        bench.wait(60.0);
        assert_eq!([first, swept(&mut bench)], expected, "{takes_files} {is_static}");
    }
}

#[test]
fn the_sweep_takes_of_each_phase_what_came_after_its_own_leaderboard() {
    let mut bench = Bench::new();
    bench.serve();
    let younger = Target {
        phases: [2].into(),
        since: wall(-1800),
        ..target()
    };
    let now = bench.now();
    bench.queue.serve(&key(90), &younger, now);
    let at = |pk, phase, seconds| Row {
        phase: Some(phase),
        submitted_at: Some(wall(seconds)),
        ..row(pk, Status::Submitted)
    };
    // The second came when only the first Leaderboard was there: whatever served its phase then still works on it.
    let rows = vec![at(1, 1, -2000), at(2, 2, -2000), at(3, 2, -1000), at(4, 3, -1000)];
    bench.list("sweep of submitted", rows);
    let swept: Vec<_> = bench.queue.take_sweep().into_iter().map(|row| row.submission).collect();
    assert_eq!(swept, [1, 3]);
}

#[test]
fn a_swept_row_that_was_run_before_differs_from_a_lost_rerun() {
    let edited = |pk| Row {
        submitted_at: Some(wall(-1000)),
        resumed_at: Some(wall(-200)),
        completed_at: Some(wall(-500)),
        ..row(pk, Status::Submitted)
    };
    let with = |row: Row, jobs: &[&str]| Row {
        jobs: jobs.iter().map(|&job| job.to_owned()).collect(),
        ..row
    };
    let rows = vec![
        with(edited(1), &["submission-1-1"]),
        with(edited(2), &["submission-1-1"]),
        with(edited(3), &["submission-1-1", "submission-3-1"]),
        edited(4),
        Row {
            completed_at: None,
            ..edited(5)
        },
        Row {
            resumed_at: None,
            ..edited(6)
        },
        // From before the Leaderboard.
        Row {
            submitted_at: Some(wall(-7200)),
            ..with(edited(7), &["submission-1-1"])
        },
        with(edited(11), &["submission-1-1"]),
    ];
    let mut bench = Bench::new();
    bench.serve();
    bench.list("sweep of submitted", rows);
    let swept = bench.queue.take_sweep();
    let kinds: Vec<_> = swept.into_iter().map(|row| (row.submission, row.kind)).collect();
    let (edited, rerun) = (Swept::Edited, Swept::Rerun);
    assert_eq!(
        kinds,
        [
            (1, edited),
            (2, rerun),
            (3, edited),
            (4, edited),
            (5, rerun),
            (6, edited),
            (7, edited),
            (11, rerun)
        ]
    );
}
