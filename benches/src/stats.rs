//! The arithmetic of the figures: medians, ranges, percentiles and ratios. Pure.

use serde::{Deserialize, Serialize};

/// A figure of several runs.
#[derive(Serialize, Deserialize, Clone, Debug, PartialEq)]
pub struct Summary {
    /// Median of the runs.
    pub median: f64,
    /// Smallest run.
    pub low: f64,
    /// Largest run.
    pub high: f64,
    /// Every run, in the order in which they were made.
    pub runs: Vec<f64>,
}

impl Summary {
    /// `None` without a run.
    pub fn of(runs: &[f64]) -> Option<Self> {
        let sorted = sorted(runs);
        Some(Self {
            median: middle(&sorted)?,
            low: *sorted.first()?,
            high: *sorted.last()?,
            runs: runs.to_vec(),
        })
    }
}

/// The smallest value that at least `percent` of all values do not exceed; `None` without a value.
pub fn percentile(values: &[f64], percent: f64) -> Option<f64> {
    let sorted = sorted(values);
    #[allow(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "a rank is small and positive"
    )]
    let rank = (sorted.len() as f64 * percent / 100.0).ceil() as usize;
    sorted.get(rank.max(1) - 1).copied()
}

/// Each of the first values divided by its neighbor of the second.
pub fn ratios(of: &[f64], to: &[f64]) -> Vec<f64> {
    let pairs = of.iter().zip(to).filter(|(_, to)| **to > 0.0);
    pairs.map(|(of, to)| of / to).collect()
}

fn sorted(values: &[f64]) -> Vec<f64> {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted
}

fn middle(sorted: &[f64]) -> Option<f64> {
    let upper = sorted.get(sorted.len() / 2)?;
    let lower = sorted.get((sorted.len() - 1) / 2)?;
    Some(f64::midpoint(*lower, *upper))
}

/// Three digits are more than the noise leaves.
pub fn number(value: f64) -> String {
    match value.abs() {
        size if size >= 100.0 => format!("{value:.0}"),
        size if size >= 10.0 => format!("{value:.1}"),
        _ => format!("{value:.2}"),
    }
}

#[cfg(test)]
#[allow(clippy::float_cmp, reason = "the expected numbers are exact")]
mod tests {
    use super::*;

    #[test]
    fn a_percentile_is_one_of_the_values() {
        let values: Vec<f64> = (1..=200).rev().map(f64::from).collect();
        for (percent, expected) in [(0.0, 1.0), (50.0, 100.0), (99.0, 198.0), (99.6, 200.0), (100.0, 200.0)] {
            assert_eq!(percentile(&values, percent), Some(expected), "{percent}");
        }
        assert_eq!(percentile(&[7.0], 99.0), Some(7.0));
        assert_eq!(percentile(&[], 50.0), None);
    }

    #[test]
    fn a_summary_has_the_median_and_the_range() {
        for (runs, median) in [
            (vec![3.0], 3.0),
            (vec![5.0, 1.0], 3.0),
            (vec![9.0, 1.0, 2.0], 2.0),
            (vec![4.0, 1.0, 9.0, 2.0], 3.0),
        ] {
            let summary = Summary::of(&runs).unwrap();
            assert_eq!(summary.median, median, "{runs:?}");
            assert_eq!(summary.runs, runs);
            assert!(runs.iter().all(|run| summary.low <= *run && *run <= summary.high));
        }
        assert_eq!(Summary::of(&[]), None);
    }

    #[test]
    fn only_neighbors_are_compared() {
        assert_eq!(ratios(&[1.0, 6.0], &[2.0, 3.0]), [0.5, 2.0]);
        assert_eq!(ratios(&[1.0, 6.0, 9.0], &[0.0, 3.0]), [2.0]);
    }

    #[test]
    fn numbers_have_three_digits() {
        for (value, text) in [(1234.5, "1234"), (12.34, "12.3"), (0.126, "0.13"), (0.0, "0.00")] {
            assert_eq!(number(value), text);
        }
    }
}
