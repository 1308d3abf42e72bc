//! Reads the stored files of a run, and how far a checkpoint is.

use std::collections::BTreeMap;

use leaderboard_aws::archive::Archive;
use leaderboard_contract::report::{MAX_BYTES, REPORT_KEY, Report};
use serde_json::Value;

const MERGED: &str = "agent/agent_results.json";
/// Keys of the files for EvalAI and the participant, and of the files that they are made of.
const FINAL: [&str; 8] = [
    "agent/agent1/agent_results.json",
    "agent/agent2/agent_results.json",
    "agent/agent3/agent_results.json",
    "agent/agent4/agent_results.json",
    MERGED,
    "evalai/metadata.json",
    "evalai/results.json",
    "evalai/stdout.txt",
];

/// The stored results by key, byte for byte.
pub type Results = BTreeMap<&'static str, String>;

/// The part of a stored text that a kill must not change. In an agent's own file these are the routes, without the global record. An
/// evaluator with no routes left is not started again for that record; 1.0's counts each route of an earlier process as failed.
pub fn of_the_drive(key: &str, text: &str) -> String {
    let Some(mut file) = serde_json::from_str::<Value>(text)
        .ok()
        .filter(|_| key.starts_with("agent/agent") && key != MERGED)
    else {
        return text.to_owned();
    };
    let routes = &mut file["_checkpoint"];
    format!("{:#} {}", routes["records"].take(), routes["progress"])
}

/// Reads the results of a run that is over.
pub async fn results(archive: &Archive) -> Results {
    let mut results = Results::new();
    for key in FINAL {
        let object = archive.get(key, 1 << 26).await.unwrap();
        let text = object.map(|object| String::from_utf8(object.bytes).unwrap());
        results.insert(key, text.unwrap_or_default());
    }
    results
}

/// The stored report.
pub async fn report(archive: &Archive) -> Option<Report> {
    let object = archive.get(REPORT_KEY, MAX_BYTES as u64).await.ok()??;
    Some(Report::parse(&object.bytes).unwrap())
}

/// The route an evaluator would go on with; none for a file from which it would start over.
pub fn next_route(checkpoint: &[u8]) -> Option<u64> {
    let file: Value = serde_json::from_slice(checkpoint).ok()?;
    let done = file["_checkpoint"]["progress"].get(0)?.as_u64()?;
    let repeats = file["sensors"].is_array() && file["entry_status"] == "Crashed" && is_v2(&file);
    Some(done - u64::from(repeats && done > 0))
}

/// A crash counts as progress in V2 only; its records have ids with the repetition.
fn is_v2(file: &Value) -> bool {
    let record = &file["_checkpoint"]["records"][0];
    record["route_id"].as_str().is_some_and(|id| id.contains("_rep"))
}
