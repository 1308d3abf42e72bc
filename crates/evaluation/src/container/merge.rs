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
    let is_final = workers
        .iter()
        .all(|result| result.is_some_and(|result| result.is_final));
    let (sharing, of_command) = match (method, workers) {
        (MergeMethod::Command, [sharing @ .., last]) => (sharing, *last),
        _ => (workers, None),
    };
    let known: Vec<(usize, &ResultFile)> = (1..)
        .zip(sharing)
        .filter_map(|(id, result)| Some((id, (*result)?)))
        .collect();
    let results = || known.iter().map(|(_, result)| *result);
    Ok(Merged {
        done: results()
            .map(|result| u64::from(result.done))
            .fold(0, u64::saturating_add),
        total: results()
            .map(|result| u64::from(result.total))
            .fold(0, u64::saturating_add),
        is_final,
        eligible: workers.iter().flatten().all(|result| result.eligible),
        splits: match (method, known.as_slice()) {
            (MergeMethod::Command, _) => {
                let result = of_command.filter(|_| is_final);
                result.map(|result| result.splits.clone()).unwrap_or_default()
            }
            (_, [(_, only)]) => only.splits.clone(),
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
            _ => sum(&values),
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

    /// The summary that a participant reads, with the messages of these workers, of which one may merge.
    pub(super) fn stdout(&self, merger: Option<usize>, workers: &[Option<&ResultFile>]) -> String {
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
                let whose = if merger == Some(id) {
                    "Merge".to_owned()
                } else {
                    format!("Evaluator {id}")
                };
                let _ = writeln!(out, "- {whose}: {message}");
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
mod tests;
