//! Check that the scores of a record follow from its infractions. The agent runs in the process that computes its score, so
//! this is the cheap answer to an edited file; it does not see an infraction that was removed together with its penalty.
//! Pure; called by the checkpoint reader.
//!
//! It reports only values that make a score better than it can be. A lower penalty gains nothing, and forks have more to punish.

use super::record::Record;
use crate::json::Value;
use crate::names::MIN_SPEED;
use crate::number::{Number, count, round};
use crate::{Format, RecordProblem};

/// Where the three scores are rounded, each on its own, their product is off by up to this.
const PRODUCT_ERROR: f64 = 1e-4;

/// Refuses a record whose driving score or penalty does not follow from the rest of it.
pub(super) fn check(format: Format, record: &Record) -> Result<(), RecordProblem> {
    let [route, penalty, composed] =
        [record.scores.route, record.scores.penalty, record.scores.composed].map(Number::as_f64);
    // A route that failed before it began has zeros everywhere.
    if route == 0.0 && penalty == 0.0 && composed == 0.0 {
        return Ok(());
    }
    let product = route * penalty;
    let expected = if product < 0.0 { 0.0 } else { product };
    if is_beyond((composed - expected).abs(), PRODUCT_ERROR) {
        let expected = round(expected, 6);
        return Err(RecordProblem::Composed {
            found: composed,
            expected,
        });
    }
    check_penalty(format, record, penalty)
}

fn check_penalty(format: Format, record: &Record, penalty: f64) -> Result<(), RecordProblem> {
    let events = Events { record };
    let (allowed, rounding) = match format {
        Format::V1 => (events.product(V2_FACTORS.split_at(5).0, 0.0), 1e-9),
        // 2.0 and 2.1 write the same format, each with a formula of its own.
        Format::V2 => {
            let (old, new) = (events.product(&V2_FACTORS, V2_SPEED), events.harmonic());
            (if old > new { old } else { new }, 1e-6)
        }
    };
    if is_beyond(penalty - allowed, rounding) {
        let allowed = round(allowed, 6);
        return Err(RecordProblem::Penalty {
            found: penalty,
            allowed,
        });
    }
    Ok(())
}

/// NaN is beyond everything.
fn is_beyond(distance: f64, limit: f64) -> bool {
    distance > limit || distance.is_nan()
}

/// Factors by which each infraction multiplies the penalty in 2.0; 1.0 has the first five.
const V2_FACTORS: [(&str, f64); 7] = [
    ("collisions_pedestrian", 0.5),
    ("collisions_vehicle", 0.6),
    ("collisions_layout", 0.65),
    ("red_light", 0.7),
    ("stop_infraction", 0.8),
    ("scenario_timeouts", 0.7),
    ("yield_emergency_vehicle_infractions", 0.7),
];
/// Driving at twice the speed of the traffic raises the penalty by so much in 2.0.
const V2_SPEED: f64 = 0.3;

/// Coefficients that each infraction adds to the divisor in 2.1.
const V21_COEFFICIENTS: [(&str, f64); 7] = [
    ("collisions_pedestrian", 1.0),
    ("collisions_vehicle", 0.7),
    ("collisions_layout", 0.6),
    ("red_light", 0.4),
    ("stop_infraction", 0.25),
    ("scenario_timeouts", 0.4),
    ("yield_emergency_vehicle_infractions", 0.4),
];
/// Driving at twice the speed of the traffic takes so much from the divisor in 2.1.
const V21_SPEED: f64 = 0.4;

/// The infraction messages of a record.
///
/// Infractions with a percentage, driving off the road and slow driving, can only take from the penalty, and the percentage is
/// rounded, missing in some forks and without effect in others: they are counted as taking nothing. Fast driving is the
/// one thing that gives.
struct Events<'a> {
    record: &'a Record,
}

impl<'a> Events<'a> {
    /// The messages an evaluator can have written: plain ASCII. Others are additions of a fork and cost nothing.
    fn messages(&self, infraction: &str) -> impl Iterator<Item = &'a str> {
        let all = self.record.object.get("infractions").and_then(Value::as_object);
        let list = all
            .and_then(|all| all.get(infraction))
            .and_then(Value::as_list)
            .unwrap_or_default();
        let is_plain = |text: &&str| text.bytes().all(|byte| (b' '..=b'~').contains(&byte));
        list.iter().filter_map(Value::as_str).filter(is_plain)
    }

    fn count(&self, infraction: &str) -> f64 {
        count(self.messages(infraction).count())
    }

    /// By how much each message of the speed is above that of the traffic: 1 is twice as fast.
    fn faster(&self) -> impl Iterator<Item = f64> {
        let percentage = |message: &str| {
            let before = message.split_once('%')?.0;
            before.rsplit([' ', '(']).next()?.parse::<f64>().ok()
        };
        self.messages(MIN_SPEED)
            .filter_map(percentage)
            .map(|p| p / 100.0 - 1.0)
            .filter(|above| *above > 0.0 && above.is_finite())
    }

    /// 1.0 and 2.0: factors multiplied, and `speed` for driving twice as fast as the traffic.
    fn product(&self, factors: &[(&str, f64)], speed: f64) -> f64 {
        let fixed = factors
            .iter()
            .fold(1.0, |product, (name, factor)| product * factor.powf(self.count(name)));
        self.faster()
            .fold(fixed, |product, above| product * (1.0 + speed * above))
    }

    /// 2.1: one over one plus the sum.
    fn harmonic(&self) -> f64 {
        let sum = V21_COEFFICIENTS
            .iter()
            .fold(1.0, |sum, (name, coefficient)| sum + coefficient * self.count(name));
        let divisor = self.faster().fold(sum, |sum, above| sum - V21_SPEED * above);
        // So fast that the formula has no sense any more.
        if divisor > 0.0 { 1.0 / divisor } else { f64::INFINITY }
    }
}
