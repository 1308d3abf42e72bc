//! The standard run's result, worked out by hand in local/challenge: 20 routes over 4 pairs, format 2.

use std::collections::BTreeMap;

use leaderboard_api::{State, Submission};
use serde_json::{Map, Value};

use crate::scene::{score, state};

/// The driving score as the SCORE column shows it.
pub const SCORE: &str = "69.41";
/// The driving score of routes 0 to 5 alone: (100 + 70 + 60 + 100 + 42 + 100) / 6.
pub const SIX_ROUTES: &str = "78.67";

/// The expected metrics by their names in EvalAI.
pub fn metrics() -> Map<String, Value> {
    let file: Value = serde_json::from_str(include_str!("../../local/challenge/expected.json")).unwrap();
    file["metrics"].as_object().unwrap().clone()
}

/// A Submission has ended with the standard score.
pub fn assert_finished(submission: &Submission) {
    let progress = submission.status.as_ref().and_then(|status| status.progress.as_ref());
    assert_eq!(state(submission), Some(State::Finished));
    assert_eq!(progress.map(|progress| progress.text.as_str()), Some("20/20"));
    assert_eq!(score(submission), SCORE);
}

/// A results.json holds exactly the expected metrics.
pub fn assert_results(text: &str) {
    let results: Value = serde_json::from_str(text).unwrap();
    let expected = serde_json::json!([{
        "split": "leaderboard",
        "show_to_participant": true,
        "accuracies": metrics(),
    }]);
    assert_eq!(results, expected);
}

/// A row of the table has the expected metrics in its columns, named as the original names them.
pub fn assert_row(row: &BTreeMap<String, String>) {
    for (name, value) in metrics() {
        let column = name.to_lowercase().replace([' ', '-'], "_");
        assert_eq!(row.get(&column), Some(&value.to_string()), "{column} in {row:?}");
    }
}
