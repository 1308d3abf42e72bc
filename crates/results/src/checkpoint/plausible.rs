//! Conditions on a stranger's file before any of it is published: the pair's own routes, known statuses, numbers a
//! drive can have. Called by the reader for `Strictness::Pod` only.

use std::collections::HashMap;

use super::record::Record;
use crate::names::{self, MIN_SPEED};
use crate::plan::{Format, Plan, Slice};
use crate::{RecordName, RecordProblem, Refusal};

/// No route is longer than 10,000 km, no drive takes longer than 100 days.
const MAX_LENGTH: f64 = 1e7;
const MAX_DURATION: f64 = 8.64e6;
/// Nothing was ever measured in less than a microsecond; a smaller divisor makes the published speed infinite.
const LEAST_DURATION: f64 = 1e-6;

pub(super) fn check_file(plan: &Plan, pair: usize, total: u32, records: &[Record]) -> Result<(), Refusal> {
    if let Some(expected) = plan.expected_of(pair) {
        if total != expected {
            let found = total;
            return Err(Refusal::Total { pair, found, expected });
        }
        let found = records.len();
        if u32::try_from(found).is_ok_and(|found| found > expected) {
            return Err(Refusal::TooManyRecords { pair, found, expected });
        }
    }
    // V1 names all repetitions of a route alike.
    let allowed = match plan.format {
        Format::V1 if plan.pairs.is_empty() => u32::MAX,
        Format::V1 => plan.repetitions,
        Format::V2 => 1,
    };
    let mut runs: HashMap<(i64, i64), u32> = HashMap::new();
    for record in records {
        let refuse = |problem| super::refused(pair, record.name.clone(), problem);
        check(plan, pair, record).map_err(refuse)?;
        let times = runs.entry(record.key).or_default();
        *times = times.saturating_add(1);
        if *times > allowed {
            return Err(refuse(RecordProblem::Repeated));
        }
    }
    Ok(())
}

fn check(plan: &Plan, pair: usize, record: &Record) -> Result<(), RecordProblem> {
    let (route, repetition) = record.key;
    if matches!(record.name, RecordName::Place(_)) || route < 0 || repetition < 0 {
        let repetition = plan.format == Format::V2;
        return Err(RecordProblem::RouteId { repetition });
    }
    if let Some(slice) = plan.pairs.get(pair) {
        if !slice.contains(route) {
            let Slice { first, last } = *slice;
            return Err(RecordProblem::OutsideSlice { first, last });
        }
        let repetitions = plan.repetitions;
        if !(0..i64::from(repetitions)).contains(&repetition) {
            return Err(RecordProblem::Repetition { repetitions });
        }
    }
    if !names::is_known_status(plan.format, &record.status) {
        return Err(RecordProblem::Status);
    }
    numbers(plan.format, record)
}

fn numbers(format: Format, record: &Record) -> Result<(), RecordProblem> {
    // V1's penalty is a product of factors up to 1. V2's rule for slow driving rewards an average speed above that of the
    // traffic where the evaluator records one.
    let fast = count_of(format, record, MIN_SPEED) > 0;
    let high_penalty = if fast { 100.0 } else { 1.0 };
    let (scores, meta) = (&record.scores, &record.meta);
    within("score_route", scores.route.as_f64(), 0.0, 100.0)?;
    within("score_penalty", scores.penalty.as_f64(), 0.0, high_penalty)?;
    within("score_composed", scores.composed.as_f64(), 0.0, 100.0)?;
    within("route_length", meta.length.as_f64(), 0.0, MAX_LENGTH)?;
    within("duration_game", meta.game.as_f64(), -1.0, MAX_DURATION)?;
    let system = meta.system.as_f64();
    let is_tiny = system != 0.0 && system.abs() < LEAST_DURATION;
    within(
        "duration_system",
        system,
        if is_tiny { LEAST_DURATION } else { -1.0 },
        MAX_DURATION,
    )?;
    within("outside_route_lanes", record.off_road, 0.0, MAX_LENGTH)
}

fn count_of(format: Format, record: &Record, infraction: &str) -> usize {
    let place = names::infractions(format).iter().position(|key| *key == infraction);
    place.and_then(|place| record.counts.get(place)).copied().unwrap_or(0)
}

fn within(field: &'static str, value: f64, low: f64, high: f64) -> Result<(), RecordProblem> {
    if !value.is_finite() {
        return Err(RecordProblem::NotFinite { field, value });
    }
    if value < low || value > high {
        return Err(RecordProblem::Range {
            field,
            value,
            low,
            high,
        });
    }
    Ok(())
}
