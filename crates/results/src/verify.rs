//! Whether the scores of a record follow from its infractions. The agent runs in the process that computes its score, so
//! this is the cheap answer to an edited file; it does not see an infraction that was removed together with its penalty.
//! Pure; called by the checkpoint reader.

use std::ops::RangeInclusive;

use crate::checkpoint::Record;
use crate::json::Value;
use crate::names::{MIN_SPEED, OFF_ROAD};
use crate::number::{Number, count, round};
use crate::{Format, RecordProblem};

/// Percentages in messages are rounded to two digits.
const PERCENTAGE_ERROR: f64 = 0.0051;

/// Refuses a record whose driving score or penalty does not follow from the rest of it.
pub(crate) fn check(format: Format, record: &Record) -> Result<(), RecordProblem> {
    let [route, penalty, composed] =
        [record.scores.route, record.scores.penalty, record.scores.composed].map(Number::as_f64);
    // A route that failed before it began has zeros everywhere.
    if route == 0.0 && penalty == 0.0 && composed == 0.0 {
        return Ok(());
    }
    let product = route * penalty;
    let expected = if product < 0.0 { 0.0 } else { product };
    // V2 rounds all three to six digits, each on its own.
    let tolerance = if format == Format::V2 { 1e-4 } else { 1e-6 };
    if is_beyond((composed - expected).abs(), tolerance) {
        let expected = round(expected, 6);
        return Err(RecordProblem::Composed {
            found: composed,
            expected,
        });
    }
    check_penalty(format, record, penalty)
}

fn check_penalty(format: Format, record: &Record, penalty: f64) -> Result<(), RecordProblem> {
    let events = Events::of(record);
    let formulas = match format {
        Format::V1 => vec![events.product(&V1_FACTORS)?],
        Format::V2 => vec![events.product(&V2_FACTORS)?, events.harmonic()?],
    };
    let slack = if format == Format::V2 { 1e-6 } else { 1e-9 };
    let off = |range: &RangeInclusive<f64>| {
        let below = range.start() - penalty;
        let above = penalty - range.end();
        if below > above { below } else { above }
    };
    let nearest = formulas.into_iter().min_by(|a, b| off(a).total_cmp(&off(b)));
    let Some(range) = nearest.filter(|range| is_beyond(off(range), slack)) else {
        return Ok(());
    };
    let expected = round(f64::midpoint(*range.start(), *range.end()), 6);
    Err(RecordProblem::Penalty {
        found: penalty,
        expected,
    })
}

/// NaN is beyond everything.
fn is_beyond(distance: f64, limit: f64) -> bool {
    distance > limit || distance.is_nan()
}

/// What each infraction multiplies the penalty by.
const V1_FACTORS: [(&str, f64); 5] = [
    ("collisions_pedestrian", 0.5),
    ("collisions_vehicle", 0.6),
    ("collisions_layout", 0.65),
    ("red_light", 0.7),
    ("stop_infraction", 0.8),
];

/// The same for 2.0; slow driving costs up to 0.3 on top.
const V2_FACTORS: [(&str, f64); 7] = [
    ("collisions_pedestrian", 0.5),
    ("collisions_vehicle", 0.6),
    ("collisions_layout", 0.65),
    ("red_light", 0.7),
    ("stop_infraction", 0.8),
    ("scenario_timeouts", 0.7),
    ("yield_emergency_vehicle_infractions", 0.7),
];

/// What each infraction adds to the divisor in 2.1; slow driving adds up to 0.4.
const V21_COEFFICIENTS: [(&str, f64); 7] = [
    ("collisions_pedestrian", 1.0),
    ("collisions_vehicle", 0.7),
    ("collisions_layout", 0.6),
    ("red_light", 0.4),
    ("stop_infraction", 0.25),
    ("scenario_timeouts", 0.4),
    ("yield_emergency_vehicle_infractions", 0.4),
];

/// The infraction messages of a record.
struct Events<'a> {
    record: &'a Record,
}

impl<'a> Events<'a> {
    fn of(record: &'a Record) -> Self {
        Self { record }
    }

    fn messages(&self, infraction: &str) -> &'a [Value] {
        let all = self.record.object.get("infractions").and_then(Value::as_object);
        all.and_then(|all| all.get(infraction))
            .and_then(Value::as_list)
            .unwrap_or_default()
    }

    fn count(&self, infraction: &str) -> f64 {
        count(self.messages(infraction).len())
    }

    /// The number in front of the `%` of each message.
    fn percentages(&self, infraction: &'static str) -> Result<Vec<f64>, RecordProblem> {
        let percentage = |message: &Value| {
            let before = message.as_str()?.split_once('%')?.0;
            let number = before.rsplit([' ', '(']).next()?;
            number.parse::<f64>().ok().filter(|p| p.is_finite())
        };
        let all = self
            .messages(infraction)
            .iter()
            .map(percentage)
            .collect::<Option<Vec<f64>>>();
        all.ok_or(RecordProblem::Percentage { infraction })
    }

    /// 1.0 and 2.0: factors multiplied. Between the least and the most the rounded percentages allow.
    fn product(&self, factors: &[(&str, f64)]) -> Result<RangeInclusive<f64>, RecordProblem> {
        let mut fixed = 1.0;
        for (infraction, factor) in factors {
            fixed *= factor.powf(self.count(infraction));
        }
        for p in self.percentages(MIN_SPEED)? {
            fixed *= 1.0 - 0.3 * (1.0 - p / 100.0);
        }
        let (low, high) = self.off_road()?;
        Ok(fixed * low..=fixed * high)
    }

    /// 2.1: one over one plus the sum.
    fn harmonic(&self) -> Result<RangeInclusive<f64>, RecordProblem> {
        let mut sum = 0.0;
        for (infraction, coefficient) in V21_COEFFICIENTS {
            sum += coefficient * self.count(infraction);
        }
        for p in self.percentages(MIN_SPEED)? {
            sum += 0.4 * (1.0 - p / 100.0);
        }
        let (low, high) = self.off_road()?;
        Ok(low / (1.0 + sum)..=high / (1.0 + sum))
    }

    fn off_road(&self) -> Result<(f64, f64), RecordProblem> {
        let (mut low, mut high) = (1.0, 1.0);
        for p in self.percentages(OFF_ROAD)? {
            low *= 1.0 - (p + PERCENTAGE_ERROR) / 100.0;
            high *= 1.0 - (p - PERCENTAGE_ERROR) / 100.0;
        }
        Ok((low, high))
    }
}
