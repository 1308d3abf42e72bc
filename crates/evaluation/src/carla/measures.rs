//! What CARLA counts and how it names its scores, in the words that EvalAI's files have for them. Pure.

use leaderboard_api::Metric;
use leaderboard_results::{Format, Merged, Score, Source, metrics};

/// What a run consists of.
pub const UNIT: &str = "routes";

/// The mean driving score: of the whole run once it is final, before of the routes that are done.
pub fn score(merged: &Merged) -> Option<Metric> {
    let value = merged.score.or(merged.partial_score)?;
    within(100.0, value).map(|value| Metric::new(name(Score::Composed), value, 2))
}

/// The means of the other two scores, over the same routes.
pub fn others(merged: &Merged) -> Vec<Metric> {
    let completion = merged.route_completion().and_then(|percent| within(100.0, percent));
    let penalty = merged.infraction_penalty().and_then(|factor| within(1.0, factor));
    [
        completion.map(|percent| Metric::new(name(Score::Route), percent, 2)),
        penalty.map(|factor| Metric::new(name(Score::Penalty), factor, 3)),
    ]
    .into_iter()
    .flatten()
    .collect()
}

fn within(most: f64, value: f64) -> Option<f64> {
    (0.0..=most).contains(&value).then_some(value)
}

/// A score as EvalAI's files name it; both formats name the three alike.
fn name(score: Score) -> &'static str {
    let all = metrics(Format::V2).iter();
    let mut named = all.filter(|metric| metric.source == Source::Score(score));
    named.next().map_or("", |metric| metric.name)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_score_has_the_name_that_evalai_knows() {
        let names = [Score::Composed, Score::Route, Score::Penalty].map(name);
        assert_eq!(names, ["Driving score", "Route completion", "Infraction penalty"]);
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
