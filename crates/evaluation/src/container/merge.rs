//! The results of all workers as one, and the texts that EvalAI and people get of it. Pure.

use std::collections::BTreeSet;
use std::fmt::Write as _;

use leaderboard_api::evaluator_result::{MAX_SPLITS, Number, ResultFile, Split};
use leaderboard_api::{MAX_METRICS, MergeMethod, Metric, ScoreMetric};
use leaderboard_contract::report::Outcome;
use serde_json::Value;

use crate::{Summary, Texts};

/// The results so far as one.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Merged {
    done: u64,
    total: u64,
    /// Each worker has a final result.
    is_final: bool,
    eligible: bool,
    splits: Vec<Split>,
}

/// Why results cannot be merged.
#[derive(thiserror::Error, Clone, Debug, PartialEq, Eq)]
pub(super) enum MergeError {
    #[error(
        "evaluator {worker} has no metric {metric} of the split {split}, which another one has. With merge Mean each worker writes all \
         metrics."
    )]
    Lacking {
        worker: usize,
        split: String,
        metric: String,
    },
    #[error("the metric {metric} of the split {split} is too large in all workers together. Write smaller numbers.")]
    TooLarge { split: String, metric: String },
    #[error(
        "all workers together have more than {MAX_SPLITS} splits, or {MAX_METRICS} metrics of one. Write those that the leaderboard shows."
    )]
    TooMany,
}

/// Merges the results of workers in their order, of which each may have none yet.
pub(super) fn merge(method: MergeMethod, workers: &[Option<&ResultFile>]) -> Result<Merged, MergeError> {
    let known: Vec<(usize, &ResultFile)> = (1..)
        .zip(workers)
        .filter_map(|(id, result)| Some((id, (*result)?)))
        .collect();
    let results = || known.iter().map(|(_, result)| *result);
    let is_final = known.len() == workers.len() && results().all(|result| result.is_final);
    Ok(Merged {
        done: results()
            .map(|result| u64::from(result.done))
            .fold(0, u64::saturating_add),
        total: results()
            .map(|result| u64::from(result.total))
            .fold(0, u64::saturating_add),
        is_final,
        eligible: results().all(|result| result.eligible),
        splits: match known.as_slice() {
            [(_, only)] => only.splits.clone(),
            _ => splits(method, &known, is_final)?,
        },
    })
}

fn splits(method: MergeMethod, known: &[(usize, &ResultFile)], is_final: bool) -> Result<Vec<Split>, MergeError> {
    let names = distinct(
        known
            .iter()
            .flat_map(|(_, result)| result.splits.iter().map(|split| split.name.as_str())),
    );
    if names.len() > MAX_SPLITS {
        return Err(MergeError::TooMany);
    }
    let splits = names.into_iter().map(|name| {
        let of_workers = known.iter().map(|(id, result)| (*id, result.done, result.split(name)));
        let of_workers: Vec<_> = of_workers.collect();
        Ok(Split {
            name: name.to_owned(),
            metrics: metrics(method, name, &of_workers, is_final)?,
        })
    });
    splits.collect()
}

/// The metrics of one split of several workers, each with its number, the units that it has done, and its own split.
fn metrics(
    method: MergeMethod,
    split: &str,
    workers: &[(usize, u32, Option<&Split>)],
    is_final: bool,
) -> Result<Vec<(String, Number)>, MergeError> {
    let all = workers
        .iter()
        .filter_map(|(_, _, own)| *own)
        .flat_map(|own| &own.metrics);
    let names = distinct(all.map(|(name, _)| name.as_str()));
    if names.len() > MAX_METRICS {
        return Err(MergeError::TooMany);
    }
    let mut merged = Vec::new();
    for name in names {
        let numbers = workers
            .iter()
            .map(|(id, done, own)| (*id, *done, own.and_then(|own| own.metric(name))));
        let lacking = numbers.clone().find(|(_, _, number)| number.is_none());
        let values: Vec<(u32, &Number)> = numbers.filter_map(|(_, done, number)| Some((done, number?))).collect();
        let (split, metric) = (split.to_owned(), name.to_owned());
        let number = match (method, lacking) {
            (MergeMethod::Mean, Some((worker, ..))) if is_final => {
                return Err(MergeError::Lacking { worker, split, metric });
            }
            // The worker has not come so far.
            (MergeMethod::Mean, Some(_)) => continue,
            (MergeMethod::Mean, None) => Number::new(mean(&values)),
            (MergeMethod::Sum, _) => sum(&values),
        };
        match number {
            Some(number) => merged.push((metric, number)),
            None => return Err(MergeError::TooLarge { split, metric }),
        }
    }
    Ok(merged)
}

/// Names in the order of their first appearance.
fn distinct<'a>(names: impl Iterator<Item = &'a str>) -> Vec<&'a str> {
    let mut known = BTreeSet::new();
    names.filter(|name| known.insert(*name)).collect()
}

/// The mean over all units; over the workers where none has done a unit.
fn mean(values: &[(u32, &Number)]) -> f64 {
    let has_units = values.iter().any(|(done, _)| *done > 0);
    let weight = |done: u32| if has_units { f64::from(done) } else { 1.0 };
    let sum: f64 = values.iter().map(|(done, number)| weight(*done) * number.value()).sum();
    let weights: f64 = values.iter().map(|(done, _)| weight(*done)).sum();
    sum / weights
}

/// The sum, of whole numbers as one.
fn sum(values: &[(u32, &Number)]) -> Option<Number> {
    let mut whole = values.iter().map(|(_, number)| number.text().parse::<i64>().ok());
    match whole.try_fold(0_i64, |sum, number| sum.checked_add(number?)) {
        Some(sum) => Number::read(&sum.to_string()),
        None => Number::new(values.iter().map(|(_, number)| number.value()).sum()),
    }
}

impl Merged {
    /// The results in numbers, by the score of the track.
    pub(super) fn summary(&self, score: &ScoreMetric) -> Summary {
        let (is_score, others): (Vec<Metric>, Vec<Metric>) = self
            .shown(score)
            .into_iter()
            .partition(|metric| metric.name == score.name());
        Summary {
            done: clamp(self.done),
            score: is_score.into_iter().next(),
            metrics: others.into_iter().take(MAX_METRICS).collect(),
            is_complete: self.is_final,
            has_ended: self.is_final,
            eligible: self.eligible,
            outcome: match (self.is_final, self.eligible) {
                (false, _) => Outcome::Running,
                (true, true) => Outcome::Finished,
                (true, false) => Outcome::Rejected,
            },
            warnings: Vec::new(),
        }
    }

    /// All metrics under the names that a status has for them, as far as it can: those of the score's split first, none twice.
    fn shown(&self, score: &ScoreMetric) -> Vec<Metric> {
        let is_first = |split: &&Split| score.split.as_deref() == Some(&split.name);
        let (first, rest): (Vec<&Split>, Vec<&Split>) = self.splits.iter().partition(is_first);
        let all = first.into_iter().chain(rest).flat_map(|split| {
            split.metrics.iter().map(|(name, number)| Metric {
                name: score.name_of(&split.name, name),
                value: number.text().to_owned(),
            })
        });
        let mut names = BTreeSet::new();
        all.filter(|metric| metric.is_plausible() && names.insert(metric.name.clone()))
            .collect()
    }

    /// EvalAI's texts, with an empty list in place of results that are not final.
    pub(super) fn texts(&self) -> Texts {
        let list = list(&self.splits);
        if self.is_final {
            return Texts {
                results: list,
                partial_results: None,
            };
        }
        Texts {
            results: NO_RESULTS.to_owned(),
            partial_results: (!self.splits.is_empty()).then_some(list),
        }
    }

    /// The summary that a participant reads, with the messages of these workers.
    pub(super) fn stdout(&self, workers: &[Option<&ResultFile>]) -> String {
        if workers.iter().all(Option::is_none) {
            return NOTHING_YET.to_owned();
        }
        let current = if self.is_final { "" } else { "current " };
        let (done, total) = (self.done, self.total);
        let mut out =
            format!("Here is a summary of the submission's {current}results\n\n- Completed {done} of {total} units\n");
        for split in &self.splits {
            // Writing to a String does not fail.
            let _ = writeln!(out, "- {}:", split.name);
            for (name, number) in &split.metrics {
                let _ = writeln!(out, "  - {name}: {}", number.text());
            }
        }
        for (id, worker) in (1..).zip(workers) {
            if let Some(message) = worker.and_then(|worker| worker.message.as_ref()) {
                let _ = writeln!(out, "- Evaluator {id}: {message}");
            }
        }
        out
    }
}

/// EvalAI's list of splits without one.
const NO_RESULTS: &str = "[]";
/// Summary before the first result.
pub(super) const NOTHING_YET: &str = "The submission is about to be evaluated. Its results will be found here.\n";

/// EvalAI's list of splits. Numbers keep their digits.
fn list(splits: &[Split]) -> String {
    let entries = splits.iter().map(|split| {
        let numbers = split
            .metrics
            .iter()
            .map(|(name, number)| format!("{}:{}", quoted(name), number.text()));
        let accuracies: Vec<String> = numbers.collect();
        format!(
            r#"{{"split":{},"show_to_participant":true,"accuracies":{{{}}}}}"#,
            quoted(&split.name),
            accuracies.join(",")
        )
    });
    format!("[{}]", entries.collect::<Vec<_>>().join(","))
}

fn quoted(text: &str) -> String {
    Value::from(text).to_string()
}

fn clamp(units: u64) -> u32 {
    u32::try_from(units).unwrap_or(u32::MAX)
}

#[cfg(test)]
mod tests {
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
        let found = parse(
            br#"{"schema":1,"done":1,"total":1,"final":true,"splits":[{"name":"a \"b\"","metrics":{"x":0.50}}]}"#,
        );
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
        let text = merge(MergeMethod::Mean, &workers).unwrap().stdout(&workers);
        let expected = "Here is a summary of the submission's current results\n\n- Completed 5 of 102 units\n- test:\n  - x: 0.5\n\
                        - Evaluator 2: Episode 4 of 100 has begun.\n";
        assert_eq!(text, expected);
    }
}
