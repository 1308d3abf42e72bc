//! Rounds of a run whose results a command merges: it is the third worker, after two evaluators.

use leaderboard_api::{EvaluationMode, WorkerState};
use leaderboard_contract::report::Outcome;
use leaderboard_protocol::files::{Mark, Side};

use super::tests::{Volume, text};
use super::*;
use crate::fixtures::{merging_run, put_result, put_status, result};

/// Final, without the metric of the score.
const COUNTS: &str = r#"{"schema":1,"done":4,"total":4,"final":true,"splits":[{"name":"test","metrics":{"right":3}}]}"#;
const REFUSAL: &str = r#"{"schema":1,"done":0,"total":1,"final":false,"splits":[],"refused":"Two rows differ."}"#;

/// A run whose evaluators are done.
fn evaluated(mode: EvaluationMode) -> Volume {
    let volume = Volume::of(&merging_run(mode));
    for worker in [1, 2] {
        put_result(volume.path(), worker, COUNTS);
    }
    volume.done(&[1, 2]);
    volume
}

#[test]
fn the_result_of_the_command_is_that_of_the_run() {
    for mode in [
        EvaluationMode::Interactive,
        EvaluationMode::Batch,
        EvaluationMode::Predictions,
    ] {
        let mut volume = evaluated(mode);
        let (gathered, seen) = volume.round();
        assert!(
            !gathered.is_complete() && seen.spoiled.is_none() && !seen.all_done,
            "{mode:?}"
        );
        assert_eq!(
            gathered.merged.as_ref().map(|merged| (merged.done, merged.outcome)),
            Some((8, Outcome::Running))
        );
        assert_eq!(
            (text(&gathered, RESULTS), &gathered.texts.partial_results),
            ("[]", &None),
            "{mode:?}"
        );
        let last = gathered.workers.last().unwrap();
        assert_eq!(
            (last.id, last.total, last.state),
            (3, 0, WorkerState::Waiting),
            "{mode:?}"
        );
        assert_eq!(gathered.seen[2].agent, None, "{mode:?}");

        put_status(volume.path(), Side::Host(HOST), 3, Mark::Start(0));
        put_result(volume.path(), 3, &result(1, 1, 0.5));
        let (gathered, seen) = volume.round();
        assert!(gathered.is_complete() && seen.complete.is_some(), "{mode:?}");
        let merged = gathered.merged.as_ref().unwrap();
        assert_eq!(
            merged.score.as_ref().map(|score| score.value.as_str()),
            Some("0.5"),
            "{mode:?}"
        );
        assert_eq!((merged.done, merged.outcome), (8, Outcome::Finished), "{mode:?}");
        assert_eq!(gathered.workers[2].state, WorkerState::Running, "{mode:?}");
        volume.done(&[3]);
        assert!(volume.round().1.all_done, "{mode:?}");
    }
}

#[test]
fn one_refusal_refuses_all_and_a_result_without_the_score_is_unusable() {
    for (worker, refusal) in [(1, REFUSAL), (3, REFUSAL), (3, COUNTS)] {
        let mut volume = evaluated(EvaluationMode::Batch);
        put_result(volume.path(), worker.into(), refusal);
        volume.done(&[worker]);
        let (gathered, seen) = volume.round();
        let (Some((Ending::Invalid(why) | Ending::Unusable(why), _)), false) = (seen.spoiled, gathered.is_complete())
        else {
            panic!("{worker} {refusal}: {gathered:?}")
        };
        assert_eq!(why.worker, Some(worker.into()), "{refusal}");
        assert_eq!(
            gathered.first_refused().is_some(),
            refusal == REFUSAL,
            "{worker} {refusal}"
        );
    }
    let mut volume = evaluated(EvaluationMode::Batch);
    volume.done(&[3]);
    let Some((Ending::Unusable(why), _)) = volume.round().1.spoiled else {
        panic!("it ended without a result")
    };
    assert!(why.why.starts_with("evaluator 3 ended without a final result"), "{why}");
}
