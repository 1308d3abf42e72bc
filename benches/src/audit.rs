//! What the API server's audit log shows of the operator: its requests by verb and resource, their times and bodies.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufRead, BufReader};
use std::path::Path;

use jiff::Timestamp;
use serde::Deserialize;
use serde_json::Value;

use crate::bench::Outcome;
use crate::servers::OPERATOR;

/// The process's own requests, which no submission causes.
const OF_THE_PROCESS: [&str; 3] = ["leases", "selfsubjectaccessreviews", "leaderboards"];
const READS: [&str; 3] = ["get", "list", "watch"];

/// A request of the operator.
#[derive(Deserialize, Clone, Debug)]
#[serde(rename_all = "camelCase")]
pub struct Entry {
    pub verb: String,
    #[serde(rename = "requestURI")]
    pub uri: String,
    #[serde(rename = "requestReceivedTimestamp")]
    pub received: Timestamp,
    #[serde(rename = "requestObject")]
    pub body: Option<Value>,
    user: User,
    object_ref: Option<ObjectRef>,
}

#[derive(Deserialize, Clone, Debug)]
struct User {
    username: String,
}

#[derive(Deserialize, Clone, Debug, Default)]
#[serde(default)]
struct ObjectRef {
    resource: String,
    subresource: Option<String>,
    name: String,
}

impl Entry {
    /// Resource, with the subresource behind a slash.
    pub fn resource(&self) -> String {
        let Some(object) = &self.object_ref else {
            return String::new();
        };
        let part = object.subresource.as_ref().map(|part| format!("/{part}"));
        format!("{}{}", object.resource, part.unwrap_or_default())
    }

    pub fn name(&self) -> &str {
        self.object_ref.as_ref().map_or("", |object| &object.name)
    }

    pub fn is_write(&self) -> bool {
        !READS.contains(&self.verb.as_str())
    }

    fn is_of_process(&self) -> bool {
        let object = self.object_ref.as_ref();
        object.is_some_and(|object| OF_THE_PROCESS.contains(&object.resource.as_str()))
    }
}

/// The operator's requests, oldest first.
pub fn read(log: &Path) -> Outcome<Vec<Entry>> {
    let mut found = Vec::new();
    for line in BufReader::new(File::open(log)?).lines() {
        let line = line?;
        // Most lines are others', and need not be read as JSON. The last line may be half written.
        if !line.contains("\"username\":\"operator\"") {
            continue;
        }
        let entry = serde_json::from_str::<Entry>(&line).ok();
        found.extend(entry.filter(|entry| entry.user.username == OPERATOR));
    }
    Ok(found)
}

/// Writes about submissions by verb and resource.
pub fn writes(entries: &[Entry]) -> BTreeMap<String, usize> {
    count(
        entries
            .iter()
            .filter(|entry| entry.is_write() && !entry.is_of_process()),
    )
}

/// All requests but watches, by verb and resource.
pub fn requests(entries: &[Entry]) -> BTreeMap<String, usize> {
    count(entries.iter().filter(|entry| entry.verb != "watch"))
}

fn count<'a>(entries: impl Iterator<Item = &'a Entry>) -> BTreeMap<String, usize> {
    let mut counts = BTreeMap::new();
    for entry in entries {
        *counts
            .entry(format!("{} {}", entry.verb, entry.resource()))
            .or_default() += 1;
    }
    counts
}

#[cfg(test)]
mod tests {
    use super::*;

    fn line(user: &str, verb: &str, resource: &str) -> String {
        format!(
            r#"{{"user":{{"username":"{user}"}},"verb":"{verb}","requestURI":"/x","requestReceivedTimestamp":"2026-01-01T00:00:00.5Z","objectRef":{{"resource":"{resource}","name":"n"}}}}"#
        )
    }

    #[test]
    fn only_the_operators_writes_about_submissions_are_counted() {
        let folder = tempfile::tempdir().unwrap();
        let log = folder.path().join("audit.log");
        let lines = [
            line("operator", "create", "jobs"),
            line("operator", "create", "jobs"),
            line("operator", "get", "nodes"),
            line("operator", "update", "leases"),
            line("bench", "create", "jobs"),
            r#"{"user":{"username":"operator"}"#.to_owned(),
        ];
        std::fs::write(&log, lines.join("\n")).unwrap();
        let entries = read(&log).unwrap();
        assert_eq!(entries.len(), 4);
        assert_eq!(writes(&entries), [("create jobs".to_owned(), 2)].into());
        assert_eq!(requests(&entries).values().sum::<usize>(), 4);
    }
}
