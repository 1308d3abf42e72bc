//! Entries as the original pipeline has them, for tests.

use serde_json::{Value, json};

use super::entries::{EVALAI, TRACKS, Texts};

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

/// The entry with the phases.
pub(super) fn tracks(phases: &[(&str, &str)]) -> String {
    let phases: std::collections::BTreeMap<_, _> = phases.iter().copied().collect();
    json!(phases).to_string()
}

/// All four.
pub(super) fn texts() -> Texts {
    let phases = [
        ("4170", "leaderboard-10-sensors"),
        ("4171", "leaderboard-10-map"),
        ("4172", "leaderboard-20-sensors"),
        ("4173", "leaderboard-20-map"),
    ];
    let evalai = json!({"auth_token": "local-host-token", "api_server": "https://eval.ai"});
    Texts::from([
        (EVALAI, evalai.to_string()),
        (TRACKS, tracks(&phases)),
        ("leaderboard-10", board("10").to_string()),
        ("leaderboard-20", board("20").to_string()),
    ])
}
