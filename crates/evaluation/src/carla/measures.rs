//! The unit that CARLA counts and the names of its scores, as EvalAI's files spell them. Pure.

use leaderboard_api::Metric;
use leaderboard_results::Merged;

/// The unit of work, in the plural.
pub const UNIT: &str = "routes";
/// The score that ranks where EvalAI names none.
pub const DRIVING_SCORE: &str = "Driving score";
const ROUTE_COMPLETION: &str = "Route completion";
const INFRACTION_PENALTY: &str = "Infraction penalty";
/// Names of all numbers of a status.
pub const NAMES: [&str; 3] = [DRIVING_SCORE, ROUTE_COMPLETION, INFRACTION_PENALTY];

/// The mean driving score: of the whole run once it is final, before of the routes that are done.
pub fn score(merged: &Merged) -> Option<Metric> {
    let value = merged.score.or(merged.partial_score)?;
    within(100.0, value).map(|value| Metric::new(DRIVING_SCORE, value, 2))
}

/// The means of the other two scores, over the same routes.
pub fn others(merged: &Merged) -> Vec<Metric> {
    let completion = merged.route_completion().and_then(|percent| within(100.0, percent));
    let penalty = merged.infraction_penalty().and_then(|factor| within(1.0, factor));
    [
        completion.map(|percent| Metric::new(ROUTE_COMPLETION, percent, 2)),
        penalty.map(|factor| Metric::new(INFRACTION_PENALTY, factor, 3)),
    ]
    .into_iter()
    .flatten()
    .collect()
}

fn within(most: f64, value: f64) -> Option<f64> {
    (0.0..=most).contains(&value).then_some(value)
}

#[cfg(test)]
mod tests {
    use super::*;
    use leaderboard_results::{Format, Score, Source, metrics};

    #[test]
    fn each_score_has_the_name_that_evalai_knows() {
        for format in [Format::V1, Format::V2] {
            let name = |score| {
                let mut named = metrics(format)
                    .iter()
                    .filter(|metric| metric.source == Source::Score(score));
                named.next().map(|metric| metric.name)
            };
            let names = [Score::Composed, Score::Route, Score::Penalty].map(name);
            assert_eq!(names, NAMES.map(Some), "{format:?}");
        }
    }

    #[test]
    fn a_number_that_no_run_can_have_is_left_out() {
        for (most, value, expected) in [
            (100.0, 43.125, Some(43.125)),
            (100.0, 100.5, None),
            (1.0, -0.1, None),
            (1.0, f64::NAN, None),
        ] {
            assert_eq!(within(most, value), expected, "{value}");
        }
    }
}
