//! How far a run is: routes that are done, and the mean scores over them.
//!
//! Part of a Submission's status. Pure.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Routes that are done, over all pairs and repetitions.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, PartialEq, Eq)]
pub struct Progress {
    /// Routes that are done.
    pub done: i32,
    /// Routes of the run, times repetitions.
    pub total: i32,
    /// `12/20`.
    #[schemars(length(max = 32))]
    pub text: String,
}

impl Progress {
    /// Progress with its text.
    pub fn new(done: i32, total: i32) -> Self {
        Self {
            done,
            total,
            text: format!("{done}/{total}"),
        }
    }
}

/// Mean scores over the routes that are done, as decimal numbers.
#[derive(Serialize, Deserialize, JsonSchema, Clone, Debug, PartialEq, Eq)]
#[serde(rename_all = "camelCase")]
pub struct Score {
    /// Driving score, 0 to 100.
    #[schemars(length(max = 32))]
    pub driving: String,
    /// Route completion in percent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(max = 32))]
    pub route_completion: Option<String>,
    /// Infraction penalty, 0 to 1: the factor that is left.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(max = 32))]
    pub infraction_penalty: Option<String>,
    /// Whether all routes are done. Until then the scores are those of the routes so far.
    #[serde(rename = "final")]
    pub is_final: bool,
    /// The driving score for people: `~41.20` over the routes so far, `43.13` when final.
    #[schemars(length(max = 33))]
    pub text: String,
}

impl Score {
    /// From the driving score, and the other two where they are known.
    pub fn new(driving: f64, route_completion: Option<f64>, infraction_penalty: Option<f64>, is_final: bool) -> Self {
        let driving = format!("{driving:.2}");
        Self {
            text: text_of(&driving, is_final),
            route_completion: route_completion.map(|percent| format!("{percent:.2}")),
            infraction_penalty: infraction_penalty.map(|factor| format!("{factor:.3}")),
            driving,
            is_final,
        }
    }

    /// The same as the score of a run that goes on.
    #[must_use]
    pub fn so_far(self) -> Self {
        Self {
            text: text_of(&self.driving, false),
            is_final: false,
            ..self
        }
    }
}

fn text_of(driving: &str, is_final: bool) -> String {
    let mark = if is_final { "" } else { "~" };
    format!("{mark}{driving}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_score_shows_whether_it_is_final() {
        let score = Score::new(43.129, Some(80.0), Some(0.5151), true);
        assert_eq!((score.text.as_str(), score.driving.as_str()), ("43.13", "43.13"));
        assert_eq!(score.route_completion.as_deref(), Some("80.00"));
        assert_eq!(score.infraction_penalty.as_deref(), Some("0.515"));
        let again = score.so_far();
        assert_eq!((again.text.as_str(), again.is_final), ("~43.13", false));
    }
}
