//! Cost of one submission for the API server, by its audit log. For a test whose scene has one.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::fs;

use serde_json::Value;

use crate::scene::{Scene, USER_AGENT, say};

/// Writes of the operator that one submission may cost. The Lease's renewals are not of a submission.
const MOST_WRITES: u32 = 40;
/// The names of the operator's programs begin so.
const OPERATOR: &str = "leaderboard-operator-";

/// The scene's only submission, which has ended, has cost few writes.
pub fn assert_few_writes(scene: &Scene) {
    let log = std::env::var("LAB_AUDIT_LOG").expect("LAB_AUDIT_LOG is not set: run through `make test`");
    let writes = writes(&log, &scene.namespace);
    let operator = writes
        .iter()
        .filter(|((agent, _, resource), _)| agent.starts_with(OPERATOR) && is_of_the_submission(resource));
    let total: u32 = operator.map(|(_, count)| count).sum();
    let mut table = format!("audit: API writes of one submission, by the operator {total}");
    for ((agent, verb, resource), count) in &writes {
        _ = write!(table, "\n  {agent:26} {verb:7} {resource:26} {count:4}");
    }
    say(&table);
    assert!(total > 0, "the audit log {log} has no write of the operator");
    assert!(total <= MOST_WRITES, "{table}");
}

/// The lease, the Leaderboard and its policy are written whether or not anybody submits.
fn is_of_the_submission(resource: &str) -> bool {
    !["leases", "networkpolicies"].contains(&resource) && !resource.starts_with("leaderboards")
}

/// The writes in a namespace, by user agent, verb and resource.
fn writes(log: &str, namespace: &str) -> BTreeMap<(String, String, String), u32> {
    let text = fs::read_to_string(log).unwrap_or_else(|error| panic!("{log} can't be read: {error}"));
    let mut writes = BTreeMap::new();
    for line in text.lines().filter(|line| line.contains(namespace)) {
        // The last line may be half written.
        let Ok(entry) = serde_json::from_str::<Value>(line) else {
            continue;
        };
        let object = &entry["objectRef"];
        let verb = entry["verb"].as_str().unwrap_or_default();
        if object["namespace"] != namespace || !["create", "update", "patch", "delete"].contains(&verb) {
            continue;
        }
        let agent = entry["userAgent"].as_str().unwrap_or_default();
        let agent = agent.split('/').next().unwrap_or_default();
        if agent == USER_AGENT {
            continue;
        }
        let resource = object["resource"].as_str().unwrap_or_default();
        let part = object["subresource"]
            .as_str()
            .map(|part| format!("/{part}"))
            .unwrap_or_default();
        *writes
            .entry((agent.to_owned(), verb.to_owned(), format!("{resource}{part}")))
            .or_insert(0) += 1;
    }
    writes
}
