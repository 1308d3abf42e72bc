//! The global record of Leaderboard 1.0: unrounded, and computed over the records in the order of the workers' files.

use super::{Exception, Global, deviations, refused, totals};
use crate::checkpoint::{Record, Scores};
use crate::json::Value;
use crate::names;
use crate::number::{Number, count};
use crate::{Format, Refusal};

/// `unsorted`: all records in the order of the files; `merged`: the same in the order of the merged file.
///
/// The original calls every run `Failed` and lists every route as an exception, because it compares the identity of the
/// status text; `as_original` does so too.
pub(crate) fn global(unsorted: &[&Record], merged: &[&Record], as_original: bool) -> Result<Global, Refusal> {
    let total = count(unsorted.len());
    let means = Scores::each(|score| {
        let scores = unsorted.iter().map(|record| record.scores.get(score));
        Number::Float(scores.fold(Number::ZERO, Number::plus).as_f64() / total)
    });
    let deviations = deviations(unsorted, means, std::convert::identity)?;
    let exceptions = if as_original {
        every_route(unsorted)
    } else {
        failed_routes(merged)
    };
    let status = if exceptions.is_empty() {
        names::COMPLETED
    } else {
        names::FAILED
    };
    Ok(Global {
        format: Format::V1,
        status: status.to_owned(),
        infractions: infractions(unsorted)?,
        means,
        deviations,
        totals: totals(unsorted),
        exceptions,
    })
}

/// The sum of the rates per kilometer of each route, not the rate over all routes. A route that never moved is left out:
/// the original takes its infractions for the simulator's.
fn infractions(records: &[&Record]) -> Result<Vec<Number>, Refusal> {
    let mut sums = vec![Number::ZERO; names::infractions(Format::V1).len()];
    for record in records {
        if record.scores.route.is_zero() {
            continue;
        }
        let kilometers = record.scores.route.as_f64() / 100.0 * record.meta.length.as_f64() / 1000.0;
        if kilometers == 0.0 {
            return Err(refused(&record.name, "it was driven in part, but has no length"));
        }
        for (sum, found) in sums.iter_mut().zip(&record.counts) {
            *sum = sum.plus(Number::Float(count(*found) / kilometers));
        }
    }
    Ok(sums)
}

fn every_route(records: &[&Record]) -> Vec<Exception> {
    let index = |record: &Record| record.object.get("index").cloned().unwrap_or(Value::Null);
    let exceptions = records.iter().map(|record| Exception::of(record, index(record)));
    exceptions.collect()
}

fn failed_routes(records: &[&Record]) -> Vec<Exception> {
    let numbered = (0..).map(Value::Int).zip(records);
    let failed = numbered.filter(|(_, record)| record.status != names::COMPLETED);
    failed.map(|(index, record)| Exception::of(record, index)).collect()
}
