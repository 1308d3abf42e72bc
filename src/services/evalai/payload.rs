//! Checks of what is about to be sent, because the server's own are incomplete: it takes results without metrics, and
//! results for the leaderboard of a foreign phase.
//!
//! Called by `queue`. Pure.

use std::hash::{DefaultHasher, Hash, Hasher};

use serde::Deserialize;
use serde_json::{Map, Value};

use super::types::Payload;

/// One entry of the list in `result`.
#[derive(Deserialize)]
struct Entry {
    split: String,
    accuracies: Map<String, Value>,
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

/// Distinguishes texts without keeping them.
pub fn digest(payload: &Payload) -> u64 {
    let mut hasher = DefaultHasher::new();
    payload.hash(&mut hasher);
    hasher.finish()
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
    fn complete_finite_results_of_the_split_pass() {
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
    fn equal_texts_have_equal_digests() {
        let one = Payload {
            stdout: "a".into(),
            ..Payload::default()
        };
        assert_eq!(digest(&one), digest(&one.clone()));
        assert_ne!(digest(&one), digest(&Payload::default()));
    }
}
