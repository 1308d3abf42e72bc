//! Results before they are sent: they name the split of their Leaderboard, or are those that EvalAI lists, and are checked, because the
//! server's own checks are incomplete: it takes results without metrics, and results for the leaderboard of a foreign phase.
//!
//! Called by `queue`. Pure.

use std::collections::BTreeMap;

use serde::Deserialize;
use serde_json::Value;
use serde_json::value::RawValue;

use super::row::Split;

/// One entry of the list in `result`. Its numbers stay as they are written: one that is read and written again may have other digits.
#[derive(Deserialize)]
struct Entry<'a> {
    split: String,
    #[serde(default)]
    show_to_participant: bool,
    #[serde(borrow)]
    accuracies: BTreeMap<String, &'a RawValue>,
}

/// Results for this split, with exactly these labels; else why they are not sent. A Pod does not know the split: what it stores names the
/// original's, in S3 for good.
pub fn for_split(result: &str, split: &str, labels: &[String]) -> Result<String, String> {
    match parsed(result)?.as_slice() {
        [only] => Ok(format!("[{}]", written(only, split, labels)?)),
        entries => Err(format!("the results are for {} splits, not for one", entries.len())),
    }
}

/// Results for the splits that EvalAI lists for a phase, each with exactly its labels: what else there is stays in the bucket. Else why
/// they are not sent.
pub fn for_listed(result: &str, listed: &[(&str, &Split)]) -> Result<String, String> {
    let entries = parsed(result)?;
    let of = |(name, split): &(&str, &Split)| {
        let found = entries.iter().find(|entry| entry.split == *name);
        let found =
            found.ok_or_else(|| format!("the results lack the split {name}, which EvalAI lists for the phase"))?;
        written(found, name, &split.schema.labels)
    };
    let sent: Result<Vec<String>, String> = listed.iter().map(of).collect();
    Ok(format!("[{}]", sent?.join(",")))
}

fn parsed(result: &str) -> Result<Vec<Entry<'_>>, String> {
    serde_json::from_str(result).map_err(|error| format!("the results are not EvalAI's list of splits ({error})"))
}

/// An entry for this split, with these labels in their order.
fn written(entry: &Entry<'_>, split: &str, labels: &[String]) -> Result<String, String> {
    let (mut metrics, mut missing) = (Vec::new(), Vec::new());
    for label in labels {
        match entry.accuracies.get(label).map(|value| value.get()) {
            Some(value) if value.parse().is_ok_and(f64::is_finite) => {
                metrics.push(format!("{}:{value}", Value::from(label.as_str())));
            }
            Some(_) => return Err(format!("the metric {label} of the split {split} is no finite number")),
            None => missing.push(label.as_str()),
        }
    }
    if !missing.is_empty() {
        let missing = missing.join(", ");
        return Err(format!("the split {split} of the results lacks the metrics {missing}"));
    }
    let (split, metrics) = (Value::from(split), metrics.join(","));
    let is_shown = entry.show_to_participant;
    Ok(format!(
        r#"{{"split":{split},"show_to_participant":{is_shown},"accuracies":{{{metrics}}}}}"#
    ))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::row::Schema;

    #[test]
    fn results_of_the_split_are_complete_and_finite_or_are_not_sent() {
        let labels = ["Driving score".to_owned(), "Route completion".to_owned()];
        let checked = |result: &str| for_split(result, "leaderboard", &labels);
        let whole = r#"[{"split":"leaderboard","show_to_participant":true,"accuracies":{"Driving score":43.1,"Route completion":100}}]"#;
        assert_eq!(checked(whole), Ok(whole.to_owned()));
        for (result, part) in [
            ("", "list of splits"),
            ("{}", "list of splits"),
            ("[]", "0 splits"),
            (r#"[{"split":"leaderboard"}]"#, "accuracies"),
            (
                r#"[{"split":"a","accuracies":{}},{"split":"b","accuracies":{}}]"#,
                "2 splits",
            ),
            (
                r#"[{"split":"leaderboard","accuracies":{"Driving score":1}}]"#,
                "lacks the metrics Route completion",
            ),
            (
                r#"[{"split":"leaderboard","accuracies":{"Driving score":"1","Route completion":1}}]"#,
                "Driving score of the split leaderboard is no finite",
            ),
            (
                r#"[{"split":"leaderboard","accuracies":{"Driving score":true,"Route completion":1}}]"#,
                "Driving score of the split leaderboard is no finite",
            ),
            (
                r#"[{"split":"leaderboard","accuracies":{"Driving score":NaN,"Route completion":1}}]"#,
                "list of splits",
            ),
        ] {
            let error = checked(result).unwrap_err();
            assert!(error.contains(part), "{result}: {error}");
        }
    }

    #[test]
    fn of_results_what_evalai_lists_is_sent_and_else_nothing() {
        let split = |labels: &[&str]| Split {
            id: 1,
            phase: 1,
            dataset_split: 1,
            schema: Schema {
                labels: labels.iter().map(|label| (*label).to_owned()).collect(),
                default_order_by: None,
                metadata: Value::Null,
            },
        };
        let (accuracy, both) = (split(&["accuracy"]), split(&["accuracy", "loss"]));
        let dev = r#"{"split":"dev","show_to_participant":true,"accuracies":{"accuracy":0.50,"loss":1e2}}"#;
        let test = r#"{"split":"test","show_to_participant":false,"accuracies":{"accuracy":0.1}}"#;
        let results = format!("[{dev}, {test}]");
        let whole = format!("[{test},{dev}]");
        let part = r#"[{"split":"dev","show_to_participant":true,"accuracies":{"accuracy":0.50}}]"#;
        assert_eq!(for_listed(&results, &[("test", &accuracy), ("dev", &both)]), Ok(whole));
        assert_eq!(for_listed(&results, &[("dev", &accuracy)]), Ok(part.to_owned()));
        let number = |number: &str| results.replace("1e2", number);
        for (results, listed, why) in [
            (results.clone(), ("val", &accuracy), "lack the split val"),
            (
                results.clone(),
                ("test", &both),
                "the split test of the results lacks the metrics loss",
            ),
            ("[]".to_owned(), ("dev", &both), "lack the split dev"),
            (
                number("1e999"),
                ("dev", &both),
                "loss of the split dev is no finite number",
            ),
            (
                number(r#""1""#),
                ("dev", &both),
                "loss of the split dev is no finite number",
            ),
            (
                number("null"),
                ("dev", &both),
                "loss of the split dev is no finite number",
            ),
            (number("NaN"), ("dev", &both), "list of splits"),
            (String::new(), ("dev", &both), "list of splits"),
        ] {
            let refused = for_listed(&results, &[listed]).unwrap_err();
            assert!(refused.contains(why), "{results}: {refused}");
        }
        // A number that nobody sends may be anything.
        assert_eq!(for_listed(&number("1e999"), &[("dev", &accuracy)]), Ok(part.to_owned()));
    }

    #[test]
    fn results_name_the_split_of_their_leaderboard_and_keep_their_digits() {
        let labels = ["Driving score".to_owned(), "Agent blocked".to_owned()];
        let sent = |result: &str, split| for_split(result, split, &labels);
        let of = |split: &str| {
            let metrics = r#"{"Driving score":0.10,"Agent blocked":1e2}"#;
            format!(r#"[{{"split":{split},"show_to_participant":true,"accuracies":{metrics}}}]"#)
        };
        let first = r#"[{"split": "leaderboard", "show_to_participant": true, "accuracies": {"Agent blocked": 1e2, "Driving score": 0.10}}]"#;
        let last = r#"[{"accuracies":{"Driving score":0.10,"Agent blocked":1e2},"show_to_participant":true,"split":"leaderboard"}]"#;
        for stored in [first, last] {
            assert_eq!(sent(stored, "val"), Ok(of(r#""val""#)));
            assert_eq!(sent(stored, r#"a "b"\"#), Ok(of(r#""a \"b\"\\""#)));
        }
        assert_eq!(
            sent(&of(r#""val""#), "leaderboard"),
            Ok(of(r#""leaderboard""#)),
            "also from another one"
        );
        for broken in ["", "[]", r#"[{"split": 1}]"#, r#"[{"split""#] {
            assert!(sent(broken, "val").is_err(), "{broken}");
        }
    }
}
