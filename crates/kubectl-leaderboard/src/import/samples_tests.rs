//! Answers of AWS for the entries of the original pipeline, for tests.

use std::collections::BTreeMap;

use serde_json::{Value, json};

use super::entries::{Entries, answers};

pub(super) const TOKEN: &str = "local-host-token";

/// The texts of the entries, by name.
pub(super) type Texts = BTreeMap<&'static str, Value>;

/// The entry of one Leaderboard.
pub(super) fn board(number: &str) -> Value {
    let image = |name: &str| format!("123456789012.dkr.ecr.us-west-2.amazonaws.com/{name}-{number}:latest");
    let name = format!("leaderboard-{number}");
    json!({
        "name": name, "endpoint": "https://0123.gr7.us-west-2.eks.amazonaws.com", "certificate_authority": "LS0tLS1CRUdJTg==",
        "simulator_image": image("simulator"), "leaderboard_image": image("leaderboard"), "logcopy_image": image("logcopy"),
        "s3_bucket": name, "dynamodb_submissions_table": name, "cloudwatch_log_group": name,
    })
}

/// All four.
pub(super) fn texts() -> Texts {
    let tracks = json!({
        "4170": "leaderboard-10-sensors", "4171": "leaderboard-10-map",
        "4172": "leaderboard-20-sensors", "4173": "leaderboard-20-map",
    });
    Texts::from([
        ("evalai", json!({"auth_token": TOKEN, "api_server": "https://eval.ai"})),
        ("evalai-tracks", tracks),
        ("leaderboard-10", board("10")),
        ("leaderboard-20", board("20")),
    ])
}

/// What `aws secretsmanager get-secret-value --output json` prints of an entry.
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
