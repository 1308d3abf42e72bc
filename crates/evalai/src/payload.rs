//! Results before they are sent: they name the split of their Leaderboard, or are those that EvalAI lists, and are checked, because the
//! server's own checks are incomplete: it takes results without metrics, and results for the leaderboard of a foreign phase.
//!
//! Called by `queue`. Pure.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use serde_json::value::RawValue;
use serde_json::{Map, Value};

use super::row::Split;
use super::types::Payload;

/// One entry of the list in `result`.
#[derive(Deserialize)]
struct Entry {
    split: String,
    accuracies: Map<String, Value>,
}

/// The same with its numbers as they are written: one that is read and written again may have other digits.
#[derive(Deserialize, Serialize)]
struct Raw<'a> {
    split: String,
    show_to_participant: bool,
    #[serde(borrow)]
    accuracies: BTreeMap<String, &'a RawValue>,
}

/// Results for this split. A Pod does not know it: what it stores names the original's, in S3 for good.
pub fn for_split(payload: Payload, split: &str) -> Payload {
    let result = named(&payload.result, split).unwrap_or(payload.result);
    Payload { result, ..payload }
}

/// A text of results with another split and otherwise the same bytes, since a number that is read and written again may have other
/// digits. None where no split is named.
fn named(result: &str, split: &str) -> Option<String> {
    let (_, after) = result.split_once(r#""split""#)?;
    let value = after.trim_start().strip_prefix(':')?.trim_start();
    let mut values = serde_json::Deserializer::from_str(value).into_iter::<String>();
    values.next()?.ok()?;
    let before = result.strip_suffix(value)?;
    let rest = value.get(values.byte_offset()..)?;
    Some(format!("{before}{}{rest}", Value::from(split)))
}

/// Results for the splits that EvalAI lists for a phase, each with exactly its labels: what else there is stays in the bucket. Else why
/// they are not sent.
pub fn for_listed(result: &str, listed: &[(&str, &Split)]) -> Result<String, String> {
    let mut entries: Vec<Raw<'_>> = parsed(result)?;
    let mut sent = Vec::new();
    for (name, split) in listed {
        let found = entries.iter().position(|entry| entry.split == *name);
        let found =
            found.ok_or_else(|| format!("the results lack the split {name}, which EvalAI lists for the phase"))?;
        let mut entry = entries.swap_remove(found);
        let labels = &split.schema.labels;
        entry.accuracies.retain(|name, _| labels.contains(name));
        let number = |value: &RawValue| value.get().parse().ok().filter(|number: &f64| number.is_finite());
        let wrong = entry.accuracies.iter().find(|(_, value)| number(value).is_none());
        if let Some((metric, _)) = wrong {
            return Err(format!("the metric {metric} of the split {name} is no finite number"));
        }
        let missing = missing(labels, |label| entry.accuracies.contains_key(label));
        if let Some(missing) = missing {
            return Err(format!("the split {name} of the results lacks the metrics {missing}"));
        }
        sent.push(entry);
    }
    serde_json::to_string(&sent).map_err(|error| error.to_string())
}

fn parsed<'a, T: Deserialize<'a>>(result: &'a str) -> Result<Vec<T>, String> {
    serde_json::from_str(result).map_err(|error| format!("the results are not EvalAI's list of splits ({error})"))
}

/// The labels that are not there, in a list.
fn missing(labels: &[String], is_there: impl Fn(&str) -> bool) -> Option<String> {
    let missing: Vec<&str> = labels
        .iter()
        .map(String::as_str)
        .filter(|label| !is_there(label))
        .collect();
    (!missing.is_empty()).then(|| missing.join(", "))
}

/// Why results are not sent: they lack or misname what the leaderboard wants.
pub fn check(payload: &Payload, split: &str, labels: &[String]) -> Result<(), String> {
    let entries: Vec<Entry> = parsed(&payload.result)?;
    let [entry] = entries.as_slice() else {
        return Err(format!("the results are for {} splits, not for one", entries.len()));
    };
    if entry.split != split {
        return Err(format!("the results are for the split {}, not {split}", entry.split));
    }
    let wrong = entry
        .accuracies
        .iter()
        .find(|(_, value)| !value.as_f64().is_some_and(f64::is_finite));
    if let Some((name, _)) = wrong {
        return Err(format!("the metric {name} is no finite number"));
    }
    match missing(labels, |label| entry.accuracies.contains_key(label)) {
        Some(missing) => Err(format!("the results lack the metrics {missing}")),
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::row::Schema;

    fn checked(result: &str) -> Result<(), String> {
        let payload = Payload {
            result: result.into(),
            ..Payload::default()
        };
        check(
            &payload,
            "leaderboard",
            &["Driving score".into(), "Route completion".into()],
        )
    }

    #[test]
    fn complete_finite_results_of_the_split_are_accepted() {
        let whole = r#"[{"split":"leaderboard","show_to_participant":true,"accuracies":{"Driving score":43.1,"Route completion":100}}]"#;
        assert_eq!(checked(whole), Ok(()));
        for (result, part) in [
            ("", "list of splits"),
            ("{}", "list of splits"),
            ("[]", "0 splits"),
            (r#"[{"split":"leaderboard"}]"#, "accuracies"),
            (r#"[{"split":"other","accuracies":{}}]"#, "split other"),
            (
                r#"[{"split":"leaderboard","accuracies":{"Driving score":1}}]"#,
                "lack the metrics Route completion",
            ),
            (
                r#"[{"split":"leaderboard","accuracies":{"Driving score":"1","Route completion":1}}]"#,
                "Driving score is no finite",
            ),
            (
                r#"[{"split":"leaderboard","accuracies":{"Driving score":true,"Route completion":1}}]"#,
                "Driving score is no finite",
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
        let (accuracy, both) = (split(&["accuracy"]), split(&["loss", "accuracy"]));
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
        let of = |result: &str, split| {
            let payload = Payload {
                result: result.into(),
                stdout: "a summary".into(),
                ..Payload::default()
            };
            let sent = for_split(payload, split);
            assert_eq!(&*sent.stdout, "a summary");
            sent.result.clone()
        };
        let first = r#"[{"split": "leaderboard", "show_to_participant": true, "accuracies": {"Driving score": 0.10}}]"#;
        let last = r#"[{"accuracies":{"Driving score":1e2},"split":"leaderboard"}]"#;
        assert_eq!(of(first, "val"), first.replace("leaderboard", "val"));
        assert_eq!(of(&of(first, "val"), "leaderboard"), first, "also from another one");
        assert_eq!(of(last, r#"a "b"\"#), last.replace("leaderboard", r#"a \"b\"\\"#));
        for same in [first, last] {
            assert_eq!(of(same, "leaderboard"), same);
        }
        for broken in ["", "[]", r#"[{"split": 1}]"#, r#"[{"split""#] {
            assert_eq!(of(broken, "val"), broken, "that it is broken is found next");
        }
    }
}
