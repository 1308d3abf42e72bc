//! Results of several workers by each method, and the texts of them.

use leaderboard_api::Order;
use leaderboard_api::evaluator_result::parse;
use serde_json::json;

use super::*;

fn result(done: u32, is_final: bool, splits: &Value) -> ResultFile {
    let total = if is_final { done } else { 100 };
    let document = json!({"schema": 1, "done": done, "total": total, "final": is_final, "splits": splits});
    parse(document.to_string().as_bytes()).unwrap()
}

fn one(done: u32, is_final: bool, metrics: &Value) -> ResultFile {
    result(done, is_final, &json!([{"name": "test", "metrics": metrics}]))
}

fn merged(method: MergeMethod, workers: &[ResultFile]) -> Result<Merged, MergeError> {
    let workers: Vec<Option<&ResultFile>> = workers.iter().map(Some).collect();
    merge(method, &workers)
}

/// Results of two workers and of the one that merges.
fn by_command(workers: [Option<&ResultFile>; 3]) -> Merged {
    merge(MergeMethod::Command, &workers).unwrap()
}

fn score(split: Option<&str>, metric: &str) -> ScoreMetric {
    ScoreMetric {
        split: split.map(str::to_owned),
        metric: metric.to_owned(),
        order: Order::Descending,
    }
}

fn numbers(merged: &Merged) -> Vec<(&str, &str)> {
    let all = merged.splits.iter().flat_map(|split| &split.metrics);
    all.map(|(name, number)| (name.as_str(), number.text())).collect()
}

#[test]
fn one_worker_keeps_its_digits() {
    let found =
        parse(br#"{"schema":1,"done":1,"total":1,"final":true,"splits":[{"name":"a \"b\"","metrics":{"x":0.50}}]}"#);
    let merged = merged(MergeMethod::Mean, &[found.unwrap()]).unwrap();
    let list = r#"[{"split":"a \"b\"","show_to_participant":true,"accuracies":{"x":0.50}}]"#;
    assert_eq!(merged.texts().results, list);
    assert_eq!(merged.texts().partial_results, None);
}

#[test]
fn a_mean_is_weighted_by_what_is_done_and_a_sum_adds() {
    use MergeMethod::{Mean, Sum};
    for (method, values, expected) in [
        (Mean, [(30, 1.0), (10, 0.0)], "0.75"),
        (Mean, [(10, 0.5), (30, 0.5)], "0.5"),
        (Mean, [(0, 1.0), (0, 0.0)], "0.5"),
        (Mean, [(0, 1.0), (5, 0.25)], "0.25"),
        (Mean, [(1, 1e300), (1, -1e300)], "0.0"),
        (Sum, [(30, 1.5), (10, 2.0)], "3.5"),
        (Sum, [(0, 1.0), (0, 2.0)], "3.0"),
    ] {
        let workers = values.map(|(done, value)| one(done, false, &json!({"x": value})));
        assert_eq!(
            numbers(&merged(method, &workers).unwrap()),
            [("x", expected)],
            "{method:?} {values:?}"
        );
    }
    let counts = [one(1, true, &json!({"n": 3})), one(1, true, &json!({"n": 4}))];
    assert_eq!(
        numbers(&merged(Sum, &counts).unwrap()),
        [("n", "7")],
        "whole numbers stay whole"
    );
    let most = [
        one(1, true, &json!({"n": i64::MAX})),
        one(1, true, &json!({"n": i64::MAX})),
    ];
    assert_eq!(numbers(&merged(Sum, &most).unwrap()), [("n", "1.8446744073709552e19")]);
}

#[test]
fn a_metric_that_a_final_result_lacks_cannot_be_merged_as_a_mean() {
    let (whole, lacking) = (json!({"x": 1, "y": 2}), json!({"x": 3}));
    let of = |is_final| [one(1, is_final, &lacking), one(1, is_final, &whole)];
    let error = merged(MergeMethod::Mean, &of(true)).unwrap_err();
    assert!(
        error
            .to_string()
            .starts_with("evaluator 1 has no metric y of the split test"),
        "{error}"
    );
    assert_eq!(numbers(&merged(MergeMethod::Mean, &of(false)).unwrap()), [("x", "2.0")]);
    assert_eq!(
        numbers(&merged(MergeMethod::Sum, &of(true)).unwrap()),
        [("x", "4"), ("y", "2")]
    );
    let other = result(1, true, &json!([{"name": "other", "metrics": {"x": 1}}]));
    let error = merged(MergeMethod::Mean, &[one(1, true, &json!({"x": 1})), other]).unwrap_err();
    assert!(
        error
            .to_string()
            .contains("evaluator 2 has no metric x of the split test"),
        "{error}"
    );
}

#[test]
fn numbers_and_names_stay_within_bounds() {
    let large = [one(2, true, &json!({"x": 1e308})), one(2, true, &json!({"x": 1e308}))];
    for method in [MergeMethod::Mean, MergeMethod::Sum] {
        let error = merged(method, &large).unwrap_err();
        assert!(matches!(error, MergeError::TooLarge { .. }), "{method:?}: {error}");
    }
    let splits = |from: usize| -> Value {
        (from..from + 9)
            .map(|n| json!({"name": n.to_string(), "metrics": {}}))
            .collect()
    };
    let many = [result(1, true, &splits(0)), result(1, true, &splits(9))];
    assert_eq!(merged(MergeMethod::Sum, &many), Err(MergeError::TooMany));
    let metrics = |from: usize| -> Value {
        (from..from + 20)
            .map(|n| (n.to_string(), n.into()))
            .collect::<serde_json::Map<_, _>>()
            .into()
    };
    let many = [one(1, true, &metrics(0)), one(1, true, &metrics(20))];
    assert_eq!(merged(MergeMethod::Sum, &many), Err(MergeError::TooMany));
}

#[test]
fn a_mean_lies_between_its_values_whatever_they_are() {
    let values = [0.0_f64, 0.1, 1.0 / 3.0, 0.7, 1e-9, 5.0, -2.5, 1e6];
    for (i, a) in values.iter().enumerate() {
        for (j, b) in values.iter().enumerate() {
            let (done_a, done_b) = (u32::try_from(i).unwrap() * 7, u32::try_from(j).unwrap() * 3);
            let workers = [
                one(done_a, false, &json!({"x": a})),
                one(done_b, false, &json!({"x": b})),
            ];
            let found = merged(MergeMethod::Mean, &workers).unwrap();
            let mean = found.splits[0].metric("x").unwrap().value();
            let slack = 1e-12 * a.abs().max(b.abs());
            assert!(
                (a.min(*b) - slack..=a.max(*b) + slack).contains(&mean),
                "{a} {b}: {mean}"
            );
            assert_eq!(found.done, u64::from(done_a) + u64::from(done_b));
        }
    }
}

#[test]
fn it_is_final_when_each_worker_is_and_eligible_only_if_all_are() {
    let done = one(1, true, &json!({"x": 1}));
    let under_way = one(1, false, &json!({"x": 1}));
    let rejected = ResultFile {
        eligible: false,
        ..done.clone()
    };
    for (workers, outcome, eligible) in [
        (vec![Some(&done), Some(&done)], Outcome::Finished, true),
        (vec![Some(&done), Some(&under_way)], Outcome::Running, true),
        (vec![Some(&done), None], Outcome::Running, true),
        (vec![Some(&done), Some(&rejected)], Outcome::Rejected, false),
        (vec![Some(&rejected), None], Outcome::Running, false),
    ] {
        let merged = merge(MergeMethod::Mean, &workers).unwrap();
        let summary = merged.summary(&score(None, "x"));
        assert_eq!((summary.outcome, summary.eligible), (outcome, eligible), "{workers:?}");
        assert_eq!(summary.is_complete, outcome != Outcome::Running);
        assert_eq!(merged.texts().results == NO_RESULTS, outcome == Outcome::Running);
        assert_eq!(merged.texts().partial_results.is_some(), outcome == Outcome::Running);
    }
    let nothing = merge(MergeMethod::Mean, &[None, None]).unwrap();
    assert_eq!((nothing.is_final, nothing.texts().partial_results), (false, None));
}

#[test]
fn a_command_merges_final_results_and_counts_none_of_its_own_units() {
    let first = one(3, true, &json!({"right": 1}));
    let second = one(5, true, &json!({"right": 4}));
    let under_way = one(4, false, &json!({"right": 3}));
    let last = one(1, true, &json!({"f1": 0.50}));
    let early = one(0, false, &json!({"f1": 0.25}));
    let metric = score(None, "f1");
    for (workers, done, total) in [
        ([None, None, None], 0, 0),
        ([Some(&first), None, None], 3, 3),
        ([Some(&first), Some(&under_way), None], 7, 103),
        ([Some(&first), Some(&second), None], 8, 8),
        ([Some(&first), Some(&second), Some(&early)], 8, 8),
        // It was restored, and a worker's was not.
        ([Some(&first), Some(&under_way), Some(&last)], 7, 103),
        ([Some(&first), None, Some(&last)], 3, 3),
    ] {
        let merged = by_command(workers);
        assert_eq!(
            (merged.done, merged.total, numbers(&merged)),
            (done, total, vec![]),
            "{workers:?}"
        );
        let summary = merged.summary(&metric);
        assert_eq!(
            (summary.outcome, summary.score),
            (Outcome::Running, None),
            "{workers:?}"
        );
        let texts = merged.texts();
        assert_eq!(
            (texts.results.as_str(), texts.partial_results),
            (NO_RESULTS, None),
            "{workers:?}"
        );
    }
    let merged = by_command([Some(&first), Some(&second), Some(&last)]);
    assert_eq!(
        (merged.done, merged.total, numbers(&merged)),
        (8, 8, vec![("f1", "0.5")])
    );
    let summary = merged.summary(&metric);
    assert_eq!((summary.outcome, summary.has_ended), (Outcome::Finished, true));
    assert_eq!(summary.score.map(|score| score.value).as_deref(), Some("0.5"));
    let list = r#"[{"split":"test","show_to_participant":true,"accuracies":{"f1":0.5}}]"#;
    assert_eq!(merged.texts().results, list);
    let rejected = |result: &ResultFile| ResultFile {
        eligible: false,
        ..result.clone()
    };
    for workers in [
        [Some(&rejected(&first)), Some(&second), Some(&last)],
        [Some(&first), Some(&second), Some(&rejected(&last))],
    ] {
        let summary = by_command(workers).summary(&metric);
        assert_eq!(
            (summary.outcome, summary.eligible),
            (Outcome::Rejected, false),
            "{workers:?}"
        );
    }
}

#[test]
fn a_status_shows_the_score_and_no_name_twice() {
    let names =
        |summary: &Summary| -> Vec<String> { summary.metrics.iter().map(|metric| metric.name.clone()).collect() };
    let found = one(1, true, &json!({"x": 0.5, "y": 2}));
    let summary = merged(MergeMethod::Mean, &[found]).unwrap().summary(&score(None, "y"));
    assert_eq!(
        summary.score,
        Some(Metric {
            name: "y".into(),
            value: "2".into()
        })
    );
    assert_eq!(names(&summary), ["x"]);

    let splits = json!([{"name": "a", "metrics": {"x": 1, "b_x": 2}}, {"name": "a_b", "metrics": {"x": 3}}, {"name": "s".repeat(64), "metrics": {"x": 4}}]);
    let found = merged(MergeMethod::Mean, &[result(1, true, &splits)]).unwrap();
    let summary = found.summary(&score(Some("a_b"), "x"));
    assert_eq!(summary.score.clone().map(|score| score.value).as_deref(), Some("3"));
    assert_eq!(
        names(&summary),
        ["a_x"],
        "the score's split comes first, and a name that is too long is left out"
    );
    assert_eq!(found.summary(&score(Some("a"), "z")).score, None);
}

#[test]
fn a_participant_reads_numbers_and_messages() {
    let first = one(2, true, &json!({"x": 0.5}));
    let second = ResultFile {
        message: Some("Episode 4 of 100 has begun.".into()),
        ..one(3, false, &json!({"x": 0.5}))
    };
    let workers = [Some(&first), Some(&second)];
    let text = merge(MergeMethod::Mean, &workers).unwrap().stdout(None, &workers);
    let expected = "Here is a summary of the submission's current results\n\n- Completed 5 of 102 units\n- test:\n  - x: 0.5\n\
                    - Evaluator 2: Episode 4 of 100 has begun.\n";
    assert_eq!(text, expected);
    let last = ResultFile {
        message: Some("The workers agree.".into()),
        ..one(1, true, &json!({"f1": 1}))
    };
    let workers = [Some(&first), Some(&second), Some(&last)];
    let text = by_command(workers).stdout(Some(3), &workers);
    let expected = "Here is a summary of the submission's current results\n\n- Completed 5 of 102 units\n\
                    - Evaluator 2: Episode 4 of 100 has begun.\n- Merge: The workers agree.\n";
    assert_eq!(text, expected);
}
