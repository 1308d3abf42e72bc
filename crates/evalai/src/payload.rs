//! Results before they are sent: they name the split of their Leaderboard, and are checked, because the server's own checks are
//! incomplete: it takes results without metrics, and results for the leaderboard of a foreign phase.
//!
//! Called by `queue`. Pure.

use serde::Deserialize;
use serde_json::{Map, Value};

use super::types::Payload;

/// One entry of the list in `result`.
#[derive(Deserialize)]
struct Entry {
    split: String,
    accuracies: Map<String, Value>,
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

/// Why results are not sent: they lack or misname what the leaderboard wants.
pub fn check(payload: &Payload, split: &str, labels: &[String]) -> Result<(), String> {
    let entries: Vec<Entry> = serde_json::from_str(&payload.result)
        .map_err(|error| format!("the results are not EvalAI's list of splits ({error})"))?;
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
    let missing: Vec<_> = labels
        .iter()
        .filter(|label| !entry.accuracies.contains_key(*label))
        .cloned()
        .collect();
    if !missing.is_empty() {
        return Err(format!("the results lack the metrics {}", missing.join(", ")));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

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
