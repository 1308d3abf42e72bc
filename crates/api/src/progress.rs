//! How far a run is, and what it has scored. The kind of evaluation decides what is counted, and which numbers there are.
//!
//! Part of a Submission's status. Pure.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Most metrics of a run, beside its score.
pub const MAX_METRICS: usize = 32;
/// Characters of a metric's name and of a unit's, and of a number.
pub const MAX_NAME: usize = 64;
/// Characters of a number.
const MAX_NUMBER: usize = 32;

/// Progress of the whole run.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, PartialEq, Eq)]
pub struct Progress {
    /// Done counts the units that are done, over all workers.
    pub done: i32,
    /// Total counts all units of the run.
    pub total: i32,
    /// Unit names what is counted, in the plural, such as `routes`.
    #[schemars(length(max = MAX_NAME))]
    pub unit: String,
    /// Text shows the progress to people, such as `12/20`.
    #[schemars(length(max = 32))]
    pub text: String,
}

impl Progress {
    /// Progress with its text.
    pub fn new(done: i32, total: i32, unit: &str) -> Self {
        Self {
            done,
            total,
            unit: unit.to_owned(),
            text: format!("{done}/{total}"),
        }
    }
}

/// One number that a run has come to.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, Default, PartialEq, Eq)]
pub struct Metric {
    /// Name is the metric's name, such as `Route completion`.
    #[schemars(length(max = MAX_NAME))]
    pub name: String,
    /// Value is a decimal number, such as `80.00`, in the unit of the metric.
    #[schemars(length(max = MAX_NUMBER))]
    pub value: String,
}

impl Metric {
    /// A number with so many digits behind the point.
    pub fn new(name: &str, value: f64, digits: usize) -> Self {
        Self {
            name: name.to_owned(),
            value: format!("{value:.digits$}"),
        }
    }

    /// True if the name is not blank, the value is a finite decimal number, and both fit the definition's lengths.
    pub fn is_plausible(&self) -> bool {
        let is_number = |text: &str| text.parse().is_ok_and(f64::is_finite);
        let is_short = self.name.chars().count() <= MAX_NAME && self.value.len() <= MAX_NUMBER;
        is_short && !self.name.trim().is_empty() && is_number(&self.value)
    }
}

/// The number that ranks a run.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, PartialEq, Eq)]
#[serde(rename_all = "camelCase")]
pub struct Score {
    /// Name is the score's name, such as `Driving score`.
    #[schemars(length(max = MAX_NAME))]
    pub name: String,
    /// Value is a decimal number, such as `43.13`, in the unit of the score.
    #[schemars(length(max = MAX_NUMBER))]
    pub value: String,
    /// Text shows the score to people: `~41.20` as long as more can follow, `43.13` when it is final.
    #[schemars(length(max = 33))]
    pub text: String,
    /// Final is true once the whole run is done. Until then the score is that of what is done so far.
    #[serde(rename = "final")]
    pub is_final: bool,
}

impl Score {
    /// The score of a run that has come so far, or to its end.
    pub fn new(metric: Metric, is_final: bool) -> Self {
        let mark = if is_final { "" } else { "~" };
        Self {
            text: format!("{mark}{}", metric.value),
            name: metric.name,
            value: metric.value,
            is_final,
        }
    }

    /// This score, marked as not final.
    #[must_use]
    pub fn so_far(self) -> Self {
        let (name, value) = (self.name, self.value);
        Self::new(Metric { name, value }, false)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_score_shows_whether_it_is_final() {
        let score = Score::new(Metric::new("Driving score", 43.129, 2), true);
        assert_eq!((score.text.as_str(), score.value.as_str()), ("43.13", "43.13"));
        let again = score.so_far();
        assert_eq!((again.text.as_str(), again.is_final), ("~43.13", false));
        assert_eq!((again.name.as_str(), again.value.as_str()), ("Driving score", "43.13"));
    }

    #[test]
    fn a_metric_is_a_name_and_a_finite_number() {
        let metric = |name: &str, value: &str| Metric {
            name: name.to_owned(),
            value: value.to_owned(),
        };
        for (name, value, expected) in [
            ("Driving score", "43.13", true),
            ("Driving score", "-1", true),
            ("Driving score", "NaN", false),
            ("Driving score", "1e999", false),
            ("Driving score", "<b>", false),
            (" ", "1", false),
            ("Driving score", &"1".repeat(33), false),
            (&"é".repeat(MAX_NAME), "1", true),
            (&"é".repeat(MAX_NAME + 1), "1", false),
        ] {
            assert_eq!(metric(name, value).is_plausible(), expected, "{name} {value}");
        }
    }
}
