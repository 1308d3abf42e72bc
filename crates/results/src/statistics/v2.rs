//! The global record of Leaderboard 2.0 and later: rounded, and computed over the records in the order of the merged file.

use super::{Exception, Global, deviations, totals};
use crate::checkpoint::{Record, Scores};
use crate::json::Value;
use crate::names::{self, OFF_ROAD, Score};
use crate::number::{Number, count, round};
use crate::{Format, Refusal};

const SCORE_DIGITS: usize = 6;
const DIGITS: usize = 3;
/// Least length of a drive, in kilometers: a shorter one counts as this long, or the rates would have no value.
const LEAST_KILOMETERS: f64 = 0.001;

/// `records`: in the order of the merged file.
pub(crate) fn global(records: &[&Record]) -> Result<Global, Refusal> {
    let means = Scores::each(|score| Number::Float(mean(records, score)));
    let (status, exceptions) = outcome(records);
    Ok(Global {
        format: Format::V2,
        status,
        infractions: infractions(records),
        means,
        deviations: deviations(records, means, |x| round(x, DIGITS))?,
        totals: totals(records),
        exceptions,
    })
}

/// Divided before it is added: the last digits depend on it.
fn mean(records: &[&Record], score: Score) -> f64 {
    let total = count(records.len());
    let sum = records
        .iter()
        .fold(0.0, |sum, record| sum + record.scores.get(score).as_f64() / total);
    round(sum, SCORE_DIGITS)
}

/// `Perfect`, `Completed` or `Failed`, whichever is worst; an unknown first text that is not `Perfect` stays as it is.
fn outcome(records: &[&Record]) -> (String, Vec<Exception>) {
    let mut status = names::PERFECT;
    let mut exceptions = Vec::new();
    for (index, record) in (0..).map(Value::Int).zip(records) {
        if record.status.contains(names::FAILED) {
            status = names::FAILED;
            exceptions.push(Exception::of(record, index));
        } else if status == names::PERFECT {
            status = &record.status;
        }
    }
    (status.to_owned(), exceptions)
}

/// Rates per kilometer driven; for driving off the road the kilometers themselves.
fn infractions(records: &[&Record]) -> Vec<Number> {
    let driven = records.iter().fold(0.0, |sum, record| {
        sum + record.meta.length.as_f64() / 1000.0 * record.scores.route.as_f64() / 100.0
    });
    // Not f64::max: NaN has to stay NaN.
    let kilometers = if driven < LEAST_KILOMETERS {
        LEAST_KILOMETERS
    } else {
        driven
    };
    let value = |(place, key): (usize, &&str)| {
        let exact = if *key == OFF_ROAD {
            records.iter().fold(0.0, |sum, record| sum + record.off_road / 1000.0)
        } else {
            let found: usize = records.iter().filter_map(|record| record.counts.get(place)).sum();
            count(found) / kilometers
        };
        Number::Float(round(exact, DIGITS))
    };
    names::infractions(Format::V2).iter().enumerate().map(value).collect()
}
