//! How a run ends: what counts, what is final, and what the evaluator is going to repeat.
#![allow(clippy::unwrap_used, reason = "the helpers of a test may fail it")]

mod common;

use common::{Drive, finished, merged, pod};
use leaderboard_results::{Format, Outcome, Plan, Strictness, render};
use serde_json::{Value, json};

const V1: Format = Format::V1;
const V2: Format = Format::V2;

fn perfect(format: Format, ids: std::ops::RangeInclusive<u32>) -> Value {
    finished(format, &ids.map(Drive::perfect).collect::<Vec<_>>())
}

#[test]
fn results_that_do_not_count_show_why() {
    let run = |format, status: &str, sensors: bool| {
        let plan = pod(format, 1, &[(0, 1)]);
        let mut worker = finished(format, &[Drive::perfect(0), Drive::perfect(1).status(status)]);
        if !sensors {
            worker["sensors"] = json!([]);
        }
        let result = merged(&plan, &[Some(worker)]).unwrap();
        assert!(result.is_final);
        (result.entry_status, result.eligible, result.outcome)
    };
    let crash = "Failed - Simulation crashed";
    let wrong = "Failed - Agent's sensors were invalid";
    assert_eq!(run(V2, crash, true), ("Crashed".to_owned(), false, Outcome::Crashed));
    assert_eq!(run(V2, wrong, true), ("Rejected".to_owned(), false, Outcome::Rejected));
    assert_eq!(
        run(V2, "Started", true),
        ("Invalid".to_owned(), false, Outcome::Invalid)
    );
    assert_eq!(run(V2, wrong, false), ("Invalid".to_owned(), false, Outcome::Invalid));
    assert_eq!(
        run(V2, "Failed - Agent crashed", true),
        ("Finished".to_owned(), true, Outcome::Finished)
    );
    assert_eq!(run(V1, crash, true), ("Finished".to_owned(), false, Outcome::Crashed));
    assert_eq!(
        run(V1, wrong, true),
        ("Finished with agent errors".to_owned(), false, Outcome::Rejected)
    );
    for outcome in [Outcome::Crashed, Outcome::Rejected, Outcome::Invalid] {
        assert!(outcome.why_not().is_some_and(|sentence| sentence.ends_with('.')));
    }
    assert_eq!(Outcome::Finished.why_not(), None);
}

/// The file an evaluator leaves when its simulator crashes in its last route: no route is missing, and that one is repeated.
fn crashed_at_the_end(format: Format) -> Value {
    let mut worker = finished(
        format,
        &[
            Drive::perfect(0),
            Drive::perfect(1).status("Failed - Simulation crashed"),
        ],
    );
    worker["entry_status"] = json!("Crashed");
    worker
}

#[test]
fn a_crashed_last_route_is_not_finished_in_a_pod() {
    for format in [V1, V2] {
        let plan = pod(format, 1, &[(0, 1), (2, 4)]);
        let worker = crashed_at_the_end(format);
        let files = [Some(worker.clone()), Some(perfect(format, 2..=4))];
        let result = merged(&plan, &files).unwrap();
        assert_eq!((result.is_final, result.eligible, result.score), (false, false, None));
        assert_eq!((result.done, result.total, result.outcome), (4, 5, Outcome::Running));
        assert_eq!((result.pairs[0].done, result.pairs[1].done), (1, 3));
        assert!(
            render(&plan, Some(&result))
                .unwrap()
                .stdout_txt
                .contains("- Completed 4 out of the 5 routes\n")
        );
        assert!(result.text.contains("Failed - Simulation crashed"), "people can see it");

        let repeated = [Some(perfect(format, 0..=1)), files[1].clone()];
        let result = merged(&plan, &repeated).unwrap();
        assert_eq!((result.is_final, result.outcome), (true, Outcome::Finished));

        // The files that are read later are the last of every worker.
        let later = Plan {
            strictness: Strictness::Offline,
            ..plan.clone()
        };
        let result = merged(&later, &files).unwrap();
        assert_eq!((result.is_final, result.outcome), (true, Outcome::Crashed));
        assert_eq!(result.ended_as(), "Crashed");
        let original = Plan {
            as_original: true,
            ..plan.clone()
        };
        assert!(merged(&original, &files).unwrap().is_final);

        // An evaluator that came to its end repeats nothing, whatever it calls it.
        let mut ended = worker;
        ended["_checkpoint"]["global_record"] = json!({"index": -1});
        let result = merged(&plan, &[Some(ended), files[1].clone()]).unwrap();
        assert_eq!((result.is_final, result.outcome), (true, Outcome::Crashed));
        assert_eq!(
            result.pairs.iter().map(|pair| pair.ended).collect::<Vec<_>>(),
            [true, false]
        );
    }
}

#[test]
fn v1_has_words_for_runs_that_do_not_count() {
    let plan = pod(V1, 1, &[(0, 0)]);
    for (status, word) in [
        ("Failed - Simulation crashed", "Crashed"),
        ("Failed - Agent's sensors were invalid", "Rejected"),
        ("Failed - Agent crashed", "Finished with agent errors"),
        ("Completed", "Finished"),
    ] {
        let result = merged(&plan, &[Some(finished(V1, &[Drive::perfect(0).status(status)]))]).unwrap();
        assert_eq!(result.ended_as(), word);
        let original = Plan {
            as_original: true,
            ..plan.clone()
        };
        assert!(
            merged(&original, &[Some(finished(V1, &[Drive::perfect(0).status(status)]))])
                .unwrap()
                .eligible
        );
    }
}
