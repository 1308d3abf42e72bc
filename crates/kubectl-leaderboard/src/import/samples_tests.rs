//! Answers of AWS for the entries of the original pipeline, for tests.

use std::collections::BTreeMap;

use serde_json::{Value, json};

use super::entries::{Entries, answers};

pub(super) const TOKEN: &str = "local-host-token";

/// The texts of the entries, by name.
pub(super) type Texts = BTreeMap<&'static str, Value>;

/// The entry of one Leaderboard.
pub(super) fn board(number: &str) -> Value {
    texts()[format!("leaderboard-{number}").as_str()].clone()
}

/// All four, as the original has them. A test of the API server reads the same file.
pub(super) fn texts() -> Texts {
    serde_json::from_str(include_str!("entries.json")).unwrap()
}

/// The output of `aws secretsmanager get-secret-value --output json` for an entry.
pub(super) fn answer(name: &str, text: &str) -> Value {
    json!({
        "ARN": format!("arn:aws:secretsmanager:us-west-2:123456789012:secret:{name}-Ab12Cd"), "Name": name,
        "VersionId": "7e5a7cd8-5bfd-4b8e-a1c1-0c8e1f0d5e3a", "SecretString": text, "VersionStages": ["AWSCURRENT"],
        "CreatedDate": "2024-02-01T10:00:00.000000+00:00",
    })
}

/// The entries as they are read.
pub(super) fn entries(texts: &Texts) -> Entries {
    let all = texts
        .iter()
        .map(|(name, text)| format!("{:#}\n", answer(name, &text.to_string())));
    answers(&all.collect::<String>()).unwrap()
}
